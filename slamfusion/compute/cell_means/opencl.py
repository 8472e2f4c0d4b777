"""Updates of cell means on an OpenCL device."""

from __future__ import annotations

import numpy as np
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.cell_means import LikelihoodRule, ScanRule
from slamfusion.compute.opencl_queue import OpenCLQueue

__all__ = ["OpenCLCellMeans"]


class OpenCLCellMeans(OpenCLQueue):
    """The operations of ``CellMeanDevice`` on one OpenCL device."""

    def mark_scan(
        self,
        observed: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: ScanRule,
        wanted: DeviceArray[np.int32],
    ) -> bool:
        """See ``cell_means.numpy.mark_scan``."""
        height, width = pages.shape
        count = beams.shape[0]
        numbers = (rule.half_blur, rule.behind, rule.free)
        self._launch(
            "mark_scan",
            (count,),
            observed,
            pages,
            np.int32(width),
            np.int32(height),
            beams,
            np.int32(count),
            *(np.int32(number) for number in numbers),
            wanted,
        )
        missing = np.empty(1, dtype=np.int32)
        cl.enqueue_copy(self.queue, missing, self._buffer(wanted))
        return bool(missing[0])

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
        """See ``cell_means.numpy.integrate_scan``."""
        height, width = pages.shape
        count = beams.shape[0]
        numbers = (
            rule.half_blur,
            rule.map_free,
            rule.quality,
            rule.is_mean,
            rule.wall_floor,
            rule.wall_gain,
        )
        self._launch(
            "integrate_scan",
            (count,),
            observed,
            valley,
            published,
            field,
            pages,
            np.int32(width),
            np.int32(height),
            beams,
            np.int32(count),
            *(np.int32(number) for number in numbers),
        )

    def mark_likelihood(
        self,
        observed: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: LikelihoodRule,
        wanted: DeviceArray[np.int32],
    ) -> bool:
        """See ``cell_means.numpy.mark_likelihood``."""
        height, width = pages.shape
        count = beams.shape[0]
        self._launch(
            "mark_likelihood",
            (count,),
            observed,
            pages,
            np.int32(width),
            np.int32(height),
            beams,
            np.int32(count),
            self._table(rule.table),
            np.int32(rule.shift),
            np.int32(rule.reach),
            wanted,
        )
        missing = np.empty(1, dtype=np.int32)
        cl.enqueue_copy(self.queue, missing, self._buffer(wanted))
        return bool(missing[0])

    def update_likelihood(
        self,
        observed: DeviceArray[np.uint32],
        states: DeviceArray[np.uint32],
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: LikelihoodRule,
    ) -> None:
        """See ``cell_means.numpy.update_likelihood``."""
        height, width = pages.shape
        count = beams.shape[0]
        self._launch(
            "update_likelihood",
            (count,),
            observed,
            states,
            field,
            pages,
            np.int32(width),
            np.int32(height),
            beams,
            np.int32(count),
            np.int32(rule.reach),
            np.int32(rule.most),
        )
