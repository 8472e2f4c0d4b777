"""``fuse_paths``: one path from several of one drive, better than the best of them where it can be.

A pose graph over all scans. Its measurements are the motions that each path tells: from one scan to
the next and over longer spans, between two visits of one place, and from the common frame to each
scan. All are robust: a motion that most of the weight contradicts loses its say there, and only
there, so a path that slipped once is right again at once about what comes after. Errors of single
paths average out. From one scan to the next the paths are held against each other and not against
the graph: some motion of theirs always counts in full, so that the path never jumps where one takes
over from another.

How well a motion is known is not asked of the paths, but read from their differences: over each
span, half of them lie within the scale that its measurements get.

Paths that share a fault agree with each other and are wrong together: two that close no loops
would outvote one that does. Where the fault shows, over long spans, between visits of one place and
in the common frame, they count as one path. And each path is weighed by how well its map predicts
what was seen at other times (``trust_in_paths``).

Source: Geman and McClure, Statistical methods for tomographic image reconstruction, Bull. ISI 52,
1987 (the weights); Holland and Welsch, Robust regression using iteratively reweighted
least-squares, Communications in Statistics A6, 1977; Suenderhauf and Protzel, Switchable
constraints for robust pose graph SLAM, IROS 2012 (what is robust is the single measurement).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.evidence.path_frames import (
    FROM_MEDIAN,
    LaidPaths,
    consensus_poses,
    find_modes,
    geman_mcclure,
    lay_paths,
    pose_distances,
)
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.geometry import F64, compose_poses, invert_poses, travelled
from slamfusion.pose_graph import PoseGraph, optimize
from slamfusion.trajectory import Trajectory

I64 = npt.NDArray[np.int64]

# Scans that a motion spans; longer ones begin at every quarter of their length.
SPANS = (1, 4, 16, 64, 256)
# From this on a drift shows in them.
LONG_SPAN = 64
# Two visits of one place: this near to each other, metres, and this much travelled in between.
VISIT_M, BETWEEN_VISITS_M = 1.5, 8.0
# Scans among which visits are looked for, and pairs that are used, at most.
VISITING_SCANS, MOST_VISITS = 1200, 4000
# Scans that are tied to the common frame at most, of each path.
MOST_TIED = 4000
# A motion is known to no better than this, metres and radians: what a scan's noise leaves.
LEAST_M, LEAST_RAD = 0.003, 0.0015
# Places in the common frame likewise.
LEAST_PLACE_M = 0.03
# Squared error, in deviations, at which a measurement has lost three quarters of its say.
HALF_WAY = 4.0
# Steps further apart than this many times what is usual are two answers.
MOST_STEP_SCALES = 5.0
# Rounds of reweighting; in each, a few steps towards the least sum of squares.
ROUNDS, STEPS = 6, 4
# Of a robust measurement at least this share stays, so that the equations can be solved.
LEAST_WEIGHT = 1e-6
# Log-likelihood of a hit by which a path falls behind the best one to lose 1 - 1/e of its say. On
# 34 simulated drives 0.1, 0.15 and 0.2 gave the same within 1 %, and 0.02 errors greater by 6 %.
TRUST_SCALE = 0.15


def trust_in_paths(evidence: PathEvidence) -> dict[str, float]:
    """Return how much each path is believed by what the scans say of it, by name, 0 to 1.

    The best one has 1; each other one falls with its distance from it, so that paths which cannot
    be told apart count alike.
    """
    told = {name: score.consistency for name, score in evidence.scores.items()}
    best = max(told.values())
    return {name: float(np.exp((value - best) / TRUST_SCALE)) for name, value in told.items()}


@dataclass(frozen=True, eq=False)
class _Motions:
    """Motions between scans as one or several paths tell them.

    Attributes:
        starts, ends: (M,) int64, indices of poses of the graph.
        motions: (M, 3), pose at the end in the frame of that at the start.
        deviations: (M, 2), of places in metres, of headings in radians.
        trust: (M,) how much each is believed before it is held against the graph, 0 to 1.
        is_settled: (M,) bool, those that are not held against it.
    """

    starts: I64
    ends: I64
    motions: F64
    deviations: F64
    trust: F64
    is_settled: npt.NDArray[np.bool_]


def fuse_paths(
    paths: Mapping[str, Trajectory],
    weights: Mapping[str, npt.ArrayLike] | None = None,
    *,
    sharing_fault: Collection[str] = (),
    name: str = "fused",
) -> Trajectory:
    """Make one path of several paths of one drive.

    Args:
        paths: by name, each in a frame of its own, at stamps of the same scans.
        weights: how much a path is believed, in [0, 1], by name: one number, or (poses,) of them;
            default: 1. See ``trust_in_paths``.
        sharing_fault: names of paths that drift alike, those of SLAMs that close no loops: over
            long spans they count together as much as the best of them alone.

    Returns:
        A path at the stamps of the path with most poses, in the frame of the path that the others
        are nearest to. Of one path alone: that path.

    Raises:
        TrajectoryError: see ``lay_paths``.
        GraphError: the equations cannot be solved in double precision.
    """
    laid = lay_paths(paths, weights)
    over_long = _counted_once(laid, sharing_fault)
    poses = consensus_poses(over_long)
    if len(laid.names) > 1 and len(laid) > 1:
        poses = _optimized(laid, over_long, poses)
    return Trajectory(laid.stamps_s, poses, name)


def _counted_once(laid: LaidPaths, names: Collection[str]) -> LaidPaths:
    """Return paths with the weights of some of them lowered to what the best of these has alone."""
    rows = [row for row, name in enumerate(laid.names) if name in names]
    if len(rows) < 2:
        return laid
    weights = laid.weights.copy()
    together = weights[rows].sum(axis=0)
    weights[rows] *= weights[rows].max(axis=0) / np.where(together > 0.0, together, 1.0)
    return replace(laid, weights=weights)


def _optimized(laid: LaidPaths, over_long: LaidPaths, poses: F64) -> F64:
    """Return (N, 3) poses that the motions of the paths bear out best, found from a start."""
    measured = _all_motions(laid, over_long, poses)
    edges = np.stack((measured.starts, measured.ends), axis=1)
    deviations = measured.deviations
    never_closure = np.zeros(len(edges), dtype=np.bool_)
    # The common frame is one more pose, which is held.
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
    return np.where(measured.is_settled, 1.0, geman_mcclure(np.sqrt(squares / HALF_WAY)))


def _all_motions(laid: LaidPaths, over_long: LaidPaths, poses: F64) -> _Motions:
    """Return every measurement of the graph; the pose behind the last is the common frame."""
    count = len(laid)
    groups = [
        _between(over_long if span >= LONG_SPAN else laid, *_span(count, span))
        for span in SPANS
        if span < count
    ]
    groups.append(_between(over_long, *_visits(poses)))
    groups.append(_in_frame(over_long, poses))
    return _Motions(
        *(
            np.concatenate([getattr(group, field) for group in groups])
            for field in ("starts", "ends", "motions", "deviations", "trust", "is_settled")
        )
    )


def _span(count: int, span: int) -> tuple[I64, I64]:
    """Return the first and last scans of motions over a number of scans."""
    starts = np.arange(0, count - span, max(1, span // 4), dtype=np.int64)
    return starts, starts + span


def _visits(poses: F64) -> tuple[I64, I64]:
    """Return pairs of scans at one place with a long way between them, evenly spread."""
    scans = np.arange(0, len(poses), max(1, -(-len(poses) // VISITING_SCANS)), dtype=np.int64)
    travelled_m = travelled(poses)[scans]
    near = scipy.spatial.KDTree(poses[scans, :2]).query_pairs(VISIT_M, output_type="ndarray")
    near = near[np.abs(travelled_m[near[:, 1]] - travelled_m[near[:, 0]]) > BETWEEN_VISITS_M]
    near = np.sort(near, axis=1)
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    near = near[:: max(1, -(-len(near) // MOST_VISITS))]
    return scans[near[:, 0]], scans[near[:, 1]]


def _between(laid: LaidPaths, starts: I64, ends: I64) -> _Motions:
    """Return what each path tells of the motions between pairs of scans."""
    told = compose_poses(invert_poses(laid.poses[:, starts]), laid.poses[:, ends])
    trust = np.minimum(laid.weights[:, starts], laid.weights[:, ends])
    deviation = _spread(told)
    has = np.isfinite(told[..., 0])
    is_step = ends - starts == 1
    if is_step.any():
        trust = np.where(is_step, _agreement(told, trust, float(deviation[0])), trust)
    at = np.broadcast_to(np.arange(len(starts)), has.shape)[has]
    return _Motions(
        starts[at], ends[at], told[has], np.tile(deviation, (len(at), 1)), trust[has], is_step[at]
    )


def _agreement(told: F64, trust: F64, scale_m: float) -> F64:
    """Return how much motions are believed beside each other, (K, M); the best of each has 1."""
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
    """Return the deviations of motions, (2,) metres and radians, from how paths differ in them."""
    variances = []
    for a in range(len(told)):
        for b in range(a + 1, len(told)):
            apart = compose_poses(invert_poses(told[a]), told[b])
            apart = np.abs(apart[np.isfinite(apart[:, 0])])
            if len(apart):
                medians = np.array([np.median(apart[:, :2]), np.median(apart[:, 2])])
                # Of the difference of two; each has half of its variance.
                variances.append(0.5 * (FROM_MEDIAN * medians) ** 2)
    spread = np.sqrt(np.mean(variances, axis=0)) if variances else np.zeros(2)
    return np.asarray(np.maximum(spread, (LEAST_M, LEAST_RAD)))


def _in_frame(laid: LaidPaths, poses: F64) -> _Motions:
    """Return where each path has the scans in the common frame."""
    count = len(laid)
    has = np.isfinite(laid.poses[..., 0])
    stride = max(1, count // MOST_TIED)
    # A scan of which a single path knows has nothing else to be tied by.
    tied = (np.arange(count) % stride == 0) | (has.sum(axis=0) < len(laid.names))
    tied[[0, -1]] = True
    starts, motions, deviations, trust, ends = [], [], [], [], []
    for path, own, weight in zip(laid.poses, has, laid.weights, strict=True):
        scans = np.flatnonzero(own & tied)
        apart = np.hypot(*(path[own, :2] - poses[own, :2]).T)
        place_m = max(FROM_MEDIAN * float(np.median(apart)), LEAST_PLACE_M)
        starts.append(np.full(len(scans), count, dtype=np.int64))
        ends.append(scans)
        motions.append(path[scans])
        deviations.append(np.tile((place_m, 0.5 * place_m), (len(scans), 1)))
        trust.append(weight[scans])
    return _Motions(
        np.concatenate(starts),
        np.concatenate(ends),
        np.concatenate(motions),
        np.concatenate(deviations),
        np.concatenate(trust),
        np.zeros(sum(map(len, trust)), dtype=np.bool_),
    )
