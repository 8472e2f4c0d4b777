"""The NumPy twins of the chunk-mark kernels: each defines the kernel of its name, exactly."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute.chunk_marks import check_mark_reach
from slamfusion.compute.layout import (
    BEAM_HALF,
    BEAM_ONE,
    BEAM_SHIFT,
    FACINGS,
    FACINGS_ALIKE,
    TILE,
    WALK_SHIFT,
    WALK_TO_BEAM_SHIFT,
)

__all__ = ["mark_chunks", "nearest_marks"]

U32 = npt.NDArray[np.uint32]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
# Beams that are walked at once: each step of each is a row of some arrays.
BATCH = 4096


def _places(pages: I32, row: I64, col: I64) -> tuple[I64, I64, I64]:
    """Return the index into a pool of cells; beyond the window, of a cell of the empty tile."""
    height, width = pages.shape[0] * TILE, pages.shape[1] * TILE
    inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
    row, col = np.where(inside, row, 0), np.where(inside, col, 0)
    tiles = np.where(inside, pages[row // TILE, col // TILE], 0)
    return tiles.astype(np.int64), row % TILE, col % TILE


def _mark(pool: U32, places: tuple[I32 | I64, ...], bits: U32) -> None:
    has_tile = places[0] != 0
    np.bitwise_or.at(pool, tuple(part[has_tile] for part in places), bits[has_tile])


def mark_chunks(hits: U32, seen: U32, pages: I32, beams: I32, facings: I32, bits: U32) -> None:
    """Mark beams with the bits of their chunks, in place.

    Every cell on the walk from a beam's end to the laser is seen, one cell of the longer axis a
    step; the cell of the end is also hit.

    Args:
        hits: (T, FACINGS, TILE, TILE) uint32, bits of the chunks whose beams ended in a cell, on a
            surface that faces about a direction.
        seen: (T, TILE, TILE) uint32, bits of the chunks whose beams passed a cell or ended in it.
        pages: (PH, PW) int32; cells of pages without a tile, and beyond the window, are left out.
        beams: (B, BEAM_INTS) int32: x and y of the hit and of the laser in 1/1024 cell.
        facings: (B,) int32, 0 to ``FACINGS`` - 1, the direction that each hit surface faces.
        bits: (B,) uint32, the bits to mark each beam with.
    """
    end = beams[:, 1].astype(np.int64) >> BEAM_SHIFT, beams[:, 0].astype(np.int64) >> BEAM_SHIFT
    tile, row, col = _places(pages, *end)
    side = FACINGS_ALIKE // 2
    for turn in range(-side, side + 1):
        _mark(hits, (tile, (facings + turn) % FACINGS, row, col), bits)
    for first in range(0, len(beams), BATCH):
        some = beams[first : first + BATCH].astype(np.int64)
        dx, dy = some[:, 2] - some[:, 0], some[:, 3] - some[:, 1]
        longest = np.maximum(np.maximum(np.abs(dx), np.abs(dy)), 1)
        step_x = np.abs(dx) * (1 << WALK_SHIFT) // longest * np.where(dx < 0, -1, 1)
        step_y = np.abs(dy) * (1 << WALK_SHIFT) // longest * np.where(dy < 0, -1, 1)
        counts = (longest >> BEAM_SHIFT) + 1
        beam = np.repeat(np.arange(len(some)), counts)
        i = np.arange(len(beam)) - np.repeat(np.cumsum(counts) - counts, counts)
        col = ((some[beam, 0] << WALK_TO_BEAM_SHIFT) + i * step_x[beam]) >> WALK_SHIFT
        row = ((some[beam, 1] << WALK_TO_BEAM_SHIFT) + i * step_y[beam]) >> WALK_SHIFT
        _mark(seen, _places(pages, row, col), bits[first : first + BATCH][beam])


def nearest_marks(
    hits: U32, seen: U32, pages: I32, beams: I32, facings: I32, left_out: U32, reach: int
) -> I32:
    """Return how near the end of each beam the chunks that are not left out hit something.

    Args:
        hits, seen, pages: a map as ``mark_chunks`` leaves it.
        beams: (B, BEAM_INTS) int32; of the laser nothing is read.
        facings: (B,) int32, the direction that each hit surface faces.
        left_out: (B,) uint32, the bits that do not count for each beam.
        reach: cells around the end's own that are looked at, 0 to ``MARK_REACH_MAX``.

    Returns:
        (B, 2) int32, on the host: the squared distance from the end to the centre of the nearest
        cell that was hit, in (1/1024 cell)^2, -1 where there is none within reach; and 1 where the
        cell of the end was seen, else 0.

    Raises:
        DeviceError: the reach is too far.
    """
    check_mark_reach(reach)
    x, y = beams[:, 0].astype(np.int64), beams[:, 1].astype(np.int64)
    col, row = x >> BEAM_SHIFT, y >> BEAM_SHIFT
    counted = ~left_out
    # More than any squared distance within reach.
    none = 2 * ((reach + 1) * BEAM_ONE) ** 2
    nearest = np.full(len(beams), none, dtype=np.int64)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            tile, in_row, in_col = _places(pages, row + dy, col + dx)
            is_hit = hits[tile, facings, in_row, in_col] & counted != 0
            gap_x = ((col + dx) << BEAM_SHIFT) + BEAM_HALF - x
            gap_y = ((row + dy) << BEAM_SHIFT) + BEAM_HALF - y
            squared = np.where(is_hit, gap_x * gap_x + gap_y * gap_y, none)
            np.minimum(nearest, squared, out=nearest)
    is_seen = seen[_places(pages, row, col)] & counted != 0
    found = np.stack((np.where(nearest == none, -1, nearest), is_seen), axis=1)
    return np.asarray(found, dtype=np.int32)
