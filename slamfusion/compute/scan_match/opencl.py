"""Scoring of poses on tiled maps on an OpenCL device."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import CLIMBERS, FOUND_FLOATS
from slamfusion.compute.opencl_queue import OpenCLQueue

__all__ = ["OpenCLScanMatch"]


class OpenCLScanMatch(OpenCLQueue):
    """The operations of ``ScanMatchDevice`` on one OpenCL device."""

    def score_poses(
        self,
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        points: DeviceArray[np.float32],
        poses: npt.NDArray[np.float32],
        *,
        reach: int = 0,
    ) -> npt.NDArray[np.int64]:
        """See ``scan_match.numpy.score_poses``."""
        n = len(poses)
        sums = np.empty(n, dtype=np.int32)
        out = self.wrap_host(sums, writable=True)
        height, width = pages.shape
        arguments: list[Any] = [
            field, pages, np.int32(width), np.int32(height), points, np.int32(points.shape[0]),
            self.wrap_host(poses), np.int32(n),
        ]  # fmt: skip
        if reach:
            self._launch("score_wide", (n,), *arguments, np.int32(reach), out)
        else:
            self._launch("score_smooth", (n,), *arguments, out)
        self.map_host(out, sums)
        return sums.astype(np.int64)

    def climb(
        self,
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        points: DeviceArray[np.float32],
        hypotheses: npt.NDArray[np.float32],
        starts: npt.NDArray[np.float32],
        steps: npt.NDArray[np.float32],
        *,
        scale: float,
    ) -> npt.NDArray[np.float32]:
        """See ``scan_match.numpy.climb``."""
        found = np.empty((len(starts), FOUND_FLOATS), dtype=np.float32)
        out = self.wrap_host(found, writable=True)
        height, width = pages.shape
        self._launch(
            "climb",
            (len(starts) * CLIMBERS,),
            field,
            pages,
            np.int32(width),
            np.int32(height),
            points,
            np.int32(points.shape[0]),
            self.wrap_host(hypotheses),
            np.int32(len(hypotheses)),
            self.wrap_host(starts),
            self.wrap_host(steps),
            np.int32(len(steps)),
            np.float32(scale),
            out,
        )
        self.map_host(out, found)
        return found

    def climb_maps(
        self,
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        points: DeviceArray[np.float32],
        hypotheses: npt.NDArray[np.float32],
        starts: npt.NDArray[np.float32],
        sizes: npt.NDArray[np.float32],
        *,
        tries: int,
        scale: float,
    ) -> npt.NDArray[np.float32]:
        """See ``scan_match.numpy.climb_maps``."""
        found = np.empty((len(starts), FOUND_FLOATS), dtype=np.float32)
        out = self.wrap_host(found, writable=True)
        _, height, width = pages.shape
        self._launch(
            "climb_maps",
            (len(starts) * CLIMBERS,),
            field,
            pages,
            np.int32(width),
            np.int32(height),
            points,
            np.int32(points.shape[0]),
            self.wrap_host(hypotheses),
            self.wrap_host(starts),
            self.wrap_host(sizes),
            np.int32(len(sizes)),
            np.int32(tries),
            np.float32(scale),
            out,
        )
        self.map_host(out, found)
        return found

    def score_maps(
        self,
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        points: DeviceArray[np.float32],
        poses: npt.NDArray[np.float32],
        table: npt.NDArray[np.int32],
    ) -> npt.NDArray[np.int64]:
        """See ``scan_match.numpy.score_maps``."""
        maps, each = poses.shape[:2]
        sums = np.empty((maps, each), dtype=np.int32)
        out = self.wrap_host(sums, writable=True)
        _, height, width = pages.shape
        self._launch(
            "score_maps",
            (maps * each,),
            field,
            pages,
            np.int32(width),
            np.int32(height),
            points,
            np.int32(points.shape[0]),
            self.wrap_host(poses),
            np.int32(maps),
            np.int32(each),
            self.wrap_host(table),
            out,
        )
        self.map_host(out, sums)
        return sums.astype(np.int64)
