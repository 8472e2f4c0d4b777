"""What JSON documents say of the evidence for paths; the text under a key is its meaning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias, TypedDict

# How far a recommended path can be trusted.
Confidence: TypeAlias = Literal["high", "medium", "low"]

# What the scans of a drive were laid on each other along, at first.
RefinementStart: TypeAlias = Literal["paths", "odometry"]


class PathSpanJson(TypedDict):
    """A part of a drive in which a path goes with the recommended one, or does not."""

    from_s: float
    """Where it begins, seconds since the first scan."""
    to_s: float
    """Where it ends, seconds since the first scan."""
    agrees: bool
    """Whether the path is near the recommended one."""
    gap_m: float
    """How far the two are apart at most, metres."""


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
    """Whether it is the recommended path, or cannot be told from it."""
    behind: float
    """Score of the recommended path less this one's."""
    behind_95: tuple[float, float] | None
    """Interval of that, 95 %; null for the recommended path."""
    p_value: float | None
    """Two-sided, of no difference to the recommended path; null for that."""
    from_fused_m: float | None
    """How far a SLAM's own path is from the fused one, root mean square, metres, after the two are
    aligned; null for others, and if the fused path is not the recommended one."""
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
    """Where the path goes with the recommended one, and where it does not."""


class CheckJson(TypedDict):
    """A place to look at before the map is used."""

    from_s: float
    """When the robot came there, seconds since the first scan."""
    to_s: float
    """When it left, seconds since the first scan."""
    x: float
    """Where it was then, metres, in the frame of the recommended map, or of the path."""
    y: float
    """The same along y."""
    what: str
    """What may be wrong."""


class RecommendationJson(TypedDict):
    """The one answer: what to use, and what to check first."""

    use: str | None
    """Name of the map to use: ``fused``, or a SLAM's; null if the job has no maps."""
    path: str | None
    """Name of the path to use: ``fused``, or a SLAM's; null if there is none."""
    best_single: str | None
    """The SLAM to take if one alone has to do; null if there is none."""
    confidence: Confidence | None
    """``high``: no scan contradicts the path; ``medium``: look at ``check`` first; ``low``: the
    scans contradict the path; null: the scans could not be asked."""
    check: Sequence[CheckJson]
    """What to look at, at most three places, in the order of time."""


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
