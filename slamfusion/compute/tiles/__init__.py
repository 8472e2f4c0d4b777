"""Tiles: the memory of maps that grow, shared tile by tile between maps of one window.

A tiled map is a window of pages (PH, PW) int32 and pools (T, TILE, TILE): a page holds the number
of a tile, and tile 0 is the empty tile that every unused page shares. Positions on it are in cells
of the window, (0, 0) its lower-left corner.

``numpy.py`` defines each operation, ``opencl.py`` and ``kernels/tiles.cl`` do it on a device.
"""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray

__all__ = ["TileDevice"]

Scalar = TypeVar("Scalar", bound=np.generic)


class TileDevice(ArrayDevice, Protocol):
    """A device that keeps pools of tiles; ``tiles.numpy`` says what each operation does."""

    def extend(self, pool: DeviceArray[Scalar], count: int, fill: int) -> DeviceArray[Scalar]:
        """See ``tiles.numpy.extend``."""

    def copy_tiles(self, pools: tuple[DeviceArray[Any], ...], pairs: npt.NDArray[np.int32]) -> None:
        """See ``tiles.numpy.copy_tiles``; works in place, the pairs come from the host."""

    def take_tiles(
        self, pool: DeviceArray[Scalar], numbers: npt.NDArray[np.int32]
    ) -> npt.NDArray[Scalar]:
        """See ``tiles.numpy.take_tiles``; the numbers come from the host."""
