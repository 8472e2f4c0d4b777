"""Gauss and Newton's steps on a pose graph, damped after Levenberg and Marquardt where needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.pose_graph.normal_equations import NormalEquations

Array = npt.NDArray[np.float64]

# Damping after a first step that made it worse, and where damping is taken for hopeless.
FIRST_DAMPING, LARGEST_DAMPING = 1e-6, 1e8
# Undamped steps in a row that may make it worse, as long as one after them makes it better: from
# far off they often cross a ridge that damped steps creep along.
PATIENCE = 4
# When that does not help, parts of the step to try instead.
SHARES = (0.5, 0.25, 0.1, 0.03)
# A sum of squares this small is no error that could be seen: poses fit to 1e-6 deviations.
NEGLIGIBLE = 1e-12


@dataclass(frozen=True, eq=False)
class Descent:
    """How a descent went.

    Attributes:
        poses: (N, 3) where it ended.
        costs: weighted sums of squares, of the start and after each accepted step; never rising.
        iterations: steps solved for, kept or not.
        is_converged: it ended because another step would change next to nothing.
    """

    poses: Array
    costs: tuple[float, ...]
    iterations: int
    is_converged: bool


def descend(
    equations: NormalEquations,
    poses: Array,
    weights: Array | None = None,
    *,
    max_iterations: int = 100,
    tolerance: float = 1e-5,
) -> Descent:
    """Descend to the nearest least weighted sum of squared errors.

    Args:
        equations: the graph.
        poses: (N, 3), the start.
        weights: (M,) by which the information is multiplied; default: 1.
        max_iterations: steps to solve for at most.
        tolerance: stop after a step that promised to lower the sum by less than this share.
    """
    walk = _Walk(equations, poses, weights)
    for iteration in range(1, max_iterations + 1):
        step, promised = walk.next_step()
        cost = walk.cost_at(walk.poses + step)
        is_small = promised <= tolerance * walk.costs[-1] + NEGLIGIBLE
        if cost <= walk.costs[-1]:
            is_done = is_small and walk.damping == 0.0
            walk.keep(step, cost)
            if is_done:
                return Descent(walk.best, tuple(walk.costs), iteration, is_converged=True)
        elif walk.risen == 0 and (is_small or walk.damping > LARGEST_DAMPING):
            # Nothing but rounding is left, or no step leads down.
            return Descent(walk.best, tuple(walk.costs), iteration, is_converged=is_small)
        else:
            walk.cope(step, cost)
    return Descent(walk.best, tuple(walk.costs), max_iterations, is_converged=False)


class _Walk:
    """Where a descent is.

    Attributes:
        best: (N, 3) poses of the least cost so far.
        costs: of the start and of each place that was better than those before.
        poses: (N, 3) where the next step starts.
        damping: of that step.
        risen: steps since ``best``, each of them for the worse.
    """

    def __init__(self, equations: NormalEquations, poses: Array, weights: Array | None) -> None:
        self._equations, self._weights = equations, weights
        self.best = self.poses = poses
        self.costs = [self.cost_at(poses)]
        self.damping = 0.0
        self.risen, self._patience = 0, PATIENCE

    def cost_at(self, poses: Array) -> float:
        """Return the weighted sum of squares."""
        squares = self._equations.measurements.squared_errors(poses)
        return float(squares.sum() if self._weights is None else np.dot(self._weights, squares))

    def next_step(self) -> tuple[Array, float]:
        """Return the step from here and what it promises; not a number, and infinity, if none."""
        self._equations.linearise(self.poses, self._weights)
        try:
            return self._equations.step(self.damping)
        except RuntimeError:  # singular in this arithmetic; damping mends it
            return np.full_like(self.poses, np.nan), np.inf

    def keep(self, step: Array, cost: float) -> None:
        """Go a step for the better."""
        if self.damping == 0.0:
            self._patience = PATIENCE
        self._go(step, cost)
        self.damping = 0.1 * self.damping if self.damping > FIRST_DAMPING else 0.0

    def cope(self, step: Array, cost: float) -> None:
        """Do something about a step for the worse: go on all the same, go back, or shorten it."""
        if self.damping == 0.0 and self.risen < self._patience and np.isfinite(cost):
            self.poses, self.risen = self.poses + step, self.risen + 1
            return
        if self.risen > 0:
            self.poses, self.risen, self._patience = self.best, 0, 0
            return
        costs = [self.cost_at(self.poses + share * step) for share in SHARES]
        least = int(np.argmin(costs))
        if costs[least] <= self.costs[-1]:
            self._go(SHARES[least] * step, costs[least])
        else:
            self.damping = max(10.0 * self.damping, FIRST_DAMPING)

    def _go(self, step: Array, cost: float) -> None:
        self.best = self.poses = self.poses + step
        self.costs.append(cost)
        self.risen = 0
