"""Detect inputs whose poses contradict each other.

SLAMs that track one robot report a pose for each of its scans, at the scan's stamp. Two inputs are
*linked* (they track one robot) once their poses of equal stamps, in the fused frame, have stayed
within 0.3 of ``APART_M`` and ``APART_RAD`` for ``LINK_M`` metres. Two robots cannot share
a place, and their scans seldom share a stamp, so their inputs are never linked; inputs that are not
linked are never compared. Linked inputs are *apart* when their poses have differed by more than a
limit for ``APART_S`` seconds of stamps without a break, until they have been within 0.7 of
both limits for as long.

The input that is apart from the most others contradicts them; it is left out and the rest is
checked again. If several are apart from equally many, there is no majority, and all of these
contradict. An input that was aligned again starts afresh, but stays linked.

Poses of equal stamps also show where the map of an input lies in that of another, before either is
aligned (``starts``), if both have driven and one motion fits all of them.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slamfusion.align.starts import StartPose
from slamfusion.geometry import (
    F64,
    Pose2,
    fit_motion,
    moved_poses,
    row_of,
    travelled,
    with_levers,
    wrap_angle,
    wrap_angles,
)
from slamfusion.trajectory import SAME_STAMP_S

# Poses of one robot farther apart than this, metres and radians, contradict each other; for this
# long, seconds, they must be apart to take a vote, and together to give it back.
APART_M, APART_RAD, APART_S = 1.0, 0.35, 3.0
# Metres that two inputs drive together before they are linked.
LINK_M = 2.0
# Shares of the limits: together, and together again.
LINK_SHARE, RETURN_SHARE = 0.3, 0.7
# Poses kept of each input, for those of slower ones: 25 s at 20 Hz.
KEPT = 512
# Stamps that go back by more, seconds, start a new time.
BACK_S = 1.0
# Poses show the place of maps from this number of equal stamps, this share of all, and this driven
# distance in metres on.
LEAST_EQUAL, EQUAL_SHARE, DRIVEN_M = 10, 0.5, 0.5
START_M, START_RAD = 0.5, 0.1
# The covariance of the fused pose is of poses of this last time, seconds, and at least that of a
# pose that all inputs agree on: half a cell of 0.05 m, metres and radians.
SPREAD_S, LEAST_M, LEAST_RAD = 10.0, 0.025, 0.01


@dataclass
class _Pair:
    """What is known of two inputs.

    Attributes:
        newest_s: stamp of the last poses that were compared.
        last: where the first of the two was then, in the fused frame.
        together_m: driven together without a break.
        changing_s: since when they say otherwise than ``is_apart``; None: they do not.
        is_apart: whether they contradict each other.
        words: how far apart they were when it began.
    """

    newest_s: float = -math.inf
    last: Pose2 | None = None
    together_m: float = 0.0
    is_linked: bool = False
    changing_s: float | None = None
    is_apart: bool = False
    words: str = ""

    def restart(self) -> None:
        """Forget what was said of two that are linked."""
        self.changing_s, self.is_apart, self.last = None, False, None
        self.together_m = 0.0

    def compare(self, stamp_s: float, a: Pose2, b: Pose2) -> None:
        """Take two poses of one stamp, in the fused frame."""
        if stamp_s < self.newest_s - BACK_S:
            self.changing_s, self.last = None, None
        elif stamp_s <= self.newest_s:
            return
        self.newest_s = stamp_s
        away_m = math.dist((a.x, a.y), (b.x, b.y))
        turn_rad = abs(wrap_angle(a.yaw_rad - b.yaw_rad))
        share = max(away_m / APART_M, turn_rad / APART_RAD)
        if not self.is_linked:
            self._link(a, share)
            return
        is_other = share <= RETURN_SHARE if self.is_apart else share > 1.0
        if not is_other:
            self.changing_s = None
            return
        if self.changing_s is None:
            self.changing_s = stamp_s
        if stamp_s - self.changing_s >= APART_S:
            self.is_apart, self.changing_s = not self.is_apart, None
            self.words = f"{away_m:.1f} m and {math.degrees(turn_rad):.0f} degrees apart"

    def _link(self, a: Pose2, share: float) -> None:
        """Measure how far the two drive together."""
        if share > LINK_SHARE:
            self.together_m, self.last = 0.0, None
            return
        if self.last is not None:
            self.together_m += math.dist((a.x, a.y), (self.last.x, self.last.y))
        self.last = a
        self.is_linked = self.together_m >= LINK_M


class PoseWatch:
    """Compares the poses of the inputs; see the rule above. Not for several threads at once."""

    def __init__(self) -> None:
        self._placed: dict[str, Pose2] = {}
        self._poses: dict[str, OrderedDict[int, Pose2]] = {}
        self._pairs: dict[tuple[str, str], _Pair] = {}

    def place(self, transforms: Mapping[str, Pose2]) -> None:
        """Take where the map frames of the inputs lie in the fused frame; others are not compared.

        Args:
            transforms: by name, of the inputs whose maps are believed; metres, radians.
        """
        for name in {*transforms, *self._placed}:
            before, now = self._placed.get(name), transforms.get(name)
            if before is not None and now is not None and not self._is_moved(name, before, now):
                continue
            for names, pair in self._pairs.items():
                if name in names:
                    pair.restart()
        self._placed = dict(transforms)

    def _is_moved(self, name: str, before: Pose2, now: Pose2) -> bool:
        """Whether a transform carries an input's newest pose elsewhere."""
        poses = self._poses.get(name)
        if before == now or not poses:
            return False
        own = poses[next(reversed(poses))]
        newest, moved = before.compose(own), now.compose(own)
        away_m = math.dist((moved.x, moved.y), (newest.x, newest.y))
        turn_rad = abs(wrap_angle(moved.yaw_rad - newest.yaw_rad))
        return away_m > LINK_SHARE * APART_M or (turn_rad > LINK_SHARE * APART_RAD)

    def remove(self, name: str) -> None:
        """Forget an input and whom it was linked with."""
        self._placed.pop(name, None)
        self._poses.pop(name, None)
        self._pairs = {names: pair for names, pair in self._pairs.items() if name not in names}

    def hear(self, name: str, stamp_s: float, pose: Pose2) -> None:
        """Receive a pose of the robot in the input's map frame, for the scan at ``stamp_s``."""
        key = round(stamp_s / SAME_STAMP_S)
        own = self._poses.setdefault(name, OrderedDict())
        own[key] = pose
        for other in self._placed if name in self._placed else ():
            if other != name and key in self._poses.get(other, ()):
                names = (name, other) if name < other else (other, name)
                a, b = (self._placed[one].compose(self._poses[one][key]) for one in names)
                self._pairs.setdefault(names, _Pair()).compare(stamp_s, a, b)
        own.move_to_end(key)
        if len(own) > KEPT:
            own.popitem(last=False)

    def starts(self, names: Collection[str]) -> dict[tuple[str, str], StartPose]:
        """Return where map frames lie in those of others by equal stamps, by other and own name."""
        found = {}
        for name in names:
            for other in self._poses:
                start = None if other == name else self._start(other, name)
                if start is not None:
                    found[other, name], found[name, other] = start, start.inverse()
        return found

    def _start(self, still: str, moving: str) -> StartPose | None:
        """Return where an input's map frame lies in another's; None where poses do not say it."""
        theirs, ours = self._poses[still], self._poses.get(moving)
        if ours is None:
            return None
        equal = [key for key in ours if key in theirs]
        if len(equal) < max(LEAST_EQUAL, EQUAL_SHARE * min(len(ours), len(theirs))):
            return None
        own, other = (_rows(poses, equal) for poses in (ours, theirs))
        if travelled(own)[-1] < DRIVEN_M:
            return None
        motion = fit_motion(with_levers(own), with_levers(other))
        apart_m = np.hypot(*(moved_poses(motion, own) - other)[:, :2].T)
        is_one = apart_m.max() <= LINK_SHARE * APART_M
        return StartPose(motion, START_M, START_RAD) if is_one else None

    def covariance(self, leader: str, others: Collection[str], stamp_s: float) -> F64:
        """Return the covariance of the leader's pose in the fused frame, (3, 3) float64.

        X and y in metres, yaw in radians: the mean square of the differences from the poses of
        others at equal stamps. It counts whole, twice the variance of independent inputs, since the
        inputs read the same scans. Without others, ``APART_M`` and ``APART_RAD`` are the
        deviations.
        """
        own, gaps = self._poses.get(leader, OrderedDict()), np.empty((0, 3))
        recent = [key for key in own if abs(stamp_s - key * SAME_STAMP_S) <= SPREAD_S]
        for name in {*others} & {*self._placed} - {leader} if leader in self._placed else ():
            theirs = self._poses.get(name, OrderedDict())
            keys = [key for key in recent if key in theirs]
            here, there = (
                moved_poses(self._placed[one], _rows(poses, keys))
                for one, poses in ((leader, own), (name, theirs))
            )
            gaps = np.concatenate((gaps, there - here))
        if not len(gaps):
            return np.diag((APART_M**2,) * 2 + (APART_RAD**2,))
        gaps[:, 2] = wrap_angles(gaps[:, 2])
        return np.asarray(gaps.T @ gaps / len(gaps) + np.diag((LEAST_M**2,) * 2 + (LEAST_RAD**2,)))

    def contradictions(self) -> dict[str, str]:
        """Return whose poses contradict those of others, by name, and why in one line."""
        apart = {
            names: pair
            for names, pair in self._pairs.items()
            if pair.is_linked and pair.is_apart and all(name in self._placed for name in names)
        }
        out: dict[str, str] = {}
        left = dict(apart)
        while left:
            rivals = Counter(name for names in left for name in names)
            most = max(rivals.values())
            for name in sorted(name for name, count in rivals.items() if count == most):
                words = {
                    names[0] if names[1] == name else names[1]: pair.words
                    for names, pair in apart.items()
                    if name in names
                }
                first = next(iter(words.values()))
                out[name] = f"its poses contradict those of {', '.join(words)}: {first}"
            left = {names: pair for names, pair in left.items() if not {*names} & {*out}}
        return out


def _rows(poses: Mapping[int, Pose2], keys: Sequence[int]) -> F64:
    """Return the poses of some stamps, (N, 3)."""
    return np.array([row_of(poses[key]) for key in keys]).reshape(-1, 3)
