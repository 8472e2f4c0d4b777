"""Refinement and settling come home, nothing pulls from unseen ground, and the rank is even."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from slamfusion.align.pair import Pair, displacement
from slamfusion.align.refine import climbed, narrow_fits, polish, refine, settle
from slamfusion.align.scores import SCORED_POINTS, count_met, rank
from slamfusion.compute import ComputeDevice
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, features_of
from tests.support.overlap import drawn, half_pairs


@pytest.mark.parametrize("seed", range(6))
def test_refine_moves_to_the_known_answer(device: ComputeDevice, seed: int) -> None:
    grid = features_of(building(seed), device)
    rng = np.random.default_rng(seed)
    away = np.append(rng.uniform(-4, 4, 2), rng.uniform(-0.05, 0.05))
    start = np.array([*grid.centre, 0.0]) + away
    found = refine(Pair(grid, grid), start[None], 1, (8.0, 4.0, 2.0), iterations=8)[0]
    shift, turn = displacement(found, np.array([*grid.centre, 0.0]))
    assert shift < 0.05
    assert turn < 1e-3


def test_refine_treats_each_motion_alone(device: ComputeDevice) -> None:
    grid = features_of(building(2), device)
    starts = np.array([*grid.centre, 0.0]) + np.array([[2, 1, 0.02], [-3, 0, -0.03], [0, 4, 0.0]])
    together = refine(Pair(grid, grid), starts, 1, (8.0, 4.0))
    alone = [refine(Pair(grid, grid), start[None], 1, (8.0, 4.0))[0] for start in starts]
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
    found = settle(Pair(thin, fat), (answer + away)[None])[0]
    shift, turn = displacement(found, answer)
    assert shift < 0.6 * thick
    assert turn < math.radians(0.6) * thick


@pytest.mark.parametrize("away", [(0.8, 0.5, 0.006), (-0.6, 0.9, -0.008)])
def test_polishing_comes_home_where_most_walls_are_in_one_map_alone(
    device: ComputeDevice, away: tuple[float, float, float]
) -> None:
    """A wide fit is pulled by what the other map has not seen; the narrow one is not."""
    whole = building(5, 14.0, 9.0, 0.05)
    strip = whole.cells.copy()
    strip[:, 90:] = -1
    ref, mov = features_of(whole, device), features_of(replace(whole, cells=strip), device)
    (rows, cols) = np.nonzero(strip >= 0)
    corner = np.array([cols.min(), rows.min()])
    answer = np.array([*(np.array(mov.centre) + corner), 0.0])
    found = polish(Pair(ref, mov), (answer + away)[None])[0]
    shift, turn = displacement(found, answer)
    assert shift < 0.1
    assert turn < 1e-3


def test_rank_of_a_map_on_itself_is_one_and_falls_with_distance(device: ComputeDevice) -> None:
    grid = features_of(building(3), device)
    away = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0], [8, 0, 0]], dtype=float)
    pair, motions = Pair(grid, grid), np.array([*grid.centre, 0.0]) + away
    scores = rank(pair, count_met(pair, motions, SCORED_POINTS))
    assert scores[0] == pytest.approx(1.0)
    assert np.all(np.diff(scores) < 0)


def two_rooms(show_second: bool, back: int) -> OccupancyGrid:
    """A room, and beyond ``back`` cells of unknown ground another wall, or not drawn that far."""
    cells = np.full((60, 80), -1, dtype=np.int8)
    cells[10:50, 10:50] = 100
    cells[11:49, 11:49] = 0
    # Holes in the far wall and one in the west: a corner alone would not hold the turn.
    cells[11:49, 30] = 100
    cells[20:30, 30] = 0
    if show_second:
        cells[10:50, 49 + back] = 100
        cells[10:50, 50 + back : 70] = 0
    # The same known box, so that both grids have the same middle.
    cells[[0, 0, 59, 59], [0, 79, 0, 79]] = 0
    return OccupancyGrid(cells, 0.1, name="two rooms" if show_second else "one room")


@pytest.mark.parametrize("solid", [False, True])
def test_walls_in_ground_that_the_other_has_not_seen_do_not_pull(
    device: ComputeDevice, *, solid: bool
) -> None:
    one, two = (features_of(two_rooms(shown, 7), device) for shown in (False, True))
    assert one.shape == two.shape
    answer = np.array([*one.centre, 0.0])
    away = []
    for everywhere in (False, True):
        found = refine(
            Pair(one, two),
            answer[None],
            1,
            (12.0,),
            iterations=8,
            solid=solid,
            everywhere=everywhere,
        )
        away.append(displacement(found[0], answer)[0])
    assert away[0] < 0.05
    assert away[1] > 0.3, "where all ground counts they do"


@pytest.mark.once
def test_on_a_strip_a_narrow_fit_is_nearer_than_the_wide_one(device: ComputeDevice) -> None:
    """Halves of a building: the other walls of each pull a wide fit."""
    turned_deg = []
    for seed in range(8):
        drafts = half_pairs(seed, (0.2,), ("sim/building/72100",))
        (case,) = drawn(drafts[:1])
        low, high = (features_of(grid, device) for grid in (case.reference, case.moving))
        assert case.truth is not None
        right = Pair(low, high).motion_of(case.truth)
        wide = settle(Pair(low, high), (right + np.array([2.0, -2.0, math.radians(1.5)]))[None])
        narrow = narrow_fits(Pair(low, high), wide)
        turned_deg.append([abs(math.degrees(fit[0, 2] - right[2])) for fit in (wide, narrow)])
    wide_deg, narrow_deg = np.mean(turned_deg, axis=0)
    assert narrow_deg < 0.1
    assert narrow_deg < 0.5 * wide_deg


@pytest.mark.once
def test_maps_without_a_common_wall_are_left_where_they_are(device: ComputeDevice) -> None:
    features = features_of(building(1), device)
    motion = np.array([features.centre[0] + 1e4, features.centre[1], 0.0])
    assert np.array_equal(climbed(Pair(features, features), motion), motion)


@pytest.mark.once
def test_a_fit_that_is_right_stays_as_it_is(device: ComputeDevice) -> None:
    features = features_of(building(1), device)
    motion = np.array([*features.centre, 0.0])
    assert np.array_equal(climbed(Pair(features, features), motion), motion)
