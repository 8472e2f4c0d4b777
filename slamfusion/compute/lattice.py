"""Rigid motions in fixed point, so that a kernel and its twin read the same cell."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import FIXED_ONE, FIXED_TO_CELL_SHIFT

__all__ = ["fixed_cells", "fixed_poses"]

I64 = npt.NDArray[np.int64]


def fixed_poses(poses: npt.ArrayLike) -> I64:
    """Return poses as the kernels' fixed-point motions.

    Args:
        poses: (N, 3) float, x and y in cells, yaw in rad; maps cells of one lattice to another.

    Returns:
        (N, 4) int64: cos and sin in Q30, x and y in Q30 half cells.
    """
    array = np.atleast_2d(np.asarray(poses, dtype=np.float64))
    columns = (np.cos(array[:, 2]), np.sin(array[:, 2]), 2.0 * array[:, 0], 2.0 * array[:, 1])
    return np.asarray(np.rint(np.stack(columns, axis=1) * FIXED_ONE), dtype=np.int64)


def fixed_cells(pose: I64, x2: I64, y2: I64) -> tuple[I64, I64]:
    """Return (row, col) of lattice positions (half cells) after one fixed pose; exact."""
    x = pose[0] * x2 - pose[1] * y2 + pose[2]
    y = pose[1] * x2 + pose[0] * y2 + pose[3]
    return y >> FIXED_TO_CELL_SHIFT, x >> FIXED_TO_CELL_SHIFT
