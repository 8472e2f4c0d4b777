"""Pieces of wall: what each piece of one map meets on another under a rigid motion.

``numpy.py`` defines the operation, ``opencl.py`` and ``kernels/wall_pieces.cl`` do it on a device.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray

__all__ = ["WallPieceDevice"]


class WallPieceDevice(ArrayDevice, Protocol):
    """A device that looks up pieces of wall; ``wall_pieces.numpy`` says what the operation does."""

    def piece_sums(
        self,
        points: npt.NDArray[np.int32],
        starts: npt.NDArray[np.int32],
        sides: npt.NDArray[np.uint8],
        poses: npt.NDArray[np.int64],
        turns: npt.NDArray[np.int32],
        field: DeviceArray[np.uint8],
        most: DeviceArray[np.uint8],
        seen: DeviceArray[np.uint8],
        facing: DeviceArray[np.uint8],
        base: int,
    ) -> npt.NDArray[np.int64]:
        """See ``wall_pieces.numpy.piece_sums``."""
