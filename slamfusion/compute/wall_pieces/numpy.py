"""The NumPy twin of the kernel of pieces of wall: it defines what the kernel does, exactly."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute.lattice import fixed_cells

__all__ = ["piece_sums"]

U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]


def piece_sums(points: I32, starts: I32, poses: I64, field: U8, seen: U8, base: int) -> I64:
    """Return what the points of each piece meet under each pose.

    Args:
        points: (N, 2) int32 lattice positions, x and y in half cells, piece by piece.
        starts: (B + 1,) int32 the first point of each piece, and N.
        poses: (P, 4) int64 fixed poses, points to field.
        field: (H, W) uint8; a point off it is worth nothing.
        seen: (H, W) uint8, 0 or 1.
        base: worth of a cell that says nothing.

    Returns:
        (P, B, 2) int64: the field less ``base``, and points in seen cells.
    """
    height, width = field.shape
    count = len(starts) - 1
    piece = np.repeat(np.arange(count), np.diff(starts))
    out = np.zeros((len(poses), count, 2), dtype=np.int64)
    x2, y2 = points[:, 0].astype(np.int64), points[:, 1].astype(np.int64)
    for p, pose in enumerate(poses):
        row, col = fixed_cells(pose, x2, y2)
        inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
        row, col, mine = row[inside], col[inside], piece[inside]
        # Whole numbers below 2^53 are exact in the float64 that bincount adds.
        out[p, :, 0] = np.bincount(mine, field[row, col].astype(np.int64) - base, count)
        out[p, :, 1] = np.bincount(mine, seen[row, col], count)
    return out
