"""Cell means: maps whose cells keep a mean of their observations.

tinySLAM's map (a beam leaves a valley around its hit) and the likelihood field of the graph's
submaps (distance to the hits) work alike: a scan is marked into a pool of words, then the marks are
integrated, so that each cell is updated once per scan. Pools are (T, TILE, TILE); the rule names
the pools of a map and its update.

``kernels/cell_means.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from slamfusion.compute.arrays import ArrayDevice, DeviceArray, host
from slamfusion.compute.layout import (
    BEAM_HALF,
    BEAM_ONE,
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
from slamfusion.compute.tiles import FieldWindow, dense_pages, walk_cells
from slamfusion.geometry import B8, I32, I64, U8

Pools = Mapping[str, DeviceArray[Any]]
# Tile, row and column of some cells.
Places = tuple[I64, ...]


class ScanRule(NamedTuple):
    """How beams of one scan write into tinySLAM's map.

    Pools: ``observed`` uint32, ``valley`` uint32 states with the blur, for the matcher,
    ``published`` uint32 states without the blur and without what lies behind hits, ``field`` uint8:
    the length between them in 1/1024 cell, the value at the ridge of the valley, 0 to 4095. The
    strongest word of a cell stays: a hit over the greatest value over in front over behind.

    Attributes:
        half_blur: half width of the valley around a hit, 1/1024 cell; at most 2^19.
        behind: least value that is written behind a hit, 0 to 4095.
        free: value of a passed cell for the matcher, 0 to 4095.
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

    def words(self, beams: I32) -> tuple[I64, I64, I64, I64]:
        """Return beam, row, column and word of every cell that beams observe.

        A beam is walked from behind its hit (step 0) to the laser, by a cell of the longer axis.
        """
        hit_x, hit_y, laser_x, laser_y, length, ridge = beams.astype(np.int64).T
        longest = np.maximum(np.abs(laser_x - hit_x), np.abs(laser_y - hit_y))
        step = length * (1 << WALK_SHIFT) // np.maximum(longest, 1)
        reach = np.where(step > 0, (self.half_blur << WALK_TO_BEAM_SHIFT) // np.maximum(step, 1), 0)
        beam, row, col, i = walk_cells(beams, reach)
        away = (np.abs(i) * step[beam]) >> WALK_TO_BEAM_SHIFT
        rise = np.maximum(ridge[beam] - self.free, 0) * (self.half_blur - away)
        value = self.free + np.where(away < self.half_blur, rise // max(1, self.half_blur), 0)
        keep = (i >= 0) | (value >= self.behind)
        value = np.where(i == 0, ridge[beam], value)
        word = (i == 0).astype(np.int64) << HIT_SHIFT | value << VALUE_SHIFT | (i >= 0)
        return beam[keep], row[keep], col[keep], word[keep]

    @property
    def margin(self) -> float:
        """How far cells that beams observe may lie from them."""
        return self.half_blur / BEAM_ONE + 1.0

    def learn(self, pools: Pools, at: Places, words: I64) -> None:
        """Fold words into the cells of tinySLAM's map."""
        valley, published, field = (host(pools[name]) for name in ("valley", "published", "field"))
        value = words >> VALUE_SHIFT & VALUE_ONE
        state = _joined(valley[at].astype(np.int64), value, self)
        valley[at] = state.astype(np.uint32)
        walls = ((state >> MEAN_SHIFT) - self.wall_floor) * self.wall_gain >> MEAN_BITS
        field[at] = np.clip(walls, 0, FIELD_ONE).astype(np.uint8)
        front = (words & 1) == 1
        at = tuple(part[front] for part in at)
        told = np.where(words[front] >> HIT_SHIFT, value[front], self.map_free)
        published[at] = _joined(published[at].astype(np.int64), told, self).astype(np.uint32)


class LikelihoodRule(NamedTuple):
    """How the hits of one scan spread into the cells around them.

    Pools: ``observed`` uint32, ``states`` uint32: mean in 1/2^20 of 255 above 12 bits of
    observations, ``field`` uint8: the mean. Beams are (B, 4) int32: x, y of the hit and of the
    laser in 1/1024 cell. The strongest word stays.

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

    def words(self, beams: I32) -> tuple[I64, I64, I64, I64]:
        """Return the same as of ``ScanRule``; passed cells get the value of no hit nearby."""
        hits = beams[:, :2].astype(np.int64)
        beam, row, col, step = walk_cells(beams)
        passed = step > 0
        around = np.arange(-self.reach, self.reach + 1)
        rows, cols = (axis.ravel() for axis in np.meshgrid(around, around, indexing="ij"))
        near_col, near_row = (hits[:, :1] >> BEAM_SHIFT) + cols, (hits[:, 1:] >> BEAM_SHIFT) + rows
        dx = hits[:, :1] - (near_col << BEAM_SHIFT) - BEAM_HALF
        dy = hits[:, 1:] - (near_row << BEAM_SHIFT) - BEAM_HALF
        step = np.minimum((dx * dx + dy * dy) >> self.shift, TABLE_LAST)
        value = np.concatenate((np.zeros(passed.sum(), np.int64), self.table[step].ravel()))
        own = np.repeat(np.arange(len(beams)), len(rows))
        beam, row, col = (
            np.concatenate((way[passed], near.ravel()))
            for way, near in ((beam, own), (row, near_row), (col, near_col))
        )
        return beam, row, col, value << LIKELIHOOD_SHIFT | 1

    @property
    def margin(self) -> float:
        """How far cells that beams observe may lie from them."""
        return self.reach + 1.0

    def learn(self, pools: Pools, at: Places, words: I64) -> None:
        """Fold words into the cells of a submap."""
        states, field = host(pools["states"]), host(pools["field"])
        state = states[at].astype(np.int64)
        mean = state >> MEAN_SHIFT
        more = np.minimum((state & MOST_OBSERVATIONS) + 1, self.most)
        change = (words >> LIKELIHOOD_SHIFT) * LIKELIHOOD_ONE - mean
        following = mean + np.sign(change) * (np.abs(change) // more)
        states[at] = (following << MEAN_SHIFT | more).astype(np.uint32)
        field[at] = (following // LIKELIHOOD_ONE).astype(np.uint8)


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


class CellMeanDevice(ArrayDevice):
    """A device that updates cell means, in place."""

    def mark_scan(
        self,
        pools: Pools,
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: ScanRule | LikelihoodRule,
        met: DeviceArray[np.int32],
    ) -> B8:
        """Write into ``observed``, in place, the words of a scan's beams.

        Args:
            pools: of the rule's kinds; ``observed`` is 0 before.
            pages: (PH, PW) int32.
            beams: as the rule says; they, and all that they come near to, are inside the window.
            met: (PH, PW) int32, set to 1 in place where a page has cells of beams; cells of pages
                that have no tile yet are left out.

        Returns:
            (B,) bool, which beams met such a page: provide tiles and mark these again.
        """
        if self.opencl:
            height, width = pages.shape
            count = beams.shape[0]
            own: tuple[Any, ...]
            if isinstance(rule, ScanRule):
                name, own = "mark_scan", (rule.half_blur, rule.behind, rule.free)
            else:
                name = "mark_likelihood"
                own = (self.opencl.table(rule.table), rule.shift, rule.reach)
            return self.opencl.launch_into(
                np.empty(count, dtype=np.bool_), name, (count,), pools["observed"], pages, width,
                height, beams, count, *own, met,
            )  # fmt: skip
        beam, row, col, words = rule.words(host(beams))
        tiles = host(pages)[row // TILE, col // TILE]
        missing, put = tiles == 0, tiles != 0
        host(met)[row // TILE, col // TILE] = 1
        at = (tiles[put], row[put] % TILE, col[put] % TILE)
        np.maximum.at(host(pools["observed"]), at, words[put].astype(np.uint32))
        return np.bincount(beam[missing], minlength=beams.shape[0]) > 0

    def integrate_scan(
        self,
        pools: Pools,
        pages: DeviceArray[np.int32],
        met: DeviceArray[np.int32],
        box: tuple[int, int, int, int],
        rule: ScanRule | LikelihoodRule,
        window: FieldWindow | None = None,
    ) -> None:
        """Fold a scan's marks into the cells, in place, once per cell; they and ``met`` become 0.

        Args:
            box: of all pages that were met: column and row of the first, columns and rows.
            window: a dense copy of a part of the field, which follows it, in place.
        """
        if self.opencl:
            own: tuple[int, ...]
            names: tuple[str, ...]
            if isinstance(rule, ScanRule):
                name, names = "integrate_scan", ("observed", "valley", "published", "field")
                own = rule[3:]
            else:
                name, names = "update_likelihood", ("observed", "states", "field")
                own = (rule.most,)
            written = [pools[pool] for pool in names]
            copied = (written[-1], 0, 0, 0, 0) if window is None else (window.cells, *window.box)
            self.opencl.launch(
                name, (box[2] * box[3],), *written, pages, pages.shape[1], met, *box, *copied, *own
            )
            return
        observed = host(pools["observed"])
        at = np.nonzero(observed)
        words = observed[at].astype(np.int64)
        observed[at] = host(met)[:] = 0
        rule.learn(pools, at, words)
        if window is not None:
            left, bottom, cols, rows = window.box
            seen = host(pages)[bottom : bottom + rows, left : left + cols]
            host(window.cells)[:] = dense_pages(host(pools["field"]), seen)
