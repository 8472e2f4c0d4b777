"""Ways through free space: short, smooth, and off the walls; tours that leave nothing out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.errors import SimulationError
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.sim.route import FreeSpace
from tests.sim.places import CELL_M, clearance_m, room


def two_rooms(door_m: float) -> OccupancyGrid:
    """Two rooms of 3 m side by side; the door in the wall between them is at the bottom."""
    grid = room(6.2, 3.0, middle=False)
    cells = grid.cells.copy()
    cells[:, 62:64] = OCCUPIED
    cells[4 : 4 + round(door_m / CELL_M), 62:64] = FREE
    return OccupancyGrid(cells, CELL_M, grid.origin, "two rooms")


def test_way_keeps_off_walls_and_is_hardly_longer_than_needed() -> None:
    grid = two_rooms(1.0)
    way = FreeSpace(grid, 0.2).way((1.0, 2.5), (5.0, 2.5))
    assert way[0].tolist() == [1.0, 2.5]
    assert way[-1].tolist() == [5.0, 2.5]
    assert clearance_m(grid, way) >= 0.2
    steps = np.hypot(*np.diff(way, axis=0).T)
    assert steps.max() < 0.08
    through = math.dist((1.0, 2.5), (3.1, 0.65)) + math.dist((3.1, 0.65), (5.0, 2.5))
    assert steps.sum() < 1.1 * through


def test_too_large_a_robot_finds_no_way_and_is_told_the_place() -> None:
    with pytest.raises(SimulationError, match=r"no way from .* to waypoint 3 at \(5\.00, 2\.00\)"):
        FreeSpace(two_rooms(1.0), 0.6).way((1.0, 2.0), (5.0, 2.0), "waypoint 3")


@pytest.mark.parametrize("place", [(0.05, 1.0), (40.0, 1.0), (3.1, 2.0)])
def test_a_place_in_or_near_a_wall_is_refused_by_name(place: tuple[float, float]) -> None:
    with pytest.raises(SimulationError, match=r"waypoint 7 at .* is no place for a disc"):
        FreeSpace(two_rooms(1.0), 0.2).way((1.0, 2.0), place, "waypoint 7")


def test_unknown_cells_are_no_place_to_be() -> None:
    grid = room(4.0, 4.0)
    cells = grid.cells.copy()
    cells[40:42] = UNKNOWN
    space = FreeSpace(OccupancyGrid(cells, CELL_M, grid.origin), 0.2)
    with pytest.raises(SimulationError, match="no way"):
        space.way((0.0, -1.0), (0.0, 1.0))


def test_tour_comes_near_every_reachable_place_and_home() -> None:
    grid = two_rooms(1.0)
    space = FreeSpace(grid, 0.2)
    stops = space.tour((1.0, 2.0), 1.5, 30)
    assert stops[-1] == (1.0, 2.0)
    rows, cols = np.nonzero(grid.cells == FREE)
    places = grid.cell_centres(rows, cols)
    inner = places[space.clearance_m(places) > 0.3]
    nearest = np.min([np.hypot(*(inner - stop).T) for stop in stops], axis=0)
    assert nearest.max() < 1.5 + 0.6 + 0.2
    assert len({stop[0] > 3.1 for stop in stops}) == 2


def test_no_room_at_all_is_said() -> None:
    with pytest.raises(SimulationError, match="no free place for a disc of radius 2 m"):
        FreeSpace(room(2.0, 2.0), 2.0).any_place(np.random.default_rng(0))
