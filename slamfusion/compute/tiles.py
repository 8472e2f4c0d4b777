"""Tiles: the memory of maps that grow, shared tile by tile between maps of one window.

A tiled map is a window of pages (PH, PW) int32 and pools (T, TILE, TILE): a page holds the number
of a tile, and tile 0 is the empty tile that every unused page shares. Positions on it are in cells
of the window, (0, 0) its lower-left corner.

``kernels/tiles.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import I32, ArrayDevice, DeviceArray, host
from slamfusion.compute.layout import COPIED_BYTES, TAKEN_BYTES, TILE, TILE_CELLS

Scalar = TypeVar("Scalar", bound=np.generic)


class TileDevice(ArrayDevice):
    """A device that keeps pools of tiles."""

    def extend(self, pool: DeviceArray[Scalar], count: int, fill: int) -> DeviceArray[Scalar]:
        """Return a longer copy of a pool.

        Args:
            pool: (T, ...) of any dtype.
            count: tiles of the copy, T or more.
            fill: value of the new tiles' cells.
        """
        if self.opencl:
            grown = self.opencl.empty((count, *pool.shape[1:]), pool.dtype)
            self.opencl.copy(pool, grown)
            self.opencl.fill(grown, fill, first=pool.size)
            return grown
        longer = np.full((count, *pool.shape[1:]), fill, dtype=pool.dtype)
        longer[: pool.shape[0]] = host(pool)
        return longer

    def copy_tiles(self, pools: tuple[DeviceArray[Any], ...], pairs: I32) -> None:
        """Copy tiles, in place.

        Args:
            pools: (T, TILE, TILE) each, of any dtype.
            pairs: (M, 2) int32, source and target; source 0 clears the target. Targets differ from
                each other and are no sources.
        """
        if self.opencl:
            count = len(pairs)
            if not count:
                return
            table = self.upload(pairs)
            for pool in pools:
                words = TILE_CELLS * pool.dtype.itemsize // COPIED_BYTES
                self.opencl.launch("copy_tiles", (words, count), pool, words, table, count)
            return
        for pool in map(host, pools):
            pool[pairs[:, 1]] = pool[pairs[:, 0]]

    def take_tiles(self, pool: DeviceArray[Scalar], numbers: I32) -> npt.NDArray[Scalar]:
        """Fetch tiles of a pool.

        Args:
            pool: (T, TILE, TILE) of any dtype.
            numbers: (K,) int32, 0 to T - 1, on the host.

        Returns:
            (K, TILE, TILE), on the host.
        """
        if self.opencl:
            count = len(numbers)
            tiles = np.empty((count, TILE, TILE), dtype=pool.dtype)
            if count:
                words = TILE_CELLS * pool.dtype.itemsize // TAKEN_BYTES
                table = self.upload(numbers)
                size = (words, count)
                self.opencl.launch_into(tiles, "take_tiles", size, pool, words, table, count)
            return tiles
        return np.asarray(host(pool)[numbers])
