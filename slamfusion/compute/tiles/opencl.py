"""Pools of tiles on an OpenCL device."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import COPIED_BYTES, TAKEN_BYTES, TILE, TILE_CELLS
from slamfusion.compute.opencl_queue import OpenCLQueue

__all__ = ["OpenCLTiles"]

Scalar = TypeVar("Scalar", bound=np.generic)


class OpenCLTiles(OpenCLQueue):
    """The operations of ``TileDevice`` on one OpenCL device."""

    def extend(self, pool: DeviceArray[Scalar], count: int, fill: int) -> DeviceArray[Scalar]:
        """See ``tiles.numpy.extend``."""
        grown = self.empty((count, *pool.shape[1:]), pool.dtype)
        used = pool.size * pool.dtype.itemsize
        total = grown.size * pool.dtype.itemsize
        cl.enqueue_copy(self.queue, grown.buffer, self._buffer(pool), byte_count=used)
        value = np.array([fill], dtype=pool.dtype)
        cl.enqueue_fill_buffer(self.queue, grown.buffer, value, used, total - used)
        return grown

    def copy_tiles(self, pools: tuple[DeviceArray[Any], ...], pairs: npt.NDArray[np.int32]) -> None:
        """See ``tiles.numpy.copy_tiles``."""
        count = len(pairs)
        if not count:
            return
        table = self.upload(pairs)
        for pool in pools:
            words = TILE_CELLS * pool.dtype.itemsize // COPIED_BYTES
            self._launch(
                "copy_tiles", (words, count), pool, np.int32(words), table, np.int32(count)
            )

    def take_tiles(
        self, pool: DeviceArray[Scalar], numbers: npt.NDArray[np.int32]
    ) -> npt.NDArray[Scalar]:
        """See ``tiles.numpy.take_tiles``."""
        count = len(numbers)
        tiles = np.empty((count, TILE, TILE), dtype=pool.dtype)
        if count:
            words = TILE_CELLS * pool.dtype.itemsize // TAKEN_BYTES
            table, out = self.upload(numbers), self.wrap_host(tiles, writable=True)
            self._launch(
                "take_tiles", (words, count), pool, np.int32(words), table, np.int32(count), out
            )
            self.map_host(out, tiles)
        return tiles
