"""Refinement and settling come home, nothing pulls from unseen ground, and the rank is even."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from slamfusion.align.features import FINE_TABLE
from slamfusion.align.motions import displacement, invert, to_lattice
from slamfusion.align.refine import polish, rank, refine, settle
from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import DISTANCE_ONE, DISTANCE_UNSEEN
from slamfusion.compute.search import FitSide
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, features_of, random_cells


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


def test_each_motion_may_have_a_scale_of_its_own(device: ComputeDevice) -> None:
    grid = features_of(building(2), device)
    starts = np.array([*grid.centre, 0.0]) + np.array([[2, 1, 0.02], [-3, 0, -0.03], [0, 4, 0.0]])
    scales = np.array([8.0, 2.0, 1.0])
    together = refine(grid, grid, starts, 1, (scales,), device, iterations=1)
    for start, scale, found in zip(starts, scales, together, strict=True):
        alone = refine(grid, grid, start[None], 1, (float(scale),), device, iterations=1)[0]
        assert np.allclose(found, alone, atol=1e-4)
        assert 0.0 < np.hypot(*(found - start)[:2]) < 1.01 * scale


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
    found = polish(ref, mov, (answer + away)[None], device)[0]
    shift, turn = displacement(found, answer)
    assert shift < 0.1
    assert turn < 1e-3


@pytest.mark.parametrize("thick", [1, 2])
def test_polishing_thick_walls_on_thin_ones_stays_centred(
    device: ComputeDevice, thick: int
) -> None:
    thin, fat = features_of(rooms(0), device), features_of(rooms(thick), device)
    for moving, reference in ((thin, fat), (fat, thin)):
        middle = np.array([reference.shape[1] / 2, reference.shape[0] / 2, 0.0])
        start = middle + np.array([0.3, -0.2, 0.002])
        shift, _ = displacement(polish(reference, moving, start[None], device)[0], middle)
        assert shift < 0.2, moving.grid.name


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
            one, two, answer[None], 1, (12.0,), device,
            iterations=8, solid=solid, everywhere=everywhere,
        )  # fmt: skip
        away.append(displacement(found[0], answer)[0])
    assert away[0] < 0.05
    assert away[1] > 0.3, "where all ground counts they do"


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize("resolution", [0.05, 0.1])
def test_distances_are_told_in_known_ground_and_near_walls(
    device: ComputeDevice, resolution: float, step: int
) -> None:
    """Deep in the unknown: farther than 0.4 m and three cells from walls, and not known at all."""
    features = features_of(OccupancyGrid(random_cells(7, 80, 100), resolution), device)
    level = features.level(step)
    found = device.download(level.distance).astype(int)
    walls, free = device.download(level.wall) != 0, device.download(level.free) != 0
    away = np.minimum(ndimage.distance_transform_edt(~walls), 64.0)
    reach = max(3.0, 0.4 / (resolution * step))
    unseen = ~walls & ~free & (away > reach)
    assert 0.02 < unseen.mean() < 0.98
    assert np.all(found[unseen] == DISTANCE_UNSEEN)
    wanted = np.rint(DISTANCE_ONE * away).astype(int)
    assert np.array_equal(found[~unseen], wanted[~unseen])
    assert np.array_equal(device.download(level.far_distance), wanted)


def test_the_solid_level_tells_distances_where_the_finest_level_does_and_no_farther(
    device: ComputeDevice,
) -> None:
    features = features_of(OccupancyGrid(random_cells(7, 80, 100), 0.1), device)
    found = device.download(features.solid_level().distance).astype(int)
    solid = np.asarray(features.grid.solid) != 0
    away = np.minimum(ndimage.distance_transform_edt(~solid), 24.0)
    unseen = ~solid & (np.asarray(features.grid.cells) != 0) & (away > 4.0)
    assert unseen.any()
    assert np.all(found[unseen] == DISTANCE_UNSEEN)
    near = ~unseen & (away < 23.0)
    assert np.array_equal(found[near], np.rint(DISTANCE_ONE * away[near]).astype(int))


@pytest.mark.parametrize("backward", [False, True])
def test_points_on_unseen_cells_are_left_out_of_the_fit(
    device: ComputeDevice, *, backward: bool
) -> None:
    """The sums of all points are those of the points whose four cells are all seen."""
    rng = np.random.default_rng(4)
    distance = rng.integers(0, 64 * DISTANCE_ONE, (40, 50)).astype(np.uint16)
    masked = distance.copy()
    masked[rng.random(distance.shape) < 0.1] = DISTANCE_UNSEEN
    points = rng.integers(0, 8 * 40, (300, 2)) / 8.0
    shift = np.array([2.375, -1.625])
    col, row = np.floor(points + shift - 0.5).astype(int).T
    inside = (col >= 0) & (row >= 0) & (col + 1 < 50) & (row + 1 < 40)
    seen = np.array(
        [
            bool(masked[y : y + 2, x : x + 2].max() < DISTANCE_UNSEEN) if is_in else False
            for x, y, is_in in zip(col, row, inside, strict=True)
        ]
    )
    assert 100 < seen.sum() < inside.sum() - 50

    def terms(own: np.ndarray, field: np.ndarray) -> np.ndarray:
        pose = np.array([[1.0, 0.0, *shift]], dtype=np.float32)
        side, nothing = (
            FitSide(device.upload(some.astype(np.float32)), pose, device.upload(field))
            for some in (own, np.full((1, 2), -99.0))
        )
        sides = (nothing, side) if backward else (side, nothing)
        scales = np.array([6.0], dtype=np.float32)
        return device.refine_terms(*sides, scales=scales, centre=(25.0, 20.0))

    assert terms(points, masked) == pytest.approx(terms(points[seen], distance), rel=1e-4)
