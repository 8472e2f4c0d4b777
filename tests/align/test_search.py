"""The search: evidence equals its definition, windows hold, and a shared part is enough."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.align.align import align_features
from slamfusion.align.features import spread_sample
from slamfusion.align.frames import motion_of
from slamfusion.align.motions import displacement
from slamfusion.align.search import (
    DOUBT,
    FINE_TOP,
    FINER_CHANCE_MAX,
    SAMPLED,
    SETTLED,
    coarse_search,
    coarse_step,
    greatest_rows,
    inside,
    score_motions,
    search,
    wall_widths,
)
from slamfusion.align.shifts import (
    COARSE_SIGMA,
    COARSE_TOP,
    SearchWindow,
    score_shifts,
    shift_work,
)
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
# No turn of these is a multiple of 45 degrees, where rounding would decide.
START_YAW = 0.1234
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
    found = score_motions(ref, mov, motions, 1, device, sigma=1.5)
    a, b = side_of(ref, 1.5, FINE_TOP), side_of(mov, 1.5, FINE_TOP)
    cells = len(a.points) + len(b.points)
    for motion, score in zip(motions, found, strict=True):
        assert score == pytest.approx(evidence_of(a, b, motion), abs=1e-9)
        assert abs(score - evidence_of(a, b, motion, exact=True)) < 0.51 * a.unit * cells


def test_the_evidence_on_a_level_equals_its_definition(device: ComputeDevice) -> None:
    ref, mov = (features_of(random_grid(seed), device) for seed in (8, 9))
    rng = np.random.default_rng(3)
    motions = np.column_stack((rng.uniform(-5, 50, (30, 2)), rng.uniform(-4, 4, 30)))
    found = score_motions(ref, mov, motions, 3, device, sigma=COARSE_SIGMA)
    a, b = (level_side(grid, 3, COARSE_SIGMA, FINE_TOP) for grid in (ref, mov))
    wanted = [evidence_of(a, b, in_level(motion, 3)) for motion in motions]
    assert found == pytest.approx(np.array(wanted), abs=1e-9)


def test_each_point_of_a_sample_stands_for_its_share_of_the_walls(device: ComputeDevice) -> None:
    grid = features_of(building(3), device)
    answer = np.array([[*grid.centre, 0.0], [*grid.centre, 1.0]])
    full, some = (
        score_motions(grid, grid, answer, 1, device, sigma=1.5, points=points)
        for points in (4096, len(grid.level(1).points) // 3)
    )
    assert some[0] == pytest.approx(full[0])
    assert some[1] == pytest.approx(full[1], abs=0.1 * full[0])


def test_evidence_is_the_same_seen_from_either_grid(device: ComputeDevice) -> None:
    a, b = features_of(building(3), device), features_of(building(4), device)
    motion = np.array([40.3, 31.7, 0.4])
    cos, sin = math.cos(-motion[2]), math.sin(-motion[2])
    x, y = np.array(a.centre) - motion[:2]
    own = b.centre
    back = np.array([[cos * x - sin * y + own[0], sin * x + cos * y + own[1], -motion[2]]])
    forth = score_motions(a, b, motion[None], 1, device, sigma=1.5)
    assert forth == pytest.approx(score_motions(b, a, back, 1, device, sigma=1.5), abs=1e-6)


def test_without_a_descent_the_peaks_are_those_of_the_shifts(device: ComputeDevice) -> None:
    ref, mov = (features_of(random_grid(seed, 20, 32), device) for seed in (21, 22))
    window = SearchWindow((0.0, 0.0, START_YAW))
    found = coarse_search(ref, mov, CONFIG, window, device)
    assert found.step == found.last_step == 1
    scores = score_shifts(ref, mov, 1, window, device)
    assert found.evidence[0] == scores.evidence.max()
    assert np.array_equal(found.best, scores.evidence.max(axis=1) / scores.evidence.max())
    a, b = (level_side(grid, 1, COARSE_SIGMA, COARSE_TOP) for grid in (ref, mov))
    wanted = [evidence_of(a, b, motion) for motion in found.motions]
    assert found.evidence == pytest.approx(np.array(wanted), abs=1e-9)


def test_peaks_are_distinct_best_first_and_each_with_its_evidence(device: ComputeDevice) -> None:
    config = AlignConfig(coarse_cells=16, candidates=9)
    ref, mov = (features_of(fine_grid(seed), device) for seed in (51, 52))
    found = coarse_search(ref, mov, config, OPEN, device)
    assert found.step > found.last_step == 4
    # Up to half as many more: those that leave least unexplained.
    assert 9 <= len(found.motions) <= 9 + 4
    assert found.evidence.shape == found.motions.shape[:1]
    assert np.all(np.diff(found.evidence) <= 0)
    a, b = (level_side(grid, 4, COARSE_SIGMA, FINE_TOP) for grid in (ref, mov))
    wanted = [evidence_of(a, b, in_level(motion, 4)) for motion in found.motions]
    assert found.evidence == pytest.approx(np.array(wanted), abs=1e-9)
    yaw_step = score_shifts(ref, mov, found.step, OPEN, device).yaw_step
    # The best lie apart, and so do those that leave least: at most two lie beside each other.
    for motion in found.motions:
        beside = 0
        for other in found.motions:
            shift, turn = displacement(motion, other)
            beside += shift < 2.5 * found.step and turn < 2.5 * yaw_step
        assert beside <= 3
    assert len(np.unique(found.motions, axis=0)) == len(found.motions)


def test_the_descent_never_loses_evidence(device: ComputeDevice) -> None:
    """The best peak is no worse on the last level than where it came from."""
    config = AlignConfig(coarse_cells=16)
    ref, mov = (features_of(fine_grid(seed), device) for seed in (53, 53))
    found = coarse_search(ref, mov, config, OPEN, device)
    scores = score_shifts(ref, mov, found.step, OPEN, device)
    top = scores.motions(scores.evidence.argmax()[None])
    last = found.last_step
    assert found.evidence[0] >= score_motions(ref, mov, top, last, device, sigma=COARSE_SIGMA)[0]


def test_shares_of_yaws_are_of_the_best_and_never_below_nothing(device: ComputeDevice) -> None:
    """In a window in which everything speaks against, no yaw has a share of anything."""
    room = np.full((60, 60), 100, dtype=np.int8)
    room[1:-1, 1:-1] = 0
    pillar = np.full((12, 12), -1, dtype=np.int8)
    pillar[2:10, 2:10] = 0
    pillar[5:7, 4:8] = 100
    ref, mov = (features_of(OccupancyGrid(cells, 0.1), device) for cells in (room, pillar))
    found = coarse_search(ref, mov, CONFIG, SearchWindow((*ref.centre, 0.0), 3.0, 0.5), device)
    assert found.evidence[0] < 0
    assert np.all(found.best == 0.0)
    found = coarse_search(ref, ref, CONFIG, OPEN, device)
    assert found.best.max() == 1.0
    assert found.best.min() >= 0.0


def test_the_window_limits_shift_and_yaw(device: ComputeDevice) -> None:
    grid = features_of(building(1), device)
    start = (grid.centre[0] + 9.0, grid.centre[1] - 5.0, 0.5)
    window = SearchWindow(start, 6.0, 0.2)
    found = coarse_search(grid, grid, CONFIG, window, device)
    assert np.abs(found.yaws - 0.5).max() == pytest.approx(0.2)
    assert np.isclose(found.yaws, 0.5).any(), "the start itself is tried"
    step = found.step
    assert np.abs(found.motions[:, :2] - np.array(start[:2])).max() <= 6.0 + step
    assert np.abs(found.motions[:, 2] - 0.5).max() <= 0.2 + 1e-9


def test_the_descent_leaves_the_window_by_less_than_a_cell_and_a_turn(
    device: ComputeDevice,
) -> None:
    config = AlignConfig(coarse_cells=16)
    ref, mov = (features_of(fine_grid(seed), device) for seed in (51, 52))
    window = SearchWindow((50.3, 40.2, 1.0), 10.0, 0.3)
    found = coarse_search(ref, mov, config, window, device)
    yaw_step = score_shifts(ref, mov, found.step, window, device).yaw_step
    assert np.abs(found.motions[:, :2] - (50.3, 40.2)).max() < 10.0 + 2.0 * found.step
    assert np.abs(found.motions[:, 2] - 1.0).max() < 0.3 + yaw_step


def test_a_window_without_yaw_tries_the_start_alone(device: ComputeDevice) -> None:
    grid = features_of(building(1), device)
    window = SearchWindow((*grid.centre, 0.25), 5.0, 0.0)
    assert coarse_search(grid, grid, CONFIG, window, device).yaws.tolist() == [0.25]


def test_answers_lie_inside_the_window(device: ComputeDevice) -> None:
    """The true motion lies outside: the search gives others, or none, but not that one."""
    grid = features_of(building(1), device)
    window = SearchWindow((grid.centre[0] + 14.0, grid.centre[1], 0.3), 8.0, 0.2)
    _, motions, evidence = search(grid, grid, CONFIG, window, device)
    assert len(motions) == len(evidence)
    assert np.abs(motions[:, :2] - window.start[:2]).max(initial=0.0) <= 8.0 + 2.0
    assert np.abs(motions[:, 2] - 0.3).max(initial=0.0) <= 0.2 + math.radians(1.0)


def test_what_is_inside_a_window_is_known_by_both_its_limits() -> None:
    window = SearchWindow((10.0, 20.0, math.pi), 5.0, 0.1)
    motions = np.array(
        [
            [10.0, 20.0, -math.pi],
            [16.9, 13.1, math.pi + 0.11],
            [17.1, 20.0, math.pi],
            [10.0, 12.9, math.pi],
            [10.0, 20.0, math.pi + 0.12],
        ]
    )
    assert inside(window, motions).tolist() == motions[:2].tolist()
    assert len(inside(OPEN, motions)) == 5


@pytest.mark.parametrize(("first", "second", "cells"), [(41, 42, 48), (43, 43, 16), (44, 41, 20)])
def test_the_twins_find_the_same_coarse_peaks(
    device: ComputeDevice, twins: ComputeDevice, first: int, second: int, cells: int
) -> None:
    config = AlignConfig(coarse_cells=cells)
    window = SearchWindow((12.0, 12.0, START_YAW), 8.0)
    found = []
    for on_device in (device, twins):
        ref, mov = (features_of(random_grid(seed, 20, 32), on_device) for seed in (first, second))
        found.append(coarse_search(ref, mov, config, window, on_device))
    a, b = found
    assert a.step == b.step
    for name in ("yaws", "best", "motions", "evidence"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


def test_the_twins_go_down_alike(device: ComputeDevice, twins: ComputeDevice) -> None:
    config = AlignConfig(coarse_cells=16)
    window = SearchWindow((50.3, 40.2, START_YAW), 8.0, 0.3)
    found = []
    for on_device in (device, twins):
        ref, mov = (features_of(fine_grid(seed), on_device) for seed in (51, 52))
        found.append(coarse_search(ref, mov, config, window, on_device))
    a, b = found
    assert a.step == b.step > a.last_step == b.last_step
    for name in ("yaws", "best", "motions", "evidence"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


def test_the_twins_find_the_same_answer(device: ComputeDevice, twins: ComputeDevice) -> None:
    answers = []
    for on_device in (device, twins):
        grid = features_of(random_grid(45, 24, 30), on_device)
        window = SearchWindow((*grid.centre, 0.0), 6.0, 0.3)
        answers.append(search(grid, grid, CONFIG, window, on_device))
    assert np.allclose(answers[0][1][0], answers[1][1][0], atol=1e-3)
    assert answers[0][2][0] == pytest.approx(answers[1][2][0], rel=2e-3)


@pytest.mark.parametrize("cells", [72, 28])
@pytest.mark.parametrize("seed", range(6))
def test_a_motion_with_an_overlap_of_a_third_is_found(
    device: ComputeDevice, seed: int, cells: int
) -> None:
    west, east, pose = building_parts(seed, 0.3, yaw_rad=1.9 * seed - 4.0)
    ref, mov = features_of(west, device), features_of(east, device)
    wanted = motion_of(ref, mov, pose)
    config = AlignConfig(coarse_cells=cells)
    coarse, motions, evidence = search(ref, mov, config, OPEN, device)
    assert (coarse.step > coarse.last_step) == (cells == 28), "there was a descent"
    away = [displacement(motion, wanted) for motion in coarse.motions]
    assert any(shift < 2.0 * coarse.last_step and turn < 0.06 for shift, turn in away)
    # Rooms of one size fit on each other: another motion may have more evidence, never the less.
    own = score_motions(ref, mov, wanted[None], 1, device, sigma=wall_widths(ref)[0])[0]
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
    _, motions, evidence = search(ref, mov, CONFIG, OPEN, device)
    away = [displacement(motion, motion_of(ref, mov, pose))[0] for motion in motions]
    right = int(np.argmin(away))
    assert away[right] < 1.5
    assert right >= SETTLED[0]
    doubted = score_motions(ref, mov, motions, 1, device, sigma=wall_widths(ref)[0], doubt=DOUBT)
    assert doubted[right] > 0.9 * doubted.max()
    assert evidence[right] < 0.9 * evidence[0]


def test_widths_of_a_wall_are_metres_but_some_cells_at_least(device: ComputeDevice) -> None:
    cells = random_cells(3)
    for size, widths in ((0.05, (3.0, 9.0)), (0.1, (1.5, 4.5)), (0.2, (1.5, 2.25))):
        grid = features_of(OccupancyGrid(cells, size), device)
        assert wall_widths(grid) == pytest.approx(widths)


@pytest.mark.parametrize("spacing", [3, 4, 6, 9, 12, 30])
def test_the_coarse_step_is_the_first_that_is_fine_enough(
    device: ComputeDevice, spacing: int
) -> None:
    """Two thirds of it again and again while walls are too near, but never four times finer."""
    striped = np.zeros((192, 192), dtype=np.int8)
    striped[::spacing] = 100
    features = features_of(OccupancyGrid(striped, 0.1), device)
    longest = max(features.shape)
    wanted, finest = math.ceil(longest / 16), math.ceil(longest / 64)
    while wanted > finest and features.chance(wanted, COARSE_SIGMA) > 0.8:
        wanted = max(finest, 2 * wanted // 3)
    assert coarse_step(features, features, 16, OPEN) == wanted
    plain = features_of(building(1), device)
    assert (
        coarse_step(plain, features, 16, OPEN) == coarse_step(features, plain, 16, OPEN) <= wanted
    )


def test_a_search_that_takes_longer_begins_on_a_finer_level(device: ComputeDevice) -> None:
    grid = features_of(building(3, 11.0, 9.0, 0.05), device)
    usual = coarse_step(grid, grid, 24, OPEN)
    finer = coarse_step(grid, grid, 24, OPEN, chance=FINER_CHANCE_MAX)
    assert grid.chance(usual, COARSE_SIGMA) > FINER_CHANCE_MAX
    assert finer < usual
    window = SearchWindow((*grid.centre, 0.0), 20.0, 0.2)
    config = replace(CONFIG, coarse_cells=24)
    coarse, _, _ = search(grid, grid, config, window, device, chance=FINER_CHANCE_MAX)
    assert coarse.step == finer
    assert coarse_search(grid, grid, config, window, device).step == usual


def test_what_a_quick_search_misses_a_thorough_one_finds(device: ComputeDevice) -> None:
    """On cells of 1.5 m the walls of this building are everywhere."""
    truth = building(2, 36.0, 27.0, 0.05)
    moving, pose = degraded(truth, 2, "moving", yaw_rad=1.1, flip_share=0.05)
    pair = features_of(truth, device), features_of(moving, device)
    config = AlignConfig(coarse_cells=16)
    assert not align_features(*pair, config, device, thorough=False).accepted
    found = align_features(*pair, config, device)
    assert found.accepted, found.reason
    assert_right(found, moving, pose)


def test_the_coarse_step_follows_the_longest_side_and_shrinks_where_walls_fill_the_cells(
    device: ComputeDevice,
) -> None:
    plain = features_of(building(1), device)
    assert coarse_step(plain, plain, 48, OPEN) == math.ceil(max(plain.shape) / 48)
    striped = np.zeros((96, 96), dtype=np.int8)
    striped[::3] = 100
    features = features_of(OccupancyGrid(striped, 0.1), device)
    step = coarse_step(features, features, 16, OPEN)
    assert step < math.ceil(max(features.shape) / 16)


def test_spread_sample_takes_every_part_of_the_points() -> None:
    points = np.stack((np.arange(1000), np.arange(1000)), axis=1).astype(np.int32)
    sample = spread_sample(points, 64)
    assert len(sample) == 64
    assert np.diff(sample[:, 0]).max() <= math.ceil(1000 / 64)
    assert spread_sample(points, 1000) is points


def test_a_level_that_takes_too_long_is_not_searched(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a map of noise walls are everywhere, on each level."""
    noise = np.where(np.random.default_rng(1).random((200, 200)) < 0.4, 100, 0).astype(np.int8)
    grid = features_of(OccupancyGrid(noise, 0.1), device)
    finest, coarsest = (math.ceil(200 / cells) for cells in (4 * 20, 20))
    assert coarse_step(grid, grid, 20, OPEN) == finest
    monkeypatch.setattr("slamfusion.align.search.LEVEL_WORK_MAX", shift_work(grid, grid, 5, OPEN))
    step = coarse_step(grid, grid, 20, OPEN)
    assert finest < step < coarsest
    assert shift_work(grid, grid, step, OPEN) <= shift_work(grid, grid, 5, OPEN)
    coarse = coarse_search(grid, grid, replace(CONFIG, coarse_cells=20), OPEN, device)
    assert (coarse.step, coarse.is_cut) == (step, True)
    plain = features_of(building(1), device)
    assert not coarse_search(plain, plain, CONFIG, OPEN, device).is_cut


@pytest.mark.parametrize("most", [1, 40, 700])
@pytest.mark.parametrize("kind", ["few values", "sorted", "the sample lies low", "high"])
def test_the_greatest_are_the_first_of_a_stable_sort(kind: str, most: int):
    values = np.random.default_rng(most).integers(0, 300, 2000).astype(np.float64)
    if kind == "sorted":
        values.sort()
    elif kind != "few values":
        values[::SAMPLED] = 1e6 if kind == "high" else -1.0
    expected = np.argsort(-values, kind="stable")[:most]
    np.testing.assert_array_equal(greatest_rows(values, most), expected)
    np.testing.assert_array_equal(
        greatest_rows(values[:30], most), np.argsort(-values[:30], kind="stable")[:most]
    )
