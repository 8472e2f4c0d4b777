"""Mirrored maps are refused by name, and only those; what needs no look at an image gets none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.align.align import align_features
from slamfusion.align.mirror import mirror_gain, mirror_image
from slamfusion.align.records import Alignment
from slamfusion.align.search import search, wall_widths
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig, FusionConfig
from slamfusion.errors import AlignmentError
from slamfusion.fusion import align, fuse_grids, groups, judge
from slamfusion.grid import UNKNOWN, OccupancyGrid
from tests.fusion.drawings import building, degraded, draw, features_of, picture_of
from tests.fusion.live.maps import mirrored, transposed, trio

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

CONFIG = AlignConfig()


def aligned(reference: OccupancyGrid, moving: OccupancyGrid, device: ComputeDevice) -> Alignment:
    a, b = features_of(reference, device), features_of(moving, device)
    return align_features(a, b, CONFIG, device)


def test_an_image_is_the_map_upside_down(device: ComputeDevice) -> None:
    grid = draw("#..\n#. \n###")
    image = mirror_image(features_of(grid, device), device)
    assert picture_of(image.grid.cells) == ["###", "#. ", "#.."]
    assert np.array_equal(image.grid.grid.cells, grid.cells[::-1])
    assert image.grid.grid.origin == grid.origin
    assert image.grid.grid.resolution == grid.resolution


@pytest.mark.parametrize("wrong", [mirrored, transposed])
@pytest.mark.parametrize("is_moving", [True, False])
def test_a_mirrored_or_transposed_map_is_refused_by_name(
    device: ComputeDevice, wrong: object, *, is_moving: bool
) -> None:
    assert callable(wrong)
    a, b = trio()["a"], trio()["b"]
    found = aligned(a, wrong(b), device) if is_moving else aligned(wrong(a), b, device)
    assert not found.accepted
    assert found.decision == "mirrored"
    assert "a map mirrored or transposed?" in found.reason
    assert found.evidence is not None
    assert found.evidence.mirrored is not None
    assert found.evidence.mirrored > 1.3
    assert f"{found.evidence.mirrored:.1f} times" in found.reason


def test_the_image_of_a_mirrored_map_is_the_map(device: ComputeDevice) -> None:
    """What it gains is what the right pair loses by its own image."""
    a, b = features_of(trio()["a"], device), features_of(trio()["b"], device)
    wrong = features_of(mirrored(trio()["b"]), device)
    sigma = wall_widths(a)[0]
    gains = []
    for moving in (b, wrong):
        _, motions, _ = search(a, moving, CONFIG, SearchWindow(), device)
        gain = mirror_gain(a, moving, motions[0], CONFIG, sigma, device)
        assert gain is not None
        gains.append(gain)
    assert gains[0] < 0.8
    assert gains[1] == pytest.approx(1.0 / gains[0], rel=0.05)


def test_what_nothing_speaks_for_has_no_gain(device: ComputeDevice) -> None:
    a, b = features_of(trio()["a"], device), features_of(trio()["b"], device)
    away = np.array([9000.0, 9000.0, 0.3])
    assert mirror_gain(a, b, away, CONFIG, wall_widths(a)[0], device) is None


def half(grid: OccupancyGrid, low: float, high: float) -> OccupancyGrid:
    """Return what lies between two shares of a grid's width, the rest unknown."""
    cells = grid.cells.copy()
    width = cells.shape[1]
    cells[:, : round(low * width)] = UNKNOWN
    cells[:, round(high * width) :] = UNKNOWN
    return replace(grid, cells=cells)


def test_what_is_refused_is_named_if_its_image_would_be_believed(device: ComputeDevice) -> None:
    """A mirrored half fits nowhere itself; its image does."""
    place = building(4, 14.0, 9.0, 0.05)
    low, high = half(place, 0.0, 0.65).with_name("low"), half(place, 0.35, 1.0).with_name("high")
    right = aligned(low, high, device)
    assert right.accepted, right.reason
    found = aligned(low, mirrored(high), device)
    assert found.decision == "mirrored"
    assert found.evidence is not None
    assert found.evidence.mirrored is not None
    assert found.evidence.mirrored > 1.0
    unnamed = align_features(
        features_of(low, device),
        features_of(mirrored(high), device),
        CONFIG,
        device,
        thorough=False,
    )
    assert not unnamed.accepted
    assert unnamed.decision != "mirrored"


@pytest.mark.parametrize(("most", "is_named"), [(1, True), (0, False)])
def test_jobs_of_many_pairs_search_what_is_refused_once(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, most: int, *, is_named: bool
) -> None:
    place = building(4, 14.0, 9.0, 0.05)
    low, high = half(place, 0.0, 0.65).with_name("low"), half(place, 0.35, 1.0).with_name("high")
    monkeypatch.setattr(groups, "THOROUGH_PAIRS", most)
    with pytest.raises(AlignmentError) as failure:
        fuse_grids([low, mirrored(high)], FusionConfig(align=CONFIG), device)
    (pair,) = failure.value.pairs
    assert (pair.decision == "mirrored") == is_named


def test_another_building_is_no_mirror_image(device: ComputeDevice) -> None:
    refused = aligned(trio()["a"], building(4, 12.0, 8.0, 0.05), device)
    assert not refused.accepted
    assert refused.decision != "mirrored"
    assert refused.evidence is not None
    assert refused.evidence.mirrored is None


@pytest.mark.parametrize(
    ("coarse_cells", "looks"), [(64, [True]), (24, [False, True])], ids=["finest", "coarse"]
)
def test_what_is_refused_is_judged_again_only_after_a_finer_search(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, coarse_cells: int, looks: list[bool]
) -> None:
    looked: list[bool] = []

    def judged(*arguments: object) -> Alignment:
        looked.extend(bool(item.image_after) for item in arguments if isinstance(item, judge.Found))
        return judge.judge(*arguments)

    monkeypatch.setattr(align, "judge", judged)
    pair = [features_of(building(seed, 11.0, 9.0, 0.05), device) for seed in (3, 5)]
    assert not align_features(*pair, replace(CONFIG, coarse_cells=coarse_cells), device).accepted
    assert looked == looks


def test_what_is_sure_is_not_searched_again(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[str] = []

    def looked(*arguments: object, **named: object) -> float | None:
        looks.append("a look")
        return mirror_gain(*arguments, **named)

    monkeypatch.setattr(judge, "mirror_gain", looked)
    sure = aligned(trio()["a"], trio()["b"], device)
    assert sure.accepted
    assert sure.evidence is not None
    assert sure.evidence.share >= 0.9
    assert sure.evidence.mirrored is None
    assert not looks
    # Walls of half the thickness are no less right, but not sure.
    faint, _ = degraded(trio()["a"], 3, "faint", yaw_rad=0.6, wall_change_cells=1, flip_share=0.05)
    found = aligned(trio()["a"], faint, device)
    assert found.accepted, found.reason
    assert found.evidence is not None
    assert found.evidence.share < 0.9
    assert found.evidence.mirrored is not None
    assert 0.0 < found.evidence.mirrored < 1.0
    assert looks == ["a look"]
