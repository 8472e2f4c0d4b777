"""``optimize``: the poses that fit the measurements of a graph best."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from slamfusion.errors import GraphError
from slamfusion.geometry import B8, F64, wrap_angles
from slamfusion.pose_graph.graph import PoseGraph, chained_poses, check_connected, joining
from slamfusion.pose_graph.least_squares import Measurements, Steps, at_once, rotations_first
from slamfusion.pose_graph.robust import InlierSet, Problem, consensus, dcs, gnc, plain

Robust = Literal["none", "consensus", "gnc", "dcs"]
Start = Literal["best", "given", "odometry", "chordal"]

_ROBUST: dict[str, Callable[[Problem, F64 | None], Steps[InlierSet]]] = {
    "none": plain,
    "consensus": consensus,
    "gnc": gnc,
    "dcs": dcs,
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Optimized(InlierSet):
    """An optimised graph; yaws are in [-pi, pi), and weights of outliers are below 0.5."""

    chi2: float
    """Chi-square after, of the edges that are no outliers."""
    chi2_all: float
    """Chi-square after, of all edges."""
    chi2_start: float
    """Chi-square before, of all edges."""
    time_s: float
    """Wall time of the optimisation, seconds."""

    @property
    def is_outlier(self) -> B8:
        """Whether each edge is outside the inlier set, (M,)."""
        return np.asarray(self.weights < 0.5)


def optimize_in_steps(
    graph: PoseGraph,
    *,
    fixed: int | Sequence[int] = 0,
    robust: Robust = "none",
    start: Start = "best",
    weights: npt.ArrayLike | None = None,
    tolerated: int = 0,
    max_iterations: int = 100,
    tolerance: float = 1e-5,
) -> Steps[Optimized]:
    """Find the poses with the least sum of squared errors, in their deviations (chi-square).

    Args:
        robust: how closures that may be false are found; ``none`` believes all of them. See
            ``slamfusion.pose_graph.robust``.
        start: where to descend from: the graph's own poses (``given``), those along the odometry,
            those after the chordal relaxation of the rotations, or (``best``) the given or the
            chordal ones, whichever fit better; a robust search then looks for its own.
        weights: (K,) of the first K edges, as an earlier optimisation of them left them; with
            ``gnc`` from given poses their inlier set stands as long as all closures fit that were
            no outliers there.
        tolerated: it stands as well where at most this number of these do not fit, which are then
            left out too.
        tolerance: a descent ends after a step that promised to lower chi-square by less than this
            share.

    Raises:
        GraphError: the graph is in several parts, or no pose is held, or there are more weights
            than edges, or the equations cannot be solved in double precision.
    """
    began = time.perf_counter()
    held = (fixed,) if isinstance(fixed, (int, np.integer)) else tuple(fixed)
    if not held or not all(0 <= pose < len(graph) for pose in held):
        raise GraphError(f"poses to hold must be some of 0 to {len(graph) - 1}, found {held}")
    check_connected(graph.edges, len(graph))
    was_outlier = None
    if weights is not None:
        earlier = np.asarray(weights)
        if len(earlier) > len(graph.edges):
            raise GraphError(f"{len(earlier)} earlier weights do not fit {len(graph.edges)} edges")
        was_outlier = np.zeros(len(graph.edges), np.bool_)
        was_outlier[: len(earlier)] = earlier < 0.5
    measured = Measurements(graph.edges, graph.motions, graph.information)
    may_be_outlier = graph.is_closure.copy()  # but not those that alone join what they join
    may_be_outlier[joining(graph.edges, graph.is_closure, len(graph))] = False
    problem = Problem(
        measured=measured,
        poses=graph.poses,
        fixed=held,
        may_be_outlier=may_be_outlier,
        was_outlier=was_outlier,
        tolerated=tolerated,
        max_iterations=max_iterations,
        tolerance=tolerance,
    )
    try:
        if len(set(held)) == len(graph):
            found = InlierSet(graph.poses, np.ones(len(measured)), 0, is_converged=True)
        else:
            found = yield from _ROBUST[robust](problem, _start(problem, graph, start))
    except RuntimeError as error:
        message = f"the graph's equations cannot be solved ({error}); look for edges of no weight"
        raise GraphError(message) from None
    squares = measured.squared_errors(found.poses)
    poses = found.poses.copy()
    poses[:, 2] = wrap_angles(poses[:, 2])
    return Optimized(
        **vars(replace(found, poses=poses)),
        chi2=float(np.dot(found.weights, squares)),
        chi2_all=float(squares.sum()),
        chi2_start=float(measured.squared_errors(graph.poses).sum()),
        time_s=time.perf_counter() - began,
    )


optimize = at_once(optimize_in_steps)


def _start(problem: Problem, graph: PoseGraph, start: Start) -> F64 | None:
    """Return the poses to start from; None if the search finds its own."""
    if start == "given":
        return graph.poses
    if start == "odometry":
        return chained_poses(graph, problem.fixed[0])
    if start == "chordal":
        return rotations_first(problem.equations(np.ones(len(graph.edges), np.bool_)), graph.poses)
    return None
