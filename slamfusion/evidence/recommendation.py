"""``recommend``: which map and path of a drive to use, which SLAM alone, and what to check first.

The score separates a path that is off by decimetres from one that is off by centimetres; between
two good paths noise decides. The fused path, along which all scans are aligned, is closer to the
truth than either. So it is the answer unless the scans clearly support a SLAM's own path more, and
the best single SLAM is the one closest to it.

A place is one to check if walls there are displaced (``find_displacements``), or if a tied path has
parted there and neither most of the SLAMs nor the scans of that time support the answer. So is a
part of the drive for which a path has no pose, because no path is judged there. If walls are
displaced in a quarter of the drive, most of what the robot saw was free space before some time, and
no small move explains it (``find_contradiction``), or the map of the path explains hits worse than
an unseen place does, the confidence is low.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np

from slamfusion.errors import counted
from slamfusion.evidence.beams import CHUNKS
from slamfusion.evidence.displacement import (
    CONTRADICTED,
    DOUBTED,
    LITTLE_SEEN,
    contradicted_share,
    find_contradiction,
    find_displacements,
    find_place_seen_before,
)
from slamfusion.evidence.parting import PART_M, Span, path_gap_m, path_spans
from slamfusion.evidence.predictive import BLOCKS, SURE, PathEvidence, compare_sums, with_path
from slamfusion.geometry import fit_motion, moved_poses
from slamfusion.slam.common.odometry_check import contradictions, laser_fault
from slamfusion.trajectory import Trajectory, flag_runs, nearest_stamps

# The most places to check.
MOST_CHECKS = 3
# Share of the drive with displaced walls above which the map is wrong as a whole.
BENT = 0.25
# Mean log-likelihood of hits in seen places below which a map predicts nothing. Of an unseen place
# it is -1.05, of right paths of 37 drives at least -0.97, of paths of other drives at most -1.5.
UNPREDICTED = -1.3
# Blocks of scans and log-likelihood per hit from which the scans of a time support one of two
# paths: scan matchers fit the scans of a place slightly better than the true path does.
LEAST_BLOCKS, LEAST_DIFFERENCE = 4, 0.03

MIRRORED = "the path is mirrored: negate its y and yaw"

# How far a recommended path can be trusted.
Confidence: TypeAlias = Literal["high", "medium", "low"]
Tone = Literal["good", "warn", "bad", "plain"]
TONES: Mapping[Confidence | None, Tone] = {
    "high": "good",
    "medium": "warn",
    "low": "bad",
    None: "plain",
}


@dataclass(frozen=True)
class Check:
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

    def __str__(self) -> str:
        times = f"{self.from_s:.0f} to {self.to_s:.0f} s"
        return f"{times}, near ({self.x:.1f}, {self.y:.1f}) m: {self.what}"


@dataclass(frozen=True)
class PathTime:
    """How well the scans support a path in one part of the drive."""

    time_s: float
    """Mean time of the part's scans, seconds since the first scan."""
    consistency: float | None
    """Mean log-likelihood of a hit; null where none was judged."""
    beams: int
    """Hits that were judged."""
    seen_share: float | None
    """Share of them that other parts of the drive have seen; null where none was judged."""


@dataclass(frozen=True)
class RankedPath:
    """What the scans say of one path."""

    name: str
    """The path."""
    consistency: float
    """Mean log-likelihood of a hit, and of its beam's way, under what other scans drew by the path;
    larger is better."""
    tied: bool
    """Whether it is the recommended path, or cannot be told apart from it."""
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
    """The same with the poses that odometry gives between them, from its first to its last."""
    faults: Sequence[str]
    """How the path contradicts the odometry, a sentence each; empty: it does not, or there is none.
    A path whose mirror image agrees with both scans and odometry is mirrored."""
    over_time: Sequence[PathTime]
    """The score in equal parts of the drive, in the order of time."""
    spans: Sequence[Span]
    """Where the path goes with the recommended one, and where it does not."""


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The one answer: what to use, and what to check first."""

    use: str | None
    """Name of the map to use: ``fused``, or a SLAM's; null if the job has no maps."""
    path: str | None
    """Name of the path to use: ``fused``, or a SLAM's; null if there is none."""
    best_single: str | None
    """The SLAM to take if one alone has to do; null if there is none."""
    confidence: Confidence | None = None
    """``high``: no scan contradicts the path; ``medium``: look at ``check`` first; ``low``: the
    scans contradict the path; null: the scans could not be asked."""
    check: Sequence[Check] = ()
    """What to look at, at most three places, in the order of time."""
    laser_fault: str | None = None
    """How the laser is mounted otherwise than the log says, as the odometry tells; null: it is not,
    or nothing tells."""
    paths: Sequence[RankedPath] = field(default=(), repr=False)
    """The reasons: the recommended path, the SLAM to take alone, then the others, the best first;
    empty if the scans could not be asked."""

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> Recommendation:
        """Read what JSON has of an answer: all but the reasons."""
        return cls(**{**record, "check": [Check(**place) for place in record["check"]]})

    @property
    def tone(self) -> Tone:
        """How it is coloured: green, amber, red, or not."""
        return TONES[self.confidence] if self.laser_fault is None else "bad"

    @property
    def is_of_fused(self) -> bool:
        """Whether the SLAMs' own paths were compared with a fused one, which is recommended."""
        return any(path.from_fused_m is not None for path in self.paths)

    @property
    def headline(self) -> str:
        """The answer in a sentence."""
        what = f"the {self.path} path" if self.use is None else f"the {self.use} map"
        if self.use is not None and self.path is not None:
            what += " and its path" if self.path == self.use else f" and the {self.path} path"
        if self.laser_fault is not None:
            return f"Correct the laser before you use {what}: it contradicts the odometry"
        if self.confidence == "low":
            return f"Do not trust {what}: the scans contradict it"
        if self.confidence == "medium":
            return f"Use {what}, but check {counted(len(self.check), 'place')} first"
        if self.confidence == "high":
            return f"Use {what}: no scan contradicts it"
        return f"Use {what}; the scans could not confirm it"

    def lines(self) -> list[tuple[str, str]]:
        """Return what stands below the headline, each a subject and its text; places as on maps."""
        why = ", the nearest to the fused path" if self.is_of_fused else ""
        alone = [("Single SLAM:", self.best_single + why)] if self.best_single else []
        laser = [("Laser:", self.laser_fault)] if self.laser_fault else []
        places = enumerate(self.check, start=1)
        return laser + alone + [(f"Place {number}:", str(place)) for number, place in places]

    def path_faults(self) -> list[tuple[str, str]]:
        """Return faults of the recommended path, else of the others, each after the path's name.

        If the odometry contradicts the recommended path, it is no reason to doubt another one.
        """
        faults = [(path.name, text) for path in self.paths for text in path.faults]
        first = [fault for fault in faults if fault[0] == self.path] or faults
        return [fault for fault in first if fault[1] not in (self.laser_fault or "")]


def recommend(
    evidence: PathEvidence,
    slams: Collection[str],
    *,
    fused: str | None = None,
    frames: Mapping[str, Trajectory] | None = None,
) -> Recommendation:
    """Choose the path to use and the SLAM to take alone, and find what to check.

    fused: name of the fused path; None or unknown: there is none.
    frames: paths by name in the frames of the reported places; default: their own.
    """
    path, alone, from_fused_m = choose_path(evidence, slams, fused)
    frame = (frames or {}).get(path)
    paths = tuple(
        _ranked(evidence, name, path, from_fused_m.get(name))
        for name in dict.fromkeys((path, alone, *evidence.ranking()))
    )
    own_paths = [own for own in paths if own.name in slams]
    check, confidence = _checks(evidence, own_paths, path, frame)
    laser = None
    if paths[0].faults == (MIRRORED,):
        confidence = "low"  # both scans and odometry prefer its image
    else:
        laser = laser_fault(evidence.scans.driven, evidence.own_path(path))
    return Recommendation(None, path, alone, confidence, check, laser, paths)


def choose_path(
    evidence: PathEvidence, slams: Collection[str], fused: str | None = None
) -> tuple[str, str, Mapping[str, float]]:
    """Return the path to use, the SLAM to take alone, and how far each SLAM is from the fused path.

    fused: name of the fused path; None or unknown: there is none.

    Returns:
        Two names, and metres by name; empty if the fused path is not the one to use.
    """
    ranking = [name for name in evidence.ranking() if name in slams]
    # Of paths that the scans do not tell apart, the one with poses for the most of them.
    known = {name: np.isfinite(evidence.scores[name].poses[:, 0]).sum() for name in ranking}
    tied = [name for name in ranking[1:] if evidence.compare(ranking[0], name).verdict != "better"]
    best = max((ranking[0], *tied), key=known.__getitem__)
    if fused is None or fused not in evidence.scores:
        return best, best, {}
    if evidence.compare(best, fused).verdict == "better":
        return best, best, {}
    from_fused_m, still = {}, evidence.scores[fused].poses[evidence.is_judged]
    for name in ranking:
        poses = evidence.scores[name].poses[evidence.is_judged]
        gaps = (moved_poses(fit_motion(poses, still), poses) - still)[:, :2]
        # The root mean square distance of the aligned paths.
        from_fused_m[name] = float(np.sqrt(np.mean(np.sum(gaps**2, axis=1))))
    return fused, min(ranking, key=from_fused_m.__getitem__), from_fused_m


# --- what to check ------------------------------------------------------------------------------


def _checks(
    evidence: PathEvidence, slams: Sequence[RankedPath], path: str, frame: Trajectory | None
) -> tuple[tuple[Check, ...], Confidence]:
    """Return the places of a path to check, in the order of time, and the confidence.

    ``frame`` is the path in the frame of the places; None: the path itself.
    """
    displaced = find_displacements(evidence, path)
    found: list[tuple[float, Check]] = []

    def add(from_s: float, to_s: float, at_s: float, weight: float, what: str) -> None:
        x, y = _place(evidence, path, frame, at_s)
        found.append((weight, Check(from_s, to_s, x, y, what)))

    for part in displaced:
        what = f"walls stand {part.away_m:.1f} m away from where they were seen at other times"
        # Certain faults come before open ones.
        add(part.from_s, part.to_s, 0.5 * (part.from_s + part.to_s), 1e3 + part.away_m, what)
    times_s = evidence.scans.stamps_s - evidence.scans.stamps_s[0]
    if (broken := find_contradiction(evidence, path)) is not None:
        what = f"from here on {broken.share:.0%} of what the robot saw was free space before"
        add(broken.since_s, float(times_s[-1]), broken.since_s, 2e3, what)
    if (again := find_place_seen_before(evidence, path)) is not None:
        what = f"a place seen before is drawn again, {again.away_m:.0f} m away"
        add(again.from_s, again.to_s, again.from_s, 1e3 + again.away_m, what)
    since_s = times_s[evidence.is_judged]
    for rival, span in undecided(evidence, {own.name: own.spans for own in slams}, path):
        here = (since_s >= span.from_s) & (since_s <= span.to_s)
        farthest = int(np.argmax(path_gap_m(evidence, rival, path) * here))
        what = f"{rival} is {span.gap_m:.1f} m from {path}, and no scan shows which is right"
        add(span.from_s, span.to_s, float(since_s[farthest]), span.gap_m, what)
    for gap, names in _unjudged(evidence):
        from_s, to_s = times_s[[gap.start, gap.stop - 1]].tolist()
        what = f"not judged, for lack of a pose in {', '.join(names)}"
        add(from_s, to_s, 0.5 * (from_s + to_s), 1e3, what)
    if evidence.scores[path].seen_share < LITTLE_SEEN:
        what = "little was seen a second time, so nothing confirms the path"
        add(0.0, float(since_s[-1]), float(since_s[-1]), 0.0, what)
    contradicted = contradicted_share(evidence, path)
    is_contradicted = evidence.scores[path].seen_consistency < UNPREDICTED
    if is_contradicted or contradicted > DOUBTED:
        free = f"{contradicted:.0%} of what the robot saw was free space at other times"
        worse = "what the robot saw at other times predicts the scans worse than nothing"
        what = worse if is_contradicted else free
        add(0.0, float(since_s[-1]), float(since_s[-1]), contradicted, what)
    first = sorted(found, key=lambda item: -item[0])[:MOST_CHECKS]
    check = tuple(sorted((place for _, place in first), key=lambda place: place.from_s))
    parted = sum(part.away_m >= PART_M for part in displaced)
    is_elsewhere = broken is not None and broken.moved_share > CONTRADICTED
    if is_contradicted or is_elsewhere or parted > BENT * CHUNKS:
        return check, "low"
    return check, "medium" if check else "high"


def _unjudged(evidence: PathEvidence) -> Iterator[tuple[slice, list[str]]]:
    """Yield scans in a row, a chunk or more, that are not judged, and the paths without poses."""
    for gap in flag_runs(~evidence.is_judged):
        if (gap.stop - gap.start) * CHUNKS >= len(evidence.scans):
            scores = evidence.scores.items()
            yield gap, [own for own, score in scores if np.isnan(score.poses[gap, 0]).any()]


def undecided(
    evidence: PathEvidence, spans: Mapping[str, Sequence[Span]], path: str
) -> Iterator[tuple[str, Span]]:
    """Yield the SLAMs that have parted from a path where no scan shows which is right, and when.

    ``spans`` are those of each SLAM with the path. Where most SLAMs are with it, it is right.
    """
    apart = {name: [span for span in own if not span.agrees] for name, own in spans.items()}
    for rival, own in apart.items():
        if not own or evidence.compare(path, rival).verdict == "better":
            continue
        for when in own:
            away = sum(
                any(span.from_s < when.to_s and span.to_s > when.from_s for span in others)
                for others in apart.values()
            )
            if 2 * away >= len(spans) and not _is_supported(evidence, path, rival, when):
                yield rival, when


def _is_supported(evidence: PathEvidence, path: str, rival: str, when: Span) -> bool:
    """Whether the scans of a span surely support a path more than its rival."""
    first, second = evidence.scores[path], evidence.scores[rival]
    since_s = evidence.scans.stamps_s - evidence.scans.stamps_s[0]
    is_asked = evidence.is_judged & (since_s >= when.from_s) & (since_s <= when.to_s)
    is_asked &= first.beams > 0
    blocks = BLOCKS * int(is_asked.sum()) // int(evidence.is_judged.sum())
    if blocks < LEAST_BLOCKS:
        return False
    found = compare_sums(first.sums, second.sums, first.beams, is_asked, blocks)
    return found.difference > LEAST_DIFFERENCE and found.p_value < SURE


def _place(
    evidence: PathEvidence, path: str, frame: Trajectory | None, at_s: float
) -> tuple[float, float]:
    """Return where the robot was at a time, seconds since the first scan."""
    judged, stamps_s = evidence.is_judged, evidence.scans.stamps_s
    if frame is None:
        frame = Trajectory(stamps_s[judged], evidence.scores[path].poses[judged], path)
    (nearest,) = nearest_stamps(frame.stamps_s, np.array([stamps_s[0] + at_s]))
    x, y, _ = frame.poses[nearest]
    return float(x), float(y)


def _faults(evidence: PathEvidence, name: str) -> tuple[str, ...]:
    """Return how a path contradicts the odometry, a sentence each."""
    wheels, path = evidence.scans.driven, evidence.own_path(name)
    if wheels is None:
        return ()
    if laser_fault(wheels, path) is not None:
        # The image of a path that a mirrored laser made fits its scans worse.
        image = path.mirrored()
        scores = with_path(evidence, "its image", image).scores
        is_better = scores["its image"].consistency > scores[name].consistency
        if is_better and laser_fault(wheels, image) is None:
            return (MIRRORED,)
    return tuple(contradictions(wheels, path))


# --- the reasons ---------------------------------------------------------------------------------


def _ranked(evidence: PathEvidence, name: str, best: str, from_fused_m: float | None) -> RankedPath:
    """Return the evidence of the scans for a path; ``best`` is the recommended one."""
    score = evidence.scores[name]
    found = None if name == best else evidence.compare(best, name)
    start_s = float(evidence.scans.stamps_s[0])
    parts = zip(*evidence.over_time(name), strict=True)
    return RankedPath(
        name=name,
        consistency=score.consistency,
        tied=found is None or found.verdict != "better",
        behind=0.0 if found is None else found.difference,
        behind_95=None if found is None else found.difference_95,
        p_value=None if found is None else found.p_value,
        from_fused_m=from_fused_m,
        beams_judged=int(score.beams.sum()),
        scans_judged=int(evidence.is_judged.sum()),
        seen_share=score.seen_share,
        seen_consistency=score.seen_consistency if score.seen.any() else None,
        own_poses_share=float(score.is_own.mean()),
        covered_share=float(np.isfinite(score.poses[:, 0]).mean()),
        faults=_faults(evidence, name),
        over_time=[
            PathTime(
                float(time_s) - start_s,
                float(mean) if beams else None,
                int(beams),
                float(share) if beams else None,
            )
            for time_s, mean, beams, share in parts
        ],
        spans=path_spans(evidence, name, best),
    )
