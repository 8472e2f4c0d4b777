"""Rays: the first thing that each ray through a grid meets.

``numpy.py`` defines the operation, ``opencl.py`` and ``kernels/rays.cl`` do it on a device.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray
from slamfusion.compute.layout import RAY_FLOATS

__all__ = ["RayDevice", "ray_table"]

F32 = npt.NDArray[np.float32]
# A ray with a smaller cosine runs along the cells' edges.
SMALLEST_COSINE = 1e-9


class RayDevice(ArrayDevice, Protocol):
    """A device that casts rays; ``rays.numpy`` says what the operation does."""

    def cast_rays(
        self, cells: DeviceArray[np.uint8], rays: npt.NDArray[np.float32], reach_cells: float
    ) -> npt.NDArray[np.float32]:
        """See ``rays.numpy.cast_rays``."""


def ray_table(rays: F32) -> F32:
    """Return rays as the kernel reads them: with the reciprocals that a step multiplies by.

    Args:
        rays: (N, 4) float32: x and y in cells, cos and sin of the direction.

    Returns:
        (N, 6) float32; a cosine too small to divide by counts as 0, its reciprocal as infinite.
    """
    table = np.empty((len(rays), RAY_FLOATS), dtype=np.float32)
    table[:, :4] = rays
    tiny = np.abs(table[:, 2:4]) < SMALLEST_COSINE
    table[:, 2:4][tiny] = 0.0
    table[:, 4:] = np.inf
    np.divide(np.float32(1.0), table[:, 2:4], out=table[:, 4:], where=~tiny)
    return table
