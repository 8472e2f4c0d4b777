"""What a map must not be to take part in the live fusion: limits that cost little to look at.

Everything else that the fusion does with a map costs more than these looks, so a map that says
nothing, or that no memory holds, costs the other inputs no time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.align.decide import WALLS_MIN
from slamfusion.config import NormalizeConfig
from slamfusion.errors import MemoryBudgetError
from slamfusion.grid import OccupancyGrid, implausible
from slamfusion.io.files import check_memory

I8 = npt.NDArray[np.int8]

# Cells that are looked at together, few enough for the processor's cache.
BAND_CELLS = 1 << 18
# Bands of a large map that are looked at before all of them are.
SAMPLE_BANDS = 4
# Steps from free to wall between neighbouring cells, per known cell. Of 70 recorded, rendered and
# drawn maps of places the highest has 0.21; noise of three values has 0.67, a chequered board of
# 4 x 4 cells 0.50.
STEPS_MAX = 0.4
# The same per wall cell: a map that is drawn in thick black has 0.009 at least; one that is all
# occupied has none.
EDGE_MIN = 0.001
# A map with fewer free cells for each wall cell is one of walls alone; there unknown is their rest.
FREE_MIN = 0.01
# Metres from corner to corner.
LENGTH_MAX_M = 1e6
# Working copies of one map, in bytes a cell, and the map from which they are worth a check.
INPUT_BYTES = 12
CHECKED_CELLS = 1 << 22


def bands(height: int, width: int) -> list[slice]:
    """Return rows that are looked at together, all of them one after the other."""
    step = max(1, BAND_CELLS // width)
    return [slice(row, min(row + step, height)) for row in range(0, height, step)]


def unusable(grid: OccupancyGrid, thresholds: NormalizeConfig) -> str | None:
    """Return in words why a map cannot take part, or None.

    It cannot with numbers that no place has (``grid.implausible``), with too few walls, as noise
    (free and wall cells change places from cell to cell), or all occupied.

    Args:
        grid: the map.
        thresholds: what is a wall, and what is free.
    """
    reason = implausible(grid.resolution, grid.origin)
    if reason is not None:
        return reason
    length = math.hypot(grid.height, grid.width) * grid.resolution
    if length > LENGTH_MAX_M:
        return f"a map must be at most {LENGTH_MAX_M:g} m long, found {length:g} m"
    occupied, walls = math.ceil(thresholds.occupied_percent), 0
    for band in bands(grid.height, grid.width):
        walls += int(np.count_nonzero(grid.cells[band] >= occupied))
        if walls >= WALLS_MIN:
            return _meaningless(grid, thresholds)
    size = f"{grid.height} x {grid.width}"
    if int(grid.cells.max()) < 0:
        return f"all {size} cells are unknown"
    return f"too few walls to judge: {walls} of the {WALLS_MIN} needed, on {size} cells"


def _meaningless(grid: OccupancyGrid, thresholds: NormalizeConfig) -> str | None:
    """Return in words why the walls of a map say nothing of a place, or None."""
    every = bands(grid.height, grid.width)
    stride = -(-len(every) // SAMPLE_BANDS)
    if stride > 1 and _verdict(_count(grid.cells, every[::stride], thresholds)) is None:
        return None
    return _verdict(_count(grid.cells, every, thresholds))


@dataclass
class _Texture:
    """Counts of a map's cells; steps are pairs of neighbours, one a wall and one not."""

    walls: int = 0
    free: int = 0
    cells: int = 0
    steps_to_free: int = 0
    steps: int = 0


def _count(cells: I8, rows: list[slice], thresholds: NormalizeConfig) -> _Texture:
    """Count the cells and steps of some bands of rows."""
    occupied, out = math.ceil(thresholds.occupied_percent), _Texture()
    for band in rows:
        wall = cells[band] >= occupied
        free = (cells[band] >= 0) & (cells[band] <= thresholds.free_percent)
        out.walls += int(np.count_nonzero(wall))
        out.free += int(np.count_nonzero(free))
        out.cells += wall.size
        for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
            out.steps += int(np.count_nonzero(wall[a] != wall[b]))
            to_free = (wall[a] & free[b]) | (free[a] & wall[b])
            out.steps_to_free += int(np.count_nonzero(to_free))
    return out


def _verdict(found: _Texture) -> str | None:
    """Return in words what is wrong with the counts of a map, or None."""
    steps, known = found.steps_to_free, found.walls + found.free
    if found.free < FREE_MIN * found.walls:
        steps, known = found.steps, found.cells
    if steps < max(WALLS_MIN, EDGE_MIN * found.walls):
        return (
            f"says nothing of a place: hardly any of its {found.walls} occupied cells lies beside "
            "another cell; is it all occupied?"
        )
    if steps > STEPS_MAX * known:
        return (
            f"says nothing of a place: {steps / known:.2f} steps from free to wall per known cell, "
            f"where maps have {STEPS_MAX:g} at most; is it noise?"
        )
    return None


def too_large(grid: OccupancyGrid, resolution: float) -> str | None:
    """Return in words that memory cannot hold a map at a resolution (m per cell), or None."""
    cells = int(grid.height * grid.width * max(1.0, (grid.resolution / resolution) ** 2))
    if cells <= CHECKED_CELLS:
        return None
    try:
        what = f"a map of {grid.height} x {grid.width} cells"
        check_memory(INPUT_BYTES * cells, what, grid.name)
    except MemoryBudgetError as error:
        return str(error)
    return None
