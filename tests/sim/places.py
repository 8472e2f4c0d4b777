"""Drawn places for the simulator's tests."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.config import ObstacleConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, OccupancyGrid
from slamfusion.sim.world import World

CELL_M = 0.05


def room(
    width_m: float, height_m: float, *, middle: bool = True, resolution: float = CELL_M
) -> OccupancyGrid:
    """An empty room of inner size; zero of the map frame in its middle, or in its corner."""
    wide, high = round(width_m / resolution), round(height_m / resolution)
    cells = np.full((high + 2, wide + 2), OCCUPIED, dtype=np.int8)
    cells[1:-1, 1:-1] = FREE
    x, y = ((wide + 2) / 2, (high + 2) / 2) if middle else (1.0, 1.0)
    return OccupancyGrid(cells, resolution, Pose2(-x * resolution, -y * resolution), "room")


def world_of(
    grid: OccupancyGrid,
    *,
    glass: npt.NDArray[np.bool_] | None = None,
    obstacles: tuple[ObstacleConfig, ...] = (),
) -> World:
    """A world of a grid without people; glass and obstacles are those that are given."""
    none = np.zeros(grid.cells.shape, dtype=np.bool_)
    return World(grid, none if glass is None else glass, 2.5, (), obstacles)


def clearance_m(grid: OccupancyGrid, points: npt.NDArray[np.float64]) -> float:
    """The least distance from points (N, 2) to the square of an occupied cell, exactly."""
    rows, cols = np.nonzero(grid.cells == OCCUPIED)
    own = grid.origin.inverse().transform(points) / grid.resolution
    least = np.inf
    for x, y in own:
        near = (np.abs(cols - x) < 30) & (np.abs(rows - y) < 30)
        away_x = np.maximum(np.maximum(cols[near] - x, x - cols[near] - 1), 0.0)
        away_y = np.maximum(np.maximum(rows[near] - y, y - rows[near] - 1), 0.0)
        least = min(least, float(np.hypot(away_x, away_y).min(initial=30.0)))
    return least * grid.resolution
