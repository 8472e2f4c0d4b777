"""Optimise a graph some of whose closures may be false.

What decides is the truncated sum of squares: an edge that may be doubted counts at most ``limit``.
It has many minima, and which one is found depends on where the search starts. Three searches:

- ``consensus``: start from the closures that bear each other out (``consensus.py``), then let in,
  one round after the other, what agrees with the graph so far within its own uncertainty.
- ``gnc``: start from the odometry, with all closures at once but softly, and harden.
- ``dcs``: from all closures, each weakened by its own error.

Sources: Yang, Antonante, Tzoumas and Carlone, Graduated Non-Convexity for Robust Spatial
Perception, RA-L 2020 (truncated least squares); Agarwal, Tipaldi, Spinello, Stachniss and Burgard,
Robust Map Optimization Using Dynamic Covariance Scaling, ICRA 2013.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.pose_graph.consensus import Consensus, find_consensus
from slamfusion.pose_graph.descend import Descent, descend
from slamfusion.pose_graph.initialize import rotations_first
from slamfusion.pose_graph.measurements import Measurements
from slamfusion.pose_graph.normal_equations import NormalEquations
from slamfusion.pose_graph.uncertainty import Uncertainty, gate_errors

__all__ = [
    "LIMIT",
    "Problem",
    "Verdict",
    "by_consensus",
    "by_graduation",
    "by_scaling",
    "truncated_weights",
]

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Squared error from which on a closure is false: the quantile 0.999 of chi-square, 3 degrees.
LIMIT = 16.27
# Where the information is too cautious the limit is lower: this many times the scale of the loops
# that closures make with each other, but at least the second number. The largest errors of true
# closures lie at a sixth of that or lower on the public graphs.
LIMIT_PER_SCALE, SMALLEST_LIMIT = 240.0, 4.0
# Weights get harder by this factor with each step.
HARDENING = 1.6
# So hard that only errors within a hundredth of the limit are still in between.
HARD = 100.0
# Times that closures are let in and out until those used are those that fit.
SETTLING = 5
# Mean error of the closures, in the scale of their loops, from which on the graph looks bent; that
# of true ones is at most 5 on the public graphs.
STRAIN = 12.0
# Share of the closures that may be left out when all of them are tried at once.
FEW_LEFT = 0.05
# Closures outside the graph that are asked whether they agree with it, those nearest to it.
GATED_AT_ONCE = 300
# They agree up to half of the above in deviations of closure and graph together; true ones lie far
# below, false ones anywhere, so the graph grows by the best first and knows more each time.
SMALLEST_AGREEMENT = 1.0
AGREEMENT_SHARES = (1.0 / 64.0, 1.0 / 16.0, 1.0 / 4.0, 1.0)
HOPELESS_TIMES = 10.0
ROUNDS = 20
# The square of an error from which dynamic covariance scaling starts to weaken an edge.
SCALING_FROM = 5.0


@dataclass(frozen=True, eq=False)
class Problem:
    """A graph to be optimised.

    Attributes:
        measured: all M edges.
        poses: (N, 3), of which only those that are held count where a start is looked for.
        fixed: poses that are held.
        is_doubted: (M,) bool; the others alone join all poses.
        max_iterations: of one descent.
        tolerance: of a descent.
    """

    measured: Measurements
    poses: Array
    fixed: tuple[int, ...]
    is_doubted: Mask
    max_iterations: int
    tolerance: float

    def equations(self, used: Mask) -> NormalEquations:
        """Return the normal equations of some edges, (M,) bool."""
        measured = self.measured if used.all() else self.measured.chosen(used)
        return NormalEquations(measured, len(self.poses), self.fixed)

    def fit(self, used: Mask, start: Array | None = None) -> Descent:
        """Fit the poses to some edges, from a start or else from the rotations."""
        equations = self.equations(used)
        return self.descend(
            equations, rotations_first(equations, self.poses) if start is None else start
        )

    def descend(self, equations: NormalEquations, start: Array) -> Descent:
        """Descend from a start."""
        return descend(
            equations, start, max_iterations=self.max_iterations, tolerance=self.tolerance
        )

    def truncated_cost(self, squares: Array, limit: float) -> float:
        """Return the sum of squares, (M,), in which a doubted edge counts at most ``limit``."""
        return float(np.where(self.is_doubted, np.minimum(squares, limit), squares).sum())


@dataclass(frozen=True, eq=False)
class Verdict:
    """What a robust search found.

    Attributes:
        poses: (N, 3).
        weights: (M,) in [0, 1]; 1 for edges that are not doubted.
        iterations: steps solved for.
        is_converged: the last descent ended by itself.
    """

    poses: Array
    weights: Array
    iterations: int
    is_converged: bool


def by_consensus(problem: Problem, start: Array | None = None) -> Verdict:
    """Start from closures that bear each other out and grow from there.

    Args:
        problem: the graph.
        start: (N, 3) poses to descend from; default: found from the edges.
    """
    found = find_consensus(problem.measured, problem.is_doubted)
    limit = float(np.clip(LIMIT_PER_SCALE * found.scale, SMALLEST_LIMIT, LIMIT))
    search = _Search(problem, limit)
    seeds = np.zeros(len(problem.measured), np.bool_)
    seeds[np.flatnonzero(problem.is_doubted)[_seeds(found)]] = True
    search.propose(seeds, start)
    if search.is_strained(found.scale):
        search.propose(seeds, search.odometry(), at_once=False)
    if search.is_nearly_complete():
        search.try_all(start)
    if not seeds.any():
        search.propose(problem.is_doubted, search.odometry(), at_once=False)
    search.grow(float(np.clip(0.5 * LIMIT_PER_SCALE * found.scale, SMALLEST_AGREEMENT, LIMIT)))
    if start is None and (problem.is_doubted & ~search.used).any():
        search.propose(search.used, None)
    return search.verdict()


def by_graduation(problem: Problem, start: Array | None = None) -> Verdict:
    """Start from given poses, or else from the odometry, with all closures, and harden."""
    search = _Search(problem, LIMIT)
    start = search.odometry() if start is None else start
    search.propose(problem.is_doubted, start, at_once=False)
    return search.verdict()


def by_scaling(problem: Problem, start: Array | None = None) -> Verdict:
    """Weaken each closure by its own error, from given poses or else from those of all closures."""
    everything = np.ones(len(problem.measured), np.bool_)
    equations = problem.equations(everything)
    poses = rotations_first(equations, problem.poses) if start is None else start
    weights = everything.astype(np.float64)
    promised, costs = np.inf, [np.inf]
    while len(costs) <= problem.max_iterations and promised > problem.tolerance * costs[-1]:
        squares = problem.measured.squared_errors(poses)
        scale = np.minimum(1.0, 2.0 * SCALING_FROM / (SCALING_FROM + squares))
        # An edge that counts nothing at all could leave a pose without any.
        weights = np.where(problem.is_doubted, np.maximum(scale * scale, 1e-9), 1.0)
        equations.linearise(poses, weights)
        step, promised = equations.step()
        poses = poses + step
        costs.append(float(np.dot(weights, squares)))
    return Verdict(poses, weights, len(costs) - 1, promised <= problem.tolerance * costs[-1])


def truncated_weights(squares: Array, hardness: float, limit: float) -> Array:
    """Return the weights of graduated truncated least squares, (K,).

    Near 0 the hardness gives nearly the same pull to every edge, however wrong; with a large one
    the weight is 1 up to the limit and 0 from there.

    Args:
        squares: (K,) squared errors.
        hardness: above 0, mu of the paper.
        limit: of a squared error.
    """
    low, high = hardness / (hardness + 1.0) * limit, (hardness + 1.0) / hardness * limit
    between = np.sqrt(limit * hardness * (hardness + 1.0) / np.clip(squares, low, high)) - hardness
    return np.where(squares >= high, 0.0, np.where(squares <= low, 1.0, between))


def _seeds(found: Consensus) -> Mask:
    """Return which closures to start from: those with two mates, if that is most of them."""
    two = found.mates > 1
    return two if two.mean() > 0.5 else found.mates > 0


class _Search:
    """The best set of closures so far, and the poses that belong to it.

    Attributes:
        poses: (N, 3).
        used: (M,) bool, closures that are believed.
    """

    def __init__(self, problem: Problem, limit: float) -> None:
        self._problem, self._limit = problem, limit
        self._trusted = ~problem.is_doubted
        self.poses = problem.poses
        self.used = np.zeros(len(problem.measured), np.bool_)
        self._squares = np.full(len(problem.measured), np.inf)
        self._cost = np.inf
        self._iterations = 0
        self._is_converged = self._is_thinned = False

    def verdict(self) -> Verdict:
        """Return the best that was found."""
        weights = (self._trusted | self.used).astype(np.float64)
        return Verdict(self.poses, weights, self._iterations, self._is_converged)

    def propose(self, closures: Mask, start: Array | None, *, at_once: bool = True) -> bool:
        """Fit some closures, leave out those that do not go with the rest, keep what is better.

        Args:
            closures: (M,) bool.
            start: (N, 3) poses to descend from; default: found from the edges.
            at_once: try them all together first.

        Returns:
            Whether it is better than what was there.
        """
        if at_once or start is None:
            descent = self._fit(closures, start)
            squares = self._problem.measured.squared_errors(descent.poses)
            if not (squares[closures] > self._limit).any():
                return self._keep_better(descent, squares, closures)
            start = descent.poses if start is None else start
            self._is_thinned = True
        return self._keep_better(*self._graduate(closures, start))

    def odometry(self) -> Array:
        """Return the poses without any closure."""
        return self._fit(np.zeros_like(self.used), None).poses

    def is_strained(self, scale: float) -> bool:
        """Whether closures had to be left out or weigh far more on the graph than they should.

        Args:
            scale: of the loops that closures make with each other.
        """
        within = float(self._squares[self._trusted | self.used].sum())
        return self._is_thinned or bool(within > STRAIN * scale * 3.0 * self.used.sum())

    def is_nearly_complete(self) -> bool:
        """Whether so few closures are left out that all of them may well be true."""
        doubted = self._problem.is_doubted
        left_out = doubted & ~self.used & (self._squares > self._limit)
        return bool(0 < left_out.sum() <= FEW_LEFT * doubted.sum())

    def try_all(self, start: Array | None) -> None:
        """Believe all closures if they can all be fitted."""
        descent = self._fit(self._problem.is_doubted, start)
        squares = self._problem.measured.squared_errors(descent.poses)
        if not (squares[self._problem.is_doubted] > self._limit).any():
            self._keep_better(descent, squares, self._problem.is_doubted)

    def grow(self, agreement: float) -> None:
        """Let in closures that agree with the graph, the best first, until none is left that does.

        Args:
            agreement: squared error, in the deviations of closure and graph together, up to which
                they agree.
        """
        outside = self._problem.is_doubted & ~self.used
        fitting = outside & (self._squares <= self._limit)
        if fitting.any() and not self.propose(self.used | fitting, self.poses):
            return
        outside = self._problem.is_doubted & ~self.used
        asked = np.flatnonzero(outside)
        asked = asked[np.argsort(self._squares[asked], kind="stable")[:GATED_AT_ONCE]]
        errors = self._errors_against_graph(asked)
        for share in AGREEMENT_SHARES:
            while (errors <= share * agreement).any():
                admitted = self.used.copy()
                admitted[asked[errors <= share * agreement]] = True
                if not self.propose(admitted, self.poses):
                    return
                # What was far off will not agree once the graph is known better.
                asked = asked[(errors <= HOPELESS_TIMES * agreement) & ~admitted[asked]]
                errors = self._errors_against_graph(asked)

    def _errors_against_graph(self, asked: npt.NDArray[np.int64]) -> Array:
        """Return the squared errors of edges outside the graph, given how well that is known."""
        if len(asked) == 0:
            return np.zeros(0)
        equations = self._problem.equations(self._trusted | self.used)
        uncertainty = Uncertainty(equations, self.poses)
        return gate_errors(uncertainty, self.poses, self._problem.measured.chosen(asked))

    def _graduate(self, closures: Mask, poses: Array) -> tuple[Descent, Array, Mask]:
        """Harden the weights of closures from nearly equal pull to all or nothing.

        Returns:
            The last descent, the squared errors of all edges after it, and the closures it used.
        """
        measured = self._problem.measured
        squares = measured.squared_errors(poses)
        worst = float(squares[closures].max(initial=0.0))
        hardness = max(self._limit / max(2.0 * worst - self._limit, self._limit), 1e-12)
        weights = self._trusted.astype(np.float64)
        used, equations = None, None
        while hardness < HARD:
            weights[closures] = truncated_weights(squares[closures], hardness, self._limit)
            if used is None or equations is None or ((weights > 0.0) != used).any():
                used = weights > 0.0
                equations = self._problem.equations(used)
            equations.linearise(poses, weights[used])
            step, _ = equations.step()
            self._iterations += 1
            poses = poses + step
            squares = measured.squared_errors(poses)
            if ((weights == 0.0) | (weights == 1.0)).all():
                break
            hardness *= HARDENING
        for _ in range(SETTLING):
            kept = closures & (squares <= self._limit)
            descent = self._fit(kept, poses)
            poses, squares = descent.poses, measured.squared_errors(descent.poses)
            if ((squares <= self._limit)[closures] == kept[closures]).all():
                break
        return descent, squares, kept

    def _fit(self, closures: Mask, start: Array | None) -> Descent:
        """Fit the trusted edges and some closures."""
        descent = self._problem.fit(self._trusted | closures, start)
        self._iterations += descent.iterations
        return descent

    def _keep_better(self, descent: Descent, squares: Array, closures: Mask) -> bool:
        """Take over a fit if its truncated sum of squares is lower."""
        cost = self._problem.truncated_cost(squares, self._limit)
        if not cost < self._cost:
            return False
        self.poses, self._squares, self.used = descent.poses, squares, closures
        self._cost, self._is_converged = cost, descent.is_converged
        return True
