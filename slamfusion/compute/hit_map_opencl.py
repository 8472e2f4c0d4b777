"""gmapping's map update on an OpenCL device; ``hit_map_reference`` defines each operation."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.arrays import DeviceArray, DeviceArrays
from slamfusion.compute.hit_map_reference import BeamScan, FieldRule, check_beams, check_rule
from slamfusion.compute.slam_reference import TILE

__all__ = ["HitMapOperations"]

# Tiles are copied, and fetched, in words of this many bytes.
COPIED_BYTES, TAKEN_BYTES = 32, 8


class HitMapOperations(DeviceArrays):
    """Counting beams in the maps of many particles, and the score field of the counts."""

    def touch_pages(self, pages: DeviceArray, scan: BeamScan, reach: int) -> npt.NDArray[np.uint8]:
        """See ``hit_map_reference.touch_pages``."""
        touched = np.zeros(pages.shape, dtype=np.uint8)
        if touched.size and len(scan.ends):
            out = self._cleared(pages.shape, np.uint8)
            self._launch_beams("touch_pages", pages, scan, np.int32(reach), out)
            cl.enqueue_copy(self.queue, touched, out.buffer)
        return touched

    def copy_tiles(self, pools: tuple[DeviceArray, ...], pairs: npt.NDArray[np.int32]) -> None:
        """See ``hit_map_reference.copy_tiles``."""
        count = len(pairs)
        if not count:
            return
        table = self.upload(pairs)
        for pool in pools:
            words = TILE * TILE * pool.dtype.itemsize // COPIED_BYTES
            self._launch(
                "copy_tiles", (words, count), pool, np.int32(words), table, np.int32(count)
            )

    def take_tiles(self, pool: DeviceArray, numbers: npt.NDArray[np.int32]) -> npt.NDArray[Any]:
        """See ``hit_map_reference.take_tiles``."""
        count = len(numbers)
        tiles = np.empty((count, TILE, TILE), dtype=pool.dtype)
        if count:
            words = TILE * TILE * pool.dtype.itemsize // TAKEN_BYTES
            table, out = self.upload(numbers), self.lend(tiles, writable=True)
            self._launch(
                "take_tiles", (words, count), pool, np.int32(words), table, np.int32(count), out
            )
            self.collect(out, tiles)
        return tiles

    def count_beams(
        self,
        counts: DeviceArray,
        sums: DeviceArray,
        pages: DeviceArray,
        scan: BeamScan,
        *,
        take_back: bool = False,
    ) -> bool:
        """See ``hit_map_reference.count_beams``."""
        check_beams(scan)
        full = np.zeros(1, dtype=np.int32)
        if pages.size and len(scan.ends):
            flag = self.upload(full)
            is_hit = self.upload(scan.is_hit)
            sign = np.int32(-1 if take_back else 1)
            self._launch_beams("count_beams", pages, scan, is_hit, pages, counts, sums, sign, flag)
            cl.enqueue_copy(self.queue, full, flag.buffer)
        return bool(full[0])

    def settle_field(
        self,
        counts: DeviceArray,
        sums: DeviceArray,
        field: DeviceArray,
        pages: DeviceArray,
        scan: BeamScan,
        rule: FieldRule,
    ) -> None:
        """See ``hit_map_reference.settle_field``."""
        check_rule(rule)
        if not (pages.size and len(scan.ends)):
            return
        self._launch_beams(
            "settle_field",
            pages,
            scan,
            pages,
            counts,
            sums,
            field,
            self._cleared((counts.shape[0], TILE), np.uint32),
            self._table(rule.table),
            np.int32(rule.shift),
            np.int32(rule.reach),
            np.uint32(rule.occupied),
            np.uint32(rule.least_hits),
        )

    def _cleared(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> DeviceArray:
        """Reserve an array of zeros."""
        array = self.empty(shape, dtype)
        size = array.size * array.dtype.itemsize
        cl.enqueue_fill_buffer(self.queue, array.buffer, np.zeros(1, np.uint8), 0, size)
        return array

    def _launch_beams(self, name: str, pages: DeviceArray, scan: BeamScan, *arguments: Any) -> None:
        """Start a kernel with an item for each beam in each map."""
        maps, height, width = pages.shape
        beams = len(scan.ends)
        # The scan is copied: the kernel may still run when its arrays are gone.
        self._launch(
            name,
            (maps * beams,),
            self.upload(scan.ends),
            np.int32(beams),
            *(np.float32(value) for value in scan.laser),
            self.upload(scan.poses),
            *(np.int32(value) for value in (maps, width, height)),
            *arguments,
        )
