"""Pieces of wall: what each piece of one map meets on another under a rigid motion.

``kernels/wall_pieces.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import I32, I64, U8, ArrayDevice, DeviceArray, host
from slamfusion.compute.lattice import fixed_cells
from slamfusion.compute.layout import FACING_PARTS, OPPOSED_PARTS


def is_another(own: U8, other: U8, turn: int) -> npt.NDArray[np.bool_]:
    """Return (N,) whether two walls were seen from opposite sides; 0 is an unknown facing.

    The own ones are turned by ``turn``, in parts of a turn.
    """
    apart = (own.astype(np.int64) + turn - other) & (FACING_PARTS - 1)
    is_far = (apart >= OPPOSED_PARTS) & (apart <= FACING_PARTS - OPPOSED_PARTS)
    return np.asarray((own != 0) & (other != 0) & is_far)


class WallPieceDevice(ArrayDevice):
    """A device that looks up pieces of wall."""

    def piece_sums(
        self,
        points: I32,
        starts: I32,
        sides: U8,
        poses: I64,
        turns: I32,
        field: DeviceArray[np.uint8],
        most: DeviceArray[np.uint8],
        seen: DeviceArray[np.uint8],
        facing: DeviceArray[np.uint8],
        base: int,
    ) -> I64:
        """Return what the points of each piece meet under each pose.

        A wall that the field has, but that was seen from another side, meets nothing.

        Args:
            points: (N, 2) int32 lattice positions, x and y in half cells, piece by piece.
            starts: (B + 1,) int32 the first point of each piece, and N.
            sides: (N,) uint8 what each point faces (see ``layout.FACES``).
            poses: (P, 4) int64 fixed poses, points to field.
            turns: (P,) int32 how far they turn, in parts of a turn.
            field: (H, W) uint8; a point off it is worth nothing.
            most: (H, W) uint8 what a point could be worth at most there, less the base.
            seen: (H, W) uint8, 0 or 1.
            facing: (H, W) uint8 what each cell faces.
            base: worth of a cell that says nothing.

        Returns:
            (P, B, 3) int64: the field less ``base``, the most that it could be, and points in seen
            cells.
        """
        if self.opencl:
            pieces, n = len(starts) - 1, len(poses)
            sums = self.opencl.empty((n, pieces, 3), np.int32)
            self.opencl.launch(
                "piece_sums", (pieces, n), self.upload(points), self.upload(starts), pieces,
                self.upload(sides), self.upload(poses), self.upload(turns), n, field, most, seen,
                facing, *field.shape, base, sums,
            )  # fmt: skip
            return np.asarray(self.download(sums), dtype=np.int64)
        field, most, seen = host(field), host(most), host(seen)
        facing = host(facing)
        height, width = field.shape
        count = len(starts) - 1
        piece = np.repeat(np.arange(count), np.diff(starts))
        out = np.zeros((len(poses), count, 3), dtype=np.int64)
        x2, y2 = points[:, 0].astype(np.int64), points[:, 1].astype(np.int64)
        for p, (pose, turn) in enumerate(zip(poses, turns, strict=True)):
            row, col = fixed_cells(pose, x2, y2)
            inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
            row, col, mine = row[inside], col[inside], piece[inside]
            value = field[row, col].astype(np.int64) - base
            tells = ~((value > 0) & is_another(sides[inside], facing[row, col], int(turn)))
            # Whole numbers below 2^53 are exact in the float64 that bincount adds.
            out[p, :, 0] = np.bincount(mine, value * tells, count)
            out[p, :, 1] = np.bincount(mine, most[row, col] * tells, count)
            out[p, :, 2] = np.bincount(mine, seen[row, col] * tells, count)
        return out
