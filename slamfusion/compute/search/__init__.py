"""Search: what rigid motions of one grid onto another are worth, and how to refine the best.

``numpy.py`` defines each operation, ``opencl.py`` and ``kernels/search.cl`` do it on a device.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray

__all__ = ["FitSide", "ScoredSide", "SearchDevice"]


class ScoredSide(NamedTuple):
    """Walls of one map on a field of the other.

    Attributes:
        points: (N, 2) int32 lattice positions, x and y in half cells.
        poses: (P, 4) int64 fixed poses, points to field.
        field: (H, W) uint8 on the device.
        base: worth of a point off the field.
    """

    points: npt.NDArray[np.int32]
    poses: npt.NDArray[np.int64]
    field: DeviceArray[np.uint8]
    base: int


class FitSide(NamedTuple):
    """Walls of one map on the distances of the other.

    Attributes:
        points: (N, 2) float32 on the device, cells.
        poses: (P, 4) float32 cos, sin, x, y (cells), points to field.
        distance: (H, W) uint16 on the device, to the nearest wall in 1/256 cell; a point that reads
            a cell of ``DISTANCE_UNSEEN`` counts for nothing.
    """

    points: DeviceArray[np.float32]
    poses: npt.NDArray[np.float32]
    distance: DeviceArray[np.uint16]


class SearchDevice(ArrayDevice, Protocol):
    """A device that scores motions; ``search.numpy`` says what each operation does."""

    def confusion(self, a: DeviceArray[np.int8], b: DeviceArray[np.int8]) -> npt.NDArray[np.int64]:
        """See ``search.numpy.confusion``."""

    def squared_error(
        self,
        a: DeviceArray[np.int8],
        b: DeviceArray[np.int8],
        poses: npt.NDArray[np.int64],
        stride: int,
    ) -> npt.NDArray[np.int64]:
        """See ``search.numpy.squared_error``."""

    def correlate(
        self,
        fields: DeviceArray[np.uint8],
        offsets: npt.NDArray[np.int32],
        shift_shape: tuple[int, int],
        spans: npt.NDArray[np.int32] | None = None,
        base: int = 0,
    ) -> DeviceArray[np.int32]:
        """See ``search.numpy.correlate``; ``shift_shape[1]`` a multiple of ``SHIFT_LANES``."""

    def polyphase(
        self,
        field: DeviceArray[np.uint8],
        corner: tuple[int, int],
        step: int,
        shape: tuple[int, int],
        fill: int,
    ) -> DeviceArray[np.uint8]:
        """See ``search.numpy.polyphase``."""

    def bound_blocks(
        self,
        blocks: npt.NDArray[np.int32],
        starts: DeviceArray[np.int32],
        classes: npt.NDArray[np.uint8],
        fields: DeviceArray[np.uint8],
        fill: int,
        *,
        least: int = -1,
    ) -> npt.NDArray[np.int32]:
        """See ``search.numpy.bound_blocks``."""

    def tile_peaks(
        self,
        forward: DeviceArray[np.int32],
        backward: DeviceArray[np.int32],
        width: int,
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """See ``search.numpy.tile_peaks``."""

    def pose_counts(
        self,
        points: npt.NDArray[np.int32],
        poses: npt.NDArray[np.int64],
        field: DeviceArray[np.uint8],
        distance2: DeviceArray[np.uint16],
        free_cell: DeviceArray[np.uint8],
        *,
        base: int,
        near2: int,
        far2: int,
    ) -> npt.NDArray[np.int64]:
        """See ``search.numpy.pose_counts``."""

    def pose_scores(self, *sides: ScoredSide) -> list[npt.NDArray[np.int64]]:
        """See ``search.numpy.pose_scores``."""

    def refine_terms(
        self,
        forward: FitSide,
        backward: FitSide,
        *,
        scales: npt.NDArray[np.float32],
        centre: tuple[float, float],
    ) -> npt.NDArray[np.float64]:
        """See ``search.numpy.refine_terms``."""
