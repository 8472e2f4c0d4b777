"""The NumPy twins of gmapping's map update: counted hits and visits, and the field they give.

All results are whole numbers and equal the kernels' exactly. See ``slamfusion.compute.hit_counts``
for the words.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.compute.hit_counts import BeamScan, FieldRule, check_beams, check_rule
from slamfusion.compute.layout import (
    BEAM_ONE,
    BEAM_SHIFT,
    CELL_HALF,
    CELL_ONE,
    FULL_HITS,
    FULL_VISITS,
    HITS_SHIFT,
    OFFSET_HALF,
    OFFSET_ONE,
    OFFSET_SHIFT,
    SHARE_ONE,
    SUM_MASK,
    SUM_SHIFT,
    TABLE_LAST,
    TILE,
    VISITS_MASK,
    WALK_SHIFT,
    WALK_TO_BEAM_SHIFT,
)

__all__ = [
    "count_beams",
    "full_field",
    "settle_field",
    "touch_pages",
]

U8 = npt.NDArray[np.uint8]
U32 = npt.NDArray[np.uint32]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
F32 = npt.NDArray[np.float32]


class _Walks(NamedTuple):
    """Every step of every beam in every map, flat: the map and the cell."""

    map: I64
    row: I64
    col: I64


def _fixed_places(cells: F32, pages: int) -> I64:
    """Return positions in 1/1024 cell, moved into the window; what is no number becomes 0."""
    limit = pages * TILE * BEAM_ONE
    with np.errstate(invalid="ignore", over="ignore"):
        place = cells * np.float32(BEAM_ONE)
        place = np.where(place > 0, place, np.float32(0.0))
        inside = place < np.float32(limit)
    return np.where(inside, np.where(inside, place, np.float32(0.0)).astype(np.int64), limit - 1)


def _placed(scan: BeamScan, points: F32, shape: tuple[int, ...]) -> tuple[I64, I64]:
    """Return x and y (N, P) of points of the robot's frame in each map, in 1/1024 cell."""
    px, py = points[:, 0], points[:, 1]
    x, y, cos, sin = (scan.poses[:, i : i + 1] for i in range(4))
    with np.errstate(invalid="ignore", over="ignore"):
        east, north = x + (cos * px - sin * py), y + (sin * px + cos * py)
    return _fixed_places(east, shape[-1]), _fixed_places(north, shape[-2])


def _walks(scan: BeamScan, shape: tuple[int, ...]) -> _Walks:
    """Walk each beam from its end to the laser, one cell of the longer axis a step."""
    end_x, end_y = _placed(scan, scan.ends, shape)
    laser_x, laser_y = _placed(scan, scan.laser[None], shape)
    dx, dy = (laser_x - end_x).ravel(), (laser_y - end_y).ravel()
    longest = np.maximum(np.maximum(np.abs(dx), np.abs(dy)), 1)
    step_x = np.abs(dx) * (1 << WALK_SHIFT) // longest * np.where(dx < 0, -1, 1)
    step_y = np.abs(dy) * (1 << WALK_SHIFT) // longest * np.where(dy < 0, -1, 1)
    counts = (longest >> BEAM_SHIFT) + 1
    beam = np.repeat(np.arange(len(counts)), counts)
    i = np.arange(len(beam)) - np.repeat(np.cumsum(counts) - counts, counts)
    col = ((end_x.ravel()[beam] << WALK_TO_BEAM_SHIFT) + i * step_x[beam]) >> WALK_SHIFT
    row = ((end_y.ravel()[beam] << WALK_TO_BEAM_SHIFT) + i * step_y[beam]) >> WALK_SHIFT
    return _Walks(beam // max(1, len(scan.ends)), row, col)


def _places(pages: I32, maps: I64, row: I64, col: I64) -> tuple[I64, I64, I64]:
    """Return the index into a pool of cells of maps; beyond the window, the empty tile."""
    height, width = pages.shape[1] * TILE, pages.shape[2] * TILE
    inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
    row, col = np.where(inside, row, 0), np.where(inside, col, 0)
    tiles = np.where(inside, pages[maps, row // TILE, col // TILE], 0)
    return tiles, row % TILE, col % TILE


def touch_pages(pages: I32, scan: BeamScan, reach: int) -> U8:
    """Say which pages a scan comes near, so that they can be given tiles of their own.

    Args:
        pages: (N, PH, PW) int32; only its shape counts.
        scan: see ``BeamScan``.
        reach: cells, 0 to 16: as far from the walked cells as will be written.

    Returns:
        (N, PH, PW) uint8, on the host: 1 where a cell lies within ``reach`` cells, on both axes,
        of one that a beam walks through.
    """
    touched = np.zeros(pages.shape, dtype=np.uint8)
    w = _walks(scan, pages.shape)
    height, width = pages.shape[1:]
    for dx, dy in ((-reach, -reach), (reach, -reach), (-reach, reach), (reach, reach)):
        row = np.clip((w.row + dy) // TILE, 0, height - 1)
        col = np.clip((w.col + dx) // TILE, 0, width - 1)
        touched[w.map, row, col] = 1
    return touched


def count_beams(
    counts: U32, sums: U32, pages: I32, scan: BeamScan, *, take_back: bool = False
) -> bool:
    """Count a scan in every map, in place.

    All cells of a beam's walk, its end included, are visited once more; the end of a beam that met
    something is also hit once more.

    Args:
        counts: (T, TILE, TILE) uint32, no cell visited ``FULL_VISITS`` or hit ``FULL_HITS`` times
            yet.
        sums: (T, TILE, TILE) uint32, each half 15 or less a hit.
        pages: (N, PH, PW) int32; cells of pages without a tile are left out.
        scan: see ``BeamScan``; ``MOST_BEAMS`` or fewer.
        take_back: undo the counting of a scan that was counted at the same places.

    Returns:
        Whether a cell has now been visited ``FULL_VISITS`` or hit ``FULL_HITS`` times: halve all
        hits, visits and sums, and take the field from ``full_field``, as ``settle_field`` only sees
        what a scan crosses.

    Raises:
        DeviceError: the scan has more beams.
    """
    check_beams(scan)
    w = _walks(scan, pages.shape)
    places = _places(pages, *w)
    places = tuple(part[places[0] != 0] for part in places)
    sum_at = np.subtract.at if take_back else np.add.at
    sum_at(counts, places, np.uint32(1))

    x, y = (part[:, scan.is_hit != 0] for part in _placed(scan, scan.ends, pages.shape))
    maps = np.broadcast_to(np.arange(len(x))[:, None], x.shape)
    hit = _places(pages, maps, y >> BEAM_SHIFT, x >> BEAM_SHIFT)
    has_tile = hit[0] != 0
    hit = tuple(part[has_tile] for part in hit)
    sum_at(counts, hit, np.uint32(1 << HITS_SHIFT))
    east, north = ((place % BEAM_ONE) >> OFFSET_SHIFT for place in (x, y))
    sum_at(sums, hit, (east << SUM_SHIFT | north)[has_tile].astype(np.uint32))

    hits, visits = counts[places] >> HITS_SHIFT, counts[places] & VISITS_MASK
    return bool(((hits >= FULL_HITS) | (visits >= FULL_VISITS)).any())


def _field_of(counts: U32, sums: U32, offset: tuple[int, int], rule: FieldRule) -> I64:
    """Return what cells give the field of those from which they lie at an offset.

    Args:
        counts: of the cells, in any shape.
        sums: likewise.
        offset: x and y from a cell whose field is asked for to these, in cells.
        rule: see ``FieldRule``.
    """
    hits, visits = (counts >> HITS_SHIFT).astype(np.int64), (counts & VISITS_MASK).astype(np.int64)
    occupied = (hits >= rule.least_hits) & (hits * SHARE_ONE > rule.occupied * visits)
    halves = (sums >> SUM_SHIFT).astype(np.int64), (sums & SUM_MASK).astype(np.int64)
    dx, dy = (
        cells * CELL_ONE + OFFSET_HALF + total * OFFSET_ONE // np.maximum(hits, 1) - CELL_HALF
        for cells, total in zip(offset, halves, strict=True)
    )
    step = np.minimum((dx * dx + dy * dy) >> rule.shift, TABLE_LAST)
    return np.where(occupied, rule.table[step], 0).astype(np.int64)


def _square(reach: int) -> list[tuple[int, int]]:
    """Return the offsets (x, y) of the cells of a square."""
    side = range(-reach, reach + 1)
    return [(dx, dy) for dy in side for dx in side]


def settle_field(
    counts: U32, sums: U32, field: U8, pages: I32, scan: BeamScan, rule: FieldRule
) -> None:
    """Renew the score field, in place, wherever counting a scan may have changed it.

    That is within ``rule.reach`` cells, on both axes, of the walked cells that have hits. There the
    field becomes the greatest value that ``rule`` gives the occupied cells within reach, 0 where
    there are none: it depends on the counts alone, and after every scan equals ``full_field``.

    Args:
        counts: (T, TILE, TILE) uint32, the scan counted.
        sums: (T, TILE, TILE) uint32, each half 15 or less a hit.
        field: (T, TILE, TILE) uint8.
        pages: (N, PH, PW) int32; cells of pages without a tile are left out.
        scan: see ``BeamScan``.
        rule: see ``FieldRule``.
    """
    check_rule(rule)
    w = _walks(scan, pages.shape)
    is_changed = counts[_places(pages, *w)] >> HITS_SHIFT > 0
    changed = np.unique(np.stack(w, axis=1)[is_changed], axis=0)
    around = [changed + (0, dy, dx) for dx, dy in _square(rule.reach)]  # noqa: RUF005 - a sum
    maps, row, col = np.unique(np.concatenate(around), axis=0).T

    targets = _places(pages, maps, row, col)
    best = np.zeros(len(maps), dtype=np.int64)
    for dx, dy in _square(rule.reach):
        places = _places(pages, maps, row + dy, col + dx)
        field_there = _field_of(counts[places], sums[places], (dx, dy), rule)
        np.maximum(best, field_there, out=best)
    has_tile = targets[0] != 0
    field[tuple(part[has_tile] for part in targets)] = best[has_tile].astype(np.uint8)


def full_field(counts: U32, sums: U32, rule: FieldRule) -> U8:
    """Return the score field of a whole map from its counts.

    Args:
        counts: (H, W) uint32.
        sums: (H, W) uint32.
        rule: see ``FieldRule``.

    Returns:
        (H, W) uint8.
    """
    height, width = counts.shape
    check_rule(rule)
    padded = [np.pad(values, rule.reach) for values in (counts, sums)]
    best = np.zeros(counts.shape, dtype=np.int64)
    for dx, dy in _square(rule.reach):
        rows = slice(rule.reach + dy, rule.reach + dy + height)
        cols = slice(rule.reach + dx, rule.reach + dx + width)
        counts, sums = (part[rows, cols] for part in padded)
        np.maximum(best, _field_of(counts, sums, (dx, dy), rule), out=best)
    return best.astype(np.uint8)
