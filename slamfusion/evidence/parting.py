"""Where one path of a drive leaves another, and where the two go together again.

Two paths may have different frames. One is aligned with the other where most of their poses agree,
so the right half of a path that went wrong half-way is aligned, not the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamfusion.evidence.path_frames import pose_distances
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.geometry import B8, F64, fit_motion, moved_poses, with_levers, wrap_angles
from slamfusion.trajectory import flag_runs

# Two paths part at this distance, metres; the span reaches to where they are within the second one.
# Good paths of one drive differ by up to 0.2 m.
PART_M, NEAR_M = 0.3, 0.15
# Shorter spans are ignored, seconds.
LEAST_S = 1.0
# Parts of the drive at which fits of two paths start, and the most rounds.
BEGINNINGS, FITS = 8, 20
# Of two fits the earlier one is taken unless the other fits more poses by this factor: if a path
# broke in two equal halves, the second is wrong.
MORE_POSES = 1.05


@dataclass(frozen=True)
class Span:
    """A part of a drive in which a path goes with another one, or does not."""

    from_s: float
    """Where it begins, seconds since the first scan."""
    to_s: float
    """Where it ends, seconds since the first scan."""
    agrees: bool
    """Whether the two are near each other."""
    gap_m: float
    """How far they are apart at most, metres."""


def path_spans(evidence: PathEvidence, name: str, other: str) -> tuple[Span, ...]:
    """Return the spans, in the order of time, in which a path agrees with another one or not."""
    since_s = evidence.scans.stamps_s[evidence.is_judged] - evidence.scans.stamps_s[0]
    gap_m = path_gap_m(evidence, name, other)
    apart = parted(gap_m, since_s)
    cuts = np.flatnonzero(np.diff(apart)) + 1
    ends_s = since_s[np.r_[0, cuts, -1]].tolist()
    widest_m = np.maximum.reduceat(gap_m, np.r_[0, cuts]).tolist()
    agrees = (~apart[np.r_[0, cuts]]).tolist()
    return tuple(map(Span, ends_s, ends_s[1:], agrees, widest_m))


def path_gaps(evidence: PathEvidence, name: str, other: str) -> F64:
    """Return an aligned path less another at each judged scan, (M, 3) metres and radians."""
    known = evidence.gaps.get((name, other))
    if known is not None:
        return known
    moving, still = (evidence.scores[one].poses[evidence.is_judged] for one in (name, other))
    gaps = _aligned(moving, still) - still
    gaps[:, 2] = wrap_angles(gaps[:, 2])
    gaps.flags.writeable = False
    evidence.gaps[name, other] = gaps
    return gaps


def path_gap_m(evidence: PathEvidence, name: str, other: str) -> F64:
    """Return how far a path is from another at each judged scan, (M,) metres."""
    return np.asarray(np.hypot(*path_gaps(evidence, name, other)[:, :2].T))


def parted(gap_m: F64, stamps_s: F64) -> B8:
    """Return at which scans, (M,) bool, two paths have parted for at least a second."""
    away = np.zeros(len(gap_m), dtype=np.bool_)
    for here in flag_runs(gap_m > NEAR_M):
        if stamps_s[min(here.stop, len(stamps_s) - 1)] - stamps_s[here.start] >= LEAST_S:
            away[here] = gap_m[here].max() > PART_M
    return away


def _aligned(moving: F64, still: F64) -> F64:
    """Return a path in the frame of another, (M, 3), aligned where most of their poses agree."""
    count = len(moving)
    found, most = moving, -1
    for part in range(BEGINNINGS):
        first = part * count // BEGINNINGS
        kept = np.zeros(count, dtype=np.bool_)
        kept[first : max(first + 1, (part + 1) * count // BEGINNINGS)] = True
        aligned = moving
        for _ in range(FITS):
            motion = fit_motion(with_levers(moving[kept]), with_levers(still[kept]))
            aligned = moved_poses(motion, moving)
            is_near = pose_distances(aligned, still) <= NEAR_M
            if not is_near.any() or np.array_equal(is_near, kept):
                break
            kept = is_near
        near = int(np.count_nonzero(is_near))
        if most < 0 or near > MORE_POSES * most:
            found, most = aligned, near
    return found
