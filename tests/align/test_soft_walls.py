"""Walls from which a map fades to free space, over a cell of unknown, count as others do."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.fusion import align_grids
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.fusion.drawings import building, degraded, draw, features_of, fusion_config, off_by

pytestmark = pytest.mark.once

ROOM = "\n".join(["#" * 40, *["#" + "." * 38 + "#"] * 28, "#" * 40])


def faded(grid: OccupancyGrid, walls: np.ndarray | None = None) -> OccupancyGrid:
    """Return a map in which the free cells beside walls are unknown; of some walls alone."""
    chosen = grid.cells == OCCUPIED if walls is None else walls & (grid.cells == OCCUPIED)
    around = np.pad(chosen, 1)
    height, width = grid.cells.shape
    near = np.zeros_like(chosen)
    for row in range(3):
        for col in range(3):
            near |= around[row : row + height, col : col + width]
    cells = np.where(near & (grid.cells == FREE), UNKNOWN, grid.cells).astype(np.int8)
    return OccupancyGrid(cells, grid.resolution, grid.origin, grid.name)


def surfaces(grid: OccupancyGrid, device: ComputeDevice) -> int:
    return len(features_of(grid, device).level(1).points)


def test_walls_behind_a_rim_of_unknown_count(device: ComputeDevice) -> None:
    clear = draw(ROOM)
    assert surfaces(clear, device) == 136
    assert surfaces(faded(clear), device) == 136


def test_a_map_that_fades_in_places_is_read_as_before(device: ComputeDevice) -> None:
    clear = draw(ROOM)
    chosen = np.zeros(clear.cells.shape, dtype=np.bool_)
    chosen[10:20, 0] = True
    # Ten walls without a free neighbour do not make the map one that fades.
    assert surfaces(faded(clear, chosen), device) == 136 - 10
    # Of two of its four sides 60 do.
    chosen[:, [0, -1]] = True
    assert surfaces(faded(clear, chosen), device) == 136


@pytest.mark.parametrize("seed", range(4))
def test_a_faded_building_has_the_walls_of_the_clear_one(device: ComputeDevice, seed: int) -> None:
    clear = building(seed)
    assert surfaces(faded(clear), device) == pytest.approx(surfaces(clear, device), rel=0.05)


def test_a_faded_map_lies_where_the_clear_one_does(device: ComputeDevice) -> None:
    truth = building(3, 16.0, 12.0, 0.05)
    moving, pose = degraded(truth, 4, yaw_rad=1.1)
    found = align_grids(truth, faded(moving), fusion_config(), device)
    assert found.accepted, found.reason
    cells, degrees = off_by(moving, found.transform, pose)
    assert cells < 1.0
    assert degrees < 0.5
