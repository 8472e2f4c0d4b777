"""Counting beams in the maps of many particles, and the score field, on an OpenCL device."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.hit_counts import BeamScan, FieldRule, check_beams, check_rule
from slamfusion.compute.layout import TILE
from slamfusion.compute.opencl_queue import OpenCLQueue

__all__ = ["OpenCLHitCounts"]


class OpenCLHitCounts(OpenCLQueue):
    """The operations of ``HitCountDevice`` on one OpenCL device."""

    def touch_pages(
        self, pages: DeviceArray[np.int32], scan: BeamScan, reach: int
    ) -> npt.NDArray[np.uint8]:
        """See ``hit_counts.numpy.touch_pages``."""
        touched = np.zeros(pages.shape, dtype=np.uint8)
        if touched.size and len(scan.ends):
            out = self._cleared(pages.shape, np.uint8)
            self._launch_beams("touch_pages", pages, scan, np.int32(reach), out)
            cl.enqueue_copy(self.queue, touched, out.buffer)
        return touched

    def count_beams(
        self,
        counts: DeviceArray[np.uint32],
        sums: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        scan: BeamScan,
        *,
        take_back: bool = False,
    ) -> bool:
        """See ``hit_counts.numpy.count_beams``."""
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
        counts: DeviceArray[np.uint32],
        sums: DeviceArray[np.uint32],
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        scan: BeamScan,
        rule: FieldRule,
    ) -> None:
        """See ``hit_counts.numpy.settle_field``."""
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

    def _launch_beams(
        self, name: str, pages: DeviceArray[np.int32], scan: BeamScan, *arguments: Any
    ) -> None:
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
