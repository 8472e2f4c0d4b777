"""The maps that are rejected from the live fusion."""

from __future__ import annotations

import math

import numpy as np

from slamfusion.align.decide import WALLS_MIN
from slamfusion.config import NormalizeConfig
from slamfusion.errors import MemoryBudgetError
from slamfusion.grid import OccupancyGrid, implausible, row_parts
from slamfusion.io.files import check_memory

# Most steps from free to wall between neighbouring cells, per known cell: recorded and drawn maps
# have 0.21 at most, noise 0.50 or more.
STEPS_MAX = 0.4
# Least share of such steps per wall cell; a map that is all occupied has none.
EDGE_MIN = 0.001
# Free cells per wall cell below which a map has walls only; unknown then counts as free.
FREE_MIN = 0.01
# Metres from corner to corner.
LENGTH_MAX_M = 1e6
# Memory of the working copies of one map, bytes per cell, and the cells from which it is checked.
INPUT_BYTES = 12
CHECKED_CELLS = 1 << 22


def unusable(grid: OccupancyGrid, thresholds: NormalizeConfig) -> str | None:
    """Return why a map cannot take part, or None.

    Reasons are implausible numbers (``grid.implausible``), too few walls, noise (free and wall
    cells alternate), or a map that is all occupied.
    """
    reason = implausible(grid.resolution, grid.origin)
    if reason is not None:
        return reason
    length = math.hypot(grid.height, grid.width) * grid.resolution
    if length > LENGTH_MAX_M:
        return f"a map must be at most {LENGTH_MAX_M:g} m long, found {length:g} m"
    occupied = math.ceil(thresholds.occupied_percent)
    # Steps are pairs of neighbours, one a wall and one not, or one free.
    walls = free = steps = to_free = 0
    for rows in row_parts(grid.cells.shape):
        part = grid.cells[rows]
        is_wall, is_free = part >= occupied, (part >= 0) & (part <= thresholds.free_percent)
        walls += int(np.count_nonzero(is_wall))
        free += int(np.count_nonzero(is_free))
        for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
            steps += int(np.count_nonzero(is_wall[a] != is_wall[b]))
            both = (is_wall[a] & is_free[b]) | (is_free[a] & is_wall[b])
            to_free += int(np.count_nonzero(both))
    if walls < WALLS_MIN:
        size = f"{grid.height} x {grid.width}"
        if int(grid.cells.max()) < 0:
            return f"all {size} cells are unknown"
        return f"too few walls to judge: {walls} of the {WALLS_MIN} needed, on {size} cells"
    known = walls + free
    if free < FREE_MIN * walls:
        known, to_free = grid.cells.size, steps
    if to_free < max(WALLS_MIN, EDGE_MIN * walls):
        return (
            f"says nothing of a place: only {to_free} sides of its {walls} occupied cells border "
            "on other cells; too few walls yet, or is it all occupied?"
        )
    if to_free > STEPS_MAX * known:
        return (
            f"says nothing of a place: {to_free / known:.2f} steps from free to wall per known "
            f"cell, where maps have {STEPS_MAX:g} at most; is it noise?"
        )
    return None


def too_large(grid: OccupancyGrid, resolution: float) -> str | None:
    """Return why memory cannot hold a map at a resolution (m per cell), or None."""
    cells = int(grid.height * grid.width * max(1.0, (grid.resolution / resolution) ** 2))
    if cells <= CHECKED_CELLS:
        return None
    try:
        what = f"a map of {grid.height} x {grid.width} cells"
        check_memory(INPUT_BYTES * cells, what, grid.name)
    except MemoryBudgetError as error:
        return str(error)
    return None
