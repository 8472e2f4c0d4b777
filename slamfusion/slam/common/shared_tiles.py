"""Maps of many particles over one pool of tiles, shared until one of them writes (copy on write).

Every map has a page table of its own over one common window. The host counts how many maps use a
tile; a map that is about to write into a tile that others use too gets a copy of it first. Taking
over another particle's map copies its page table and no cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import TILE
from slamfusion.slam.common.shapes import check_kinds, check_shapes
from slamfusion.slam.common.tile_map import (
    FIRST_TILES,
    MARGIN,
    check_tiles,
    grown_window,
    joined_tiles,
)

# Factor by which a full pool grows: the number of copies stays logarithmic.
GROWTH = 1.25
# Tiles from which on a pool is large, and the factor by which it grows then: little is held in
# reserve.
LARGE_TILES, LARGE_GROWTH = 10_000, 1.1


class SharedTileMaps:
    """N maps of tiles that share what is equal.

    Attributes:
        pools: by name, (T, TILE, TILE) handles; unseen cells are 0.
        pages: (N, PH, PW) int32, tile of each page of the window, 0 where there is none.
        corner: (2,) int64, column and row of the window's lower-left page, counted from the anchor.
        page_tables: ``pages`` on the device.
    """

    def __init__(
        self, device: ComputeDevice, count: int, pools: Mapping[str, npt.DTypeLike]
    ) -> None:
        """Make empty maps.

        Args:
            device: where they live.
            count: how many.
            pools: by name, the dtype of a cell.
        """
        self._device = device
        self._cell_bytes = sum(np.dtype(kind).itemsize for kind in pools.values())
        self.pools: dict[str, DeviceArray[Any]] = {
            name: device.upload(np.zeros((FIRST_TILES, TILE, TILE), dtype=kind))
            for name, kind in pools.items()
        }
        # Maps that use each tile; the empty tile is nobody's and never free.
        self._users = np.zeros(FIRST_TILES, dtype=np.int32)
        size = 2 * MARGIN + 1
        self.corner = np.array([-(size // 2), -(size // 2)], dtype=np.int64)
        self.pages = np.zeros((count, size, size), dtype=np.int32)
        self.page_tables: DeviceArray[Any]
        self._one: tuple[int, DeviceArray[Any]] | None = None
        self._send()

    @property
    def memory_bytes(self) -> int:
        """Bytes of pools and page tables, on host and device."""
        return len(self._users) * TILE * TILE * self._cell_bytes + 2 * self.pages.nbytes

    @property
    def used_bytes(self) -> int:
        """Bytes of the tiles that some map uses."""
        return int((self._users > 0).sum()) * TILE * TILE * self._cell_bytes

    @property
    def tiles_shared(self) -> int:
        """Tiles that more than one map uses."""
        return int((self._users > 1).sum())

    @property
    def tiles_owned(self) -> int:
        """Tiles that one map uses alone."""
        return int((self._users == 1).sum())

    @property
    def origin(self) -> npt.NDArray[np.float64]:
        """Lower-left corner of the window from the anchor, (2,) x and y in cells."""
        return np.asarray(self.corner * TILE, dtype=np.float64)

    def page_table(self, index: int) -> DeviceArray[Any]:
        """Return one map's pages on the device."""
        if self._one is None or self._one[0] != index:
            self._one = (index, self._device.upload(self.pages[index]))
        return self._one[1]

    def page_tables_of(self, indices: npt.NDArray[np.int64]) -> DeviceArray[Any]:
        """Return some maps' pages, (M, PH, PW), on the device."""
        if len(indices) == len(self.pages):
            return self.page_tables
        return self._device.upload(self.pages[indices])

    def cover(self, low: npt.NDArray[np.float64], high: npt.NDArray[np.float64]) -> None:
        """Move and grow the window until it holds a box of cells; see ``grown_window``."""
        window = grown_window(self.corner, self.pages.shape[1:], low, high)
        if window is None:
            return
        start, (height, width) = window
        pages = np.zeros((len(self.pages), height, width), dtype=np.int32)
        col, row = (int(value) for value in self.corner - start)
        old_height, old_width = self.pages.shape[1:]
        pages[:, row : row + old_height, col : col + old_width] = self.pages
        self.pages, self.corner = pages, start
        self._send()

    def take_over(self, parents: npt.NDArray[np.int64]) -> None:
        """Let every map become that of its parent; no cell is copied.

        Args:
            parents: (N,) indices of maps.
        """
        self.pages = self.pages[parents]
        self._users = np.bincount(self.pages.ravel(), minlength=len(self._users)).astype(np.int32)
        self._users[0] = 0
        self._send()

    def make_writable(self, written: npt.NDArray[np.bool_]) -> None:
        """Give maps tiles of their own where they are going to write.

        Args:
            written: (N, PH, PW) pages of each map.
        """
        places = np.flatnonzero(written)
        tiles = self.pages.flat[places]
        # Of several that write into a tile the last may keep it, if nobody else uses it.
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

    def cells(self, name: str, index: int) -> tuple[npt.NDArray[np.generic], npt.NDArray[np.int64]]:
        """Return one map of a pool as an array, cut to the pages in use.

        Returns:
            (H, W) values, and (2,) column and row of its first cell from the anchor.
        """
        return joined_tiles(self._device, self.pools[name], self.pages[index], self.corner)

    def to_state(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything as arrays, for saving; tiles keep their numbers."""
        used = int(np.flatnonzero(self._users).max(initial=0)) + 1
        pools = {
            f"pool_{name}": self._device.download(pool)[:used] for name, pool in self.pools.items()
        }
        return {
            "pages": self.pages,
            "corner": self.corner,
            "users": self._users[:used],
            "capacity": np.array(len(self._users)),
            **pools,
        }

    def restore(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Take over what ``to_state`` returned.

        Raises:
            ValueError: arrays that do not fit each other, pages of tiles that are not there, or
                room for far more tiles than there are.
        """
        tiles = check_tiles(arrays, self.pools, "N H W", "users")
        check_shapes(arrays, {"capacity": ""})
        check_kinds(arrays, {"capacity": np.int64})
        capacity = int(arrays["capacity"])
        if not tiles <= capacity <= max(4 * tiles, FIRST_TILES):
            message = f"room for {capacity} tiles, of which {tiles} are used"
            raise ValueError(message)
        users = np.bincount(arrays["pages"].ravel(), minlength=tiles)
        if not np.array_equal(users[1:], arrays["users"][1:]):
            message = "users: not as many as the pages have"
            raise ValueError(message)
        self.pages, self.corner = arrays["pages"].copy(), arrays["corner"].copy()
        self._users = np.zeros(capacity, dtype=np.int32)
        self._users[: len(arrays["users"])] = arrays["users"]
        for name in self.pools:
            saved = arrays[f"pool_{name}"]
            self.pools[name] = self._device.extend(self._device.upload(saved), capacity, 0)
        self._send()

    def _take(self, count: int) -> npt.NDArray[np.int64]:
        """Return the numbers of ``count`` free tiles; the pools grow where they must."""
        free = np.flatnonzero(self._users[1:] == 0)[:count] + 1
        missing = count - len(free)
        if missing > 0:
            held = len(self._users)
            growth = LARGE_GROWTH if held > LARGE_TILES else GROWTH
            capacity = max(held + missing, int(held * growth))
            for name in self.pools:  # no old pool outlives its turn
                self.pools[name] = self._device.extend(self.pools[name], capacity, 0)
            self._users = np.append(self._users, np.zeros(capacity - held, dtype=np.int32))
            free = np.append(free, np.arange(held, held + missing))
        return free

    def _send(self) -> None:
        self.page_tables = self._device.upload(self.pages)
        self._one = None
