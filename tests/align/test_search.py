"""The search: evidence equals its definition, windows hold, and a shared part is enough."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.align.align import align_pair
from slamfusion.align.pair import Pair, displacement
from slamfusion.align.scores import FIELD_TOP
from slamfusion.align.search import (
    CANDIDATES,
    DOUBT,
    SETTLED,
    coarse_search,
    greatest_rows,
    score_motions,
    search,
)
from slamfusion.align.shifts import COARSE_SIGMA, SearchWindow, score_shifts
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.grid import OccupancyGrid
from tests.align.definitions import evidence_of, level_side, side_of
from tests.fusion.drawings import (
    assert_right,
    building,
    building_parts,
    degraded,
    features_of,
    random_cells,
    random_grid,
)

CONFIG = AlignConfig()
OPEN = SearchWindow()


def in_level(motion: np.ndarray, step: int) -> np.ndarray:
    return motion / np.array([step, step, 1.0])


def fine_grid(seed: int) -> OccupancyGrid:
    """A random place of cells of 5 cm: coarse levels are not the last, so there is a descent."""
    return OccupancyGrid(random_cells(seed, 90, 110), 0.05, name=f"fine {seed}")


@pytest.mark.parametrize("seed", range(4))
def test_the_evidence_of_motions_equals_its_definition(device: ComputeDevice, seed: int) -> None:
    ref, mov = (features_of(random_grid(seed + k), device) for k in (0, 60))
    rng = np.random.default_rng(seed)
    motions = np.column_stack((rng.uniform(-5, 50, (30, 2)), rng.uniform(-4, 4, 30)))
    found = score_motions(Pair(ref, mov), motions, 1, sigma=1.5)
    a, b = side_of(ref, 1.5, FIELD_TOP), side_of(mov, 1.5, FIELD_TOP)
    cells = len(a.points) + len(b.points)
    for motion, score in zip(motions, found, strict=True):
        assert score == pytest.approx(evidence_of(a, b, motion), abs=1e-9)
        assert abs(score - evidence_of(a, b, motion, exact=True)) < 0.51 * a.unit * cells


def test_the_evidence_on_a_level_equals_its_definition(device: ComputeDevice) -> None:
    ref, mov = (features_of(random_grid(seed), device) for seed in (8, 9))
    rng = np.random.default_rng(3)
    motions = np.column_stack((rng.uniform(-5, 50, (30, 2)), rng.uniform(-4, 4, 30)))
    found = score_motions(Pair(ref, mov), motions, 3, sigma=COARSE_SIGMA)
    a, b = (level_side(grid, 3, COARSE_SIGMA, FIELD_TOP) for grid in (ref, mov))
    wanted = [evidence_of(a, b, in_level(motion, 3)) for motion in motions]
    assert found == pytest.approx(np.array(wanted), abs=1e-9)


def test_evidence_is_the_same_seen_from_either_grid(device: ComputeDevice) -> None:
    a, b = features_of(building(3), device), features_of(building(4), device)
    motion = np.array([40.3, 31.7, 0.4])
    cos, sin = math.cos(-motion[2]), math.sin(-motion[2])
    x, y = np.array(a.centre) - motion[:2]
    own = b.centre
    back = np.array([[cos * x - sin * y + own[0], sin * x + cos * y + own[1], -motion[2]]])
    forth = score_motions(Pair(a, b), motion[None], 1, sigma=1.5)
    assert forth == pytest.approx(score_motions(Pair(b, a), back, 1, sigma=1.5), abs=1e-6)


def narrow_evidence(pair: Pair, motions: np.ndarray) -> np.ndarray:
    """The evidence of all walls by the narrow width."""
    return score_motions(pair, motions, 1, sigma=pair.widths[0])


def test_peaks_are_distinct_best_first_and_each_with_its_evidence(device: ComputeDevice) -> None:
    config = AlignConfig(coarse_cells=16)
    ref, mov = (features_of(fine_grid(seed), device) for seed in (51, 52))
    found = coarse_search(Pair(ref, mov), config, OPEN)
    assert found.step > found.last_step == 4
    # Up to half as many more: those that leave least unexplained.
    assert CANDIDATES <= len(found.motions) <= CANDIDATES * 3 // 2
    a, b = (level_side(grid, 4, COARSE_SIGMA, FIELD_TOP) for grid in (ref, mov))
    wanted = [evidence_of(a, b, in_level(motion, 4)) for motion in found.motions]
    assert np.all(np.diff(wanted) <= 1e-9)
    yaw_step = score_shifts(Pair(ref, mov), found.step, OPEN).yaw_step
    # The best lie apart, and so do those that leave least: at most two lie beside each other.
    for motion in found.motions:
        beside = 0
        for other in found.motions:
            shift, turn = displacement(motion, other)
            beside += shift < 2.5 * found.step and turn < 2.5 * yaw_step
        assert beside <= 3
    assert len(np.unique(found.motions, axis=0)) == len(found.motions)


def test_the_window_limits_shift_and_yaw(device: ComputeDevice) -> None:
    grid = features_of(building(1), device)
    start = (grid.centre[0] + 9.0, grid.centre[1] - 5.0, 0.5)
    window = SearchWindow(start, 6.0, 0.2)
    found = coarse_search(Pair(grid, grid), CONFIG, window)
    assert np.abs(found.yaws - 0.5).max() == pytest.approx(0.2)
    assert np.isclose(found.yaws, 0.5).any(), "the start itself is tried"
    step = found.step
    assert np.abs(found.motions[:, :2] - np.array(start[:2])).max() <= 6.0 + step
    assert np.abs(found.motions[:, 2] - 0.5).max() <= 0.2 + 1e-9


def test_answers_lie_inside_the_window(device: ComputeDevice) -> None:
    """The true motion lies outside: the search gives others, or none, but not that one."""
    grid = features_of(building(1), device)
    window = SearchWindow((grid.centre[0] + 14.0, grid.centre[1], 0.3), 8.0, 0.2)
    _, motions = search(Pair(grid, grid), CONFIG, window)
    assert np.abs(motions[:, :2] - window.start[:2]).max(initial=0.0) <= 8.0 + 2.0
    assert np.abs(motions[:, 2] - 0.3).max(initial=0.0) <= 0.2 + math.radians(1.0)


@pytest.mark.parametrize("cells", [72, 28])
@pytest.mark.parametrize("seed", range(6))
def test_a_motion_with_an_overlap_of_a_third_is_found(
    device: ComputeDevice, seed: int, cells: int
) -> None:
    west, east, pose = building_parts(seed, 0.3, yaw_rad=1.9 * seed - 4.0)
    ref, mov = features_of(west, device), features_of(east, device)
    wanted = Pair(ref, mov).motion_of(pose)
    config = AlignConfig(coarse_cells=cells)
    coarse, motions = search(Pair(ref, mov), config, OPEN)
    evidence = narrow_evidence(Pair(ref, mov), motions)
    assert (coarse.step > coarse.last_step) == (cells == 28), "there was a descent"
    away = [displacement(motion, wanted) for motion in coarse.motions]
    assert any(shift < 2.0 * coarse.last_step and turn < 0.06 for shift, turn in away)
    # Rooms of one size fit on each other: another motion may have more evidence, never the less.
    own = narrow_evidence(Pair(ref, mov), wanted[None])[0]
    away = [displacement(motion, wanted) for motion in motions]
    right = [shift < 1.5 and turn < math.radians(1.0) for shift, turn in away].index(True)
    assert evidence[right] > 0.99 * own > 500.0
    assert np.all(np.diff(evidence) <= 0)


def test_a_small_common_ground_is_found_beside_a_large_one_that_fits_badly(
    device: ComputeDevice,
) -> None:
    """Eight motions have more evidence than the right one, all of them with more unexplained."""
    west, east, pose = building_parts(4, 0.15, yaw_rad=1.2)
    ref, mov = features_of(west, device), features_of(east, device)
    _, motions = search(Pair(ref, mov), CONFIG, OPEN)
    evidence = narrow_evidence(Pair(ref, mov), motions)
    away = [displacement(motion, Pair(ref, mov).motion_of(pose))[0] for motion in motions]
    right = int(np.argmin(away))
    assert away[right] < 1.5
    assert right >= SETTLED[0]
    doubted = score_motions(Pair(ref, mov), motions, 1, sigma=Pair(ref, ref).widths[0], doubt=DOUBT)
    assert doubted[right] > 0.9 * doubted.max()
    assert evidence[right] < 0.9 * evidence[0]


def test_what_a_quick_search_misses_a_thorough_one_finds(device: ComputeDevice) -> None:
    """On cells of 1.5 m the walls of this building are everywhere."""
    truth = building(2, 36.0, 27.0, 0.05)
    moving, pose = degraded(truth, 2, "moving", yaw_rad=1.1, flip_share=0.05)
    pair = features_of(truth, device), features_of(moving, device)
    config = AlignConfig(coarse_cells=16)
    assert not align_pair(Pair(*pair), config, thorough=False).accepted
    found = align_pair(Pair(*pair), config)
    assert found.accepted, found.reason
    assert_right(found, moving, pose)


@pytest.mark.parametrize("most", [1, 40, 700])
@pytest.mark.parametrize("kind", ["few values", "sorted", "the sample lies low", "high"])
def test_the_greatest_are_the_first_of_a_stable_sort(kind: str, most: int):
    values = np.random.default_rng(most).integers(0, 300, 2000).astype(np.float64)
    if kind == "sorted":
        values.sort()
    elif kind != "few values":
        values[::16] = 1e6 if kind == "high" else -1.0
    expected = np.argsort(-values, kind="stable")[:most]
    np.testing.assert_array_equal(greatest_rows(values, most), expected)
    np.testing.assert_array_equal(
        greatest_rows(values[:30], most), np.argsort(-values[:30], kind="stable")[:most]
    )
