"""Rays on an OpenCL device."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import RAY_HIT_FLOATS
from slamfusion.compute.opencl_queue import OpenCLQueue
from slamfusion.compute.rays import ray_table

__all__ = ["OpenCLRays"]


class OpenCLRays(OpenCLQueue):
    """The operations of ``RayDevice`` on one OpenCL device."""

    def cast_rays(
        self, cells: DeviceArray[np.uint8], rays: npt.NDArray[np.float32], reach_cells: float
    ) -> npt.NDArray[np.float32]:
        """See ``rays.numpy.cast_rays``."""
        count = len(rays)
        if not count:
            return np.empty((0, RAY_HIT_FLOATS), dtype=np.float32)
        hits = self.empty((count, RAY_HIT_FLOATS), np.float32)
        sizes = [np.int32(v) for v in cells.shape]
        table, reach = self.upload(ray_table(rays)), np.float32(reach_cells)
        self._launch("cast_rays", (count,), cells, *sizes, table, np.int32(count), reach, hits)
        return self.download(hits)
