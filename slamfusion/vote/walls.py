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
# Rows and columns of cells.
Points = tuple[npt.NDArray[np.intp], ...]

# By how much good maps of one place differ in where they draw a wall, metres.
TOLERANCE_M = 0.08
# Up to here a wall that faces the same way is the same wall drawn elsewhere, metres.
SAME_WALL_M = 0.4
# A wall faces free cells up to this many cells away; the cells between may be unknown.
FRONT_CELLS = 3
# Steps in rows and columns to what a wall may face.
SIDES = ((0, 1), (0, -1), (1, 0), (-1, 0))


def margin_cells(resolution: float) -> int:
    """Return how far, in cells of a size in metres, a cell has a say in the codes of others."""
    return _same_wall_cells(resolution) + FRONT_CELLS


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
    codes: U8 = (walls * np.uint8(WALL_OCCUPIED) | free * np.uint8(WALL_FREE)).astype(np.uint8)
    rows, cols = np.flatnonzero(walls.any(axis=1)), np.flatnonzero(walls.any(axis=0))
    if not len(rows):
        return codes
    reach = margin_cells(resolution)
    # Cells farther from all walls have no more bits.
    window = (
        slice(max(0, int(rows[0]) - reach), int(rows[-1]) + reach + 1),
        slice(max(0, int(cols[0]) - reach), int(cols[-1]) + reach + 1),
    )
    own = codes[window]
    occupied = own & np.uint8(WALL_OCCUPIED)
    near_walls = cv2.dilate(occupied, _disc(TOLERANCE_M / resolution))
    own |= np.asarray(near_walls * np.uint8(WALL_NEAR), dtype=np.uint8)
    points = np.nonzero(occupied)
    fronts = _fronts(own, points)
    elsewhere = np.zeros_like(own)
    same, near = _same_wall_cells(resolution), max(1, math.floor(TOLERANCE_M / resolution))
    for number, side in enumerate(SIDES):
        bit = np.uint8(1 << number)
        front = np.zeros_like(own)
        front[points] = fronts & bit
        elsewhere |= np.asarray(cv2.dilate(front, _band(side, same, 3)), dtype=np.uint8)
    ways = _thick(fronts, points, own.shape, same)
    elsewhere[points] = ways
    elsewhere[~_is_shown(own, points, ways, same)] = 0
    own |= np.left_shift(elsewhere, np.uint8(WALL_SIDES))
    own &= ~(np.uint8(WALL_NEAR) * ~_is_shown(own, points, ways, near))
    return codes


def _same_wall_cells(resolution: float) -> int:
    return max(2, round(SAME_WALL_M / resolution))


def _fronts(codes: U8, points: Points) -> U8:
    """Return the ways that wall cells face, (N,) bits: free cells lie there, behind no wall."""
    padded = np.pad(codes, FRONT_CELLS)
    rows, cols = (at + FRONT_CELLS for at in points)
    ways = np.zeros(len(rows), dtype=np.uint8)
    for number, (down, right) in enumerate(SIDES):
        steps = [padded[rows + n * down, cols + n * right] for n in range(1, FRONT_CELLS + 1)]
        faces = np.bitwise_or.reduce(steps) & WALL_FREE != 0
        faces &= steps[0] & WALL_OCCUPIED == 0
        ways |= faces * np.uint8(1 << number)
    return ways


def _thick(fronts: U8, points: Points, shape: tuple[int, int], reach: int) -> U8:
    """Return the ways that wall cells face, (N,) bits; cells behind a face take its ways."""
    height, width = shape
    ways = np.zeros((height + 2, width + 2), dtype=np.uint8)
    rows, cols = (at + 1 for at in points)
    ways[rows, cols] = fronts
    for _ in range(reach):
        rest = np.flatnonzero(ways[rows, cols] == 0)
        if not len(rest):
            break
        row, col = rows[rest], cols[rest]
        around = [ways[row + down, col + right] for down in (-1, 0, 1) for right in (-1, 0, 1)]
        ways[row, col] = np.bitwise_or.reduce(around)
    return ways[rows, cols]


def _is_shown(codes: U8, points: Points, ways: U8, reach: int) -> npt.NDArray[np.bool_]:
    """Return the cells of which a map says something: known ones, and those at a wall's faces.

    Before and behind its wall a map says that the wall stands here; beyond its end, as where the
    map was cropped, it says nothing.
    """
    shown = codes & np.uint8(WALL_OCCUPIED | WALL_FREE)
    for number, side in enumerate(SIDES):
        faces = np.zeros_like(codes)
        faces[points] = ways & np.uint8(1 << number)
        shown |= np.asarray(cv2.dilate(faces, _band(side, reach, 1)), dtype=np.uint8)
    return np.asarray(shown != 0)


def _disc(radius: float) -> U8:
    """Return a structuring element of the cells within a radius, at least of the next ones."""
    radius = max(radius, math.sqrt(2.0))
    reach = math.floor(radius)
    row, col = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(row**2 + col**2 <= radius**2 + 1e-6, dtype=np.uint8)


def _band(side: tuple[int, int], reach: int, width: int) -> U8:
    """Return a structuring element along a way, ``reach`` cells to both ends."""
    shape = (width, 2 * reach + 1) if side[0] == 0 else (2 * reach + 1, width)
    return np.ones(shape, dtype=np.uint8)
