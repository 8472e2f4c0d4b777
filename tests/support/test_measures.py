"""The benchmarks' measures count what they say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.geometry import Pose2, compose_poses
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.trajectory import Trajectory
from tests.sim.places import CELL_M, room
from tests.support.measures import cells_of_people, closure_error, false_walls

TRUTH = room(4.0, 3.0)
NOBODY = np.empty((5, 0, 2))


def moved(grid: OccupancyGrid, motion: Pose2) -> OccupancyGrid:
    """The same map in a frame from which ``motion`` leads back."""
    origin = motion.inverse().compose(grid.origin)
    return OccupancyGrid(grid.cells, grid.resolution, origin, grid.name)


def with_walls(*places: tuple[float, float]) -> OccupancyGrid:
    """The room with one more wall cell under each place."""
    cells = TRUTH.cells.copy()
    rows, cols = TRUTH.cell_indices(np.array(places))
    cells[rows, cols] = OCCUPIED
    return OccupancyGrid(cells, CELL_M, TRUTH.origin, "map")


def test_the_truth_has_no_false_wall() -> None:
    assert false_walls(TRUTH, TRUTH, Pose2()).occupied == 0
    assert false_walls(TRUTH, TRUTH, Pose2()).cells == TRUTH.cells.size


def test_a_wall_is_false_only_far_from_true_ones() -> None:
    grid = with_walls((0.0, 0.0), (1.0, 0.5), (1.92, 0.0))
    found = false_walls(grid, TRUTH, Pose2())
    assert found.occupied == 2
    assert found.percent == pytest.approx(200.0 / TRUTH.cells.size)


def test_the_map_is_moved_onto_the_truth() -> None:
    motion = Pose2(3.0, -1.0, 0.4)
    grid = moved(with_walls((0.0, 0.0)), motion)
    assert false_walls(grid, TRUTH, motion).occupied == 1
    assert false_walls(grid, TRUTH, Pose2()).occupied > 100


def test_only_cells_near_a_person_and_far_from_walls_are_a_persons() -> None:
    way = np.stack((np.linspace(-1.0, 1.0, 41), np.zeros(41)), axis=1)[:, None]
    grid = with_walls((0.5, 0.1), (0.5, 0.6), (0.0, -0.2))
    touched, others = cells_of_people(grid, TRUTH, way, Pose2())
    area_m2 = 2.0 * 0.6 + math.pi * 0.3**2
    assert touched.cells == pytest.approx(area_m2 / CELL_M**2, rel=0.03)
    assert (touched.occupied, others.occupied) == (2, 1)
    # Of 80 x 60 free cells, those whose centre is more than three cells from a wall's.
    assert touched.cells + others.cells == (80 - 6) * (60 - 6)


def test_what_the_map_does_not_know_is_nobodys() -> None:
    cells = TRUTH.cells.copy()
    cells[cells == FREE] = UNKNOWN
    grid = OccupancyGrid(cells, CELL_M, TRUTH.origin, "map")
    touched, others = cells_of_people(grid, TRUTH, np.zeros((5, 1, 2)), Pose2())
    assert (touched.cells, others.cells) == (0, 0)
    assert math.isnan(touched.percent)


def test_without_people_every_cell_is_another() -> None:
    touched, others = cells_of_people(with_walls((0.0, 0.0)), TRUTH, NOBODY, Pose2())
    assert touched.cells == 0
    assert others.occupied == 1


def test_the_closure_is_seen_from_the_first_pose() -> None:
    poses = np.array([(1.0, 2.0, 0.5), (4.0, 3.0, 1.0), (1.2, 2.0, 0.4)])
    truth = Trajectory(np.arange(3.0), poses)
    motion = (5.0, -2.0, 1.0)
    elsewhere = Trajectory(truth.stamps_s, compose_poses(motion, poses))
    assert closure_error(elsewhere, truth) == pytest.approx((0.0, 0.0), abs=1e-9)
    poses[2] += (0.3, 0.4, 0.1)
    wrong = Trajectory(truth.stamps_s, compose_poses(motion, poses))
    assert closure_error(wrong, truth) == pytest.approx((0.5, math.degrees(0.1)))
