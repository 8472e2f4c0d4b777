"""A map of tiles that grows where the robot goes, and maps of many particles over one pool.

Cells are counted from the map's anchor; the window of pages is the part of the plane that has a
page table, and moves and grows with the map. See ``slamfusion.compute.tiles``. Particles share
tiles until one of them writes (copy on write): each has a page table of its own over one window,
and the host counts how many maps use a tile. Taking over another particle's map copies its page
table and no cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.cell_means import LikelihoodRule, ScanRule
from slamfusion.compute.layout import BEAM_ONE, TILE
from slamfusion.compute.tiles import FieldWindow, tile_bytes
from slamfusion.errors import MemoryBudgetError
from slamfusion.geometry import B8, F64, I8, I64, Pose2, corners
from slamfusion.grid import OccupancyGrid
from slamfusion.slam.common.state import check_arrays, check_indices

# Tiles for which a pool reserves memory at first: a room's, so that a small map is never copied.
FIRST_ROOM = 64
# The same of shared maps: hours in a large building, 30 particles. A copy takes longer than many
# scans, and twice the memory. Only where memory that was never written takes no room, as on a CPU.
SHARED_ROOM = 1 << 15
# Empty pages that the window keeps between its content and its border, so that it seldom moves.
MARGIN = 2
# Pages that a window may have: 64 MB of page table, far beyond any building.
MOST_PAGES = 1 << 24
# Most pages on a side: beams count in 1/1024 cell in 32 bits.
MOST_SIDE = 1 << 15

Array = npt.NDArray[Any]


def known_part(percent: I8, anchor: F64, first: Array, cell: float, name: str) -> OccupancyGrid:
    """Return a map (H, W) as a grid, cut to what is known.

    Its first cell is ``first`` (2,) from the anchor (2,), metres; ``cell`` is in metres.
    """
    grid = OccupancyGrid(percent, cell, Pose2(*(anchor + first * cell).tolist()), name)
    box = grid.known_box
    return grid if box is None else grid.crop(box)


class _Tiles:
    """Pools of tiles on the device behind one window of pages.

    Attributes:
        pools: by name, (T, ...) handles: the tiles in use, first the empty one.
        pages: (..., PH, PW) int32, tile of each page of the window, 0 where there is none.
        corner: (2,) int64, column and row of the window's lower-left page, counted from the anchor.
        origin: (2,) float64, lower-left corner of the window from the anchor, x and y in cells.
        page_tables: ``pages`` on the device.
    """

    def __init__(
        self, device: ComputeDevice, empty: Mapping[str, Array], maps: tuple[int, ...] = ()
    ) -> None:
        """Make a pool for each empty tile."""
        self._device = device
        self.pools: dict[str, DeviceArray[Any]] = {
            name: device.upload(tile[None]) for name, tile in empty.items()
        }
        size = 2 * MARGIN + 1
        self.corner = np.array([-(size // 2), -(size // 2)], dtype=np.int64)
        self.pages = np.zeros((*maps, size, size), dtype=np.int32)
        self.page_tables: DeviceArray[Any]
        self._send()

    @property
    def memory_bytes(self) -> int:
        """Bytes of the tiles in use and of the page tables, on host and device."""
        pools = sum(pool.size * pool.dtype.itemsize for pool in self.pools.values())
        return pools + 2 * self.pages.nbytes

    @property
    def tiles(self) -> int:
        """Number of tiles in use, the empty one included."""
        return next(iter(self.pools.values())).shape[0]

    def cover(self, low: Sequence[float] | F64, high: Sequence[float] | F64) -> None:
        """Extend the window to a box of cells from the anchor, with a margin of empty pages.

        Raises:
            MemoryBudgetError: the window would be larger than any building.
        """
        old_height, old_width = self.pages.shape[-2:]
        (left, bottom), (right, top) = self.page_of(low), self.page_of(high)
        if min(left, bottom) >= MARGIN and right < old_width - MARGIN and top < old_height - MARGIN:
            return
        old_end = self.corner + np.array([old_width, old_height])
        first = self.corner + np.array([left, bottom]) - MARGIN
        last = self.corner + np.array([right, top]) + MARGIN + 1
        start, end = np.minimum(first, self.corner), np.maximum(last, old_end)
        grown = (end - start) // 4
        start = np.where(start < self.corner, start - grown, start)
        end = np.where(end > old_end, end + grown, end)
        width, height = (int(value) for value in end - start)
        if width * height > MOST_PAGES or max(width, height) > MOST_SIDE:
            raise MemoryBudgetError(
                f"the map would span {width * TILE} x {height * TILE} cells; the pose has jumped "
                f"or the log's units are wrong; use a coarser cell"
            )
        pages = np.zeros((*self.pages.shape[:-2], height, width), dtype=np.int32)
        col, row = (int(value) for value in self.corner - start)
        pages[..., row : row + old_height, col : col + old_width] = self.pages
        self.pages, self.corner = pages, start
        self._send()

    def page_of(self, place: Sequence[float] | F64) -> tuple[int, int]:
        """Return column and row in the window of the page at a place (2,), in cells."""
        (x, y), (left, bottom) = place, self.corner.tolist()
        return math.floor(x / TILE) - left, math.floor(y / TILE) - bottom

    def cells(self, name: str, *index: int) -> tuple[Array, I64]:
        """Return one map (H, W), cut to the pages in use, and its first (column, row), (2,)."""
        return self.made(lambda values: values, self.pools[name].dtype, (name,), *index)

    def made(
        self, rule: Callable[..., Array], kind: npt.DTypeLike, names: Sequence[str], *index: int
    ) -> tuple[Array, I64]:
        """Return what a rule makes of the cells of some pools; see ``cells``.

        It takes (K, TILE, TILE) of each pool, so the whole is only in memory as the result.
        """
        (col0, row0), (col1, row1) = (corner // TILE for corner in self.used_box(*index))
        cut = self.pages[index][row0:row1, col0:col1]
        height, width = cut.shape
        values = np.empty((height, TILE, width, TILE), dtype=kind)
        for row, numbers in zip(values, cut, strict=True):
            tiles = [self._device.take_tiles(self.pools[name], numbers) for name in names]
            row[:] = rule(*tiles).transpose(1, 0, 2)
        first = (self.corner + np.array([col0, row0])) * TILE
        return values.reshape(height * TILE, width * TILE), first

    def used_box(self, *index: int) -> tuple[I64, I64]:
        """Return the corners of one map's pages in use, (2,) x and y in cells of the window."""
        places = np.argwhere(self.pages[index])[:, ::-1]
        if len(places) == 0:
            places = np.zeros((1, 2), dtype=np.int64)
        first, last = corners(places)
        return first * TILE, (last + 1) * TILE

    def to_state(self) -> dict[str, Array]:
        """Return everything as arrays, for saving; tiles keep their numbers."""
        pools = {f"pool_{name}": self._device.download(p) for name, p in self.pools.items()}
        return {"pages": self.pages, "corner": self.corner, **pools}

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """Take over what ``to_state`` returned, with the pools that it has."""
        kept = {name: pool for name, pool in self.pools.items() if f"pool_{name}" in arrays}
        wanted: dict[str, tuple[npt.DTypeLike, str]] = {
            "pages": (np.int32, "N H W" if self.pages.ndim > 2 else "H W"),
            "corner": (np.int64, "2"),
            **{
                f"pool_{name}": (pool.dtype, "T " + " ".join(map(str, pool.shape[1:])))
                for name, pool in kept.items()
            },
        }
        lengths = check_arrays(arrays, wanted)
        if arrays["pages"].size > MOST_PAGES * max(len(arrays["pages"]), 1):
            raise ValueError(f"a window of {arrays['pages'].shape} pages")
        check_indices("pages", arrays["pages"], lengths.get("T", 0))
        check_indices("corner", arrays["corner"], MOST_SIDE, first=-MOST_SIDE)
        self.pages, self.corner = arrays["pages"].copy(), arrays["corner"].copy()
        self.pools = {name: self._device.upload(arrays[f"pool_{name}"]) for name in kept}
        self._send()

    def _send(self) -> None:
        self.page_tables = self._device.upload(self.pages)
        self.origin: F64 = np.asarray(self.corner * TILE, dtype=np.float64)


class TileMap(_Tiles):
    """One map of cell means, see ``slamfusion.compute.cell_means``; its pages are (PH, PW)."""

    def __init__(
        self, device: ComputeDevice, pools: Mapping[str, tuple[npt.DTypeLike, int]]
    ) -> None:
        """Make pools with their empty tile, given the dtype and the fill value by name."""
        self._fills = {name: fill for name, (_, fill) in pools.items()}
        # Pages that beams have met, and the last part of the field that was asked for.
        self._met: Any = None
        self._window: FieldWindow | None = None
        super().__init__(
            device,
            {name: np.full((TILE, TILE), fill, kind) for name, (kind, fill) in pools.items()},
        )

    def write(
        self,
        hits: F64,
        laser: Sequence[float],
        rule: ScanRule | LikelihoodRule,
        *more: npt.ArrayLike,
    ) -> None:
        """Write a scan's beams, as the rule says.

        Args:
            hits: (B, 2) in cells from the anchor, B at least 1; the laser (2,) likewise.
            more: (B,) each or a number: what a beam of the rule has besides.
        """
        device, margin, (least, most) = self._device, rule.margin, corners(hits)
        low = [min(pair) - margin for pair in zip(least.tolist(), laser, strict=True)]
        high = [max(pair) + margin for pair in zip(most.tolist(), laser, strict=True)]
        self.cover(low, high)
        beams = np.empty((len(hits), 4 + len(more)), dtype=np.int32)
        beams[:, 0:2] = (hits - self.origin) * BEAM_ONE
        beams[:, 2:4] = np.subtract(laser, self.origin) * BEAM_ONE
        for column, values in enumerate(more, start=4):
            beams[:, column] = values
        handle = device.upload(beams)
        missed = device.mark_scan(self.pools, self.page_tables, handle, rule, self._met)
        if missed.any():
            self._provide_met()
            again = device.upload(beams[missed])
            device.mark_scan(self.pools, self.page_tables, again, rule, self._met)
        (left, bottom), (right, top) = self.page_of(low), self.page_of(high)
        box = left, bottom, right + 1 - left, top + 1 - bottom
        device.integrate_scan(self.pools, self.page_tables, self._met, box, rule, self._window)

    def window(self, low: Sequence[float], high: Sequence[float]) -> FieldWindow:
        """Return a part of the field between two corners, x and y in cells of the window of pages.

        It follows what is written, and has room around, so that it is seldom copied.
        """
        window, pages = self._window, self.page_tables
        if window is None or not window.has(low, high, pages):
            room = MARGIN * TILE
            low, high = [at - room for at in low], [at + room for at in high]
            window = self._device.field_window(self.pools["field"], pages, low, high)
            self._window = window
        return window

    def keep_only(self, name: str) -> None:
        """Free every pool but one; the map becomes read-only."""
        self.pools = {name: self.pools[name]}
        self._met = self._window = None

    def _provide_met(self) -> None:
        """Give a tile to every page that beams met."""
        missing = np.flatnonzero(self._device.download(self._met) * (self.pages == 0))
        used, needed = self.tiles, self.tiles + len(missing)
        for name, fill in self._fills.items():  # no old pool outlives its turn
            self.pools[name] = self._device.extend(self.pools[name], needed, fill, FIRST_ROOM)
        self.pages.flat[missing] = np.arange(used, needed)
        super()._send()

    def _send(self) -> None:
        super()._send()
        self._met = self._device.upload(np.zeros_like(self.pages))
        self._window = None


class SharedTileMaps(_Tiles):
    """N maps that share equal tiles; pages are (N, PH, PW)."""

    def __init__(self, device: ComputeDevice, count: int, empty: Mapping[str, Array]) -> None:
        # Number of maps that use each tile; the empty tile counts as unused and is never free.
        self._users = np.zeros(1, dtype=np.int32)
        # Tiles that no map uses since the last maps were taken over.
        self._left = np.zeros(0, dtype=np.int64)
        self._one: tuple[int, DeviceArray[Any]] | None = None
        super().__init__(device, empty, (count,))

    @property
    def used_bytes(self) -> int:
        """Bytes of the tiles that some map uses."""
        return int((self._users > 0).sum()) * sum(map(tile_bytes, self.pools.values()))

    @property
    def owned_and_shared(self) -> tuple[int, int]:
        """Numbers of the tiles that one map uses alone, and that several maps use."""
        return int((self._users == 1).sum()), int((self._users > 1).sum())

    def page_table(self, index: int) -> DeviceArray[Any]:
        """Return one map's pages on the device."""
        if self._one is None or self._one[0] != index:
            self._one = (index, self._device.upload(self.pages[index]))
        return self._one[1]

    def page_tables_of(self, indices: I64) -> DeviceArray[Any]:
        """Return some maps' pages, (M, PH, PW), on the device."""
        if len(indices) == len(self.pages):
            return self.page_tables
        return self._device.upload(self.pages[indices])

    def take_over(self, parents: I64) -> None:
        """Replace every map by its parent's, (N,) indices of maps; no cell is copied."""
        # What was not needed since it was left is hardly needed soon.
        idle, before = self._left[self._users[self._left] == 0], self._users
        for pool in self.pools.values():
            self._device.discard_tiles(pool, idle)
        self.pages = self.pages[parents]
        self._count_users()
        self._left = np.flatnonzero((before > 0) & (self._users == 0))
        self._send()

    def make_writable(self, written: B8) -> None:
        """Give maps tiles of their own on the pages (N, PH, PW) that they are going to write."""
        places = np.flatnonzero(written)
        tiles = self.pages.flat[places]
        # The last of several writers of a tile may keep it if no other map uses it.
        order = np.argsort(tiles, kind="stable")
        ordered = tiles[order]
        last = np.append(ordered[1:] != ordered[:-1], np.array([True]))[: len(ordered)]
        writers = np.bincount(ordered, minlength=len(self._users))
        keeps = last & (writers == self._users)[ordered] & (ordered != 0)
        changed = order[~keeps]
        if len(changed) == 0:
            return
        sources = tiles[changed]
        targets = self._take(len(changed))
        pairs = np.column_stack((sources, targets)).astype(np.int32)
        self._device.copy_tiles(tuple(self.pools.values()), pairs)
        self._users -= np.bincount(sources, minlength=len(self._users)).astype(np.int32)
        self._users[0] = 0
        self._users[targets] = 1
        self.pages.flat[places[changed]] = targets
        self._send()

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """Take over what ``to_state`` returned."""
        super().restore(arrays)
        self._count_users()
        self._left = self._left[:0]

    def _count_users(self) -> None:
        self._users = np.bincount(self.pages.ravel(), minlength=self.tiles).astype(np.int32)
        self._users[0] = 0

    def _take(self, count: int) -> I64:
        """Return the numbers of ``count`` free tiles; grow the pools if needed."""
        free = np.flatnonzero(self._users[1:] == 0)[:count] + 1
        missing = count - len(free)
        if missing > 0:
            held, needed = self.tiles, self.tiles + missing
            for name, pool in self.pools.items():  # who takes a tile copies all of another into it
                self.pools[name] = self._device.extend(pool, needed, None, SHARED_ROOM)
            self._users = np.append(self._users, np.zeros(missing, dtype=np.int32))
            free = np.append(free, np.arange(held, needed))
        return free

    def _send(self) -> None:
        super()._send()
        self._one = None
