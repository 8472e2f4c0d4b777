"""``refine_borne_out``: the refined path, where the scans do not say that it is the worse one.

Laying all scans on each other can pull walls together that are two. Both paths are scored by
predictive consistency, and the refined one is taken unless what was seen is surely less likely
by it.

It reaches as far as walls of one place are drawn near each other. Where the scans see little twice
the SLAMs may be further off than that, each its own way, and the odometry nearer: of a short drive
of a laser that sees a small sector, over a threshold on which wheels slip. So where the scans bear
the odometry out nearly as well as the path, the path is sought from there, too, and the scans say
which is taken. Where they cannot tell, the two differ in what was not seen: there the SLAMs have
the odometry too, and pull at it, so that from the odometry counts.
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

# What the scans of a drive were laid on each other along, at first.
RefinementStart: TypeAlias = Literal["paths", "odometry"]
# What the refined path is called while it is held against the given one.
_REFINED = "refined"
# Odometry by which a hit is less likely than by the given path by more than this, log-likelihood,
# is no start: of 30 simulated drives of minutes 27 are, of 24 of ten seconds none.
NEAR = 0.3
# Paths by which a hit differs by less, log-likelihood, say the same of what was seen: those of one
# place, drawn a little differently, differ by 0.004.
GAIN = 0.01
# What a round must have gained for another: where it gained 0.01 the next one gained nothing, and
# moved loops of corridor by a centimetre.
ROUND_GAIN = 0.02
# Paths that lie farther apart than this, metres, are no two fits of one place, and that from the
# odometry must gain as much as this: a path that meets little of what it saw before is contradicted
# by little, and two of 30 drives of minutes had one that came within 0.2, 7 m off.
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
    """Lay the scans of a drive on each other along a path, unless they contradict what comes.

    Args:
        evidence: of other paths of the drive; none has the name of ``path``.

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
    # By a p-value of 0.05 the paths of three of 73 simulated drives were refused, all nearer to the
    # truth by half and more.
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
