"""Cell means: maps whose cells keep a mean of what scans told them.

tinySLAM's map (a beam leaves a valley around its hit) and the likelihood field of the graph's
submaps (how near a scan's hits come) share the way: a scan is marked into a pool of words, then
what was marked is integrated, so that each cell learns once a scan.

``kernels/cell_means.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slamfusion.compute.arrays import I32, I64, U8, U32, ArrayDevice, DeviceArray, host
from slamfusion.compute.layout import (
    BEAM_HALF,
    BEAM_SHIFT,
    FIELD_ONE,
    HIT_SHIFT,
    LIKELIHOOD_ONE,
    LIKELIHOOD_SHIFT,
    MEAN_BITS,
    MEAN_HALF,
    MEAN_SHIFT,
    MOST_OBSERVATIONS,
    QUALITY_SHIFT,
    TABLE_LAST,
    TILE,
    VALUE_ONE,
    VALUE_SHIFT,
    VALUE_TO_MEAN_SHIFT,
    WALK_SHIFT,
    WALK_TO_BEAM_SHIFT,
)


class ScanRule(NamedTuple):
    """How beams of one scan write into the map.

    Attributes:
        half_blur: half width of the valley around a hit, 1/1024 cell.
        behind: least value that is written behind a hit, 0 to 4095.
        free: value of a passed cell for the matcher, 0 to 4095.
        map_free: the same for the published map.
        quality: weight of the scan, in 1/1024.
        is_mean: cell model ``mean``; otherwise ``base``.
        wall_floor: mean of a cell, in 1/2^20, up to which the score field is 0.
        wall_gain: what a mean above it adds to the field; at most 2000.
    """

    half_blur: int
    behind: int
    free: int
    map_free: int
    quality: int
    is_mean: bool
    wall_floor: int
    wall_gain: int


class LikelihoodRule(NamedTuple):
    """How the hits of one scan spread into the cells around them.

    Attributes:
        table: (256,) uint8 value by the squared distance from a cell's centre to a hit, in (1/1024
            cell)^2; it never rises, and its last counts for all that is farther.
        shift: the squared distance is shifted right by this first.
        reach: cells around a hit's own that learn of it.
        most: observations that a cell remembers, 1 to 4095.
    """

    table: U8
    shift: int
    reach: int
    most: int


class _Walks(NamedTuple):
    """Every step of every beam, flat: its beam, its number (0 at the hit) and its cell."""

    beam: I64
    i: I64
    col: I64
    row: I64
    step: I64


def _walks(beams: I32, half_blur: int) -> _Walks:
    """Walk each beam from behind its hit to the laser, one cell of the longer axis a step."""
    hit_x, hit_y, laser_x, laser_y, length, _ = beams.astype(np.int64).T
    dx, dy = laser_x - hit_x, laser_y - hit_y
    longest = np.maximum(np.abs(dx), np.abs(dy))
    m = np.maximum(longest, 1)
    step_x = np.abs(dx) * (1 << WALK_SHIFT) // m * np.where(dx < 0, -1, 1)
    step_y = np.abs(dy) * (1 << WALK_SHIFT) // m * np.where(dy < 0, -1, 1)
    step = length * (1 << WALK_SHIFT) // m
    reach = np.where(step > 0, (half_blur << WALK_TO_BEAM_SHIFT) // np.maximum(step, 1), 0)
    counts = reach + (longest >> BEAM_SHIFT) + 1
    beam = np.repeat(np.arange(len(beams)), counts)
    i = np.arange(len(beam)) - np.repeat(np.cumsum(counts) - counts, counts) - reach[beam]
    col = ((hit_x[beam] << WALK_TO_BEAM_SHIFT) + i * step_x[beam]) >> WALK_SHIFT
    row = ((hit_y[beam] << WALK_TO_BEAM_SHIFT) + i * step_y[beam]) >> WALK_SHIFT
    return _Walks(beam, i, col, row, step[beam])


def _joined(state: I64, value: I64, rule: ScanRule) -> I64:
    """Join observations (0 to 4095) to the states of cells, by the cell model."""
    mean, seen = state >> MEAN_SHIFT, state & MOST_OBSERVATIONS
    told = value << VALUE_TO_MEAN_SHIFT
    if rule.is_mean:
        change = MEAN_HALF + (((told - MEAN_HALF) * rule.quality) >> QUALITY_SHIFT) - mean
        following = mean + np.sign(change) * (np.abs(change) // (seen + 1))
    else:
        following = mean + (((told - mean) * rule.quality) >> QUALITY_SHIFT)
    return np.asarray(following << MEAN_SHIFT | np.minimum(seen + 1, MOST_OBSERVATIONS))


def _put(observed: U32, pages: I32, wanted: I32, row: I64, col: I64, words: I64) -> bool:
    """Put words into cells, of which the strongest stays; return whether a page was missing."""
    tiles = pages[row // TILE, col // TILE]
    missing = tiles == 0
    wanted[1 + (row // TILE * pages.shape[1] + col // TILE)[missing]] = 1
    wanted[0] |= int(missing.any())
    put = ~missing
    at = (tiles[put], row[put] % TILE, col[put] % TILE)
    np.maximum.at(observed, at, words[put].astype(np.uint32))
    return bool(wanted[0])


def _near_cells(beams: I32, reach: int) -> tuple[I64, I64, I64, I64]:
    """Return beam, column and row of every cell that beams speak of, and whether it is passed."""
    flat = np.column_stack((beams, np.zeros((len(beams), 2), dtype=np.int32)))
    w = _walks(flat, 0)
    way = w.i >= 1
    around = np.arange(-reach, reach + 1)
    rows, cols = (axis.ravel() for axis in np.meshgrid(around, around, indexing="ij"))
    col = (beams[:, :1].astype(np.int64) >> BEAM_SHIFT) + cols
    row = (beams[:, 1:2].astype(np.int64) >> BEAM_SHIFT) + rows
    beam = np.repeat(np.arange(len(beams)), len(rows))
    passed = np.concatenate((np.ones(int(way.sum()), np.int64), np.zeros(col.size, np.int64)))
    return (
        np.concatenate((w.beam[way], beam)),
        np.concatenate((w.col[way], col.ravel())),
        np.concatenate((w.row[way], row.ravel())),
        passed,
    )


class CellMeanDevice(ArrayDevice):
    """A device that updates cell means, in place."""

    def mark_scan(
        self,
        observed: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: ScanRule,
        wanted: DeviceArray[np.int32],
    ) -> bool:
        """Write into ``observed``, in place, what the beams of a scan say of their cells.

        Args:
            observed: (T, TILE, TILE) uint32, 0 before; the strongest word stays: a hit over the
                greatest value over in front over behind.
            pages: (PH, PW) int32.
            beams: (B, 6) int32: x, y of the hit and of the laser and the length between them in
                1/1024 cell, the value at the ridge of the valley, 0 to 4095. All inside the window.
            rule: see ``ScanRule``.
            wanted: (1 + PH * PW,) int32, set to 1 in place at 0 and at 1 + page where a page has no
                tile yet; those cells are left out.

        Returns:
            Whether a page was missing: provide tiles and mark again, which changes nothing twice.
        """
        if self.opencl:
            height, width = pages.shape
            count = beams.shape[0]
            self.opencl.launch(
                "mark_scan", (count,), observed, pages, width, height, beams, count,
                rule.half_blur, rule.behind, rule.free, wanted,
            )  # fmt: skip
            return bool(self.opencl.first(wanted))
        observed, pages, beams = host(observed), host(pages), host(beams)
        wanted = host(wanted)
        w = _walks(beams, rule.half_blur)
        away = (np.abs(w.i) * w.step) >> WALK_TO_BEAM_SHIFT
        half = max(1, rule.half_blur)
        value = np.full(len(w.i), rule.free, dtype=np.int64)
        near = away < rule.half_blur
        rise = np.maximum(beams[w.beam, 5].astype(np.int64) - rule.free, 0)
        value[near] += (rise * (rule.half_blur - away) // half)[near]
        keep = (w.i >= 0) | (value >= rule.behind)
        value[w.i == 0] = beams[w.beam[w.i == 0], 5]
        word = (w.i == 0).astype(np.int64) << HIT_SHIFT | value << VALUE_SHIFT | (w.i >= 0)
        return _put(observed, pages, wanted, w.row[keep], w.col[keep], word[keep])

    def integrate_scan(
        self,
        observed: DeviceArray[np.uint32],
        valley: DeviceArray[np.uint32],
        published: DeviceArray[np.uint32],
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: ScanRule,
    ) -> None:
        """Fold, in place, what a scan marked into the cells; each cell learns once a scan.

        Args:
            observed: (T, TILE, TILE) uint32, as ``mark_scan`` left it; becomes 0.
            valley: (T, TILE, TILE) uint32 states with the blur, for the matcher.
            published: the same without the blur and without what lies behind hits.
            field: (T, TILE, TILE) uint8: how much of a wall the valley is, 0 to 255.
            pages: (PH, PW) int32.
            beams: as for ``mark_scan``.
            rule: as for ``mark_scan``.
        """
        if self.opencl:
            height, width = pages.shape
            count = beams.shape[0]
            self.opencl.launch(
                "integrate_scan", (count,), observed, valley, published, field, pages, width,
                height, beams, count, rule.half_blur, rule.map_free, rule.quality, rule.is_mean,
                rule.wall_floor, rule.wall_gain,
            )  # fmt: skip
            return
        observed, valley, published = host(observed), host(valley), host(published)
        field, pages, beams = host(field), host(pages), host(beams)
        w = _walks(beams, rule.half_blur)
        places = np.stack(
            (pages[w.row // TILE, w.col // TILE], w.row % TILE, w.col % TILE), axis=-1
        )
        places = np.unique(places, axis=0)
        words = observed[tuple(places.T)].astype(np.int64)
        places, words = (item[words > 0] for item in (places, words))
        at = tuple(places.T)
        observed[at] = 0
        value = words >> VALUE_SHIFT & VALUE_ONE
        state = _joined(valley[at].astype(np.int64), value, rule)
        valley[at] = state.astype(np.uint32)
        walls = ((state >> MEAN_SHIFT) - rule.wall_floor) * rule.wall_gain >> MEAN_BITS
        field[at] = np.clip(walls, 0, FIELD_ONE).astype(np.uint8)
        front = (words & 1) == 1
        at = tuple(places[front].T)
        told = np.where(words[front] >> HIT_SHIFT, value[front], rule.map_free)
        published[at] = _joined(published[at].astype(np.int64), told, rule).astype(np.uint32)

    def mark_likelihood(
        self,
        observed: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: LikelihoodRule,
        wanted: DeviceArray[np.int32],
    ) -> bool:
        """Write into ``observed``, in place, how near the hits of a scan come to the cells.

        Args:
            observed: (T, TILE, TILE) uint32, 0 before; the strongest word stays.
            pages: (PH, PW) int32.
            beams: (B, 4) int32: x, y of the hit and of the laser in 1/1024 cell; all that they come
                near to inside the window.
            rule: see ``LikelihoodRule``.
            wanted: as for ``mark_scan``.

        Returns:
            Whether a page was missing: provide tiles and mark again, which changes nothing twice.
        """
        if self.opencl:
            height, width = pages.shape
            count = beams.shape[0]
            self.opencl.launch(
                "mark_likelihood", (count,), observed, pages, width, height, beams, count,
                self.opencl.table(rule.table), rule.shift, rule.reach, wanted,
            )  # fmt: skip
            return bool(self.opencl.first(wanted))
        observed, pages, beams = host(observed), host(pages), host(beams)
        wanted = host(wanted)
        beam, col, row, passed = _near_cells(beams, rule.reach)
        hit_x, hit_y = beams[beam, 0].astype(np.int64), beams[beam, 1].astype(np.int64)
        dx, dy = hit_x - (col << BEAM_SHIFT) - BEAM_HALF, hit_y - (row << BEAM_SHIFT) - BEAM_HALF
        step = np.minimum((dx * dx + dy * dy) >> rule.shift, TABLE_LAST)
        value = np.where(passed == 1, 0, rule.table[step].astype(np.int64))
        return _put(observed, pages, wanted, row, col, value << LIKELIHOOD_SHIFT | 1)

    def update_likelihood(
        self,
        observed: DeviceArray[np.uint32],
        states: DeviceArray[np.uint32],
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: LikelihoodRule,
    ) -> None:
        """Fold, in place, what a scan marked into the cells' means; each cell learns once a scan.

        Args:
            observed: (T, TILE, TILE) uint32, as ``mark_likelihood`` left it; becomes 0.
            states: (T, TILE, TILE) uint32: mean in 1/2^20 of 255 above 12 bits of observations.
            field: (T, TILE, TILE) uint8: the mean.
            pages: (PH, PW) int32.
            beams: as for ``mark_likelihood``.
            rule: as for ``mark_likelihood``.
        """
        if self.opencl:
            height, width = pages.shape
            count = beams.shape[0]
            self.opencl.launch(
                "update_likelihood", (count,), observed, states, field, pages, width, height,
                beams, count, rule.reach, rule.most,
            )  # fmt: skip
            return
        observed, states, field = host(observed), host(states), host(field)
        pages, beams = host(pages), host(beams)
        _, col, row, _ = _near_cells(beams, rule.reach)
        places = np.stack((pages[row // TILE, col // TILE], row % TILE, col % TILE), axis=-1)
        places = np.unique(places, axis=0)
        words = observed[tuple(places.T)].astype(np.int64)
        places, words = (item[words > 0] for item in (places, words))
        at = tuple(places.T)
        observed[at] = 0
        state = states[at].astype(np.int64)
        mean = state >> MEAN_SHIFT
        more = np.minimum((state & MOST_OBSERVATIONS) + 1, rule.most)
        change = (words >> LIKELIHOOD_SHIFT) * LIKELIHOOD_ONE - mean
        following = mean + np.sign(change) * (np.abs(change) // more)
        states[at] = (following << MEAN_SHIFT | more).astype(np.uint32)
        field[at] = (following // LIKELIHOOD_ONE).astype(np.uint8)
