"""Pieces of wall on an OpenCL device."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.opencl_queue import OpenCLQueue

__all__ = ["OpenCLWallPieces"]


class OpenCLWallPieces(OpenCLQueue):
    """The operations of ``WallPieceDevice`` on one OpenCL device."""

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
        pieces, n = len(starts) - 1, len(poses)
        sums = self.empty((n, pieces, 3), np.int32)
        walls = (self.upload(points), self.upload(starts), np.int32(pieces), self.upload(sides))
        given = (self.upload(poses), self.upload(turns), np.int32(n), field, most, seen)
        sizes = [facing, *(np.int32(v) for v in (*field.shape, base))]
        self._launch("piece_sums", (pieces, n), *walls, *given, *sizes, sums)
        return np.asarray(self.download(sums), dtype=np.int64)
