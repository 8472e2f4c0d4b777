"""``refine_path``: the path near a given one under which each wall is drawn once.

A scan matcher aligns each scan with the previous ones, so errors add up, and SLAMs of one drive
share them. Here all scans are aligned at once. The hits are sorted into patches of wall by place
and visible side; the place and tilt of each patch are unknowns like the poses, and the solution has
the least spread of hits about their patches. Hits with little spread, near the laser or along a
wall, weigh more; the spread of each kind is estimated from the drive. Directions without walls,
along a corridor, follow the calibrated odometry (``known_motions``); without odometry, and where it
errs, the given path. Hits far from their patch have no weight.

The lines of the patches are eliminated from the normal equations of each round (the Schur
complement), as points are in bundle adjustment; the rest is solved by conjugate gradients, with its
banded part as preconditioner. After each round hits are sorted on a shifted lattice, so that no
wall stays cut in two.

Source: Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle adjustment - a modern synthesis, Vision
Algorithms, LNCS 1883, 2000, section 6; Liu and Zhang, BALM: Bundle adjustment for lidar mapping,
IEEE RA-L 6(2), 2021 (features of lidar scans that are eliminated); Geman and McClure as in
``fused_path`` (the weights of hits).

``refine_borne_out``: that path, unless the scans show that it is worse, since it can pull two walls
together. Both are scored by predictive consistency.

The refinement reaches as far as walls of one place are drawn near each other. The path may follow a
SLAM that is wrong, since the scans support each of them little before the refinement. So if half of
the SLAMs or more lie far away from the result, it is also refined from the paths of those of them
that the scans support nearly as well, and taken from there if they then support it much better.

If the scans see little twice, the SLAMs may be further off, and the odometry closer: on a short
drive with a narrow view, over a threshold where wheels slip. So if the scans support the odometry
nearly as well as the path, the path is also refined from the odometry, and the scans decide. If
they are undecided, the start at the odometry is taken: the SLAMs use the odometry too, and distort
it. Where the wheels slipped and the scans see little, the parts of the drive before and after are
each right, and too far apart for the refinement: all scans after some time are moved together, as
long as that gains. The parts of a path that is torn are joined so before it is refined.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from slamfusion.evidence.beams import JudgedScans, carried_along, cover_stamps
from slamfusion.evidence.displacement import find_contradiction, moved_together
from slamfusion.evidence.known_motions import KnownMotions, MotionEquations
from slamfusion.evidence.patches import LATTICES, Patches, SurfaceHits, line_inverses, line_sums
from slamfusion.evidence.path_frames import laid_onto
from slamfusion.evidence.predictive import SURE, Comparison, PathEvidence, compare_sums, with_path
from slamfusion.geometry import F64, I64, wrap_angles
from slamfusion.json_values import FLAT
from slamfusion.trajectory import Trajectory

# Rounds with equal hits before those that are averaged; the most solver steps of a round, and the
# residual at which it ends.
ROUNDS, MOST_STEPS, TOLERANCE = 3, 400, 1e-4


def refine_path(scans: JudgedScans, path: Trajectory) -> Trajectory:
    """Return a path that aligns the scans of a drive with each other.

    Walls that ``path`` draws further apart than ``REACH_M`` stay so. Poses between scans move with
    those around them. A path with fewer than two scans, or without surfaces, is returned unchanged.
    """
    given, is_own = cover_stamps(path, scans)
    kept = np.flatnonzero(is_own)
    if len(kept) < 2:
        return path
    hits = SurfaceHits.of(scans, kept)
    if not len(hits.scans):
        return path
    before = given[kept]
    motions = KnownMotions.of(before, None if scans.driven is None else scans.driven.poses[kept])
    poses, calibration, moved = before, motions.calibration, np.zeros_like(before)
    for number in range(ROUNDS + LATTICES):
        say = motions.say(poses, calibration, number)
        equations = motions.equations(poses, calibration, say)
        step, calibrated = _step(hits, poses, equations, number)
        poses, calibration = poses + step, calibration + calibrated
        # The frame is held by the places alone, and the steps are not solved to the end.
        poses = laid_onto(poses, before)
        if number >= ROUNDS:
            off = poses - before
            off[:, 2] = wrap_angles(off[:, 2])
            moved += off
    # Weakly determined poses depend on the lattice, so the mean counts.
    poses = before + moved / LATTICES
    laid = Trajectory(scans.stamps_s[kept], poses)
    return replace(path, poses=carried_along(laid, path, path.stamps_s))


def _step(
    hits: SurfaceHits, poses: F64, equations: MotionEquations, number: int
) -> tuple[F64, F64]:
    """Return the step of one round towards the least sum of squares."""
    patches = Patches.at(hits, poses, number, by_kind=number >= ROUNDS)
    diagonal, slope = equations.diagonal.copy(), equations.slope.copy()
    count = len(poses)
    weighted = patches.weights[:, None] * patches.slopes
    for a in range(3):
        slope[:, a] += np.bincount(hits.scans, weighted[:, a] * patches.away_m, count)
        for b in range(3):
            products = weighted[:, a] * patches.slopes[:, b]
            diagonal[:, a, b] += np.bincount(hits.scans, products, count)
    banded, border = _banded(diagonal, equations.beside), equations.border
    to_lines = _to_lines(hits.scans, patches, weighted, count)
    from_lines = to_lines.T.tocsr()
    inverses = line_inverses(patches.of, len(patches.keys), patches.sides_m, patches.weights)

    def through_lines(of_lines: F64) -> F64:
        """Return the part of the lines' equations for the poses, for one right-hand side."""
        solved = np.einsum("pab,pb->pa", inverses, of_lines.reshape(-1, 2))
        return np.asarray(to_lines.dot(solved.ravel()))

    def times(step: F64) -> F64:
        """Multiply by the equations without the lines, which follow the poses."""
        own, calibration = step[:-2], step[-2:]
        of_poses = banded @ own - through_lines(np.asarray(from_lines.dot(own)))
        of_calibration = border.T @ own + equations.corner @ calibration
        return np.concatenate((of_poses + border @ calibration, of_calibration))

    factor = scipy.sparse.linalg.splu(banded)
    across = factor.solve(border)
    corner = np.linalg.inv(equations.corner - border.T @ across)

    def precondition(right: F64) -> F64:
        """Solve the equations in which the patches stay where they are."""
        own = factor.solve(right[:-2])
        calibration = corner @ (right[-2:] - border.T @ own)
        return np.concatenate((own - across @ calibration, calibration))

    size = (3 * count + 2, 3 * count + 2)
    pulls = patches.weights * patches.away_m
    of_lines = line_sums(patches.of, len(patches.keys), patches.sides_m, pulls)
    slopes = slope.ravel() - through_lines(of_lines)
    step, _ = scipy.sparse.linalg.cg(
        scipy.sparse.linalg.LinearOperator(size, matvec=times, dtype=np.float64),
        -np.concatenate((slopes, equations.end)),
        rtol=TOLERANCE,
        maxiter=MOST_STEPS,
        M=scipy.sparse.linalg.LinearOperator(size, matvec=precondition, dtype=np.float64),
    )
    return np.asarray(step[:-2].reshape(count, 3)), np.asarray(step[-2:])


def _to_lines(scans: I64, patches: Patches, weighted: F64, count: int) -> scipy.sparse.csr_matrix:
    """Return the matrix of the lines of patches, two columns each, and of ``count`` poses."""
    rows = np.repeat(3 * scans[:, None] + np.arange(3), 2, axis=1).astype(np.int32)
    columns = np.tile(2 * patches.of[:, None] + np.arange(2), 3).astype(np.int32)
    values = np.repeat(weighted, 2, axis=1)
    values[:, 1::2] *= patches.sides_m[:, None]
    return scipy.sparse.csr_matrix(
        (values.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * count, 2 * len(patches.keys))
    )


def _banded(diagonal: F64, beside: F64) -> scipy.sparse.csc_matrix:
    """Return the symmetric matrix of (N, 3, 3) blocks and of (N - 1, 3, 3) right of them."""
    count = len(diagonal)
    first = 3 * np.arange(count)[:, None, None]
    row, col = (
        np.broadcast_to(first + part, diagonal.shape)
        for part in (np.arange(3)[:, None], np.arange(3))
    )
    values = np.concatenate([part.ravel() for part in (diagonal, beside, beside)])
    rows = np.concatenate([part.ravel() for part in (row, row[:-1], col[1:])])
    columns = np.concatenate([part.ravel() for part in (col, col[1:], row[:-1])])
    return scipy.sparse.csc_matrix((values, (rows, columns)), shape=(3 * count, 3 * count))


# --- whether it is taken --------------------------------------------------------------------------

# Name of the refined path while it is compared with the given one.
_REFINED = "refined"
# Another start counts only if a hit is at most this much less likely by it, log-likelihood.
NEAR = 0.3
# Two paths are equal if their difference per hit, log-likelihood, is smaller or not sure.
GAIN = 0.01
# Least gain of a round for another one.
ROUND_GAIN = 0.02
# Paths farther apart than this, metres, are different places, and another start must gain the
# second value: a path that revisits little is hardly contradicted.
FAR_M, FAR_GAIN = 1.0, 0.1
MOST_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Refinement:
    """The decision whether the path along which all scans are aligned replaces the given one."""

    taken: bool
    """Whether the refined path was taken: it is not where the scans say that it is worse."""
    start: str
    """What it was sought from: ``paths``, the path made of those of the SLAMs; ``odometry``; or the
    name of the SLAM whose path it was."""
    comparison: Comparison = field(metadata=FLAT)
    """Of the refined path, the first, with the given one."""


def refine_borne_out(
    evidence: PathEvidence, path: Trajectory
) -> tuple[Trajectory, PathEvidence, Refinement]:
    """Refine a path unless the scans contradict the result; ``evidence`` has other paths.

    Returns:
        The refined path if it is taken, else the given one; the evidence with it as the last path;
        and the decision.

    Raises:
        TrajectoryError: see ``score_paths``.
    """
    with_given = with_path(evidence, path.name, path)
    told = with_given.scores[path.name].consistency
    start = "paths"
    # Sought where the path is as it was given: the refinement blurs where it is torn.
    scores = {**with_given.scores, _REFINED: with_given.scores[path.name]}
    joined, _ = _joined(with_given, path, replace(with_given, scores=scores), is_torn=True)
    refined, both = _settled(with_given, joined, told)
    starts = {name: _at_scans(with_given, path, one.poses) for name, one in evidence.scores.items()}
    far = [name for name, one in starts.items() if _apart_m(one, refined).max() > FAR_M]
    for name in far if 2 * len(far) >= len(starts) else ():
        if evidence.scores[name].consistency < told - NEAR:
            continue
        other, with_other = _settled(with_given, starts[name], told, is_far=True)
        if _gain(with_other, both).difference > FAR_GAIN:
            start, refined, both = name, other, with_other
    by_odometry = _from_odometry(with_given, path)
    if by_odometry is not None:
        other, with_other = by_odometry
        gain = _gain(with_other, both)
        is_taken = gain.difference > -GAIN or gain.p_value >= SURE
        if np.median(_apart_m(other, refined)) > FAR_M:
            is_taken = gain.difference > FAR_GAIN
        if is_taken:
            start, refined, both = "odometry", other, with_other
    found = both.compare(_REFINED, path.name)
    # A p-value of 0.05 would also reject paths that are closer to the truth.
    taken = found.difference >= 0.0 or found.p_value >= SURE
    decision = Refinement(taken, start, found)
    if not taken:
        return path, with_given, decision
    scores = dict(both.scores)
    scores[path.name] = scores.pop(_REFINED)
    return refined, replace(both, scores=scores), decision


def _apart_m(one: Trajectory, other: Trajectory) -> F64:
    """Return (N,) the distances of the poses of two paths at the same times."""
    return np.asarray(np.linalg.norm(one.poses[:, :2] - other.poses[:, :2], axis=1))


def _gain(found: PathEvidence, before: PathEvidence) -> Comparison:
    """Compare the refined path of one record with that of another."""
    first, second = found.scores[_REFINED], before.scores[_REFINED]
    return compare_sums(first.sums, second.sums, first.beams, found.is_judged)


def _at_scans(evidence: PathEvidence, path: Trajectory, poses: F64) -> Trajectory:
    """Return ``path`` along other poses (N, 3) at the scans, laid onto it; NaN: no pose."""
    given = evidence.scores[path.name]
    kept = np.flatnonzero(given.is_own & np.isfinite(poses[:, 0]))
    laid = Trajectory(evidence.scans.stamps_s[kept], laid_onto(poses[kept], given.poses[kept]))
    return replace(path, poses=carried_along(laid, path, path.stamps_s))


def _from_odometry(
    evidence: PathEvidence, path: Trajectory
) -> tuple[Trajectory, PathEvidence] | None:
    """Lay the scans on each other along the odometry; None where they contradict it."""
    score, driven = evidence.scores[path.name], evidence.scans.driven
    if driven is None or np.count_nonzero(score.is_own) < 2:
        return None
    wheels = _at_scans(evidence, path, driven.poses)
    told = with_path(evidence, _REFINED, wheels).scores[_REFINED].consistency
    if told < score.consistency - NEAR:
        return None
    refined, both = _joined(evidence, *_settled(evidence, wheels, told), is_torn=False)
    poses = laid_onto(refined.poses, path.poses)
    return Trajectory(path.stamps_s, poses, path.name), both


def _joined(
    evidence: PathEvidence, refined: Trajectory, both: PathEvidence, *, is_torn: bool
) -> tuple[Trajectory, PathEvidence]:
    """Move the scans after some time together while that gains; see ``moved_together``."""
    for _ in range(MOST_ROUNDS):
        told = both.scores[_REFINED].consistency
        moved, gain = moved_together(both, _REFINED, refined, is_torn=is_torn)
        if gain < GAIN:
            break
        again, with_again = _settled(evidence, moved, told)
        if with_again.scores[_REFINED].consistency < told + GAIN:
            break
        # On another floor no motion makes the parts one place.
        if find_contradiction(with_again, _REFINED) is not None:
            break
        refined, both = again, with_again
    return refined, both


def _settled(
    evidence: PathEvidence, path: Trajectory, told: float, *, is_far: bool = False
) -> tuple[Trajectory, PathEvidence]:
    """Lay scans on each other along a path, and along the result while that gains.

    A path that is far from right gains little in some rounds, and much in later ones.
    """
    refined = latest = refine_path(evidence.scans, path)
    both = with_path(evidence, _REFINED, refined)
    for _ in range(1, MOST_ROUNDS):
        found = both.scores[_REFINED].consistency
        if found < told + ROUND_GAIN and not is_far:
            break
        latest = refine_path(evidence.scans, latest)
        with_latest = with_path(evidence, _REFINED, latest)
        told = found
        if with_latest.scores[_REFINED].consistency > found:
            refined, both = latest, with_latest
    return refined, both
