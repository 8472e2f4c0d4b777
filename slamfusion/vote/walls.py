"""What a map shows around each cell: a wall, a wall within the tolerance, the same wall elsewhere.

Maps of one place draw a wall a cell or two apart, so the vote on a wall has a tolerance. A map with
the wall a little further away contradicts it, even where that map knows nothing: it has not seen
what is behind its wall. Only a wall that faces the same way is the same wall; the other side of a
thin wall faces the other way.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import cv2
import numpy as np

from slamfusion.compute.layout import (
    ALONG_COL,
    ALONG_ROW,
    WALL_FACE,
    WALL_FREE,
    WALL_NEAR,
    WALL_OCCUPIED,
    WALL_SIDES,
)
from slamfusion.geometry import B8, I8, U8
from slamfusion.grid import CellBox

# Distance in metres between the same wall in two good maps of one place.
TOLERANCE_M = 0.08
# Up to here a wall that faces the same way is the same wall drawn elsewhere, metres.
SAME_WALL_M = 0.4
# A wall faces free cells up to this many cells away; the cells between may be unknown.
FRONT_CELLS = 3
# Range in cells in which lone beams and walls near them are detected.
BEAM_CELLS = 7
# Steps in rows and columns to what a wall may face: the first two along a row, the others along a
# column. Each has the bit of its place.
SIDES = ((0, 1), (0, -1), (1, 0), (-1, 0))
# Rows processed at once, to spare memory; the margins of more strips would cost more time.
STRIP_ROWS = 512


def margin_cells(resolution: float) -> int:
    """Return how far, in cells of a size in metres, a cell has a say in the codes of others."""
    # Cells behind the face of a thick wall take its directions, which are visible from as far
    # again.
    return max(2 * same_wall_cells(resolution) + FRONT_CELLS, BEAM_CELLS)


def wall_codes(cells: I8, resolution: float) -> U8:
    """Return what a map shows at and around each cell.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
        resolution: metres a cell.

    Returns:
        (H, W) uint8 of bits: ``WALL_OCCUPIED``, ``WALL_FREE``, ``WALL_NEAR`` (a wall within the
        tolerance), ``WALL_FACE`` (a wall that faces free cells itself), and from ``WALL_SIDES`` on
        one for each way that walls face: at a wall cell the ways that this wall faces, elsewhere
        those of walls up to 0.4 m away.
    """
    height = cells.shape[0]
    codes = np.empty(cells.shape, dtype=np.uint8)
    reach = margin_cells(resolution)
    for row in range(0, height, STRIP_ROWS):
        first, stop = max(0, row - reach), min(height, row + STRIP_ROWS)
        strip = _codes_of_strip(cells[first : stop + reach], resolution)
        codes[row:stop] = strip[row - first : stop - first]
    return codes


def codes_on(box: CellBox, whole: CellBox, resolution: float, read: Callable[[CellBox], I8]) -> U8:
    """Return ``wall_codes`` of a box of ``whole``; ``read`` returns its cells."""
    wide = box.grown_inside(margin_cells(resolution), whole)
    codes = wall_codes(read(wide), resolution)
    return np.ascontiguousarray(codes[box.slices(wide)])


def _codes_of_strip(cells: I8, resolution: float) -> U8:
    known = _without_lone_beams(cells)
    walls = known & np.uint8(WALL_OCCUPIED)
    if not walls.any():
        return known
    same, near = same_wall_cells(resolution), max(1, math.floor(TOLERANCE_M / resolution))
    fronts = _fronts(known)
    # Cells behind a face take its ways.
    ways = fronts.copy()
    for _ in range(same):
        taken = _spread(_spread(ways, 0, 1), 1, 1) * (walls * (ways == 0))
        if not taken.any():
            break
        ways |= taken
    # Three cells wide: walls of two maps are seldom quite parallel.
    elsewhere = _spread(_spread(ways & ALONG_ROW, 0, 1), 1, same)
    elsewhere |= _spread(_spread(ways & ALONG_COL, 1, 1), 0, same)
    elsewhere *= _is_shown(known, ways, same)
    # A disc of the tolerance, at least of the next cells.
    radius = max(TOLERANCE_M / resolution, math.sqrt(2.0))
    reach = math.floor(radius)
    row, col = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = (row**2 + col**2 <= radius**2 + 1e-6).astype(np.uint8)
    near_walls = np.asarray(cv2.dilate(walls, disc), dtype=np.uint8)
    near_walls *= _is_shown(known, ways, near)
    sides = np.where(walls != 0, ways, elsewhere) << np.uint8(WALL_SIDES)
    faces = (fronts != 0) * np.uint8(WALL_FACE)
    return np.asarray(known | faces | near_walls * np.uint8(WALL_NEAR) | sides, dtype=np.uint8)


def _without_lone_beams(cells: I8) -> U8:
    """Return known cells as ``WALL_OCCUPIED`` and ``WALL_FREE``, (H, W), lone beams left out.

    Beams that leak through a wall or a window leave streaks of free cells, one or two wide, with an
    end point without a wall next to it. Known ground is at least three cells wide, after gaps of
    two cells between beams are filled.
    """
    walls, free = (cells == 1).view(np.uint8), (cells == 0).view(np.uint8)
    square = np.ones((3, 3), dtype=np.uint8)
    filled = cv2.morphologyEx(walls | free, cv2.MORPH_CLOSE, square)
    narrow = 1 - np.asarray(cv2.morphologyEx(filled, cv2.MORPH_OPEN, square), dtype=np.uint8)
    beams = free & narrow
    ends = walls & narrow & np.asarray(cv2.dilate(beams, square), dtype=np.uint8)
    if ends.any():
        ends &= _walls_in(walls, 9) == _walls_in(walls, 5)
    known: U8 = (walls - ends) * np.uint8(WALL_OCCUPIED) | (free - beams) * np.uint8(WALL_FREE)
    return known


def _walls_in(walls: U8, side: int) -> U8:
    """Return how many wall cells lie in the square around each cell, (H, W)."""
    box = (side, side)
    counts = cv2.boxFilter(walls, -1, box, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(counts, dtype=np.uint8)


def same_wall_cells(resolution: float) -> int:
    """Return up to how many cells away a wall that faces the same way is the same wall."""
    return max(2, round(SAME_WALL_M / resolution))


def _fronts(known: U8) -> U8:
    """Return the ways that wall cells face, (H, W) bits: free cells lie there, behind no wall."""
    walls, free = (np.pad(known & bit != 0, FRONT_CELLS) for bit in (WALL_OCCUPIED, WALL_FREE))
    inner = CellBox(0, 0, *known.shape).moved(FRONT_CELLS, FRONT_CELLS)
    ways = np.zeros_like(known)
    for number, (down, right) in enumerate(SIDES):
        own, *ahead = (
            inner.moved(cells * down, cells * right).slices() for cells in range(FRONT_CELLS + 1)
        )
        faces = functools.reduce(np.bitwise_or, (free[cells] for cells in ahead))
        faces &= walls[own] > walls[ahead[0]]
        ways |= faces * np.uint8(1 << number)
    return ways


def _is_shown(known: U8, ways: U8, reach: int) -> B8:
    """Return the cells about which a map shows something: known ones, and those at a wall's faces.

    It does so before and behind its wall, but not beyond the end of the wall, for example where the
    map was cropped.
    """
    shown = known | _spread(ways & ALONG_ROW, 1, reach) | _spread(ways & ALONG_COL, 0, reach)
    return np.asarray(shown != 0)


def _spread(bits: U8, axis: int, reach: int) -> U8:
    """Return the bits of all cells up to ``reach`` cells away along an axis, in each cell."""
    shape, before = list(bits.shape), (slice(None),) * axis
    shape[axis] += 2 * reach
    out = np.zeros(shape, dtype=np.uint8)
    out[(*before, slice(reach, -reach))] = bits
    width, wanted = 1, 2 * reach + 1
    while width < wanted:
        step = min(width, wanted - width)
        out = out[(*before, slice(None, -step))] | out[(*before, slice(step, None))]
        width += step
    return out
