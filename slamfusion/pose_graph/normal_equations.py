"""Sparse normal equations of a pose graph: the pattern is found once, the values at every step.

Poses are (x, y, yaw) and steps are added to them.

Turning error and information by the measured pose's yaw into the world's axes leaves Jacobians of
plain numbers: with d the way from i to j, ``de/dx_j`` is the identity and ``de/dx_i`` is
``[[-1, 0, d_y], [0, -1, -d_x], [0, 0, -1]]``. So all edges are done at once, term by term.

Unknowns are ordered by whole poses to keep the factor sparse (minimum degree on the graph of the
poses, which is a ninth of the matrix), and SuperLU factorises in its symmetric mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.pose_graph.measurements import Measurements

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

# Columns that SuperLU updates together; of 1 to 20 the fastest on matrices of 3 x 3 blocks.
PANEL_SIZE = 4


def factorise(matrix: scipy.sparse.csc_matrix, order: str = "NATURAL") -> Any:
    """Factorise a symmetric positive definite sparse matrix without pivoting.

    Args:
        matrix: whole, not only a triangle.
        order: of the columns, in SuperLU's words; natural where they are in a good one already.

    Returns:
        SciPy's ``SuperLU``.

    Raises:
        RuntimeError: the matrix is singular.
    """
    # Its types know neither complex matrices nor the order as a name.
    solve: Any = scipy.sparse.linalg.splu
    return solve(
        matrix,
        permc_spec=order,
        diag_pivot_thresh=0.0,
        panel_size=PANEL_SIZE,
        options={"SymmetricMode": True},
    )


def elimination_order(edges: Indices, count: int) -> Indices:
    """Return an order of the nodes of a graph that keeps its factor sparse (minimum degree).

    Args:
        edges: (M, 2) between nodes.
        count: nodes.

    Returns:
        (count,) nodes, first the one to be eliminated first.
    """
    if count < 3:
        return np.arange(count)
    low, high = edges.min(axis=1), edges.max(axis=1)
    low, high = np.divmod(np.unique(low * count + high), count)
    degree = 1.0 + np.bincount(np.concatenate((low, high)), minlength=count)
    values = np.concatenate((degree, np.full(2 * len(low), -1.0)))
    diagonal = np.arange(count)
    rows = np.concatenate((diagonal, low, high))
    columns = np.concatenate((diagonal, high, low))
    laplacian = scipy.sparse.csc_matrix((values, (rows, columns)), shape=(count, count))
    return np.argsort(factorise(laplacian, "MMD_AT_PLUS_A").perm_c)


class NormalEquations:
    """The least-squares problem of a graph, linearised where it is asked to.

    Attributes:
        measurements: the edges.
        fixed: poses that do not move.
        free: (F,) poses that may move, in the order of elimination.
        place: (N,) of each pose its place in ``free``; -1 for the fixed ones.
        gradient: (3 F,) of half the weighted sum of squares, at the last linearisation.
    """

    def __init__(self, measurements: Measurements, count: int, fixed: Sequence[int]) -> None:
        """Find the pattern for edges between ``count`` poses."""
        self.measurements = measurements
        self.fixed = tuple(fixed)
        self._count = count
        self.free = self._order()
        self.place = np.full(count, -1)
        self.place[self.free] = np.arange(len(self.free))
        self._pattern()
        self.gradient = np.zeros(3 * len(self.free))

    def linearise(
        self, poses: Array, weights: Array | None = None, *, by_measured_ways: bool = False
    ) -> None:
        """Fill in the matrix and the gradient.

        Args:
            poses: (N, 3), where.
            weights: (M,) by which the information is multiplied; default: 1.
            by_measured_ways: take the way from i to j as measured, turned by the yaw of i, where
                the positions are not known yet.
        """
        measured = self.measurements
        x, y = measured.ways(poses)
        cos, sin = np.cos(poses[:, 2])[measured.start], np.sin(poses[:, 2])[measured.start]
        measured_x = cos * measured.motion[0] - sin * measured.motion[1]
        measured_y = sin * measured.motion[0] + cos * measured.motion[1]
        error = (x - measured_x, y - measured_y, measured.turns(poses))
        if by_measured_ways:
            x, y = measured_x, measured_y
        information = measured.turned_information(cos, sin)
        if weights is not None:
            information = information * weights
        i00, i01, i02, i11, i12, i22 = information
        # Minus the third row of the transposed Jacobian of the first pose, times the information.
        lever = (y * i00 - x * i01 - i02, y * i01 - x * i11 - i12, y * i02 - x * i12 - i22)
        self._fill(
            ends=(i00, i01, i02, i11, i12, i22),
            starts=(i00, i01, -lever[0], i11, -lever[1], y * lever[0] - x * lever[1] - lever[2]),
            between=(-i00, -i01, -i02, -i01, -i11, -i12, *lever),
        )
        pull = (
            i00 * error[0] + i01 * error[1] + i02 * error[2],
            i01 * error[0] + i11 * error[1] + i12 * error[2],
            i02 * error[0] + i12 * error[1] + i22 * error[2],
        )
        back = (-pull[0], -pull[1], y * pull[0] - x * pull[1] - pull[2])
        gradient = np.empty((len(self.free), 3))
        for column in range(3):
            gradient[:, column] = self._sum_at_poses(back[column], pull[column])
        self.gradient = gradient.ravel()

    def matrix(self, damping: float = 0.0) -> scipy.sparse.csc_matrix:
        """Return the matrix of the last linearisation; the diagonal times 1 + ``damping``.

        Returns:
            (3 F, 3 F), x, y and yaw of each pose in ``free``.
        """
        data = self._values.ravel()[self._source]
        data[self._diagonal] *= 1.0 + damping
        size = 3 * len(self.free)
        return scipy.sparse.csc_matrix((data, self._rows, self._columns), shape=(size, size))

    def step(self, damping: float = 0.0) -> tuple[Array, float]:
        """Solve for the step that takes the linearised errors to their least squares.

        Args:
            damping: of Levenberg and Marquardt; 0 is Gauss and Newton's step.

        Returns:
            (N, 3) to be added to the poses, and by how much the weighted sum of squares would fall
            if the errors were linear.

        Raises:
            RuntimeError: the matrix is singular.
        """
        matrix = self.matrix(damping)
        moved = -factorise(matrix).solve(self.gradient)
        if not np.isfinite(moved).all():
            message = "the matrix is singular"
            raise RuntimeError(message)
        damped = damping / (1.0 + damping) * np.dot(matrix.data[self._diagonal], moved * moved)
        step = np.zeros((self._count, 3))
        step[self.free] = moved.reshape(-1, 3)
        return step, float(damped - np.dot(self.gradient, moved))

    def _order(self) -> Indices:
        """Return the free poses in a good order."""
        is_free = np.ones(self._count, np.bool_)
        is_free[list(self.fixed)] = False
        free = np.flatnonzero(is_free)
        place = np.full(self._count, -1)
        place[free] = np.arange(len(free))
        ends = place[self.measurements.edges]
        return free[elimination_order(ends[(ends >= 0).all(axis=1)], len(free))]

    def _pattern(self) -> None:
        """Find where each block of the matrix comes from and goes to.

        Blocks are kept once: first those on the diagonal, then those of each pair of joined poses,
        with the pose that is eliminated later as row. The matrix has them twice.
        """
        count = len(self.free)
        start, end = self.place[self.measurements.edges].T
        both = np.concatenate((start, end))
        self._at_free = np.flatnonzero(both >= 0)
        self._at_place = both[self._at_free]
        self._joins = np.flatnonzero((start >= 0) & (end >= 0))
        start, end = start[self._joins], end[self._joins]
        self._is_turned = start < end
        low, high = np.minimum(start, end), np.maximum(start, end)
        pairs, self._pair = np.unique(low * count + high, return_inverse=True)
        low, high = np.divmod(pairs, max(count, 1))
        self._values = np.zeros((count + len(pairs), 9))

        diagonal, below = np.arange(count), count + np.arange(len(pairs))
        columns = np.concatenate((diagonal, low, high))
        rows = np.concatenate((diagonal, high, low))
        source = np.concatenate((diagonal, below, below))
        is_turned = np.repeat((False, False, True), (count, len(pairs), len(pairs)))
        order = np.argsort(columns * count + rows)
        columns, rows, source, is_turned = (
            array[order] for array in (columns, rows, source, is_turned)
        )
        per_column = np.bincount(columns, minlength=count)
        first = np.cumsum(per_column) - per_column
        rank = np.arange(len(columns)) - first[columns]
        within = np.arange(3)
        row, column = within[:, None], within[None, :]
        target = (9 * first[columns] + 3 * rank)[:, None, None] + row
        target = target + 3 * per_column[columns][:, None, None] * column
        taken = np.where(is_turned[:, None, None], 3 * column + row, 3 * row + column)
        self._source = np.empty(target.size, np.int64)
        self._source[target] = 9 * source[:, None, None] + taken
        self._rows = np.empty(target.size, np.int32)
        self._rows[target] = 3 * rows[:, None, None] + row
        starts = 9 * first[:, None] + 3 * per_column[:, None] * within
        self._columns = np.append(starts.ravel(), target.size).astype(np.int32)
        self._diagonal = target[rows == columns][:, within, within].ravel()

    def _fill(
        self, *, ends: Sequence[Array], starts: Sequence[Array], between: Sequence[Array]
    ) -> None:
        """Sum the edges' blocks: of their last poses, of their first ones (upper), of the pairs."""
        count = len(self.free)
        upper = ((0, 1, 2, 4, 5, 8), (0, 3, 6, 4, 7, 8))
        for index, (place, mirrored) in enumerate(zip(*upper, strict=True)):
            summed = self._sum_at_poses(starts[index], ends[index])
            self._values[:count, place] = summed
            self._values[:count, mirrored] = summed
        blocks = [block[self._joins] for block in between]
        pairs = len(self._values) - count
        for place in range(9):
            mirrored = 3 * (place % 3) + place // 3
            block = np.where(self._is_turned, blocks[mirrored], blocks[place])
            self._values[count:, place] = np.bincount(self._pair, block, minlength=pairs)

    def _sum_at_poses(self, of_starts: Array, of_ends: Array) -> Array:
        """Sum the edges' numbers at their free poses, (F,)."""
        numbers = np.concatenate((of_starts, of_ends))[self._at_free]
        summed = np.bincount(self._at_place, numbers, minlength=len(self.free))
        return np.asarray(summed, np.float64)
