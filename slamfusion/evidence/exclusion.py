"""``find_exclusions``: when a path has left the others, so that what it drew then must not vote.

A SLAM that goes wrong half-way is right before, and its map with it. Paths are laid on one of them
where most of their poses agree, and part where they do not (``path_spans``). A path that is in no
largest group of which no two have parted is outvoted for that time; but if the scans support it
more than the others together, those of them that it is surely better than lose their vote. Between
two in such groups that have parted (two paths, or all of them) the scans decide alone, and if they
cannot tell no path is left out.

A path that is wrong for some time draws what contradicts it at all other times. So scans of the
times in which a path has already lost its vote are neither drawn nor asked, where the scans decide.

Scans that are laid on one heap predict each other, and whatever is seen near it: what the scans say
for a path that stands still for some time while the robot drives does not count.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.evidence.beams import CHUNKS
from slamfusion.evidence.path_frames import pose_distances
from slamfusion.evidence.predictive import BLOCKS, SURE, PathEvidence, compare_sums, without_scans
from slamfusion.geometry import F64, fit_motion, moved_poses, with_levers
from slamfusion.trajectory import flag_runs, nearest_stamps

I64 = npt.NDArray[np.int64]
B8 = npt.NDArray[np.bool_]

# Two paths part where they are this far from each other, metres: from where they last were within
# half of it, to where they are so again. Good paths of one drive differ by up to 0.2 m.
PART_M, NEAR_M = 0.3, 0.15
# Shorter spans are none, seconds.
LEAST_S = 1.0


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
    since_s = evidence.scans.stamps_s[evidence.is_judged] - evidence.scans.stamps_s[0]
    gap_m = path_gap_m(evidence, name, other)
    apart = parted(gap_m, since_s)
    cuts = np.flatnonzero(np.diff(apart)) + 1
    ends_s = since_s[np.r_[0, cuts, -1]].tolist()
    widest_m = np.maximum.reduceat(gap_m, np.r_[0, cuts]).tolist()
    agrees = (~apart[np.r_[0, cuts]]).tolist()
    return tuple(map(Span, ends_s, ends_s[1:], agrees, widest_m))


def path_gap_m(evidence: PathEvidence, name: str, other: str) -> F64:
    """Return how far a path lies from another at each judged scan, metres; see ``lay_on``."""
    moving, still = (evidence.scores[one].path.poses[evidence.is_judged] for one in (name, other))
    aligned, _ = lay_on(moving, still)
    return np.asarray(np.hypot(*(aligned[:, :2] - still[:, :2]).T))


def long_runs(flags: B8, stamps_s: F64) -> Iterator[slice]:
    """Yield where flags, (N,), are set without a break for ``LEAST_S`` at least.

    Args:
        stamps_s: (N,) seconds; a run lasts until the first time after it.
    """
    for here in flag_runs(flags):
        if stamps_s[min(here.stop, len(stamps_s) - 1)] - stamps_s[here.start] >= LEAST_S:
            yield here


# Two paths are fitted from each of as many parts of the drive, in as many rounds at most.
BEGINNINGS, FITS = 8, 20
# Of two fits the one from the earlier part, unless the other takes in more poses by this factor: of
# a path that broke in two equal halves, the second one is wrong.
MORE_POSES = 1.05
# With fewer blocks of scans than this, the scans are not asked about a time.
LEAST_BLOCKS = 4
# And where their difference is greater than this, log-likelihood of a hit: what scan matchers fit
# explains the scans of a place a little better than the true path does, by less than this in 98 %
# of 1440 parts of 40 simulated drives.
LEAST_DIFFERENCE = 0.03
# And not for a path that somewhere travels less than this share of the way that most travel, where
# that is so many metres, from second to second: steps of single scans are noise.
LEAST_WAY, DRIVEN_M, STEP_S = 0.5, 0.5, 1.0

_OUTVOTED, _CONTRADICTED = 1, 2
# Two paths, by their rows, and the scans at which they have parted.
_Unsettled = tuple[int, int, slice]


@dataclass(frozen=True)
class ExcludedSpan:
    """A part of a drive in which a producer has no vote."""

    from_s: float
    """Where it begins, seconds since the first scan."""
    to_s: float
    """Where it ends, seconds since the first scan."""
    gap_m: float
    """How far it is at most from the nearest path that votes, metres, and 2 m for a radian; from
    all others where none votes."""
    ground: Literal["outvoted", "contradicted by the scans"]
    """Why: most others agree with each other, or the scans bear another path out better."""


@dataclass(frozen=True)
class UndecidedSpan:
    """A part of a drive in which paths have parted and nothing tells which one is right.

    Attributes:
        from_s, to_s: seconds since the first scan.
    """

    from_s: float
    to_s: float


@dataclass(frozen=True, eq=False)
class Exclusions:
    """When each path of a drive has no vote.

    Attributes:
        stamps_s: (M,) float64, of the scans that were judged, seconds.
        excluded: (M,) bool by name of every path, whether it has no vote then.
        spans: the same as times, by name, in their order.
        undecided: where paths have parted and nothing tells which one is right.
    """

    stamps_s: F64
    excluded: Mapping[str, B8]
    spans: Mapping[str, tuple[ExcludedSpan, ...]]
    undecided: tuple[UndecidedSpan, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The paths that have no vote at some time."""
        return tuple(name for name, spans in self.spans.items() if spans)

    def excluded_share(self, name: str) -> float:
        """Return the share of the judged scans at which a path has no vote."""
        return float(self.excluded[name].mean())

    def votes_at(self, name: str, stamps_s: F64) -> B8:
        """Return whether a path has a vote at times, (T,) bool: as at the judged scan next to each.

        Args:
            stamps_s: (T,) seconds.
        """
        return np.asarray(~self.excluded[name][nearest_stamps(self.stamps_s, stamps_s)])


def find_exclusions(evidence: PathEvidence, device: ComputeDevice | None = None) -> Exclusions:
    """Say when each path of a drive has left the others and must not vote.

    Args:
        evidence: of the paths that vote, and of no path made of them.
    """
    return _Drive.of(evidence, device).judge()


def lay_on(moving: F64, still: F64) -> tuple[F64, int]:
    """Lay a path on another where most of their poses agree.

    Args:
        moving, still: (M, 3) poses of the same scans, M at least 1.

    Returns:
        (M, 3) the poses of the first in the frame of the other, and how many are near.
    """
    count = len(moving)
    found, most = moving, -1
    for part in range(BEGINNINGS):
        first = part * count // BEGINNINGS
        kept = np.zeros(count, dtype=np.bool_)
        kept[first : max(first + 1, (part + 1) * count // BEGINNINGS)] = True
        laid = moving
        for _ in range(FITS):
            motion = fit_motion(with_levers(moving[kept]), with_levers(still[kept]))
            laid = moved_poses(motion, moving)
            is_near = pose_distances(laid, still) <= NEAR_M
            if not is_near.any() or np.array_equal(is_near, kept):
                break
            kept = is_near
        near = int(np.count_nonzero(is_near))
        if most < 0 or near > MORE_POSES * most:
            found, most = laid, near
    return found, most


def _in_one_frame(paths: Sequence[F64], likelihoods: Sequence[float]) -> F64:
    """Lay K paths, (M, 3) each, on the one that they agree with most, (K, M, 3).

    Of those that hardly differ in this, on the one that the scans bear out best.
    """
    laid, agreed = [], []
    for still in paths:
        found = [lay_on(moving, still) for moving in paths]
        laid.append(np.stack([poses for poses, _ in found]))
        agreed.append(sum(near for _, near in found))
    able = [row for row in range(len(paths)) if MORE_POSES * agreed[row] >= max(agreed)]
    return laid[max(able, key=lambda row: likelihoods[row])]


def parted(gap_m: F64, stamps_s: F64) -> B8:
    """Return at which scans two paths have parted, (M,) bool; for less than a second they have not.

    Args:
        gap_m: (M,) how far apart they are, metres.
        stamps_s: (M,) seconds.
    """
    away = np.zeros(len(gap_m), dtype=np.bool_)
    for here in long_runs(gap_m > NEAR_M, stamps_s):
        away[here] = gap_m[here].max() > PART_M
    return away


def _in_largest_group(apart: B8) -> B8:
    """Return which paths are in a largest group of which no two have parted, (K, M) bool."""
    count = len(apart)
    patterns, at = np.unique(apart.reshape(count * count, -1), axis=1, return_inverse=True)
    found = np.zeros((count, patterns.shape[1]), dtype=np.bool_)
    for column, pattern in enumerate(patterns.T):
        has_parted = pattern.reshape(count, count)
        for size in range(count, 0, -1):
            for members in itertools.combinations(range(count), size):
                if not has_parted[np.ix_(members, members)].any():
                    found[list(members), column] = True
            if found[:, column].any():
                break
    return np.asarray(found[:, at.reshape(-1)])


@dataclass(frozen=True, eq=False)
class _Drive:
    """K paths, where they have parted among the M judged scans, and what the scans say of them.

    Attributes:
        judged: (M,) int64, the judged scans.
        gaps: (K, K, M) float64, how far every two are apart, metres.
        apart: (K, K, M) bool, whether they have parted.
        in_majority: (K, M) bool, see ``_in_largest_group``.
    """

    evidence: PathEvidence
    device: ComputeDevice | None
    judged: I64
    gaps: F64
    apart: B8
    in_majority: B8

    @classmethod
    def of(cls, evidence: PathEvidence, device: ComputeDevice | None) -> _Drive:
        """Lay the paths into one frame, and see who goes with whom."""
        judged = np.flatnonzero(evidence.is_judged)
        stamps_s = evidence.scans.stamps_s[judged]
        scores = evidence.scores.values()
        paths = _in_one_frame(
            [score.path.poses[judged] for score in scores], [score.consistency for score in scores]
        )
        gaps = pose_distances(paths[:, None], paths[None])
        apart = np.zeros(gaps.shape, dtype=np.bool_)
        for a, b in itertools.combinations(range(len(paths)), 2):
            apart[a, b] = apart[b, a] = parted(gaps[a, b], stamps_s)
        return cls(evidence, device, judged, gaps, apart, _in_largest_group(apart))

    @property
    def stamps_s(self) -> F64:
        """(M,) times of the judged scans, seconds."""
        return np.asarray(self.evidence.scans.stamps_s[self.judged])

    @property
    def beams(self) -> I64:
        """(M,) judged hits of each scan, the same for all paths."""
        return np.asarray(next(iter(self.evidence.scores.values())).beams[self.judged])

    def judge(self) -> Exclusions:
        """Take the vote of whoever left the others."""
        grounds = np.zeros(self.in_majority.shape, dtype=np.int8)
        unsettled = self._judge_minorities(grounds)
        unsettled += self._judge_rivals(grounds)
        is_open = self._still_open(unsettled, grounds)
        undecided = tuple(
            UndecidedSpan(*self._times(here)) for here in long_runs(is_open, self.stamps_s)
        )
        names = tuple(self.evidence.scores)
        return Exclusions(
            self.stamps_s,
            {name: own > 0 for name, own in zip(names, grounds, strict=True)},
            {name: tuple(self._excluded(row, grounds)) for row, name in enumerate(names)},
            undecided,
        )

    def _judge_minorities(self, grounds: npt.NDArray[np.int8]) -> list[_Unsettled]:
        """Take the vote of whoever is in no largest group, or of those in it whom it belies."""
        sums = np.stack([score.sums[self.judged] for score in self.evidence.scores.values()])
        members = self.in_majority.sum(axis=0)
        of_group = np.where(self.in_majority, sums, 0.0).sum(axis=0) / members
        unsettled = []
        for row, own in enumerate(sums):
            for here in long_runs(~self.in_majority[row], self.stamps_s):
                group = np.flatnonzero(self.in_majority[:, here].any(axis=1)).tolist()
                is_best = bool((own[here].sum() > sums[group, here].sum(axis=1)).all())
                if row in self.standing or not (
                    is_best and self._is_better(own, of_group, self.beams, here, 0.0)
                ):
                    grounds[row, here] = _OUTVOTED
                    continue
                for other in group:
                    if self._is_better(own, sums[other], self.beams, here):
                        grounds[other, here][self.in_majority[other, here]] = _CONTRADICTED
                    else:
                        unsettled.append((row, other, here))
        return unsettled

    def _judge_rivals(self, grounds: npt.NDArray[np.int8]) -> list[_Unsettled]:
        """Let the scans decide between paths of equal groups that have parted."""
        unsettled = []
        names, decided = tuple(self.evidence.scores), grounds > 0
        for a, b in itertools.combinations(range(len(names)), 2):
            are_rivals = self.apart[a, b] & self.in_majority[a] & self.in_majority[b]
            spans = list(long_runs(are_rivals, self.stamps_s))
            if not spans:
                continue
            evidence = self._without(a, b, decided[a] | decided[b])
            scores = [evidence.scores[names[row]] for row in (a, b)]
            first, second = (score.sums[self.judged] for score in scores)
            beams = scores[0].beams[self.judged]
            for here in spans:
                if a not in self.standing and self._is_better(first, second, beams, here):
                    grounds[b, here] = _CONTRADICTED
                elif b not in self.standing and self._is_better(second, first, beams, here):
                    grounds[a, here] = _CONTRADICTED
                else:
                    unsettled.append((a, b, here))
        return unsettled

    def _still_open(self, unsettled: Sequence[_Unsettled], grounds: npt.NDArray[np.int8]) -> B8:
        """Return where two paths that have parted both vote, and none is between them, (M,)."""
        is_open = np.zeros(grounds.shape[1], dtype=np.bool_)
        for a, b, here in unsettled:
            both_vote = (grounds[a, here] == 0) & (grounds[b, here] == 0)
            # Where a third one goes with both, they differ by a little.
            is_bridged = (~self.apart[a, :, here] & ~self.apart[b, :, here]).any(axis=0)
            is_open[here] |= both_vote & ~is_bridged
        return is_open

    def _without(self, a: int, b: int, left_out: B8) -> PathEvidence:
        """Return what the scans say of two paths where some of the judged ones are left out."""
        if self.device is None or not left_out.any() or not self.beams[~left_out].any():
            return self.evidence
        scans = np.zeros(len(self.evidence.scans), dtype=np.bool_)
        scans[self.judged[left_out]] = True
        names = tuple(self.evidence.scores)
        return without_scans(self.evidence, (names[a], names[b]), scans, self.device)

    def _is_better(
        self, first: F64, second: F64, beams: I64, here: slice, least: float = LEAST_DIFFERENCE
    ) -> bool:
        """Whether the scans of a time surely bear the first path out better than the second.

        Args:
            first, second: (M,) sums of log-likelihoods of the judged scans.
            beams: (M,) their judged hits; 0 for scans that are left out.
            least: what they differ by more than, log-likelihood of a hit.
        """
        inside = np.zeros(len(self.judged), dtype=np.bool_)
        inside[here] = True
        inside &= beams > 0
        blocks = BLOCKS * int(np.count_nonzero(inside)) // len(inside)
        if blocks < LEAST_BLOCKS:
            return False
        found = compare_sums(first, second, beams, inside, blocks)
        return found.difference > least and found.p_value < SURE

    @cached_property
    def standing(self) -> frozenset[int]:
        """Paths that stand still somewhere while most drive; what the scans say does not count.

        The odometry is one of those that drive.
        """
        seconds = np.floor(self.stamps_s / STEP_S)
        picked = np.flatnonzero(np.diff(seconds, prepend=-np.inf) > 0)
        paths = [score.path.poses for score in self.evidence.scores.values()]
        if self.evidence.scans.odometry is not None:
            paths.append(self.evidence.scans.odometry)
        part = picked[1:] * CHUNKS // len(self.judged)
        ways_m = np.stack(
            [
                np.bincount(
                    part, np.hypot(*np.diff(poses[self.judged[picked], :2], axis=0).T), CHUNKS
                )
                for poses in paths
            ]
        )
        driven_m = np.median(ways_m, axis=0)
        stands = (ways_m < LEAST_WAY * driven_m) & (driven_m >= DRIVEN_M)
        return frozenset(np.flatnonzero(stands.any(axis=1)).tolist())

    def _times(self, here: slice) -> tuple[float, float]:
        """Return when a time begins and ends, seconds since the first scan."""
        since_s = self.stamps_s - self.evidence.scans.stamps_s[0]
        return float(since_s[here.start]), float(since_s[min(here.stop, len(since_s) - 1)])

    def _excluded(self, row: int, grounds: npt.NDArray[np.int8]) -> Iterator[ExcludedSpan]:
        """Yield the times in which a path has no vote."""
        others = np.arange(len(grounds)) != row
        votes = (grounds == 0) & others[:, None]
        nearest = np.where(votes | (others[:, None] & ~votes.any(axis=0)), self.gaps[row], np.inf)
        gap_m = nearest.min(axis=0)
        for here in flag_runs(grounds[row] > 0):
            outvoted = np.count_nonzero(grounds[row, here] == _OUTVOTED)
            is_outvoted = 2 * outvoted >= here.stop - here.start
            yield ExcludedSpan(
                *self._times(here),
                float(gap_m[here].max()),
                "outvoted" if is_outvoted else "contradicted by the scans",
            )
