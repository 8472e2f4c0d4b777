"""What JSON documents say of the evidence for paths; the text under a key is its meaning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias, TypedDict

__all__ = [
    "PathEvidenceJson",
    "PathSpanJson",
    "PathTimeJson",
    "PathVerdictJson",
    "RefinementJson",
    "RefinementStart",
    "UntoldSpanJson",
]

# What the scans of a drive were laid on each other along, at first.
RefinementStart: TypeAlias = Literal["paths", "odometry"]


class PathSpanJson(TypedDict):
    """A part of a drive in which a path goes with the best one, or does not."""

    from_s: float
    """Where it begins, seconds since the first scan."""
    to_s: float
    """Where it ends, seconds since the first scan."""
    agrees: bool
    """Whether the path is near the best one."""
    gap_m: float
    """How far the two are apart at most, metres."""
    verdict: Literal["better", "worse", "cannot tell"] | None
    """What the scans of the span say of the path against the best one; null where they agree."""


class PathTimeJson(TypedDict):
    """How well a path is borne out in one part of the drive."""

    time_s: float
    """Mean time of the part's scans, seconds since the first scan."""
    consistency: float | None
    """Mean log-likelihood of a hit; null where none was judged."""
    beams: int
    """Hits that were judged."""
    seen_share: float | None
    """Share of them that other parts of the drive have seen; null where none was judged."""


class PathEvidenceJson(TypedDict):
    """What the scans say of one path."""

    name: str
    """The path."""
    consistency: float
    """Mean log-likelihood of a hit under what other scans drew by the path; larger is better."""
    tied: bool
    """Whether it is the best path, or cannot be told from it."""
    behind_best: float
    """Score of the best path less this one's."""
    behind_best_95: tuple[float, float] | None
    """Interval of that, 95 %; null for the best."""
    p_value: float | None
    """Two-sided, of no difference to the best; null for the best."""
    from_fused_m: float | None
    """How far a SLAM's own path is from the fused one, root mean square, metres, laid on each
    other; null for others, and where there is no fused path or the scans speak against it."""
    beams_judged: int
    """Hits that the score rests on, the same for all paths."""
    scans_judged: int
    """Scans that they are of: those that every path has a pose for."""
    seen_share: float
    """Share of the hits that lie where other scans have seen something, by this path."""
    seen_consistency: float | None
    """Mean log-likelihood of these hits; null where there is none."""
    own_poses_share: float
    """Share of the log's scans that the path itself has a pose for."""
    covered_share: float
    """The same with poses that odometry carried on."""
    over_time: Sequence[PathTimeJson]
    """The score in equal parts of the drive, in the order of time."""
    spans: Sequence[PathSpanJson]
    """Where the path goes with the best one, and where it does not."""


class UntoldSpanJson(TypedDict):
    """A part of a drive of which the scans tell nothing."""

    from_s: float
    """Where it begins, seconds since the first scan."""
    to_s: float
    """Where it ends, seconds since the first scan."""


class PathVerdictJson(TypedDict):
    """Which path the scans bear out best."""

    best: str
    """The path that the scans bear out best."""
    best_producer: str | None
    """Which SLAM's own path to take: the one nearest to the fused path; where there is none, or the
    scans speak against it, the one that they bear out best. Null where no path is a SLAM's own."""
    sentence: str
    """The verdict in words."""
    sure: bool
    """Whether every other path is worse beyond chance."""
    contradicted: bool
    """Whether the scans contradict even the best path: what it draws is not what is there."""
    untold: Sequence[UntoldSpanJson]
    """Parts of the drive that hardly saw what any other part saw, by the best path."""


class RefinementJson(TypedDict):
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
