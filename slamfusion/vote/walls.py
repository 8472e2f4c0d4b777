"""What a map shows around each cell: a wall, a wall within the tolerance, the same wall elsewhere.

Maps of one place draw a wall a cell or two apart. So a wall is voted for with a tolerance, and a
map whose wall stands a little further away contradicts it, also where the map knows nothing: what
is behind its wall it has not seen. Only a wall that faces the same way is the same wall; the other
side of a thin wall faces the other way.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import WALL_FREE, WALL_NEAR, WALL_OCCUPIED, WALL_SIDES

__all__ = ["margin_cells", "wall_codes"]

I8 = npt.NDArray[np.int8]
U8 = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

# By how much good maps of one place differ in where they draw a wall, metres.
TOLERANCE_M = 0.08
# Up to here a wall that faces the same way is the same wall drawn elsewhere, metres.
SAME_WALL_M = 0.4
# A wall faces free cells up to this many cells away; the cells between may be unknown.
FRONT_CELLS = 3
# Cells behind a face that belong to it: walls are drawn several cells thick.
THICK_CELLS = 3
# Steps in rows and columns to what a wall may face.
SIDES = ((0, 1), (0, -1), (1, 0), (-1, 0))


def margin_cells(resolution: float) -> int:
    """Return how far, in cells of a size in metres, a cell has a say in the codes of others."""
    return max(_same_wall_cells(resolution), THICK_CELLS) + FRONT_CELLS


def wall_codes(cells: I8, resolution: float) -> U8:
    """Return what a map shows at and around each cell.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
        resolution: metres a cell.

    Returns:
        (H, W) uint8 of bits: ``WALL_OCCUPIED``, ``WALL_FREE``, ``WALL_NEAR`` (a wall within the
        tolerance), and from ``WALL_SIDES`` on one for each way that walls face: at a wall cell the
        ways that this wall faces, elsewhere those of walls up to 0.4 m away.
    """
    walls, free = cells == 1, cells == 0
    codes = (walls * np.uint8(WALL_OCCUPIED) | free * np.uint8(WALL_FREE)).astype(np.uint8)
    rows, cols = np.flatnonzero(walls.any(axis=1)), np.flatnonzero(walls.any(axis=0))
    if not len(rows):
        return codes
    reach = margin_cells(resolution)
    # Cells farther from all walls have no more bits.
    window = (
        slice(max(0, int(rows[0]) - reach), int(rows[-1]) + reach + 1),
        slice(max(0, int(cols[0]) - reach), int(cols[-1]) + reach + 1),
    )
    walls, free, codes_there = walls[window], free[window], codes[window]
    codes_there |= cv2.dilate(walls.view(np.uint8), _disc(TOLERANCE_M / resolution)) * np.uint8(
        WALL_NEAR
    )
    fronts = [_faces(walls, free, side) for side in SIDES]
    same = _same_wall_cells(resolution)
    for number, (side, own) in enumerate(zip(SIDES, _thick(walls, fronts), strict=True)):
        around = cv2.dilate(fronts[number].view(np.uint8), _band(side, same))
        bits = np.where(walls, own, around).astype(np.uint8)
        codes_there |= bits << np.uint8(WALL_SIDES + number)
    return codes


def _same_wall_cells(resolution: float) -> int:
    return max(2, round(SAME_WALL_M / resolution))


def _faces(walls: Mask, free: Mask, side: tuple[int, int]) -> Mask:
    """Return the wall cells that face a way: free cells lie there, and no wall is next to it."""
    rows, cols = side
    seen = np.zeros_like(free)
    for step in range(1, FRONT_CELLS + 1):
        seen |= _from(free, step * rows, step * cols)
    return np.asarray(walls & seen & ~_from(walls, rows, cols))


def _thick(walls: Mask, fronts: list[Mask]) -> list[Mask]:
    """Return the ways that wall cells face; those behind a face take its ways."""
    ways = list(fronts)
    square = np.ones((3, 3), dtype=np.uint8)
    for _ in range(THICK_CELLS):
        rest = walls & ~np.logical_or.reduce(ways)
        ways = [way | (rest & (cv2.dilate(way.view(np.uint8), square) > 0)) for way in ways]
    return ways


def _from(mask: Mask, rows: int, cols: int) -> Mask:
    """Return what lies some rows and columns from each cell; nothing does beyond the edge."""
    height, width = mask.shape
    out = np.zeros_like(mask)
    target = (
        slice(max(0, -rows), min(height, height - rows)),
        slice(max(0, -cols), min(width, width - cols)),
    )
    source = (
        slice(max(0, rows), min(height, height + rows)),
        slice(max(0, cols), min(width, width + cols)),
    )
    out[target] = mask[source]
    return out


def _disc(radius: float) -> U8:
    """Return a structuring element of the cells within a radius, at least of the next ones."""
    radius = max(radius, math.sqrt(2.0))
    reach = math.floor(radius)
    row, col = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return (row**2 + col**2 <= radius**2 + 1e-6).astype(np.uint8)


def _band(side: tuple[int, int], reach: int) -> U8:
    """Return a structuring element along a way, ``reach`` cells to both ends, three cells wide."""
    element = np.zeros((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    middle = slice(reach - 1, reach + 2)
    element[(middle, slice(None)) if side[0] == 0 else (slice(None), middle)] = 1
    return element
