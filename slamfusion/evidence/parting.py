"""Where one path of a drive leaves another: spans of time, and how far they lie apart in them.

Two paths are laid on each other where they agree best, so that one that broke away near its end
does not turn the rest. Who is right in such a span, ``find_exclusions`` decides.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.evidence.predictive import PathEvidence
from slamfusion.geometry import fit_motion, moved_poses, with_levers
from slamfusion.trajectory import flag_runs

F64 = npt.NDArray[np.float64]
B8 = npt.NDArray[np.bool_]

# Two paths part where they are this far from each other, metres, and meet again at half of it.
# Good paths of one drive differ by up to 0.2 m.
PART_M = 0.3
# Shorter spans are none, seconds.
LEAST_S = 1.0
# Rounds of fitting the better half of the poses.
FITS = 20


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
    """Return the spans of a drive in which a path agrees with another one, and in which not.

    Returns:
        Spans in the order of time that together cover the judged part of the drive.
    """
    judged = np.flatnonzero(evidence.is_judged)
    since_s = evidence.scans.stamps_s[judged] - evidence.scans.stamps_s[0]
    gap_m = path_gap_m(evidence, name, other)
    apart = _parted(gap_m, since_s)
    cuts = np.flatnonzero(np.diff(apart.astype(np.int8))) + 1
    first, last = np.r_[0, cuts], np.r_[cuts, len(apart)]
    spans = []
    for start, stop in zip(first.tolist(), last.tolist(), strict=True):
        end_s = float(since_s[stop] if stop < len(since_s) else since_s[-1])
        widest_m = float(gap_m[start:stop].max())
        spans.append(Span(float(since_s[start]), end_s, not bool(apart[start]), widest_m))
    return tuple(spans)


def path_gap_m(evidence: PathEvidence, name: str, other: str) -> F64:
    """Return how far a path lies from another at each judged scan, metres.

    The paths are laid on each other where the better half of their poses fits: least trimmed
    squares, begun from the whole and from each third of the drive.

    Source: Rousseeuw and Van Driessen, Computing LTS regression for large data sets, Data Mining
    and Knowledge Discovery 12, 2006 (concentration steps).
    """
    moving = evidence.scores[name].path.poses[evidence.is_judged]
    still = evidence.scores[other].path.poses[evidence.is_judged]
    count = len(moving)
    thirds = [
        slice(k * count // 3, max(k * count // 3 + 1, (k + 1) * count // 3)) for k in (0, 1, 2)
    ]
    found = [_fit_half(moving, still, begin) for begin in (slice(0, count), *thirds)]
    return min(found, key=lambda gap_m: float(np.median(gap_m)))


def _fit_half(moving: F64, still: F64, begin: slice) -> F64:
    """Return what is left at each pose after fitting the half of them that fits best, metres."""
    kept = np.zeros(len(moving), dtype=np.bool_)
    kept[begin] = True
    for _ in range(FITS):
        motion = fit_motion(with_levers(moving[kept]), with_levers(still[kept]))
        laid = moved_poses(motion, moving)
        left = np.hypot(*(laid[:, :2] - still[:, :2]).T)
        half = left <= np.median(left)
        if np.array_equal(half, kept):
            break
        kept = half
    return np.asarray(left, dtype=np.float64)


def long_runs(flags: B8, stamps_s: F64) -> Iterator[slice]:
    """Yield where flags, (N,), are set without a break for ``LEAST_S`` at least.

    Args:
        stamps_s: (N,) seconds; a run lasts until the first time after it.
    """
    for here in flag_runs(flags):
        if stamps_s[min(here.stop, len(stamps_s) - 1)] - stamps_s[here.start] >= LEAST_S:
            yield here


def _parted(gap_m: F64, since_s: F64) -> B8:
    """Say at which scans two paths have parted, with a lower threshold for meeting again."""
    wide, near = gap_m > PART_M, gap_m <= 0.5 * PART_M
    # The last scan that is wide or near decides; before the first such scan, nothing has parted.
    decided = np.where(wide, 1, np.where(near, -1, 0))
    last = np.maximum.accumulate(np.where(decided != 0, np.arange(len(gap_m)), -1))
    wide_last = np.where(last >= 0, decided[np.maximum(last, 0)] > 0, False)
    apart = np.zeros(len(gap_m), dtype=np.bool_)
    for here in long_runs(wide_last, since_s):
        apart[here] = True
    return apart
