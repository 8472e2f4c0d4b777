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
        poses: npt.NDArray[np.int64],
        field: DeviceArray[np.uint8],
        seen: DeviceArray[np.uint8],
        base: int,
    ) -> npt.NDArray[np.int64]:
        """See ``wall_pieces.numpy.piece_sums``."""
        pieces, n = len(starts) - 1, len(poses)
        sums = self.empty((n, pieces, 2), np.int32)
        given = (self.upload(points), self.upload(starts), np.int32(pieces), self.upload(poses))
        sizes = [np.int32(v) for v in (*field.shape, base)]
        self._launch("piece_sums", (pieces, n), *given, np.int32(n), field, seen, *sizes, sums)
        return np.asarray(self.download(sums), dtype=np.int64)
