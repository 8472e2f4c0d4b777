"""Points on lattices: motions in fixed point, and which shifts of a field can meet points."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import FIXED_ONE, FIXED_TO_CELL_SHIFT, SHIFT_POINTS
from slamfusion.geometry import F64

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]

# Limit of a coordinate after a pose: it fits 32 bits with its sign and rounding.
NARROW_LIMIT = (1 << 31) - (1 << 20)


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


def narrow_motions(points: I32, poses: I64) -> tuple[I32, I32, int]:
    """Return points about their middle and poses in 32 bits, with the remaining fraction bits.

    Args:
        points: (N, 2) int32 lattice positions, x and y in half cells.
        poses: (P, 4) int64 fixed poses.

    Returns:
        (N, 2) int32 points, each column one stretch; (P, 4) int32 poses that move them where the
        given ones move the given points; and the bits of a place below a whole cell. A map of 2000
        cells is read within 0.01 cells of where the 64 bits read it.
    """
    # By columns, each contiguous, which makes minima and sums fast.
    near = np.array(points.T, dtype=np.int64, order="C")
    middle = np.zeros(2, np.int64)
    if len(points):
        middle[:] = (near.min(axis=1) + near.max(axis=1)) // 2
    near -= middle[:, None]
    # In float64, which is vectorised and exact below 2^53.
    moved = np.array(poses.T, dtype=np.float64, order="C")
    moved[2] += moved[0] * middle[0] - moved[1] * middle[1]
    moved[3] += moved[1] * middle[0] + moved[0] * middle[1]
    reach = int(np.abs(near).max(axis=1, initial=0).sum())
    farthest = _largest(moved[:2]) * reach + _largest(moved[2:])
    drop = max(1, (farthest // NARROW_LIMIT).bit_length())
    moved *= 0.5**drop
    moved += 0.5
    narrow = np.empty((len(poses), 4), dtype=np.int32)
    narrow.T[:] = np.floor(moved, out=moved)
    return near.astype(np.int32).T, narrow, FIXED_TO_CELL_SHIFT - drop


def _largest(values: F64) -> int:
    return int(max(values.max(initial=0.0), -values.min(initial=0.0)))


def shift_spans(rows: I32, cols: I32, boxes: I32) -> I32:
    """Return at which shifts each ``SHIFT_POINTS`` points meet a box of the field.

    Args:
        rows, cols: (K or 1, N) int32, where the points read the field at no shift; N > 0.
        boxes: (K or 1, 4) int32: the first row and the one behind the last, then columns.

    Returns:
        (K, G, 4) int32 first and last row, first and last column of the shifts: what ``correlate``
        takes.
    """
    starts = np.arange(0, rows.shape[1], SHIFT_POINTS)
    sides = []
    for places, box in ((rows, boxes[:, :2]), (cols, boxes[:, 2:])):
        low = np.minimum.reduceat(places, starts, axis=1)
        high = np.maximum.reduceat(places, starts, axis=1)
        sides += [box[:, :1] - high, box[:, 1:] - 1 - low]
    return np.ascontiguousarray(np.stack(sides, axis=2), dtype=np.int32)


def grouped(points: F64 | I32) -> npt.NDArray[np.intp]:
    """Return an order of points (N, 2) in which each ``SHIFT_POINTS`` of them lie close together.

    Columns of points, and each from bottom to top.
    """
    groups = max(1, len(points) // SHIFT_POINTS)
    column = SHIFT_POINTS * math.ceil(math.sqrt(groups))
    order = np.argsort(points[:, 0], kind="stable")
    of_column = np.arange(len(points)) // column
    return np.asarray(order[np.lexsort((points[order, 1], of_column))])
