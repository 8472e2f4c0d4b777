"""``refine_borne_out``: the refined path, unless the scans show that it is worse.

Aligning all scans can pull two walls together. Both paths are scored by predictive consistency, and
the refined one is taken unless it makes the scans clearly less likely.

The refinement reaches as far as walls of one place are drawn near each other. If the scans see
little twice, the SLAMs may be further off, and the odometry closer: on a short drive with a narrow
view, over a threshold where wheels slip. So if the scans support the odometry nearly as well as the
path, the path is also refined from the odometry, and the scans decide. If they are undecided, the
start at the odometry is taken: the SLAMs use the odometry too, and distort it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.evidence.beams import JudgedScans, cover_stamps
from slamfusion.evidence.path_frames import laid_onto
from slamfusion.evidence.predictive import SURE, PathEvidence, with_path
from slamfusion.evidence.refined_path import carried_along, refine_path
from slamfusion.trajectory import Trajectory

# Start of the refinement.
RefinementStart: TypeAlias = Literal["paths", "odometry"]
# Name of the refined path while it is compared with the given one.
_REFINED = "refined"
# Odometry is a start only if a hit is at most this much less likely by it, log-likelihood.
NEAR = 0.3
# Paths with a smaller difference per hit, log-likelihood, are equal.
GAIN = 0.01
# Least gain of a round for another one.
ROUND_GAIN = 0.02
# Paths farther apart than this, metres, are different places, and the start at the odometry must
# gain the second value: a path that revisits little is hardly contradicted.
FAR_M, FAR_GAIN = 1.0, 0.1
MOST_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class RefinedPath:
    """What laying all scans on each other has made of a path."""

    taken: bool
    """Whether the refined path was taken: it is not where the scans say that it is worse."""
    start: RefinementStart
    """What it was sought from: the path made of those of the SLAMs, or the odometry."""
    verdict: Literal["better", "worse", "cannot tell"]
    """What the scans say of the refined path against the one before."""
    difference: float
    """Score of the refined path less that of the one before, log-likelihood of a hit."""
    difference_95: tuple[float, float]
    """Interval of that, 95 %."""
    p_value: float
    """Two-sided, of no difference."""
    given: Trajectory = field(repr=False)
    """The path of before."""
    path: Trajectory = field(repr=False)
    """The refined path where it was taken, else the given one."""
    evidence: PathEvidence = field(repr=False)
    """What the scans say of the paths of before, and of ``path`` as the last one."""


def refine_borne_out(
    evidence: PathEvidence, path: Trajectory, device: ComputeDevice
) -> RefinedPath:
    """Refine a path unless the scans contradict the result; ``evidence`` has other paths.

    Raises:
        TrajectoryError: see ``score_paths``.
    """
    with_given = with_path(evidence, path.name, path, device)
    refined, both = _settled(with_given, path, _consistency(with_given, path.name), device)
    start: RefinementStart = "paths"
    by_odometry = _from_odometry(with_given, path, device)
    if by_odometry is not None:
        other, with_other = by_odometry
        apart_m = np.linalg.norm(other.poses[:, :2] - refined.poses[:, :2], axis=1)
        wanted = FAR_GAIN if np.median(apart_m) > FAR_M else -GAIN
        if _consistency(with_other, _REFINED) > _consistency(both, _REFINED) + wanted:
            start, refined, both = "odometry", other, with_other
    found = both.compare(_REFINED, path.name)
    # A p-value of 0.05 would also reject paths that are closer to the truth.
    taken = found.difference >= 0.0 or found.p_value >= SURE
    if taken:
        scores = dict(both.scores)
        scores[path.name] = replace(scores.pop(_REFINED), name=path.name)
        both = replace(both, scores=scores)
    interval = (found.low, found.high)
    return RefinedPath(
        taken,
        start,
        found.verdict,
        found.difference,
        interval,
        found.p_value,
        path,
        refined if taken else path,
        both if taken else with_given,
    )


def _from_odometry(
    evidence: PathEvidence, path: Trajectory, device: ComputeDevice
) -> tuple[Trajectory, PathEvidence] | None:
    """Lay the scans on each other along the odometry; None where they contradict it."""
    wheels = _odometry_at(evidence.scans, path)
    if wheels is None:
        return None
    told = _consistency(with_path(evidence, _REFINED, wheels, device), _REFINED)
    if told < _consistency(evidence, path.name) - NEAR:
        return None
    refined, both = _settled(evidence, wheels, told, device)
    poses = laid_onto(refined.poses, path.poses)
    return Trajectory(path.stamps_s, poses, path.name), both


def _odometry_at(scans: JudgedScans, path: Trajectory) -> Trajectory | None:
    """Return the odometry of a drive as a path at the stamps of another one; None without."""
    given = cover_stamps(path, scans)
    kept = np.flatnonzero(given.is_own)
    if scans.odometry is None or len(kept) < 2:
        return None
    before = given.poses[kept]
    poses = laid_onto(scans.odometry[kept], before)
    return carried_along(path, scans.stamps_s[kept], before, poses)


def _settled(
    evidence: PathEvidence, path: Trajectory, told: float, device: ComputeDevice
) -> tuple[Trajectory, PathEvidence]:
    """Lay scans on each other along a path, and along what came of it while that gains."""
    refined = refine_path(evidence.scans, path)
    both = with_path(evidence, _REFINED, refined, device)
    for _ in range(1, MOST_ROUNDS):
        found = _consistency(both, _REFINED)
        if found < told + ROUND_GAIN:
            break
        again = refine_path(evidence.scans, refined)
        with_again = with_path(evidence, _REFINED, again, device)
        told = found
        if _consistency(with_again, _REFINED) > found:
            refined, both = again, with_again
    return refined, both


def _consistency(evidence: PathEvidence, name: str) -> float:
    return evidence.scores[name].consistency
