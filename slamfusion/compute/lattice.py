"""Points on lattices: motions in fixed point, and which shifts of a field can meet points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray
from slamfusion.compute.layout import FIXED_ONE, FIXED_TO_CELL_SHIFT, SHIFT_POINTS
from slamfusion.geometry import F64, I32, I64, Scalar

# Points that kernels move at once; planes of points are a multiple long.
POINT_LANES = 8
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


def from_the_end(poses: I64, last: tuple[int, int]) -> I64:
    """Return fixed poses of cells counted backwards from column and row ``last``; exact."""
    cos, sin, x, y = poses.T
    along, up = 2 * (last[0] + 1), 2 * (last[1] + 1)
    return np.stack((-cos, -sin, x + cos * along - sin * up, y + sin * along + cos * up), axis=1)


def fixed_cells(pose: I64, x2: I64, y2: I64) -> tuple[I64, I64]:
    """Return (row, col) of lattice positions (half cells) after one fixed pose; exact."""
    x = pose[0] * x2 - pose[1] * y2 + pose[2]
    y = pose[1] * x2 + pose[0] * y2 + pose[3]
    return y >> FIXED_TO_CELL_SHIFT, x >> FIXED_TO_CELL_SHIFT


def cells_at(
    cells: npt.NDArray[Scalar], row: npt.NDArray[Any], col: npt.NDArray[Any], otherwise: int
) -> npt.NDArray[Scalar]:
    """Return some cells of a grid (H, W); ``otherwise`` outside of it."""
    inside = (row >= 0) & (col >= 0) & (row < cells.shape[0]) & (col < cells.shape[1])
    out = np.full(row.shape, otherwise, dtype=cells.dtype)
    out[inside] = cells[row[inside], col[inside]]
    return out


@dataclass(frozen=True, eq=False)
class PointPlanes:
    """Points on a device, about their middle, for motions in 32 bits.

    Attributes:
        planes: (2, stride) int32 x and y in half cells; a stretch each, the first ``count`` count.
        middle: x and y of the middle, half cells.
        reach: half cells from it, along x and y together, of the farthest point.
    """

    planes: DeviceArray[np.int32]
    count: int
    middle: tuple[int, int]
    reach: int


def point_planes(points: I32, device: ArrayDevice) -> PointPlanes:
    """Bring points (N, 2), x and y in half cells, to the device, about their middle."""
    count = len(points)
    planes = np.zeros((2, -(-count // POINT_LANES) * POINT_LANES), np.int32)
    own = planes[:, :count]
    own[:] = points.T
    low, high = (own.min(axis=1), own.max(axis=1)) if count else np.zeros((2, 2), np.int32)
    middle = (low + high) // 2
    own -= middle[:, None]
    x, y = middle.tolist()
    return PointPlanes(device.upload(planes), count, (x, y), int((high - middle).sum()))


def narrow_motions(points: PointPlanes, motions: F64) -> tuple[F64, int]:
    """Return motions of points about their middle, and how many of their bits 32 do not hold.

    Args:
        motions: (4, P) whole numbers in Q30, as the columns of ``fixed_poses``: cos, sin, x and y
            in half cells; two more rows are a step in x and y, to be taken later along both axes.

    Returns:
        The motions that move the points about their middle where the given ones move the given
        points; a map of 2000 cells is read within 0.01 cells of where 64 bits read it.
    """
    # In float64, which is vectorised and exact below 2^53.
    moved = motions.copy()
    moved[2] += moved[0] * points.middle[0] - moved[1] * points.middle[1]
    moved[3] += moved[1] * points.middle[0] + moved[0] * points.middle[1]
    # The greatest of turn, shift and step.
    rows = np.abs(moved).max(axis=1, initial=0.0)
    turn, shift, *step = (int(most) for most in np.maximum(rows[::2], rows[1::2]))
    farthest = turn * points.reach + shift + 2 * sum(step)
    return moved, max(1, (farthest // NARROW_LIMIT).bit_length())


def narrowed(moved: F64, drop: int) -> I32:
    """Return numbers in Q30, rounded to what 32 bits hold of them."""
    return np.floor(moved * 0.5**drop + 0.5).astype(np.int32)


def shift_spans(rows: I32, cols: I32, boxes: I32) -> I32:
    """Return at which shifts each ``SHIFT_POINTS`` points meet a box of the field.

    Args:
        rows, cols: (K or 1, N) int32, where the points read the field at no shift; N > 0.
        boxes: (K or 1, 4) int32: the first row and the one behind the last, then columns.

    Returns:
        (K, G, 4) int32 first and last row, first and last column of the shifts, see
        ``search.ShiftedSide``.
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
