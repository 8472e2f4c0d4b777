"""Scan matching: how well a scan's hits fall on the walls of a tiled map, at many poses.

``numpy.py`` defines each operation, ``opencl.py`` and ``kernels/scan_match.cl`` do it on a device.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray

__all__ = ["ScanMatchDevice"]


class ScanMatchDevice(ArrayDevice, Protocol):
    """A device that matches scans; ``scan_match.numpy`` says what each operation does.

    Field, pages and points stay on the device; poses, hypotheses and steps come from the host.
    """

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

    def score_maps(
        self,
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        points: DeviceArray[np.float32],
        poses: npt.NDArray[np.float32],
        table: npt.NDArray[np.int32],
    ) -> npt.NDArray[np.int64]:
        """See ``scan_match.numpy.score_maps``."""
