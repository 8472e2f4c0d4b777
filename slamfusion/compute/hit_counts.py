"""Hit counts: gmapping's map update, counted hits and visits, and the score field they give.

N maps (particles) have a page table each, (N, PH, PW) int32, over one common window and one set of
pools (T, TILE, TILE); see ``slamfusion.compute.tiles``. A tile that is written must be on one page
of one map only: see ``touch_pages`` and ``copy_tiles``. Positions are in cells of the window.

A cell of ``counts`` (uint32) has its hits in the upper and its visits, hits included, in the lower
16 bits. A cell of ``sums`` (uint32) sums over the hits their offset in the cell, 0 to 15 in 1/16
cell, in x in the upper and in y in the lower 16 bits; an offset stands for the middle of its
sixteenth. An unseen cell is 0 in all pools. A half of a sum has room for the hits of a cell that is
nearly full and of one scan more; see ``FULL_HITS`` and ``MOST_BEAMS`` in ``layout``.

The ``field`` (T, TILE, PAIRS) uint16 has the value of a cell in the lower and that of the cell
above it in the upper 8 bits. The last pair of a row is the first of the next tile's, and the upper
half of the last row is the first row of the tile above: the four values around a place are two
neighbouring pairs of one tile.

``kernels/hit_counts.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray, host
from slamfusion.compute.layout import (
    BEAM_ONE,
    CELL_HALF,
    CELL_ONE,
    CLIMBERS,
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
    UNKNOWN,
    VISITS_MASK,
)
from slamfusion.compute.tiles import move_points, tile_places, walk_cells
from slamfusion.geometry import B8, F32, I8, I32, I64, U8, U32

# Beams that NumPy walks at once.
BATCH = 4096
# The limits of the map servers, in percent.
FREE_PERCENT, OCCUPIED_PERCENT = 25.0, 65.0


def halve_counts(device: ArrayDevice, pools: dict[str, DeviceArray[Any]]) -> None:
    """Halve the counts of busy cells before they overflow; few counts would become inexact."""
    counts = device.download(pools["counts"])
    is_busy = (counts >= FULL_HITS // 2 << 16) | (counts & 0xFFFF >= FULL_VISITS // 2)
    busy = np.nonzero(is_busy)
    hits, visits = counts[busy] >> 16, counts[busy] & 0xFFFF
    fewer = (hits + 1) >> 1
    counts[busy] = fewer << 16 | (visits + 1) >> 1
    pools["counts"] = device.upload(counts)
    sums = device.download(pools["sums"])
    some = np.maximum(hits, 1)
    sum_x, sum_y = (
        (half * fewer + some // 2) // some for half in (sums[busy] >> 16, sums[busy] & 0xFFFF)
    )
    sums[busy] = sum_x << 16 | sum_y
    pools["sums"] = device.upload(sums)


def percent_of_counts(
    hits: npt.NDArray[Any], visits: npt.NDArray[Any], threshold: float, least_visits: int = 1
) -> I8:
    """Return hits and visits as occupancy in percent.

    The percent rises with the share of hits, and the threshold maps to 65, the limit of the map
    servers: walls by the threshold are published as walls, all else as free.

    Args:
        hits, visits: (H, W) uint32.
        threshold: a cell is a wall when more than this share of its visits were hits, 0 to 1.
    """
    percent = np.where(visits < least_visits, np.int8(UNKNOWN), np.int8(0))
    # Few cells were hit; the others are free, 0 %.
    some = np.nonzero((hits > 0) & (visits >= least_visits))
    share = hits[some] / visits[some]
    rising = np.rint(np.interp(share, (0.0, threshold, 1.0), (0.0, OCCUPIED_PERCENT, 100.0)))
    percent[some] = np.where(
        share > threshold, np.maximum(rising, OCCUPIED_PERCENT), np.minimum(rising, FREE_PERCENT)
    ).astype(np.int8)
    return percent


if TYPE_CHECKING:
    from slamfusion.compute.opencl import OpenCLDevice


class BeamScan(NamedTuple):
    """A scan as it is written into every map, on the host.

    What lies outside the window is moved to its border.

    Attributes:
        ends: (B, 2) float32 ends of the beams, cells, in the robot's frame.
            ``count_and_settle`` takes up to ``MOST_BEAMS``.
        is_hit: (B,) uint8, 0 where the beam is free up to its end and met nothing.
        laser: (2,) float32, cells, in the robot's frame.
        poses: (N, 4) float32, the robot in each map: x, y in cells of the window, cos, sin.
    """

    ends: F32
    is_hit: U8
    laser: F32
    poses: F32


class FieldRule(NamedTuple):
    """How the score field follows from the counts.

    Attributes:
        table: (256,) uint8, never rising: the field by the squared distance, in (1/256 cell)^2,
            between the centre of a cell and the mean hit of an occupied one; the last for all that
            is farther.
        shift: the distance is shifted right by this first.
        reach: how many cells around, 0 to ``MOST_REACH``, occupied ones are looked for.
        occupied: a cell is occupied with more hits than this share of its visits, in 1/65536,
        least_hits: and at least this many hits.
    """

    table: U8
    shift: int
    reach: int
    occupied: int
    least_hits: int


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
    with np.errstate(invalid="ignore", over="ignore"):
        east, north = move_points(points, scan.poses)
    return _fixed_places(east, shape[-1]), _fixed_places(north, shape[-2])


def _beams(scan: BeamScan, shape: tuple[int, ...]) -> I64:
    """Return each beam in each map, (N * B, 4), as ``walk_cells`` takes them."""
    ends, laser = _placed(scan, scan.ends, shape), _placed(scan, scan.laser[None], shape)
    return np.stack(np.broadcast_arrays(*ends, *laser), axis=-1).reshape(-1, 4)


def _is_wall(counts: U32, rule: FieldRule) -> B8:
    """Return which cells are occupied."""
    hits, visits = (counts >> HITS_SHIFT).astype(np.int64), (counts & VISITS_MASK).astype(np.int64)
    return np.asarray((hits >= rule.least_hits) & (hits * SHARE_ONE > rule.occupied * visits))


def _field_of(counts: U32, sums: U32, offset: tuple[int, int], rule: FieldRule) -> I64:
    """Return the field that cells cause at an offset."""
    hits = (counts >> HITS_SHIFT).astype(np.int64)
    halves = (sums >> SUM_SHIFT).astype(np.int64), (sums & SUM_MASK).astype(np.int64)
    dx, dy = (
        cells * CELL_ONE + OFFSET_HALF + total * OFFSET_ONE // np.maximum(hits, 1) - CELL_HALF
        for cells, total in zip(offset, halves, strict=True)
    )
    step = np.minimum((dx * dx + dy * dy) >> rule.shift, TABLE_LAST)
    return np.where(_is_wall(counts, rule), rule.table[step], 0).astype(np.int64)


def _square(reach: int) -> list[tuple[int, int]]:
    """Return the offsets (x, y) of the cells of a square."""
    side = range(-reach, reach + 1)
    return [(dx, dy) for dy in side for dx in side]


def _launch_beams(
    device: OpenCLDevice,
    name: str,
    each: int,
    pages: DeviceArray[np.int32],
    scan: BeamScan,
    *arguments: Any,
) -> None:
    """Start a kernel with ``each`` items for a map."""
    maps, height, width = pages.shape
    # The scan is copied: the kernel may still run when its arrays are gone.
    device.launch(
        name, (maps * each,), device.upload(scan.ends), len(scan.ends), *scan.laser,
        device.upload(scan.poses), *(maps, width, height), *arguments,
    )  # fmt: skip


def _count_on_host(counts: U32, sums: U32, pages: I32, scan: BeamScan) -> bool:
    """Count a scan in every map, in place; return whether a cell is full."""
    beams = _beams(scan, pages.shape)
    beam, row, col, step = walk_cells(beams)
    maps, own = np.divmod(beam, max(1, len(scan.ends)))
    places = tile_places(pages, maps, row, col)
    has_tile = places[0] != 0
    is_end = has_tile & (step == 0) & (scan.is_hit[own] != 0)
    places, hit = (tuple(part[some] for part in places) for some in (has_tile, is_end))
    np.add.at(counts, places, np.uint32(1))
    np.add.at(counts, hit, np.uint32(1 << HITS_SHIFT))
    east, north = (beams[beam[is_end], :2] % BEAM_ONE >> OFFSET_SHIFT).T
    np.add.at(sums, hit, (east << SUM_SHIFT | north).astype(np.uint32))
    hits, visits = counts[places] >> HITS_SHIFT, counts[places] & VISITS_MASK
    return bool(((hits >= FULL_HITS) | (visits >= FULL_VISITS)).any())


class HitCountDevice(ArrayDevice):
    """A device that counts beams, in place; the scan comes from the host."""

    def touch_pages(self, pages: DeviceArray[np.int32], scan: BeamScan, reach: int) -> U8:
        """Say which pages a scan comes near, so that they can be given tiles of their own.

        Args:
            pages: (N, PH, PW) int32; only its shape counts.
            reach: cells, 0 to 16: as far from the walked cells as will be written.

        Returns:
            (N, PH, PW) uint8, on the host: 1 where a cell lies within ``reach`` cells, on both
            axes, of one that a beam walks through.
        """
        if self.opencl:
            out = self.opencl.cleared(pages.shape, np.uint8)
            _launch_beams(self.opencl, "touch_pages", len(scan.ends), pages, scan, reach, out)
            return self.download(out)
        pages = host(pages)
        touched = np.zeros(pages.shape, dtype=np.uint8)
        beam, rows, cols, _ = walk_cells(_beams(scan, pages.shape))
        maps = beam // max(1, len(scan.ends))
        height, width = pages.shape[1:]
        for dx, dy in ((-reach, -reach), (reach, -reach), (-reach, reach), (reach, reach)):
            row = np.clip((rows + dy) // TILE, 0, height - 1)
            col = np.clip((cols + dx) // TILE, 0, width - 1)
            touched[maps, row, col] = 1
        return touched

    def count_walks(
        self,
        hits: DeviceArray[np.uint32],
        visits: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: I32,
        is_hit: U8,
        sign: int,
    ) -> None:
        """Count the beams of any number of scans in one map, in place.

        Args:
            hits, visits: (T, TILE, TILE) uint32; as ``count_and_settle`` counts.
            pages: (1, PH, PW) int32; cells of pages without a tile are left out.
            beams: (B, BEAM_INTS) int32, on the host: x and y of end and laser in 1/1024 cell,
                inside of the window.
            is_hit: (B,) uint8, on the host.
            sign: 1, or -1 to take beams back that were counted.
        """
        if self.opencl:
            count, width = len(beams), pages.shape[2]
            self.opencl.launch(
                "count_walks", (count,), self.upload(beams), count, self.upload(is_hit), width,
                pages, hits, visits, sign,
            )  # fmt: skip
            return
        pages, pools = host(pages), (host(visits), host(hits))
        sum_at = np.add.at if sign > 0 else np.subtract.at
        for first in range(0, len(beams), BATCH):
            beam, row, col, step = walk_cells(beams[first : first + BATCH])
            places = tile_places(pages, 0, row, col)
            is_visit = places[0] != 0
            is_end = is_visit & (step == 0)
            counted = is_visit, is_end & (is_hit[first : first + BATCH][beam] != 0)
            for pool, here in zip(pools, counted, strict=True):
                sum_at(pool, tuple(part[here] for part in places), np.uint32(1))

    def count_and_settle(
        self,
        counts: DeviceArray[np.uint32],
        sums: DeviceArray[np.uint32],
        field: DeviceArray[np.uint16],
        pages: DeviceArray[np.int32],
        touched: U8,
        scan: BeamScan,
        rule: FieldRule,
    ) -> bool:
        """Count a scan in every map, and renew the score field, in place.

        All cells of a beam's walk, its end included, are visited once more; the end of a beam that
        met something is also hit once more. The field is the greatest value that ``rule`` gives the
        occupied cells within reach, on both axes, 0 where there are none. It is computed again
        around the cells that the scan hits, and around those that are no longer occupied.

        Args:
            counts: (T, TILE, TILE) uint32, no cell visited ``FULL_VISITS`` or hit ``FULL_HITS``
                times yet.
            sums: (T, TILE, TILE) uint32, each half 15 or less a hit.
            field: (T, TILE, PAIRS) uint16.
            pages: (N, PH, PW) int32; cells of pages without a tile are left out.
            touched: (N, PH, PW) uint8, on the host: what ``touch_pages`` returns for this scan and
                a cell more than ``rule.reach``.
            scan: see ``BeamScan``; ``MOST_BEAMS`` or fewer.

        Returns:
            Whether a cell has now been visited ``FULL_VISITS`` or hit ``FULL_HITS`` times: halve
            all hits, visits and sums.
        """
        if self.opencl:
            marks = self.opencl.cleared((counts.shape[0], TILE), np.uint32)
            full = self.opencl.upload(np.zeros(1, dtype=np.int32))
            wall = np.uint32(rule.occupied), np.uint32(rule.least_hits)
            each = CLIMBERS if self.opencl.is_pocl else max(1, len(scan.ends))
            _launch_beams(
                self.opencl, "count_beams", each, pages, scan, each, self.upload(scan.is_hit),
                pages, counts, sums, full, marks, *wall,
            )  # fmt: skip
            near = np.flatnonzero(touched.view(np.bool_)).astype(np.int32)  # ten times as fast
            self.opencl.launch(
                "settle_field", (len(near),), self.upload(near), len(near), pages, pages.shape[2],
                pages.shape[1], counts, sums, field, marks, self.opencl.table(rule.table),
                rule.shift, rule.reach, *wall,
            )  # fmt: skip
            return bool(self.download(full)[0])
        counts, sums, field, pages = host(counts), host(sums), host(field), host(pages)
        before = counts.copy()
        is_full = _count_on_host(counts, sums, pages, scan)
        is_hit = counts >> HITS_SHIFT != before >> HITS_SHIFT
        is_changed = is_hit | (_is_wall(counts, rule) != _is_wall(before, rule))
        maps, page_row, page_col, in_row, in_col = np.nonzero(is_changed[pages])
        changed = np.column_stack((maps, page_row * TILE + in_row, page_col * TILE + in_col))
        around = [changed + (0, dy, dx) for dx, dy in _square(rule.reach)]  # noqa: RUF005 - a sum
        maps, row, col = np.unique(np.concatenate(around), axis=0).T

        best = np.zeros(len(maps), dtype=np.int64)
        for dx, dy in _square(rule.reach):
            places = tile_places(pages, maps, row + dy, col + dx)
            field_there = _field_of(counts[places], sums[places], (dx, dy), rule)
            np.maximum(best, field_there, out=best)
        values = field.view(np.uint8).reshape(*field.shape, 2)
        for down, left in ((0, 0), (1, 0), (0, 1), (1, 1)):
            tile, in_row, in_col = tile_places(pages, maps, row - down, col - left)
            is_there = (tile != 0) & ((left == 0) | (in_col == TILE - 1))
            place = tile[is_there], in_row[is_there], in_col[is_there] + left
            values[(*place, down)] = best[is_there]
        return is_full
