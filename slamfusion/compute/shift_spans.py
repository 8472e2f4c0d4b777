"""Which shifts of a field can bring points onto what it shows: the others need not be read."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import SHIFT_POINTS

F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]


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
