"""The coarsest stage: every shift with any overlap at every yaw, both ways, as defined."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.align import shifts
from slamfusion.align.pair import Pair
from slamfusion.align.shifts import (
    COARSE_SIGMA,
    COARSE_TOP,
    SearchWindow,
    ShiftScores,
    score_shifts,
    shift_work,
)
from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import SHIFT_TILE
from slamfusion.grid import OCCUPIED, CellBox, OccupancyGrid
from tests.align.definitions import Side, evidence_of, level_side, side_of
from tests.fusion.drawings import building, features_of, random_cells, random_grid

# No turn from here is a multiple of 45 degrees, where rounding would decide.
START_YAW = 0.1234


def odd_grid(seed: int, low: int, high: int) -> OccupancyGrid:
    """A random place of odd sides: no cell comes to lie with its middle between two cells."""
    cells = random_cells(seed, low, high)
    cells = cells[: (cells.shape[0] - 1) // 2 * 2 + 1, : (cells.shape[1] - 1) // 2 * 2 + 1]
    cells[0, 0] = cells[-1, -1] = OCCUPIED
    return OccupancyGrid(cells, 0.1, name=f"odd {seed}")


def direct_surface(
    ref: Side, mov: Side, yaw: float, rows: tuple[int, int], cols: tuple[int, int]
) -> np.ndarray:
    """Evidence of every shift that lands the moving centre on a cell's centre."""
    return np.array(
        [
            [evidence_of(ref, mov, np.array([col + 0.5, row + 0.5, yaw])) for col in range(*cols)]
            for row in range(*rows)
        ]
    )


def assert_tiles_are(
    scores: ShiftScores, k: int, surface: np.ndarray, rows: tuple[int, int], cols: tuple[int, int]
) -> None:
    """Each tile of one yaw holds the best of its shifts, and where that is."""
    tiles_y, tiles_x = (math.ceil(size / SHIFT_TILE) for size in surface.shape)
    assert scores.evidence.shape[1] == tiles_y * tiles_x
    for tile in range(tiles_y * tiles_x):
        row, col = (SHIFT_TILE * n for n in divmod(tile, tiles_x))
        part = surface[row : row + SHIFT_TILE, col : col + SHIFT_TILE]
        assert scores.evidence[k, tile] == pytest.approx(part.max(), abs=1e-9)
        at = np.ravel_multi_index(([k], [tile]), scores.evidence.shape)
        x, y, yaw = scores.motions(at)[0] / (scores.step, scores.step, 1.0)
        assert yaw == scores.yaws[k]
        assert x % 1.0 == y % 1.0 == 0.5, "on the middle of a cell"
        at = round(y - 0.5) - rows[0], round(x - 0.5) - cols[0]
        assert surface[at] == pytest.approx(part.max(), abs=1e-9)


@pytest.mark.parametrize(("first", "second"), [(11, 12), (13, 11), (14, 14)])
def test_scores_in_a_window_equal_their_definition(
    device: ComputeDevice, first: int, second: int
) -> None:
    ref, mov = (features_of(odd_grid(seed, 14, 22), device) for seed in (first, second))
    window = SearchWindow((8.0, 9.0, START_YAW), 6.0)
    scores = score_shifts(Pair(ref, mov), 1, window)
    a, b = (side_of(grid, COARSE_SIGMA, COARSE_TOP) for grid in (ref, mov))
    rows, cols = (3, 16), (2, 15)
    for k in range(0, len(scores.yaws), 9):
        surface = direct_surface(a, b, float(scores.yaws[k]), rows, cols)
        assert_tiles_are(scores, k, surface, rows, cols)


@pytest.mark.parametrize("step", [2, 3])
def test_scores_of_coarse_levels_equal_their_definition_at_every_shift(
    device: ComputeDevice, step: int
) -> None:
    ref, mov = (features_of(odd_grid(seed, 25, 31), device) for seed in (15, 16))
    scores = score_shifts(Pair(ref, mov), step, SearchWindow((0.0, 0.0, START_YAW)))
    a, b = (level_side(grid, step, COARSE_SIGMA, COARSE_TOP) for grid in (ref, mov))
    reach = math.ceil(np.hypot(*(b.points - b.centre).T).max()) + 1
    rows, cols = ((-reach, size + reach + 1) for size in a.walls.shape)
    for k in range(0, len(scores.yaws), 13):
        surface = direct_surface(a, b, float(scores.yaws[k]), rows, cols)
        assert_tiles_are(scores, k, surface, rows, cols)


@pytest.mark.parametrize("seed", range(3))
def test_an_open_window_leaves_out_no_shift_under_which_walls_meet(
    device: ComputeDevice, seed: int
) -> None:
    """Around the range of shifts nothing speaks for any motion."""
    ref, mov = (features_of(random_grid(seed + k, 20, 30), device) for k in (0, 30))
    scores = score_shifts(Pair(ref, mov), 1, SearchWindow())
    all_motions = scores.motions(np.arange(scores.evidence.size))[:, :2]
    low, high = all_motions.min(axis=0), all_motions.max(axis=0)
    a, b = (side_of(grid, COARSE_SIGMA, COARSE_TOP) for grid in (ref, mov))
    reach = math.ceil(np.hypot(*(b.points - b.centre).T).max()) + 1
    rows, cols = ((-reach, size + reach + 1) for size in a.walls.shape)
    assert np.all(low >= (cols[0] + 0.5, rows[0] + 0.5))
    assert np.all(high <= (cols[1] - 0.5, rows[1] - 0.5))
    for yaw in (0.1, 1.3, 2.9, -1.7):
        for row in (rows[0] - 1, rows[1]):
            for col in range(cols[0] - 1, cols[1] + 1, 3):
                assert evidence_of(a, b, np.array([col + 0.5, row + 0.5, yaw])) <= 0.0
        for col in (cols[0] - 1, cols[1]):
            for row in range(rows[0] - 1, rows[1] + 1, 3):
                assert evidence_of(a, b, np.array([col + 0.5, row + 0.5, yaw])) <= 0.0


def test_a_part_of_a_map_is_scored_where_it_hangs_out_of_the_other(device: ComputeDevice) -> None:
    """The best shift of a corner that both show may lie outside of the reference."""
    whole = building(5, 12.0, 8.0)
    ref = features_of(whole.crop(CellBox(0, 0, whole.height, 40)), device)
    mov = features_of(whole.crop(CellBox(0, 30, whole.height, 110)), device)
    scores = score_shifts(Pair(ref, mov), 2, SearchWindow())
    best = scores.motions(scores.evidence.argmax()[None])[0]
    assert best[0] > ref.shape[1], "the centre of the moving grid is not on the reference"
    assert abs(math.remainder(best[2], 2.0 * math.pi)) < 1.5 * scores.yaw_step


@pytest.mark.parametrize("window", [SearchWindow(), SearchWindow((9.0, 7.0, 0.3), 12.0, 0.4)])
def test_the_work_of_a_level_is_known_before_it_is_done(
    device: ComputeDevice, window: SearchWindow
) -> None:
    """But for rows that are filled up to whole lanes: here not by more than as much again."""
    ref, mov = (features_of(random_grid(seed, 60, 90), device) for seed in (21, 22))
    most = [shift_work(Pair(ref, mov), step, window) for step in (1, 2, 4)]
    found = [score_shifts(Pair(ref, mov), step, window) for step in (1, 2, 4)]
    done = [2.0 * shifts.COARSE_POINTS * SHIFT_TILE**2 * level.evidence.size for level in found]
    for known, work in zip(most, done, strict=True):
        assert work <= 2.0 * known
    assert most[0] > 4.0 * most[1] > 16.0 * most[2]


def test_yaws_in_batches_are_scored_as_all_at_once(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    ref, mov = (features_of(odd_grid(seed, 17, 29), device) for seed in (5, 6))
    found = []
    for most in (shifts.BATCH_BYTES, 1 << 16, 1):
        monkeypatch.setattr(shifts, "BATCH_BYTES", most)
        found.append(score_shifts(Pair(ref, mov), 2, SearchWindow()))
    for other in found[1:]:
        for name in ("evidence", "rows", "cols"):
            assert np.array_equal(getattr(other, name), getattr(found[0], name)), name
