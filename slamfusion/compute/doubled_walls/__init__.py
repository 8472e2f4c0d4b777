"""Doubled walls: cells of a wall that has another one, parallel, close before or behind it.

From each wall cell a ray goes along the wall's normal to either side. It first crosses its own
wall and then looks for the next one. The normal is the main direction of the structure tensor.
All is in whole numbers, so that every device marks the same cells.

``numpy.py`` defines the operation; ``opencl.py`` and ``kernels/doubled_walls.cl`` do it on a
device.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice
from slamfusion.compute.layout import BLUR_RADIUS, NORMAL_BLOCK, WEIGHT_SHIFT, WINDOW_RADIUS

__all__ = [
    "DOUBLED",
    "DoubledWallDevice",
    "RaySteps",
    "blur_weights",
    "pad_walls",
    "window_weights",
]

U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]

# The mark of a doubled wall.
DOUBLED = 2
BLUR_SIGMA_CELLS = 1.0
WINDOW_SIGMA_CELLS = 2.5
STEPS_PER_CELL = 2


class RaySteps(NamedTuple):
    """How far rays go, in steps of half a cell.

    Attributes:
        total: steps of a ray.
        own: most steps from the last sample on the own wall to one that is on it, too.
        other: most steps from there to the first sample of another wall.
        gap: most steps from there at which a ray goes on.
        thickness: most steps from the start to the last sample on the own wall.
    """

    total: int
    own: int
    other: int
    gap: int
    thickness: int

    @classmethod
    def of(cls, near: float, far: float) -> RaySteps:
        """Return the steps for other walls at a distance.

        Args:
            near: least cells from the last cell of the own wall to the first of the other; one
                less in free width, since both walls reach half a cell beyond their centres.
            far: most cells likewise, and the greatest thickness of the own wall.
        """
        return cls(
            total=int(2 * far * STEPS_PER_CELL),
            own=math.ceil((near - 1.0) * STEPS_PER_CELL) - 1,
            other=math.floor((far - 1.0) * STEPS_PER_CELL),
            gap=math.ceil((far - 1.0) * STEPS_PER_CELL) - 1,
            thickness=math.floor(far * STEPS_PER_CELL),
        )


class DoubledWallDevice(ArrayDevice, Protocol):
    """A device that marks doubled walls; ``doubled_walls.numpy`` says what the operation does."""

    def mark_doubled(self, walls: U8, asked: U8, steps: RaySteps) -> U8:
        """See ``doubled_walls.numpy.mark_doubled``."""


def blur_weights() -> I32:
    """Return the weights that smooth walls before their gradient is taken, see ``_gaussian``."""
    return _gaussian(BLUR_SIGMA_CELLS, BLUR_RADIUS)


def window_weights() -> I32:
    """Return the weights of the structure tensor's window, see ``_gaussian``."""
    return _gaussian(WINDOW_SIGMA_CELLS, WINDOW_RADIUS)


def pad_walls(cells: U8, steps: RaySteps) -> tuple[U8, tuple[slice, slice]]:
    """Return cells with a free border that no ray leaves, and where in it they lie.

    The border is two blocks wide or more: one of these has normals, since a ray may end a cell
    beyond the walls. Both sides are a whole number of blocks.
    """
    blocks = max(2, math.ceil((steps.total / STEPS_PER_CELL + 3) / NORMAL_BLOCK))
    border = blocks * NORMAL_BLOCK
    height, width = cells.shape
    padded = np.zeros(
        [-(-size // NORMAL_BLOCK) * NORMAL_BLOCK + 2 * border for size in cells.shape], np.uint8
    )
    inner = slice(border, border + height), slice(border, border + width)
    padded[inner] = cells
    return padded, inner


@cache
def _gaussian(sigma: float, radius: int) -> I32:
    """Return (2 radius + 1,) int32 weights of a Gaussian that add up to 2^WEIGHT_SHIFT."""
    weight = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    whole: I32 = np.rint(weight / weight.sum() * (1 << WEIGHT_SHIFT)).astype(np.int32)
    whole[radius] += (1 << WEIGHT_SHIFT) - int(whole.sum())
    whole.flags.writeable = False
    return whole
