"""Optimise a graph some of whose closures may be false.

An edge that may be an outlier counts at most ``limit`` in the (truncated) sum of squares. It has
many minima, and the start of the search decides which one is found. Three searches:

- ``consensus``: start from the closures that support each other (``consensus.py``), then add in
rounds what agrees with the graph within its own uncertainty. If that is large, false closures agree
by chance, so an unsupported one has to agree better.
- ``gnc``: from given poses, keep the closures that fit there and add what agrees. If some are left
or no poses are given: from the odometry, with soft weights of all closures that harden; then add
what agrees. The better of the two.
- ``dcs``: from all closures, each weakened by its own error.

A growing graph is solved repeatedly. With ``gnc`` the outliers of the last solution are not
re-evaluated while all other closures fit, except for a tolerated few: the inlier set stands, at the
cost of a plain descent. Searches are ``Steps``, so a caller can interleave other work.

Sources: Yang, Antonante, Tzoumas and Carlone, Graduated Non-Convexity for Robust Spatial
Perception, RA-L 2020 (truncated least squares); Agarwal, Tipaldi, Spinello, Stachniss and Burgard,
Robust Map Optimization Using Dynamic Covariance Scaling, ICRA 2013.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from slamfusion.geometry import B8, F64, I64
from slamfusion.json_values import printed_as
from slamfusion.pose_graph.consensus import find_consensus
from slamfusion.pose_graph.least_squares import (
    NEGLIGIBLE,
    Descent,
    Measurements,
    NormalEquations,
    Steps,
    descend,
    rotations_first,
)
from slamfusion.pose_graph.uncertainty import Gates, gates

# Squared error above which a closure is false: the quantile 0.999 of chi-square, 3 degrees.
LIMIT = 16.27
# If the information is too cautious the limit is lower: this many times the scale of the closures'
# loops with each other, but at least the second number.
LIMIT_PER_SCALE, SMALLEST_LIMIT = 240.0, 4.0
# Weights get harder by this factor with each step.
HARDENING = 1.6
# At this hardness only errors within a hundredth of the limit are in between.
HARD = 100.0
# Share of edges without weight at which the equations are rebuilt without them.
SUPERFLUOUS = 0.01
# The most rounds of adding and removing closures until those used are those that fit.
SETTLING = 5
# Mean error of the closures, in the scale of their loops, above which the graph looks bent.
STRAIN = 12.0
# Share of the closures that may be left out when all of them are tried at once.
FEW_LEFT = 0.05
# Outside closures that are checked against the graph at once, the nearest first.
GATED_AT_ONCE = 300
# Closures agree up to half of the above in deviations of closure and graph together. The graph
# grows by the best first, which makes it more certain.
SMALLEST_AGREEMENT = 1.0
AGREEMENT_SHARES = (1.0 / 64.0, 1.0 / 16.0, 1.0 / 4.0, 1.0)
HOPELESS_TIMES = 10.0
# If the graph is uncertain, false closures agree by chance. An unsupported one is added if at most
# this number of false ones is expected to agree as well.
BY_CHANCE = 0.05
# The square of an error from which dynamic covariance scaling starts to weaken an edge.
SCALING_FROM = 5.0
# Sums of squared errors that differ by less are equal.
EQUAL_COST = 1e-9


@dataclass(frozen=True, eq=False)
class Problem:
    """A graph to be optimised.

    Attributes:
        poses: (N, 3); without a given start only the fixed ones count.
        may_be_outlier: (M,) bool; the others alone join all poses.
        was_outlier: (M,) bool, outliers of an earlier solution; None without one.
        tolerated: new outliers with which the earlier inlier set stands, without re-evaluation.
    """

    measured: Measurements
    poses: F64
    fixed: tuple[int, ...]
    may_be_outlier: B8
    was_outlier: B8 | None
    tolerated: int
    max_iterations: int
    tolerance: float

    def equations(self, used: B8) -> NormalEquations:
        """Return the normal equations of some edges, (M,) bool."""
        measured = self.measured if used.all() else self.measured.chosen(used)
        return NormalEquations(measured, len(self.poses), self.fixed)

    def descend(self, equations: NormalEquations, start: F64 | None = None) -> Steps[Descent]:
        """Fit the poses to some edges, from a start or else from the rotations."""
        if start is None:
            start = rotations_first(equations, self.poses)
            yield
        return (
            yield from descend(
                equations, start, max_iterations=self.max_iterations, tolerance=self.tolerance
            )
        )


@dataclass(frozen=True, eq=False)
class InlierSet:
    """The closures that a search keeps, and the poses that fit them.

    Attributes:
        poses: (N, 3) float64.
        weights: (M,) float64 in [0, 1], by which each edge's information counts; 1 for edges that
            cannot be outliers.
        is_converged: the last descent ended because another step would change next to nothing.
        is_reevaluated: all closures were weighed; False where an earlier inlier set stands.
    """

    poses: F64 = field(repr=False)
    weights: F64 = field(repr=False)
    iterations: int
    """Steps of the solver."""
    is_converged: bool = field(metadata=printed_as("converged"))
    """Whether the last step changed next to nothing."""
    is_reevaluated: bool = field(default=True, repr=False)


def plain(problem: Problem, start: F64 | None = None) -> Steps[InlierSet]:
    """Believe all closures; start where they fit better, as given or after the rotations."""
    weights = np.ones(len(problem.measured))
    equations = problem.equations(weights > 0.0)
    if start is None:
        start = min(
            (problem.poses, rotations_first(equations, problem.poses)),
            key=lambda at: float(problem.measured.squared_errors(at).sum()),
        )
    descent = yield from problem.descend(equations, start)
    return InlierSet(descent.poses, weights, descent.iterations, descent.is_converged)


def consensus(problem: Problem, start: F64 | None = None) -> Steps[InlierSet]:
    """Start from the closures that support each other and grow from there."""
    mates, scale = find_consensus(problem.measured, problem.may_be_outlier)
    limit = float(np.clip(LIMIT_PER_SCALE * scale, SMALLEST_LIMIT, LIMIT))
    search = _Search(problem, limit)
    seeds = np.zeros(len(problem.measured), np.bool_)
    has_two = mates > 1
    has_enough = has_two if has_two.mean() > 0.5 else mates > 0
    seeds[np.flatnonzero(problem.may_be_outlier)[has_enough]] = True
    yield from search.propose(seeds, start)
    if search.is_strained(scale):
        odometry = yield from search.odometry()
        yield from search.propose(seeds, odometry, at_once=False)
    if search.is_nearly_complete():
        yield from search.try_all(start)
    if not seeds.any():
        odometry = yield from search.odometry()
        yield from search.propose(problem.may_be_outlier, odometry, at_once=False)
    agreement = float(np.clip(0.5 * LIMIT_PER_SCALE * scale, SMALLEST_AGREEMENT, LIMIT))
    alone = np.zeros(len(problem.measured), np.bool_)
    alone[np.flatnonzero(problem.may_be_outlier)[mates == 0]] = True
    yield from search.grow(agreement, alone)
    if start is None and (problem.may_be_outlier & ~search.used).any():
        yield from search.propose(search.used, None)
    return search.inlier_set()


def gnc(problem: Problem, start: F64 | None = None) -> Steps[InlierSet]:
    """Accept what fits given poses (N, 3) and what agrees with that; or harden all closures.

    Without ``start``, and to harden, the descent starts at the odometry: from given poses
    everything accepted so far would be accepted again, however many closures contradict it.
    """
    search = _Search(problem, LIMIT)
    if start is not None:
        yield from search.keep_what_fits(start)
        yield from search.grow(LIMIT)
        if search.new_outliers() <= problem.tolerated:
            return replace(search.inlier_set(), is_reevaluated=False)
    odometry = yield from search.odometry(start)
    yield from search.propose(problem.may_be_outlier, odometry, at_once=False)
    yield from search.grow(LIMIT)
    return search.inlier_set()


def dcs(problem: Problem, start: F64 | None = None) -> Steps[InlierSet]:
    """Weaken each closure by its own error, from given poses or else from those of all closures."""
    everything = np.ones(len(problem.measured), np.bool_)
    equations = problem.equations(everything)
    poses = rotations_first(equations, problem.poses) if start is None else start
    for iteration in range(1, problem.max_iterations + 1):
        squares = problem.measured.squared_errors(poses)
        scale = np.minimum(1.0, 2.0 * SCALING_FROM / (SCALING_FROM + squares))
        # A weight of 0 could leave a pose without any edge.
        weights = np.where(problem.may_be_outlier, np.maximum(scale * scale, 1e-9), 1.0)
        equations.linearise(poses, weights)
        step, promised = equations.step()
        yield
        poses = poses + step
        if promised <= problem.tolerance * float(np.dot(weights, squares)) + NEGLIGIBLE:
            return InlierSet(poses, weights, iteration, is_converged=True)
    return InlierSet(poses, weights, problem.max_iterations, is_converged=False)


def truncated_weights(squares: F64, hardness: float, limit: float) -> F64:
    """Return the weights of graduated truncated least squares, (K,), from squared errors.

    With ``hardness`` (mu of the paper, above 0) near 0 every edge has nearly the same weight; if it
    is large, the weight is 1 up to the limit and 0 above.
    """
    low, high = hardness / (hardness + 1.0) * limit, (hardness + 1.0) / hardness * limit
    between = np.sqrt(limit * hardness * (hardness + 1.0) / np.clip(squares, low, high)) - hardness
    return np.where(squares >= high, 0.0, np.where(squares <= low, 1.0, between))


class _Search:
    """The best set of closures so far, ``used`` (M,) bool, and its poses (N, 3)."""

    def __init__(self, problem: Problem, limit: float) -> None:
        self._problem, self._limit = problem, limit
        self._trusted = ~problem.may_be_outlier
        self.poses = problem.poses
        self.used = np.zeros(len(problem.measured), np.bool_)
        self._squares = np.full(len(problem.measured), np.inf)
        self._cost = np.inf
        self._iterations = 0
        self._is_converged = self._is_thinned = False
        self._equations: tuple[B8, NormalEquations] | None = None

    def inlier_set(self) -> InlierSet:
        weights = (self._trusted | self.used).astype(np.float64)
        return InlierSet(self.poses, weights, self._iterations, self._is_converged)

    def propose(self, closures: B8, start: F64 | None, *, at_once: bool = True) -> Steps[bool]:
        """Fit some closures, leave out those that disagree with the rest, keep what is better."""
        if at_once or start is None:
            descent = yield from self._fit(closures, start)
            squares = self._problem.measured.squared_errors(descent.poses)
            if not (squares[closures] > self._limit).any():
                return self._keep_better(descent, squares, closures)
            start = descent.poses if start is None else start
            self._is_thinned = True
        return self._keep_better(*(yield from self._graduate(closures, start)))

    def keep_what_fits(self, start: F64) -> Steps[None]:
        """Fit the closures that fit poses, (N, 3), already."""
        squares = self._problem.measured.squared_errors(start)
        fits = self._problem.may_be_outlier & (squares <= self._limit)
        yield from self.propose(fits, start)
        fitting = self._outside() & (self._squares <= self._limit)
        if fitting.any():
            yield from self.propose(self.used | fitting, self.poses)

    def new_outliers(self) -> int:
        """Count the outliers that were none in the earlier solution."""
        outliers = self._problem.was_outlier
        outside = self._outside()
        return int((outside if outliers is None else outside & ~outliers).sum())

    def odometry(self, start: F64 | None = None) -> Steps[F64]:
        """Return the poses without any closure, by way of given ones, (N, 3), or of none."""
        return (yield from self._fit(np.zeros_like(self.used), start)).poses

    def is_strained(self, scale: float) -> bool:
        """Whether closures had to be left out or weigh far more on the graph than they should."""
        within = float(self._squares[self._trusted | self.used].sum())
        return self._is_thinned or bool(within > STRAIN * scale * 3.0 * self.used.sum())

    def is_nearly_complete(self) -> bool:
        """Whether so few closures are left out that all of them may well be true."""
        left_out = self._outside() & (self._squares > self._limit)
        return bool(0 < left_out.sum() <= FEW_LEFT * self._problem.may_be_outlier.sum())

    def try_all(self, start: F64 | None) -> Steps[None]:
        """Accept all closures if they can all be fitted."""
        descent = yield from self._fit(self._problem.may_be_outlier, start)
        squares = self._problem.measured.squared_errors(descent.poses)
        if not (squares[self._problem.may_be_outlier] > self._limit).any():
            self._keep_better(descent, squares, self._problem.may_be_outlier)

    def grow(self, agreement: float, alone: B8 | None = None) -> Steps[None]:
        """Add closures that agree with the graph, the best first, until none does."""
        fitting = self._outside() & (self._squares <= self._limit)
        if fitting.any() and not (yield from self.propose(self.used | fitting, self.poses)):
            return
        outliers = self._problem.was_outlier
        known_false = np.zeros_like(self.used) if outliers is None else outliers & self._outside()
        asked_about = np.flatnonzero(self._outside() & ~known_false)
        asked_about = asked_about[np.argsort(self._squares[asked_about], kind="stable")]
        asked = first_asked = asked_about[:GATED_AT_ONCE]
        found = self._against_graph(asked)
        yield
        for share in AGREEMENT_SHARES:
            while True:
                agrees = found.errors <= share * agreement
                if alone is not None and agrees.any():
                    # Closures that are not checked are false as often as those that are.
                    others = (~self.used[first_asked]).sum() - (found.errors <= agreement).sum()
                    false = known_false.sum() + others * len(asked_about) / len(first_asked)
                    agrees &= ~alone[asked] | (false * found.chances <= BY_CHANCE)
                if not agrees.any():
                    break
                admitted = self.used.copy()
                admitted[asked[agrees]] = True
                if not (yield from self.propose(admitted, self.poses)):
                    return
                # Closures that were far off will not agree later.
                asked = asked[(found.errors <= HOPELESS_TIMES * agreement) & ~agrees]
                found = self._against_graph(asked)
                yield

    def _outside(self) -> B8:
        return self._problem.may_be_outlier & ~self.used

    def _against_graph(self, asked: I64) -> Gates:
        """Check outside edges against the graph, given its uncertainty."""
        if len(asked) == 0:
            return Gates(np.zeros(0), np.zeros(0))
        _, equations = self._equations_of(self._trusted | self.used, superfluous=0.0)
        return gates(equations, self.poses, self._problem.measured.chosen(asked))

    def _graduate(self, closures: B8, poses: F64) -> Steps[tuple[Descent, F64, B8]]:
        """Harden the weights of closures from nearly equal pull to all or nothing."""
        measured = self._problem.measured
        squares = measured.squared_errors(poses)
        worst = float(squares[closures].max(initial=0.0))
        hardness = max(self._limit / max(2.0 * worst - self._limit, self._limit), 1e-12)
        weights = self._trusted.astype(np.float64)
        while hardness < HARD:
            weights[closures] = truncated_weights(squares[closures], hardness, self._limit)
            used, equations = self._equations_of(weights > 0.0)
            equations.linearise(poses, weights[used])
            step, _ = equations.step()
            yield
            self._iterations += 1
            poses = poses + step
            squares = measured.squared_errors(poses)
            if ((weights == 0.0) | (weights == 1.0)).all():
                break
            hardness *= HARDENING
        for _ in range(SETTLING):
            kept = closures & (squares <= self._limit)
            descent = yield from self._fit(kept, poses)
            poses, squares = descent.poses, measured.squared_errors(descent.poses)
            if ((squares <= self._limit)[closures] == kept[closures]).all():
                break
        return descent, squares, kept

    def _equations_of(
        self, used: B8, superfluous: float = SUPERFLUOUS
    ) -> tuple[B8, NormalEquations]:
        """Return normal equations that contain some edges, reusing the last ones if possible."""
        if self._equations is not None:
            there, _ = self._equations
            needless = there & ~used
            if not (used & ~there).any() and needless.sum() <= superfluous * used.sum():
                return self._equations
        self._equations = (used, self._problem.equations(used))
        return self._equations

    def _fit(self, closures: B8, start: F64 | None) -> Steps[Descent]:
        _, equations = self._equations_of(self._trusted | closures, superfluous=0.0)
        yield
        descent = yield from self._problem.descend(equations, start)
        self._iterations += descent.iterations
        return descent

    def _keep_better(self, descent: Descent, squares: F64, closures: B8) -> bool:
        """Accept a fit of a lower truncated sum of squares, or an equal one with more closures."""
        truncated = np.minimum(squares, self._limit)
        cost = float(np.where(self._problem.may_be_outlier, truncated, squares).sum())
        more = bool((self.used <= closures).all() and (closures & ~self.used).any())
        if not (cost < self._cost or (more and cost <= self._cost + EQUAL_COST)):
            return False
        self.poses, self._squares, self.used = descent.poses, squares, closures
        self._cost, self._is_converged = cost, descent.is_converged
        return True
