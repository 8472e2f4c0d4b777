"""Fields: from trinary cells to walls, distances and scores, and grids resampled under motions.

``numpy.py`` defines each operation, ``opencl.py`` and ``kernels/fields.cl`` do it on a device.
"""

from __future__ import annotations

from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray
from slamfusion.compute.layout import DISTANCE_MAX

__all__ = ["FieldDevice"]

Cell = TypeVar("Cell", np.int8, np.uint8)


class FieldDevice(ArrayDevice, Protocol):
    """A device that makes fields; ``fields.numpy`` says what each operation does."""

    def solid_walls(self, cells: DeviceArray[np.int8]) -> DeviceArray[np.uint8]:
        """See ``fields.numpy.solid_walls``."""

    def surface_walls(
        self, cells: DeviceArray[np.int8], solid: DeviceArray[np.uint8]
    ) -> DeviceArray[np.uint8]:
        """See ``fields.numpy.surface_walls``."""

    def shrink(
        self, walls: DeviceArray[np.uint8], cells: DeviceArray[np.int8], step: int
    ) -> tuple[DeviceArray[np.uint8], DeviceArray[np.uint8]]:
        """See ``fields.numpy.shrink``."""

    def distance_squared(
        self, walls: DeviceArray[np.uint8], reach: int = DISTANCE_MAX
    ) -> DeviceArray[np.uint16]:
        """See ``fields.numpy.distance_squared``."""

    def score_field(
        self,
        distance2: DeviceArray[np.uint16],
        free_share: DeviceArray[np.uint8],
        hit: npt.NDArray[np.uint16],
        miss: npt.NDArray[np.uint16],
        base: int,
    ) -> DeviceArray[np.uint8]:
        """See ``fields.numpy.score_field``."""

    def look_up(
        self, values: DeviceArray[np.uint16], table: npt.NDArray[np.uint16]
    ) -> DeviceArray[np.uint16]:
        """See ``fields.numpy.look_up``."""

    def look_up_where(
        self,
        values: DeviceArray[np.uint16],
        mask: DeviceArray[np.uint8],
        table: npt.NDArray[np.uint16],
        otherwise: npt.NDArray[np.uint16],
    ) -> DeviceArray[np.uint16]:
        """See ``fields.numpy.look_up_where``."""

    def max_window(
        self, field: DeviceArray[np.uint8], window: int, *, along_rows: bool, fill: int
    ) -> DeviceArray[np.uint8]:
        """See ``fields.numpy.max_window``."""

    def warp(
        self,
        cells: DeviceArray[Cell],
        poses: npt.NDArray[np.int64],
        shape: tuple[int, int],
        fill: int,
    ) -> DeviceArray[Cell]:
        """See ``fields.numpy.warp``."""
