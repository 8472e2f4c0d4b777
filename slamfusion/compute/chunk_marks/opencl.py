"""Marks of chunks on an OpenCL device."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.chunk_marks import check_mark_reach
from slamfusion.compute.opencl_queue import OpenCLQueue

__all__ = ["OpenCLChunkMarks"]


class OpenCLChunkMarks(OpenCLQueue):
    """The operations of ``ChunkMarkDevice`` on one OpenCL device."""

    def mark_chunks(
        self,
        hits: DeviceArray[np.uint32],
        seen: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        facings: DeviceArray[np.int32],
        bits: DeviceArray[np.uint32],
    ) -> None:
        """See ``chunk_marks.numpy.mark_chunks``."""
        count, (height, width) = beams.shape[0], pages.shape
        window = (pages, np.int32(width), np.int32(height))
        self._launch(
            "mark_chunks", (count,), hits, seen, *window, beams, facings, bits, np.int32(count)
        )

    def nearest_marks(
        self,
        hits: DeviceArray[np.uint32],
        seen: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        facings: DeviceArray[np.int32],
        left_out: DeviceArray[np.uint32],
        reach: int,
    ) -> npt.NDArray[np.int32]:
        """See ``chunk_marks.numpy.nearest_marks``."""
        check_mark_reach(reach)
        count, (height, width) = beams.shape[0], pages.shape
        out = self.empty((count, 2), np.int32)
        self._launch(
            "nearest_marks",
            (count,),
            hits,
            seen,
            pages,
            np.int32(width),
            np.int32(height),
            beams,
            facings,
            left_out,
            np.int32(count),
            np.int32(reach),
            out,
        )
        return self.download(out)
