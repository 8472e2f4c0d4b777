"""Solve a pose graph in the plane: Gauss-Newton on sparse normal equations, closures doubted.

Closures are weighed by dynamic covariance scaling: one that contradicts the rest loses its weight
instead of bending the map.

Sources: Grisetti, Kuemmerle, Stachniss and Burgard, A Tutorial on Graph-Based SLAM, 2010; Agarwal,
Tipaldi, Spinello, Stachniss and Burgard, Dynamic Covariance Scaling, ICRA 2013.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from slamfusion.geometry import wrap_angles

__all__ = ["Constraints", "Solution", "solve_graph"]

F64 = npt.NDArray[np.float64]

MOST_STEPS = 10
# A step that moves no pose by more ends the search; metres and radians.
SMALL_STEP = 1e-5
# The square of a closure's error from which it loses weight.
SCALING_FROM = 5.0


@dataclass(frozen=True, eq=False)
class Constraints:
    """What was measured of some poses from others.

    Attributes:
        pairs: (M, 2) int64, from and to.
        motions: (M, 3) measured pose of ``to`` in the frame of ``from``; metres, radians.
        information: (M, 3, 3) inverse covariance of the motion.
        is_doubted: (M,) bool; these may lose weight.
    """

    pairs: npt.NDArray[np.int64]
    motions: F64
    information: F64
    is_doubted: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Solution:
    """Poses that agree best with the constraints.

    Attributes:
        poses: (N, 3); the first one is where it was.
        chi2: weighted sum of the squared errors there.
        weights: (M,) 0 to 1, what is left of each constraint.
        steps: of the search.
        time_s: that it took.
    """

    poses: F64
    chi2: float
    weights: F64
    steps: int
    time_s: float


def solve_graph(poses: F64, constraints: Constraints) -> Solution:
    """Return the poses near given ones that agree best with the constraints.

    Args:
        poses: (N, 3) start; the first pose is held, and all others hang on it by constraints.
        constraints: at least one.
    """
    begun_s = time.perf_counter()
    pattern = _Pattern(constraints.pairs, len(poses))
    at = poses.copy()
    best, best_cost = at, np.inf
    taken = 0
    while taken < MOST_STEPS:
        taken += 1
        errors, to_first, to_second = _linearise(at, constraints)
        squares = np.einsum("mi,mij,mj->m", errors, constraints.information, errors)
        weights = _weights(squares, constraints.is_doubted)
        cost = _cost(squares, weights)
        if cost < best_cost:
            best, best_cost = at, cost
        weighted = constraints.information * weights[:, None, None]
        step = pattern.step(to_first, to_second, weighted, errors)
        at = at + step
        if np.abs(step).max() < SMALL_STEP:
            break
    errors, _, _ = _linearise(at, constraints)
    squares = np.einsum("mi,mij,mj->m", errors, constraints.information, errors)
    weights = _weights(squares, constraints.is_doubted)
    if _cost(squares, weights) > best_cost:  # a step too far
        at = best
        errors, _, _ = _linearise(at, constraints)
        squares = np.einsum("mi,mij,mj->m", errors, constraints.information, errors)
        weights = _weights(squares, constraints.is_doubted)
    at = at.copy()
    at[:, 2] = wrap_angles(at[:, 2])
    chi2 = float(weights @ squares)
    return Solution(at, chi2, weights, taken, time.perf_counter() - begun_s)


def _weights(squares: F64, is_doubted: npt.NDArray[np.bool_]) -> F64:
    """Return what is left of each constraint by dynamic covariance scaling."""
    scale = np.minimum(1.0, 2.0 * SCALING_FROM / (SCALING_FROM + squares))
    return np.where(is_doubted, scale**2, 1.0)


def _cost(squares: F64, weights: F64) -> float:
    """Return the sum of which the weighted squares are the slope: what must not rise."""
    root = np.sqrt(weights)
    return float((weights * squares + SCALING_FROM * (1.0 - root) ** 2).sum())


def _linearise(poses: F64, constraints: Constraints) -> tuple[F64, F64, F64]:
    """Return errors (M, 3) and their derivatives (M, 3, 3) by the first and the second pose."""
    first, second = constraints.pairs.T
    yaw = poses[first, 2]
    cos, sin = np.cos(yaw), np.sin(yaw)
    way = poses[second, :2] - poses[first, :2]
    ahead = cos * way[:, 0] + sin * way[:, 1]
    aside = -sin * way[:, 0] + cos * way[:, 1]
    turn = poses[second, 2] - yaw - constraints.motions[:, 2]
    errors = np.column_stack(
        (ahead - constraints.motions[:, 0], aside - constraints.motions[:, 1], wrap_angles(turn))
    )
    to_second = np.zeros((len(errors), 3, 3))
    to_second[:, 0, 0], to_second[:, 0, 1] = cos, sin
    to_second[:, 1, 0], to_second[:, 1, 1] = -sin, cos
    to_second[:, 2, 2] = 1.0
    to_first = -to_second
    to_first[:, 0, 2], to_first[:, 1, 2] = aside, -ahead
    return errors, to_first, to_second


class _Pattern:
    """Normal equations of one set of pairs: where their values go is found once."""

    def __init__(self, pairs: npt.NDArray[np.int64], count: int) -> None:
        first, second = pairs.T
        self._first, self._second, self._count = first, second, count
        rows = np.concatenate((first, first, second, second))
        cols = np.concatenate((first, second, first, second))
        inner = np.arange(3)
        self._rows = (3 * rows[:, None, None] + inner[:, None] + 0 * inner).ravel()
        self._cols = (3 * cols[:, None, None] + inner + 0 * inner[:, None]).ravel()

    def step(self, to_first: F64, to_second: F64, information: F64, errors: F64) -> F64:
        """Return the (N, 3) step to the least of the linearised sum; the first pose stays."""
        left_first = np.einsum("mki,mkl->mil", to_first, information)
        left_second = np.einsum("mki,mkl->mil", to_second, information)
        values = np.concatenate(
            (
                left_first @ to_first,
                left_first @ to_second,
                left_second @ to_first,
                left_second @ to_second,
            )
        )
        size = 3 * self._count
        slope = np.zeros((self._count, 3))
        np.add.at(slope, self._first, np.einsum("mij,mj->mi", left_first, errors))
        np.add.at(slope, self._second, np.einsum("mij,mj->mi", left_second, errors))
        matrix = csc_matrix((values.ravel(), (self._rows, self._cols)), shape=(size, size))
        factor = splu(
            csc_matrix(matrix[3:, 3:]),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        step = np.zeros((self._count, 3))
        step.ravel()[3:] = -factor.solve(slope.ravel()[3:])
        return step
