"""Mirrored maps are refused, and only those."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig, NormalizeConfig
from slamfusion.fusion.align import align_features, rejected_alignment
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.live import mirror
from slamfusion.fusion.live.mirror import GAIN_MIN, SURE_SCORE, refuse_mirrored
from slamfusion.fusion.normalize import normalize_grid
from slamfusion.fusion.records import Alignment
from slamfusion.grid import OccupancyGrid
from tests.fusion.live.maps import mirrored, transposed, trio

CONFIG = AlignConfig(prove=False)


def features(grid: OccupancyGrid, device: ComputeDevice) -> GridFeatures:
    return GridFeatures(normalize_grid(grid, 0.05, NormalizeConfig(), device), device)


def pair_of(
    moving: OccupancyGrid, device: ComputeDevice
) -> tuple[Alignment, GridFeatures, GridFeatures]:
    a, b = features(trio()["a"], device), features(moving, device)
    return align_features(a, b, CONFIG, device), a, b


def test_a_mirrored_or_transposed_map_is_refused_and_the_right_one_is_not(
    device: ComputeDevice,
) -> None:
    right, a, b = pair_of(trio()["b"], device)
    assert right.accepted
    assert refuse_mirrored(right, a, b, CONFIG, device) is right
    for wrong in (mirrored, transposed):
        pair, a, b = pair_of(wrong(trio()["b"]), device)
        believed = replace(pair, accepted=True)
        looked = refuse_mirrored(believed, a, b, CONFIG, device)
        assert not looked.accepted
        assert "mirrored or transposed" in looked.reason


@pytest.mark.parametrize(
    ("gain", "is_refused"),
    [(0.047, False), (GAIN_MIN - 1e-9, False), (GAIN_MIN, True), (0.053, True), (-0.4, False)],
)
def test_both_sides_of_what_the_mirror_image_must_gain(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, gain: float, is_refused: bool
) -> None:
    pair, a, b = pair_of(trio()["b"], device)
    believed = replace(pair, accepted=True, score=0.5)
    better = replace(pair, score=0.5 + gain, accepted=False)
    monkeypatch.setattr(mirror, "align_features", lambda *_, **__: better)
    assert refuse_mirrored(believed, a, b, CONFIG, device).accepted is not is_refused


@pytest.mark.parametrize(
    ("score", "is_searched"), [(0.85, True), (0.95, False), (SURE_SCORE, False)]
)
def test_the_mirror_image_alone_is_searched_everywhere_unless_the_fit_is_sure(
    monkeypatch: pytest.MonkeyPatch, twins: ComputeDevice, score: float, is_searched: bool
) -> None:
    grid = trio()["b"]
    own = features(grid, twins)
    pair = rejected_alignment(own, own, "", 0.0)
    searched: list[tuple[GridFeatures, GridFeatures, AlignConfig]] = []

    def search(
        reference: GridFeatures, moving: GridFeatures, config: AlignConfig, *_: object, **__: object
    ) -> Alignment:
        searched.append((reference, moving, config))
        return pair

    monkeypatch.setattr(mirror, "align_features", search)
    narrow = AlignConfig(window_m=1.0, window_yaw_rad=0.1, shared_frame=True, prove=True)
    believed = replace(pair, accepted=True, score=score)
    assert refuse_mirrored(believed, own, own, narrow, twins) is believed
    assert len(searched) == is_searched
    for reference, moving, config in searched:
        assert reference is own
        assert np.array_equal(moving.grid.cells, np.flipud(own.grid.cells))
        assert np.array_equal(moving.grid.solid, np.flipud(own.grid.solid))
        assert np.array_equal(moving.grid.grid.cells, np.flipud(own.grid.grid.cells))
        assert (config.prove, config.shared_frame) == (False, False)
        assert (config.window_m, config.window_yaw_rad) == (None, math.pi)


def test_what_was_refused_or_is_sure_is_not_searched_again(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair, a, b = pair_of(trio()["b"], device)

    def search(*_: object, **__: object) -> None:
        pytest.fail("a second search")

    monkeypatch.setattr(mirror, "align_features", search)
    for known in (replace(pair, accepted=False), replace(pair, accepted=True, score=SURE_SCORE)):
        assert refuse_mirrored(known, a, b, CONFIG, device) is known
