"""Doubled walls on an OpenCL device."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute.doubled_walls import RaySteps, blur_weights, pad_walls, window_weights
from slamfusion.compute.layout import NORMAL_BLOCK
from slamfusion.compute.opencl_queue import OpenCLQueue

__all__ = ["OpenCLDoubledWalls"]


class OpenCLDoubledWalls(OpenCLQueue):
    """The operation of ``DoubledWallDevice`` on one OpenCL device."""

    def mark_doubled(
        self, walls: npt.NDArray[np.uint8], asked: npt.NDArray[np.uint8], steps: RaySteps
    ) -> npt.NDArray[np.uint8]:
        """See ``doubled_walls.numpy.mark_doubled``."""
        cells, inner = pad_walls(walls, steps)
        height, width = cells.shape
        size = np.int32(height), np.int32(width)
        given = self.upload(cells)
        kept = self.empty(cells.shape, np.uint8)
        self._launch("drop_specks", (width // NORMAL_BLOCK, height), given, *size, kept)
        normals = self.empty((height, width, 2), np.int16)
        weights = self._table(blur_weights()), self._table(window_weights())
        blocks = width // NORMAL_BLOCK, height // NORMAL_BLOCK
        self._launch("wall_normals", blocks, kept, *size, *weights, normals)
        # The walls as they were given are of no more use.
        corners = given
        self._launch("wall_corners", (width // NORMAL_BLOCK, height), kept, *size, corners)
        marks = self.upload(pad_walls(asked, steps)[0])
        limits = [np.int32(value) for value in steps]
        self._launch(
            "mark_doubled", (width // NORMAL_BLOCK, height), corners, normals, *size, *limits, marks
        )
        return np.ascontiguousarray(self.download(marks)[inner])
