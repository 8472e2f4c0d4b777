"""Mirrored maps are refused, and only those."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig, NormalizeConfig
from slamfusion.fusion.align import align_features
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


@pytest.mark.parametrize("above", [True, False])
def test_both_sides_of_what_the_mirror_image_must_gain(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, *, above: bool
) -> None:
    pair, a, b = pair_of(trio()["b"], device)
    believed = replace(pair, accepted=True, score=0.5)
    gained = 0.5 + GAIN_MIN + (1e-9 if above else -1e-9)
    monkeypatch.setattr(
        mirror, "align_features", lambda *_, **__: replace(pair, score=gained, accepted=False)
    )
    assert refuse_mirrored(believed, a, b, CONFIG, device).accepted is not above


def test_what_was_refused_or_is_sure_is_not_searched_again(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair, a, b = pair_of(trio()["b"], device)

    def search(*_: object, **__: object) -> None:
        pytest.fail("a second search")

    monkeypatch.setattr(mirror, "align_features", search)
    for known in (replace(pair, accepted=False), replace(pair, accepted=True, score=SURE_SCORE)):
        assert refuse_mirrored(known, a, b, CONFIG, device) is known
