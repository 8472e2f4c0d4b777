"""Sparse least squares on a pose graph: measurements, normal equations, first poses and steps.

Poses are (x, y, yaw) and steps are added to them. Turning error and information by the measured
pose's yaw into the world's axes leaves Jacobians of plain numbers: with d the way from i to j,
``de/dx_j`` is the identity and ``de/dx_i`` is ``[[-1, 0, d_y], [0, -1, -d_x], [0, 0, -1]]``. So
all edges are done at once, term by term. The pattern of the matrix is found once, its values at
every step. Unknowns are ordered by whole poses to keep the factor sparse (minimum degree on the
graph of the poses, which is a ninth of the matrix); SuperLU factorises in its symmetric mode.

Poses that are far off start again by rotations first, then everything at once.

Sources: Carlone, Tron, Daniilidis and Dellaert, Initialization Techniques for 3D SLAM, ICRA 2015
(the chordal relaxation); Carlone, Aragues, Castellanos and Bona, A Linear Approximation for
Graph-Based Simultaneous Localization and Mapping, RSS 2011 (the second step).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeAlias, TypeVar, cast

import numpy as np
import scipy

from slamfusion.geometry import B8, F64, I64, wrap_angles


class Measurements:
    """The measured motions of a graph's edges, or of some of them.

    Errors are those of g2o: of an edge with the measured motion z from pose i to pose j,
    ``e = z^-1 (x_i^-1 x_j)`` as x, y and wrapped yaw.

    Attributes:
        edges: (M, 2) int64, from and to.
        motions: (M, 3) float64 x, y, yaw.
        information: (M, 3, 3) float64.
        start, end: (M,) int64, the columns of ``edges``.
        motion: (3, M), the same motions; ``cos`` and ``sin`` (M,) are of their yaws.
        upper: (6, M), the upper triangles of the information, row by row.
    """

    def __init__(self, edges: I64, motions: F64, information: F64) -> None:
        self.edges, self.motions, self.information = edges, motions, information
        self.start, self.end = edges[:, 0].copy(), edges[:, 1].copy()
        self.motion = np.ascontiguousarray(motions.T)
        self.cos, self.sin = np.cos(motions[:, 2]), np.sin(motions[:, 2])
        triangle = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        self.upper = np.stack([information[:, row, column] for row, column in triangle])

    def __len__(self) -> int:
        return len(self.edges)

    def chosen(self, which: B8 | I64) -> Measurements:
        """Return those of some edges, by (M,) bool or by their indices."""
        return Measurements(self.edges[which], self.motions[which], self.information[which])

    def errors(self, poses: F64) -> F64:
        """Return the errors in the frames of the measured poses, (3, M): x, y, wrapped yaw."""
        cos, sin = np.cos(poses[:, 2])[self.start], np.sin(poses[:, 2])[self.start]
        x, y = self.ways(poses)
        across_x = cos * x + sin * y - self.motion[0]
        across_y = cos * y - sin * x - self.motion[1]
        return np.stack(
            (
                self.cos * across_x + self.sin * across_y,
                self.cos * across_y - self.sin * across_x,
                self.turns(poses),
            )
        )

    def squared_errors(self, poses: F64) -> F64:
        """Return each edge's squared error in its own deviations (chi-square), (M,)."""
        e = self.errors(poses)
        i00, i01, i02, i11, i12, i22 = self.upper
        return np.asarray(
            e[0] * (i00 * e[0] + 2.0 * (i01 * e[1] + i02 * e[2]))
            + e[1] * (i11 * e[1] + 2.0 * i12 * e[2])
            + i22 * e[2] * e[2]
        )

    def ways(self, poses: F64) -> tuple[F64, F64]:
        """Return x and y of the way from the first to the last pose of each edge, world's axes."""
        x, y = poses[:, 0], poses[:, 1]
        return x[self.end] - x[self.start], y[self.end] - y[self.start]

    def turns(self, poses: F64) -> F64:
        """Return the errors in yaw, wrapped, (M,)."""
        yaw = poses[:, 2]
        return wrap_angles(yaw[self.end] - yaw[self.start] - self.motion[2])


# Columns that SuperLU updates together; of 1 to 20 the fastest on matrices of 3 x 3 blocks.
PANEL_SIZE = 4


def factorise(matrix: scipy.sparse.csc_matrix, order: str = "NATURAL") -> Any:
    """Return SciPy's ``SuperLU`` of a symmetric positive definite matrix, without pivoting."""
    # SciPy's type stubs do not cover complex matrices and the order by name.
    solve: Any = scipy.sparse.linalg.splu
    return solve(
        matrix,
        permc_spec=order,
        diag_pivot_thresh=0.0,
        panel_size=PANEL_SIZE,
        options={"SymmetricMode": True},
    )


def elimination_order(edges: I64, count: int) -> I64:
    """Return the (count,) nodes of a graph in an order that keeps its factor sparse."""
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
    """The least-squares problem of a graph, linearised on request.

    Attributes:
        free: (F,) poses that may move, in the order of elimination.
        place: (N,) place of each pose in ``free``; -1 for the fixed ones.
        gradient: (3 F,) of half the weighted sum of squares, at the last linearisation.
    """

    def __init__(self, measurements: Measurements, count: int, fixed: Sequence[int]) -> None:
        self.measurements = measurements
        self.fixed = tuple(fixed)
        self._count = count
        is_free = np.ones(count, np.bool_)
        is_free[list(self.fixed)] = False
        free = np.flatnonzero(is_free)
        place = np.full(count, -1)
        place[free] = np.arange(len(free))
        ends = place[measurements.edges]
        self.free = free[elimination_order(ends[(ends >= 0).all(axis=1)], len(free))]
        self.place = np.full(count, -1)
        self.place[self.free] = np.arange(len(self.free))
        self._pattern()
        self.gradient = np.zeros(3 * len(self.free))

    def linearise(
        self, poses: F64, weights: F64 | None = None, *, by_measured_ways: bool = False
    ) -> None:
        """Fill in the matrix and the gradient at poses (N, 3), with weights (M,), default 1.

        With ``by_measured_ways`` the way from i to j is the measured one, turned by the yaw of i,
        for positions that are not known yet.
        """
        measured = self.measurements
        x, y = measured.ways(poses)
        cos, sin = np.cos(poses[:, 2])[measured.start], np.sin(poses[:, 2])[measured.start]
        measured_x = cos * measured.motion[0] - sin * measured.motion[1]
        measured_y = sin * measured.motion[0] + cos * measured.motion[1]
        error = (x - measured_x, y - measured_y, measured.turns(poses))
        if by_measured_ways:
            x, y = measured_x, measured_y
        # The upper triangles of the information in the world's axes.
        c, s = cos * measured.cos - sin * measured.sin, sin * measured.cos + cos * measured.sin
        i00, i01, i02, i11, i12, i22 = measured.upper
        information = np.stack(
            (
                c * (c * i00 - s * i01) - s * (c * i01 - s * i11),
                s * (c * i00 - s * i01) + c * (c * i01 - s * i11),
                c * i02 - s * i12,
                s * (s * i00 + c * i01) + c * (s * i01 + c * i11),
                s * i02 + c * i12,
                i22,
            )
        )
        if weights is not None:
            information = information * weights
        i00, i01, i02, i11, i12, i22 = information
        # Minus the third row of the transposed Jacobian of the first pose, times the information.
        lever = (y * i00 - x * i01 - i02, y * i01 - x * i11 - i12, y * i02 - x * i12 - i22)
        self._fill(
            (i00, i01, i02, i11, i12, i22),
            (i00, i01, -lever[0], i11, -lever[1], y * lever[0] - x * lever[1] - lever[2]),
            (-i00, -i01, -i02, -i01, -i11, -i12, *lever),
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
        """Return the last (3 F, 3 F) matrix, its diagonal times 1 + ``damping``; x, y, yaw."""
        data = self._values.ravel()[self._source]
        data[self._diagonal] *= 1.0 + damping
        size = 3 * len(self.free)
        return scipy.sparse.csc_matrix((data, self._rows, self._columns), shape=(size, size))

    def step(self, damping: float = 0.0) -> tuple[F64, float]:
        """Return the step, (N, 3), and the predicted decrease of the weighted sum of squares."""
        matrix = self.matrix(damping)
        moved = -factorise(matrix).solve(self.gradient)
        if not np.isfinite(moved).all():
            raise RuntimeError("the matrix is singular")
        damped = damping / (1.0 + damping) * np.dot(matrix.data[self._diagonal], moved * moved)
        step = np.zeros((self._count, 3))
        step[self.free] = moved.reshape(-1, 3)
        return step, float(damped - np.dot(self.gradient, moved))

    def _pattern(self) -> None:
        """Find source and target of each block of the matrix.

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

    def _fill(self, ends: Sequence[F64], starts: Sequence[F64], between: Sequence[F64]) -> None:
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

    def _sum_at_poses(self, of_starts: F64, of_ends: F64) -> F64:
        """Sum the edges' numbers at their free poses, (F,)."""
        numbers = np.concatenate((of_starts, of_ends))[self._at_free]
        summed = np.bincount(self._at_place, numbers, minlength=len(self.free))
        return np.asarray(summed, np.float64)


def rotations_first(equations: NormalEquations, poses: F64) -> F64:
    """Return a start that needs no guess: two linear problems, both solved exactly.

    First the yaws alone, as free complex numbers u with ``u_j = exp(i z) u_i`` of each edge.
    Then poses and yaws together, with the measured way along each edge. Of ``poses`` (N, 3) only
    the fixed ones count; the result is (N, 3) float64, not wrapped.
    """
    measured = equations.measurements
    start, end = measured.start, measured.end
    # The information of yaw with x and y unknown.
    xx, xy, x_yaw, yy, y_yaw, yaw = measured.upper
    known = (yy * x_yaw * x_yaw - 2.0 * xy * x_yaw * y_yaw + xx * y_yaw * y_yaw) / (
        xx * yy - xy * xy
    )
    weight = np.maximum(yaw - known, 1e-9 * yaw)
    turn = np.exp(1j * measured.motion[2])
    turned = np.array(poses, np.float64)
    count, free, fixed = len(turned), equations.free, list(equations.fixed)
    rows = np.concatenate((start, end, end, start))
    columns = np.concatenate((start, end, start, end))
    values = np.concatenate((weight, weight, -weight * turn, -weight * turn.conj()))
    matrix = scipy.sparse.csc_matrix((values, (rows, columns)), shape=(count, count))
    pull = -(matrix[:, fixed] @ np.exp(1j * turned[fixed, 2]))[free]
    turned[free, 2] = np.angle(factorise(matrix[:, free][free]).solve(pull))
    equations.linearise(turned, by_measured_ways=True)
    step, _ = equations.step()
    return turned + step


# Damping after a first step that increased the cost, and the damping at which the search stops.
FIRST_DAMPING, LARGEST_DAMPING = 1e-6, 1e8
# Undamped steps in a row that may increase the cost: from far off they often cross a ridge that
# damped steps follow slowly.
PATIENCE = 4
# Parts of the step to try otherwise.
SHARES = (0.5, 0.25, 0.1, 0.03)
# A negligible sum of squares: poses fit to 1e-6 deviations.
NEGLIGIBLE = 1e-12


@dataclass(frozen=True, eq=False)
class Descent:
    """The result of a descent.

    Attributes:
        poses: (N, 3) at the end.
        iterations: steps solved for, kept or not.
        is_converged: it ended because another step would change next to nothing.
    """

    poses: F64
    iterations: int
    is_converged: bool


Result = TypeVar("Result")
Parameters = ParamSpec("Parameters")
# Work that may rest after each of its steps, which take about as long as a factorisation each.
Steps: TypeAlias = Generator[None, None, Result]


def take_steps(steps: Steps[Result], most: float = math.inf) -> Result | None:
    """Take up to ``most`` steps; return the result if the work is finished, else None."""
    taken = 0
    try:
        while taken < most:
            next(steps)
            taken += 1
    except StopIteration as end:
        return cast("Result", end.value)
    return None


def at_once(in_steps: Callable[Parameters, Steps[Result]]) -> Callable[Parameters, Result]:
    """Return the same work as a function that does all its steps."""

    @functools.wraps(in_steps)
    def done(*arguments: Parameters.args, **options: Parameters.kwargs) -> Result:
        return cast("Result", take_steps(in_steps(*arguments, **options)))

    return done


def descend(  # noqa: C901 - the method, from top to bottom
    equations: NormalEquations, poses: F64, *, max_iterations: int = 100, tolerance: float = 1e-5
) -> Steps[Descent]:
    """Descend from poses (N, 3) to the nearest minimum of the squared errors.

    It stops after a step that promised to lower the sum by less than the share ``tolerance``.
    """
    measured = equations.measurements

    def cost_at(poses: F64) -> float:
        return float(measured.squared_errors(poses).sum())

    best, least_cost = poses, cost_at(poses)
    # Steps since ``best``, each of which increased the cost.
    damping, risen, patience = 0.0, 0, PATIENCE
    for iteration in range(1, max_iterations + 1):
        equations.linearise(poses)
        try:
            step, promised = equations.step(damping)
        except RuntimeError:  # singular in this arithmetic; damping fixes it
            step, promised = np.full_like(poses, np.nan), np.inf
        yield
        cost = cost_at(poses + step)
        is_small = promised <= tolerance * least_cost + NEGLIGIBLE
        if cost <= least_cost:
            best = poses = poses + step
            least_cost, risen = cost, 0
            if damping == 0.0:
                if is_small:
                    return Descent(best, iteration, is_converged=True)
                patience = PATIENCE
            damping = 0.1 * damping if damping > FIRST_DAMPING else 0.0
        elif risen == 0 and (is_small or damping > LARGEST_DAMPING):
            # Only rounding is left, or no step leads down.
            return Descent(best, iteration, is_converged=is_small)
        elif damping == 0.0 and risen < patience and np.isfinite(cost):
            poses, risen = poses + step, risen + 1
        elif risen > 0:
            poses, risen, patience = best, 0, 0
        else:
            shorter = [cost_at(poses + share * step) for share in SHARES]
            least = int(np.argmin(shorter))
            if shorter[least] <= least_cost:
                best = poses = poses + SHARES[least] * step
                least_cost = shorter[least]
            else:
                damping = max(10.0 * damping, FIRST_DAMPING)
    return Descent(best, max_iterations, is_converged=False)
