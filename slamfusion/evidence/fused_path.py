"""``fuse_paths``: one path from several of one drive, if possible better than the best of them.

A pose graph over all scans. Its measurements are the motions of each path: between successive scans
and over longer spans, between two visits of one place, and from the common frame to each scan. All
are robust: a motion that most of the weight contradicts loses its weight there only, so a path that
slipped once is used again right after. Errors of single paths average out. Motions between
successive scans are compared among the paths, not with the graph: one of them always counts in
full, so that the path never jumps between paths.

The accuracy of motions is estimated from the differences of the paths: over each span, half of them
lie within the scale of its measurements.

Paths with a common fault agree with each other: two that close no loops would outvote one that
does. Over long spans, between visits and in the common frame they count as one path. Each path is
weighted by how well its map predicts the scans of other times (``trust_in_paths``).

Source: Geman and McClure, Statistical methods for tomographic image reconstruction, Bull. ISI 52,
1987 (the weights); Holland and Welsch, Robust regression using iteratively reweighted
least-squares, Communications in Statistics A6, 1977; Suenderhauf and Protzel, Switchable
constraints for robust pose graph SLAM, IROS 2012 (what is robust is the single measurement).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from slamfusion.evidence.path_frames import (
    FROM_MEDIAN,
    find_modes,
    geman_mcclure,
    lay_paths,
    pose_distances,
)
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.geometry import F64, I64, compose_poses, invert_poses, travelled
from slamfusion.pose_graph.graph import PoseGraph
from slamfusion.pose_graph.optimize import optimize
from slamfusion.trajectory import Trajectory

# Spans of motions in scans; long ones start at every quarter of their length.
SPANS = (1, 4, 16, 64, 256)
# From this span on drift is visible.
LONG_SPAN = 64
# Two visits of one place: closer than this, and at least this much travelled in between, metres.
VISIT_M, BETWEEN_VISITS_M = 1.5, 8.0
# Scans among which visits are searched, and the most pairs.
VISITING_SCANS, MOST_VISITS = 1200, 4000
# The most scans of each path that are tied to the common frame.
MOST_TIED = 4000
# Least deviation of a motion, metres and radians: the noise of a scan.
LEAST_M, LEAST_RAD = 0.003, 0.0015
# Least deviation of a place in the common frame.
LEAST_PLACE_M = 0.03
# Squared error, in deviations, at which a measurement keeps a quarter of its weight.
HALF_WAY = 4.0
# Steps differ if they are farther apart than this many times the usual difference.
MOST_STEP_SCALES = 5.0
# Rounds of reweighting; in each, a few steps towards the least sum of squares.
ROUNDS, STEPS = 6, 4
# Least weight of a robust measurement, so that the equations can be solved.
LEAST_WEIGHT = 1e-6
# Log-likelihood per hit behind the best path at which a path keeps 1/e of its weight.
TRUST_SCALE = 0.15


def trust_in_paths(evidence: PathEvidence) -> dict[str, float]:
    """Return the weight of each path by the evidence of the scans, by name, 0 to 1.

    The best one has 1; the others fall with their distance in score, so tied paths count alike.
    """
    told = {name: score.consistency for name, score in evidence.scores.items()}
    best = max(told.values())
    return {name: float(np.exp((value - best) / TRUST_SCALE)) for name, value in told.items()}


class _Motions(NamedTuple):
    """Motions between scans by one or several paths.

    Attributes:
        starts, ends: (M,) int64, indices of poses of the graph.
        motions: (M, 3), pose at the end in the frame of the start.
        deviations: (M, 2), metres and radians.
        trust: (M,) prior weight, 0 to 1.
    """

    starts: I64
    ends: I64
    motions: F64
    deviations: F64
    trust: F64


def fuse_paths(
    paths: Mapping[str, Trajectory],
    weights: Mapping[str, float] | None = None,
    *,
    sharing_fault: Collection[str] = (),
    name: str = "fused",
) -> Trajectory:
    """Make one path of several paths of one drive.

    Args:
        paths: by name, each in a frame of its own, at stamps of the same scans.
        weights: of the paths by name, 0 to 1; default: 1. See ``trust_in_paths``.
        sharing_fault: names of paths of SLAMs that close no loops: over long spans they count
            together as much as the best of them.

    Returns:
        A path at the stamps of the path with most poses, in the frame of the path that is closest
        to the others. A single path is returned unchanged.

    Raises:
        TrajectoryError: see ``lay_paths``.
        GraphError: the equations cannot be solved in double precision.
    """
    stamps_s, laid, trusted = lay_paths(paths, weights)
    over_long = _counted_once(
        trusted, [row for row, own in enumerate(paths) if own in sharing_fault]
    )
    poses = find_modes(laid, over_long)
    if len(paths) > 1 and len(stamps_s) > 1:
        poses = _optimized(laid, trusted, over_long, poses)
    return Trajectory(stamps_s, poses, name)


def _counted_once(weights: F64, rows: Sequence[int]) -> F64:
    """Lower the weights (K, N) of some paths to the best one's share."""
    if len(rows) < 2:
        return weights
    weights = weights.copy()
    together = weights[rows].sum(axis=0)
    weights[rows] *= weights[rows].max(axis=0) / np.where(together > 0.0, together, 1.0)
    return weights


def _optimized(laid: F64, weights: F64, over_long: F64, poses: F64) -> F64:
    """Return (N, 3) poses that fit the motions of the paths (K, N, 3) best.

    ``weights`` (K, N) count over short spans, ``over_long`` over long ones.
    """
    measured = _all_motions(laid, weights, over_long, poses)
    edges = np.stack((measured.starts, measured.ends), axis=1)
    deviations = measured.deviations
    never_closure = np.zeros(len(edges), dtype=np.bool_)
    # The common frame is one more, fixed pose.
    frame = len(poses)
    found = np.concatenate((poses, np.zeros((1, 3))))
    for _ in range(ROUNDS):
        trust = measured.trust * _robust_weights(found, measured)
        information = np.zeros((len(edges), 3, 3))
        places = np.maximum(trust, LEAST_WEIGHT) / deviations[:, 0] ** 2
        information[:, 0, 0] = information[:, 1, 1] = places
        information[:, 2, 2] = np.maximum(trust, LEAST_WEIGHT) / deviations[:, 1] ** 2
        graph = PoseGraph(found, edges, measured.motions, information, never_closure)
        solved = optimize(graph, fixed=frame, start="given", max_iterations=STEPS, tolerance=1e-4)
        found = solved.poses
    return np.asarray(found[:frame])


def _robust_weights(poses: F64, measured: _Motions) -> F64:
    """Return the weight of each measurement by its error, (M,) in (0, 1]."""
    told = compose_poses(invert_poses(poses[measured.starts]), poses[measured.ends])
    left = compose_poses(invert_poses(measured.motions), told)
    # Both coordinates of a place share one deviation, so their mean square counts.
    squares = 0.5 * (left[:, :2] ** 2).sum(axis=1) / measured.deviations[:, 0] ** 2
    squares += left[:, 2] ** 2 / measured.deviations[:, 1] ** 2
    # The weight of a step does not depend on the graph.
    is_step = measured.ends - measured.starts == 1
    return np.where(is_step, 1.0, geman_mcclure(np.sqrt(squares / HALF_WAY)))


def _all_motions(laid: F64, weights: F64, over_long: F64, poses: F64) -> _Motions:
    """Return every measurement of the graph; the pose behind the last is the common frame."""
    count = len(poses)
    groups = [
        _between(laid, over_long if span >= LONG_SPAN else weights, *_span(count, span))
        for span in SPANS
        if span < count
    ]
    groups.append(_between(laid, over_long, *visits(poses)))
    groups.append(_in_frame(laid, over_long, poses))
    return _Motions(*map(np.concatenate, zip(*groups, strict=True)))


def _span(count: int, span: int) -> tuple[I64, I64]:
    """Return the first and last scans of motions over a number of scans."""
    starts = np.arange(0, count - span, max(1, span // 4), dtype=np.int64)
    return starts, starts + span


def visits(poses: F64) -> tuple[I64, I64]:
    """Return pairs of (N, 3) poses at one place with a long way between them, evenly spread."""
    scans = np.arange(0, len(poses), max(1, -(-len(poses) // VISITING_SCANS)), dtype=np.int64)
    travelled_m = travelled(poses)[scans]
    near = scipy.spatial.KDTree(poses[scans, :2]).query_pairs(VISIT_M, output_type="ndarray")
    near = near[np.abs(travelled_m[near[:, 1]] - travelled_m[near[:, 0]]) > BETWEEN_VISITS_M]
    near = np.sort(near, axis=1)
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    near = near[:: max(1, -(-len(near) // MOST_VISITS))]
    return scans[near[:, 0]], scans[near[:, 1]]


def _between(laid: F64, weights: F64, starts: I64, ends: I64) -> _Motions:
    """Return the motions of each path between pairs of scans."""
    told = compose_poses(invert_poses(laid[:, starts]), laid[:, ends])
    trust = np.minimum(weights[:, starts], weights[:, ends])
    deviation = _spread(told)
    has = np.isfinite(told[..., 0])
    is_step = ends - starts == 1
    if is_step.any():
        trust = np.where(is_step, _agreement(told, trust, float(deviation[0])), trust)
    at = np.broadcast_to(np.arange(len(starts)), has.shape)[has]
    deviations = np.tile(deviation, (len(at), 1))
    return _Motions(starts[at], ends[at], told[has], deviations, trust[has])


def _agreement(told: F64, trust: F64, scale_m: float) -> F64:
    """Return the weights of motions compared with each other, (K, M); the best of each has 1."""
    has = np.isfinite(told[..., 0])
    believed = np.where(has, np.maximum(trust, LEAST_WEIGHT), 0.0)
    known = has.any(axis=0)
    agreed = np.zeros_like(believed)
    if known.any():
        answers = told[:, known]
        middle = find_modes(answers, trust[:, known], scale_m, MOST_STEP_SCALES * scale_m)
        away = pose_distances(np.where(has[:, known, None], answers, middle), middle)
        agreed[:, known] = believed[:, known] * geman_mcclure(away / (2.0 * scale_m))
    return np.asarray(agreed / np.maximum(agreed.max(axis=0), 1e-300))


def _spread(told: F64) -> F64:
    """Return the deviations of motions, (2,) metres and radians, from the paths' differences."""
    variances = []
    for a in range(len(told)):
        for b in range(a + 1, len(told)):
            apart = compose_poses(invert_poses(told[a]), told[b])
            apart = np.abs(apart[np.isfinite(apart[:, 0])])
            if len(apart):
                medians = np.array([np.median(apart[:, :2]), np.median(apart[:, 2])])
                # The variance of a difference is that of two motions.
                variances.append(0.5 * (FROM_MEDIAN * medians) ** 2)
    spread = np.sqrt(np.mean(variances, axis=0)) if variances else np.zeros(2)
    return np.asarray(np.maximum(spread, (LEAST_M, LEAST_RAD)))


def _in_frame(laid: F64, weights: F64, poses: F64) -> _Motions:
    """Return the place of each path's scans in the common frame."""
    count = len(poses)
    has = np.isfinite(laid[..., 0])
    stride = max(1, count // MOST_TIED)
    # A scan of a single path has no other tie.
    tied = (np.arange(count) % stride == 0) | (has.sum(axis=0) < len(laid))
    tied[[0, -1]] = True
    apart_m = np.hypot(laid[..., 0] - poses[:, 0], laid[..., 1] - poses[:, 1])
    place_m = np.maximum(FROM_MEDIAN * np.nanmedian(apart_m, axis=1), LEAST_PLACE_M)
    here = has & tied
    path, ends = np.nonzero(here)
    deviations = np.stack((place_m, 0.5 * place_m), axis=1)[path]
    return _Motions(np.full_like(ends, count), ends, laid[here], deviations, weights[here])
