"""The search: scores equal their definition, windows hold, refinement and settling come home."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.fusion.features import FINE_TABLE, GridFeatures, score_table, spread_sample
from slamfusion.fusion.motions import displacement, distinct, invert, to_lattice
from slamfusion.fusion.refine import rank, refine, settle
from slamfusion.fusion.search import SearchWindow, coarse_search, coarse_step, search, shift_range
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, features_of, random_grid

CONFIG = AlignConfig(prove=False)
# No turn of these is a multiple of 45 degrees, where rounding would decide.
START_YAW = 0.1234


def field_by_definition(walls: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The coarse worth of each cell: 4 + 11 exp(-d^2 / 2), less 4 min(1, d / 4) where free."""
    d = np.minimum(ndimage.distance_transform_edt(~walls), 64.0)
    hit = np.rint(11 * np.exp(-0.5 * d * d))
    miss = np.rint(4 * np.where(d > 1.5, np.minimum(1.0, d / 4), 0.0))
    return np.asarray(np.clip(4 + hit - np.where(free, miss, 0), 0, 255), dtype=np.int64)


def walls_by_definition(cells: np.ndarray) -> np.ndarray:
    """Walls with a free neighbour, no specks: at most six of the eight neighbours are free."""
    count = ndimage.convolve((cells == 0).astype(int), np.ones((3, 3), int), mode="constant")
    return np.asarray((cells == 1) & (count > 0) & (count < 7))


def look_up(field: np.ndarray, x: np.ndarray, y: np.ndarray) -> int:
    """Sum of the field in the cells under positions; 4 outside."""
    row, col = np.floor(y).astype(int), np.floor(x).astype(int)
    inside = (row >= 0) & (col >= 0) & (row < field.shape[0]) & (col < field.shape[1])
    return int(field[row[inside], col[inside]].sum()) + 4 * int((~inside).sum())


def direct_score(
    ref: tuple[np.ndarray, np.ndarray],
    mov: tuple[np.ndarray, np.ndarray],
    motion: tuple[float, float, float],
) -> float:
    """The two-sided score of one motion by its definition: (walls, field) of both grids."""
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    centre = mov[0].shape[1] / 2, mov[0].shape[0] / 2
    row, col = np.nonzero(mov[0])
    x, y = col + 0.5 - centre[0], row + 0.5 - centre[1]
    total = look_up(ref[1], cos * x - sin * y + motion[0], sin * x + cos * y + motion[1])
    row, col = np.nonzero(ref[0])
    x, y = col + 0.5 - motion[0], row + 0.5 - motion[1]
    total += look_up(mov[1], cos * x + sin * y + centre[0], -sin * x + cos * y + centre[1])
    count = int(ref[0].sum() + mov[0].sum())
    return (total / count - 4) / 11


def parts_of(features: GridFeatures) -> tuple[np.ndarray, np.ndarray]:
    walls = walls_by_definition(np.asarray(features.grid.cells))
    return walls, field_by_definition(walls, np.asarray(features.grid.cells) == 0)


@pytest.mark.parametrize(("first", "second"), [(11, 12), (13, 11), (14, 14)])
def test_coarse_scores_equal_a_direct_computation(
    device: ComputeDevice, first: int, second: int
) -> None:
    ref = features_of(random_grid(first, 14, 22), device)
    mov = features_of(random_grid(second, 14, 22), device)
    window = SearchWindow((8.0, 9.0, START_YAW), 6.0)
    found = coarse_search(ref, mov, CONFIG, window, device)
    assert found.step == 1
    a, b = parts_of(ref), parts_of(mov)
    for k in range(0, len(found.yaws), 7):
        direct = [
            direct_score(a, b, (col + 0.5, row + 0.5, float(found.yaws[k])))
            for row in range(3, 16)
            for col in range(2, 15)
        ]
        assert found.best[k] == pytest.approx(max(direct), abs=1e-12)
    for motion, score in zip(found.motions, found.scores, strict=True):
        wanted = direct_score(a, b, (float(motion[0]), float(motion[1]), float(motion[2])))
        assert score == pytest.approx(wanted, abs=1e-12)


def test_coarse_peaks_are_best_first_and_the_first_is_the_best_of_all(
    device: ComputeDevice,
) -> None:
    ref, mov = (features_of(random_grid(seed), device) for seed in (21, 22))
    found = coarse_search(ref, mov, CONFIG, SearchWindow(), device)
    assert np.all(np.diff(found.scores) <= 0)
    assert found.scores[0] == found.best.max()
    assert len(found.motions) <= CONFIG.candidates


def test_coarse_search_covers_the_full_turn_evenly(device: ComputeDevice) -> None:
    ref, mov = (features_of(random_grid(seed), device) for seed in (21, 22))
    yaws = coarse_search(ref, mov, CONFIG, SearchWindow((0.0, 0.0, START_YAW)), device).yaws
    step = np.diff(yaws)
    assert np.allclose(step, 2 * math.pi / len(yaws))
    assert yaws[0] == START_YAW


def test_yaw_steps_move_the_rim_by_little_more_than_a_cell(device: ComputeDevice) -> None:
    for seed in range(30, 36):
        ref, mov = (features_of(random_grid(seed + k), device) for k in (0, 50))
        found = coarse_search(ref, mov, CONFIG, SearchWindow(), device)
        level = mov.level(found.step)
        own = level.points / 2 - np.array(mov.centre) / found.step
        rim = np.percentile(np.hypot(own[:, 0], own[:, 1]), 90)
        assert (found.yaws[1] - found.yaws[0]) * rim <= 1.3 + 1e-9


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


def test_a_window_without_yaw_tries_the_start_alone(device: ComputeDevice) -> None:
    grid = features_of(building(1), device)
    window = SearchWindow((*grid.centre, 0.25), 5.0, 0.0)
    assert coarse_search(grid, grid, CONFIG, window, device).yaws.tolist() == [0.25]


def test_an_open_window_lets_the_walls_leave_by_half_of_the_shorter_side() -> None:
    low, high = shift_range(100, (40, 60), 36, 0.0, SearchWindow(), 1)
    assert (low, high) == (20 - 36, 100 - 20 + 36 + 1)


@pytest.mark.parametrize(("first", "second", "cells"), [(41, 42, 48), (43, 43, 16), (44, 41, 20)])
def test_the_twins_find_the_same_coarse_peaks(
    device: ComputeDevice, twins: ComputeDevice, first: int, second: int, cells: int
) -> None:
    config = AlignConfig(coarse_cells=cells, prove=False)
    window = SearchWindow((12.0, 12.0, START_YAW), 8.0)
    found = []
    for on_device in (device, twins):
        ref, mov = (features_of(random_grid(seed, 20, 32), on_device) for seed in (first, second))
        found.append(coarse_search(ref, mov, config, window, on_device))
    a, b = found
    assert a.step == b.step
    for name in ("yaws", "best", "motions", "scores"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


def test_the_twins_find_the_same_answer(device: ComputeDevice, twins: ComputeDevice) -> None:
    answers = []
    for on_device in (device, twins):
        grid = features_of(random_grid(45, 24, 30), on_device)
        window = SearchWindow((*grid.centre, 0.0), 6.0, 0.3)
        answers.append(search(grid, grid, CONFIG, window, on_device))
    assert np.allclose(answers[0][1][0], answers[1][1][0], atol=1e-3)
    assert answers[0][2][0] == pytest.approx(answers[1][2][0], abs=2e-3)


def test_the_coarse_step_follows_the_longest_side_and_shrinks_where_walls_fill_the_cells(
    device: ComputeDevice,
) -> None:
    plain = features_of(building(1), device)
    assert coarse_step(plain, plain, 48) == math.ceil(max(plain.shape) / 48)
    striped = np.zeros((96, 96), dtype=np.int8)
    striped[::3] = 100
    features = features_of(OccupancyGrid(striped, 0.1), device)
    step = coarse_step(features, features, 16)
    assert step < math.ceil(max(features.shape) / 16)


def test_to_lattice_and_invert_undo_each_other() -> None:
    motions = np.array([[3.0, -4.0, 1.2], [0.5, 8.0, -3.0]])
    centre = (10.0, 6.0)
    lattice = to_lattice(motions, centre)
    for motion, pose in zip(motions, lattice, strict=True):
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        x = cos * centre[0] - sin * centre[1] + pose[0]
        y = sin * centre[0] + cos * centre[1] + pose[1]
        assert (x, y) == pytest.approx(motion[:2])
    assert np.allclose(invert(invert(lattice)), lattice)


def test_displacement_wraps_the_turn() -> None:
    a, b = np.array([0.0, 0.0, math.pi - 0.1]), np.array([3.0, 4.0, -math.pi + 0.1])
    assert displacement(a, b) == pytest.approx((5.0, 0.2))


def test_distinct_keeps_the_better_of_near_ones() -> None:
    motions = np.array([[0.0, 0, 0], [2.0, 0, 0.01], [2.0, 0, 0.5], [9.0, 0, 0], [9.5, 0, 0]])
    assert distinct(motions, 3.0, 0.1).tolist() == motions[[0, 2, 3]].tolist()


def test_spread_sample_takes_every_part_of_the_points() -> None:
    points = np.stack((np.arange(1000), np.arange(1000)), axis=1).astype(np.int32)
    sample = spread_sample(points, 64)
    assert len(sample) == 64
    assert np.diff(sample[:, 0]).max() <= math.ceil(1000 / 64)
    assert spread_sample(points, 1000) is points


@pytest.mark.parametrize("seed", range(6))
def test_refine_moves_to_the_known_answer(device: ComputeDevice, seed: int) -> None:
    grid = features_of(building(seed), device)
    rng = np.random.default_rng(seed)
    away = np.append(rng.uniform(-4, 4, 2), rng.uniform(-0.05, 0.05))
    start = np.array([*grid.centre, 0.0]) + away
    found = refine(grid, grid, start[None], 1, (8.0, 4.0, 2.0), device, iterations=8)[0]
    shift, turn = displacement(found, np.array([*grid.centre, 0.0]))
    assert shift < 0.05
    assert turn < 1e-3


def test_refine_treats_each_motion_alone(device: ComputeDevice) -> None:
    grid = features_of(building(2), device)
    starts = np.array([*grid.centre, 0.0]) + np.array([[2, 1, 0.02], [-3, 0, -0.03], [0, 4, 0.0]])
    together = refine(grid, grid, starts, 1, (8.0, 4.0), device)
    alone = [refine(grid, grid, start[None], 1, (8.0, 4.0), device)[0] for start in starts]
    assert np.allclose(together, alone, atol=1e-4)


def rooms(thick: int) -> OccupancyGrid:
    """Three rooms in unknown space; walls grow by ``thick`` cells away from their middle line."""
    lines = np.zeros((90, 120), dtype=bool)
    lines[[15, 75], 15:106] = lines[45, 15:70] = True
    lines[15:76, [15, 105]] = lines[15:45, 60] = True
    inside = np.zeros_like(lines)
    inside[15:76, 15:106] = True
    walls = ndimage.binary_dilation(lines, np.ones((3, 3)), iterations=thick) if thick else lines
    cells = np.where(walls, 100, np.where(inside, 0, -1)).astype(np.int8)
    return OccupancyGrid(cells, 0.05, name=f"walls {2 * thick + 1} cells thick")


@pytest.mark.parametrize("thick", [1, 2])
@pytest.mark.parametrize("away", [(2.0, 1.5, 0.02), (-2.5, 1.0, -0.02), (0.7, -2.2, 0.01)])
def test_settling_thick_walls_on_thin_ones_stays_centred(
    device: ComputeDevice, thick: int, away: tuple[float, float, float]
) -> None:
    """Locked onto one side of a room the maps would be off by ``thick`` cells along x and y."""
    thin, fat = features_of(rooms(0), device), features_of(rooms(thick), device)
    # Each is cropped to its known cells; both crops have the same middle.
    answer = np.array([thin.shape[1] / 2, thin.shape[0] / 2, 0.0])
    found = settle(thin, fat, (answer + away)[None], device)[0]
    shift, turn = displacement(found, answer)
    assert shift < 0.6 * thick
    assert turn < math.radians(0.6) * thick


def test_rank_of_a_map_on_itself_is_one_and_falls_with_distance(device: ComputeDevice) -> None:
    grid = features_of(building(3), device)
    away = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0], [8, 0, 0]], dtype=float)
    scores = rank(grid, grid, np.array([*grid.centre, 0.0]) + away, 1, FINE_TABLE, device)
    assert scores[0] == pytest.approx(1.0)
    assert np.all(np.diff(scores) < 0)


def test_rank_is_the_same_seen_from_either_grid(device: ComputeDevice) -> None:
    a, b = features_of(building(3), device), features_of(building(4), device)
    motion = np.array([[40.3, 31.7, 0.4]])
    lattice = invert(to_lattice(motion, b.centre))[0]
    cos, sin = math.cos(lattice[2]), math.sin(lattice[2])
    x, y = a.centre
    back = np.array([[cos * x - sin * y + lattice[0], sin * x + cos * y + lattice[1], lattice[2]]])
    forth = rank(a, b, motion, 1, FINE_TABLE, device)[0]
    assert forth == pytest.approx(rank(b, a, back, 1, FINE_TABLE, device)[0], abs=1e-9)


def test_score_tables_fall_from_walls_and_never_below_zero() -> None:
    for sigma, base, span in ((1.0, 4, 11), (3.0, 64, 191), (4.0, 4, 11)):
        table = score_table(sigma, base, span)
        assert table.hit[0] == span
        assert np.all(np.diff(table.hit.astype(int)) <= 0)
        assert table.miss[0] == 0
        assert table.miss.max() == base
