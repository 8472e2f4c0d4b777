"""Deskewing: move the beams of a sweep to the scan's stamp by the robot's motion.

The stamp of a scan is the time of its first beam. In a sweep of 0.2 s a robot that turns at
1.5 rad/s turns by 17 degrees. ``Deskewer`` gives each beam the robot's pose at the beam's time,
relative to its pose at the stamp.

The duration of a sweep follows from ``time_increment`` of the scans. If it is longer than the scan
period, the value is in ms, us or ns; if it is 0 or fits no unit, it is found from the scans
(``SkewTest``). The motion follows from odometry, or else from matching sweeps (``LaserMotion``).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.config import LogConfig
from slamfusion.errors import counted
from slamfusion.geometry import (
    F64,
    Pose2,
    compose_poses,
    interpolate_poses,
    invert_poses,
    transform_points,
)
from slamfusion.scan import LaserScan

# Returns poses (K, 3) of the base in a fixed frame at times (K,); None if unknown.
Track = Callable[[F64], F64 | None]

# Interval of the robot's poses within a sweep, seconds.
SAMPLE_S = 0.02
# A motion that moves hits by less, metres, is below the noise of a lidar.
MATTERS_M = 0.005
# Limits of a sweep as a share of the scan period: stamps have jitter; a shorter sweep has a wrong
# unit.
LONGEST_SHARE, LEAST_SHARE = 1.1, 0.01
# Units of ``time_increment`` that drivers send, seconds.
UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
# Largest distance of two hits of one surface, metres. Noise of a hit, metres.
SURFACE_M, NOISE_M = 0.3, 0.02
# Rounds of matching: largest distance of a hit to its surface in the other sweep, metres.
REACHES_M = (1.0, 1.0, 0.7, 0.5, 0.35, 0.25, 0.2, 0.2)
# Most hits of a sweep that are matched; up to twice as many in the test for skew.
MOST_HITS = 200
# Weights of the prior: change of the step between stamps, and of the motion during a sweep
# relative to its share of the step; metres, metres, radians.
STIFF = 1.0 / np.square((0.3, 0.3, 0.5, 0.05, 0.05, 0.1))
# Longest time between matched sweeps, seconds.
LATEST_S = 1.0
# Number of cases, and of agreeing ones, that decide whether scans are skewed (false positive rate
# 1 in 800). A case is a scan and one of the last scans whose turns differ by this much.
CASES, AGREEING, TURN_RAD, LOOK_BACK = 20, 17, 0.05, 10
# Number of scans for estimating the period.
PERIODS = 50


@dataclass
class Deskewing:
    """Result of deskewing.

    Attributes:
        scans: number of scans deskewed.
        without_motion: number of scans left as they are, because the motion is unknown.
        sweep_s: time from the first to the last beam, seconds; 0: simultaneous beams.
        source: where that follows from.
        largest_turn_rad: of the robot within a sweep.
    """

    scans: int = 0
    without_motion: int = 0
    sweep_s: float = 0.0
    source: str = ""
    largest_turn_rad: float = 0.0

    def sentences(self) -> list[str]:
        """Return a sentence on what was done, or nothing."""
        if not self.scans and not self.without_motion:
            return []
        text = (
            f"{counted(self.scans, 'scan', 'are')} deskewed: a sweep takes {self.sweep_s:.3f} s "
            f"({self.source}), and the robot turns by up to "
            f"{math.degrees(self.largest_turn_rad):.1f} degrees in it"
        )
        if self.without_motion:
            text += f"; of {counted(self.without_motion, 'scan')} the motion is not known"
        return [text]


class Deskewer:
    """Deskews the scans of one laser.

    Attributes:
        learned_s: duration of a sweep found by ``learn``, if it differs from that of the scans,
            seconds; 0: simultaneous beams; else None.
    """

    def __init__(self, config: LogConfig) -> None:
        self.done = Deskewing()
        self.learned_s: float | None = None
        self._is_on, self._sweep_s = config.deskew == "auto", config.sweep_s
        self._stamp_s: float | None = None
        self._periods_s: deque[float] = deque(maxlen=PERIODS)
        self._laser_motion, self._test = LaserMotion(), SkewTest()

    def note(self, stamp_s: float) -> None:
        """Take the stamp of the next scan, for the period."""
        if self._stamp_s is not None and stamp_s > self._stamp_s:
            self._periods_s.append(stamp_s - self._stamp_s)
        self._stamp_s = stamp_s

    def is_skewed(self, scan: LaserScan) -> bool:
        """Whether the beams of a scan have different times."""
        return self._is_on and (self._sweep_s is not None or scan.time_increment_s != 0.0)

    def learn(self, scan: LaserScan, odometry: Pose2) -> bool:
        """Find the duration of a sweep (``SkewTest``); return whether it is known now."""
        if not self._is_on or self._sweep_s is not None or self._test.sweep_s is not None:
            return True
        told_s = self._sweep(scan)
        self._test.add(replace(scan, motion=None), odometry, told_s)
        found_s = self._test.sweep_s
        if found_s is not None and found_s != told_s:
            self._sweep_s = self.learned_s = found_s
            self.done.source = "as the scans fit each other"
        return found_s is not None

    def times(self, scan: LaserScan) -> F64:
        """Return the times of the poses for ``moved``, (K,) seconds, from the scan's stamp on.

        One time: simultaneous beams.
        """
        sweep_s = self._sweep(scan)
        count = 1 + math.ceil(abs(sweep_s) / SAMPLE_S)
        return np.asarray(scan.stamp_s + np.linspace(0.0, sweep_s, count))

    def follow(self, scan: LaserScan, odometry_at: Track) -> tuple[F64 | None, Pose2 | None]:
        """Take the next scan of a live laser, and learn its sweep.

        Returns:
            The result of ``odometry_at`` (for ``moved``), and the odometry at the scan's stamp.
        """
        self.note(scan.stamp_s)
        poses = odometry_at(self.times(scan))
        odometry = None if poses is None else Pose2(*poses[0].tolist())
        if odometry is not None:
            self.learn(scan, odometry)
        return poses, odometry

    def moved(self, scan: LaserScan, poses: F64 | None) -> LaserScan:
        """Return the scan with the robot's motion at each beam, if it is large enough.

        Args:
            poses: (K, 3) of the base in any fixed frame at ``times``; fewer: they end within the
                sweep; None: no odometry.
        """
        sweep_s = self._sweep(scan)
        if sweep_s == 0.0:
            return scan
        self.done.sweep_s = abs(sweep_s)
        if poses is None:
            self._laser_motion.follow(scan, sweep_s)
            during = self._laser_motion.during
            motion = None if during is None else np.stack((np.zeros(3), during))
        elif len(poses) == len(self.times(scan)):
            motion = compose_poses(invert_poses(poses[0]), poses)
        else:
            motion = None
        if motion is None:
            self.done.without_motion += 1
            return scan
        motion[:, 2] = np.unwrap(motion[:, 2])
        turn_rad = float(np.abs(motion[:, 2]).max())
        farthest_m = float(np.max(scan.ranges, where=scan.is_hit(), initial=0.0))
        if np.hypot(*motion[:, :2].T).max() + turn_rad * farthest_m < MATTERS_M:
            return scan
        self.done.scans += 1
        self.done.largest_turn_rad = max(self.done.largest_turn_rad, turn_rad)
        beams, known = (np.linspace(0.0, 1.0, count) for count in (len(scan), len(motion)))
        return replace(scan, motion=interpolate_poses(beams, known, motion))

    def matched(self, first: LaserScan, second: LaserScan) -> F64 | None:
        """Return the motion between the stamps of two scans, (3,), from matching them."""
        for scan in (first, second):
            if scan.stamp_s > self._laser_motion.stamp_s:
                self._laser_motion.follow(scan, self._sweep(scan))
        return None if self._laser_motion.during is None else self._laser_motion.step

    def _sweep(self, scan: LaserScan) -> float:
        """Return the time from the first to the last beam, seconds; 0: simultaneous."""
        if not self.is_skewed(scan) or len(scan) < 2:
            return 0.0
        if self._sweep_s is not None:
            self.done.source = self.done.source or "as set"
            return self._sweep_s
        said_s = scan.time_increment_s * (len(scan) - 1)
        if said_s == 0.0 or not self._periods_s or not math.isfinite(said_s):
            return 0.0
        period_s = float(np.median(self._periods_s))
        for unit_s in UNITS_S:
            if LEAST_SHARE <= abs(said_s) * unit_s / period_s <= LONGEST_SHARE:
                self.done.source = "time_increment"
                if unit_s < 1.0:
                    self.done.source += f" in units of {unit_s:g} s"
                return said_s * unit_s
        return 0.0


class LaserMotion:
    """Follows a robot without odometry: matches each sweep with the one before it.

    The step between stamps and the deviation of the motion during the sweep are estimated together;
    with that the sweep before is deskewed again, and both are matched a second time.

    Attributes:
        stamp_s: of the last sweep, seconds.
        step: (3,) motion between the last two stamps; metres, radians.
        during: (3,) motion from the first to the last beam of the last sweep; None without a recent
            sweep before it.
    """

    def __init__(self) -> None:
        self.stamp_s = -math.inf
        self.during: F64 | None = None
        self._before: tuple[F64, F64] | None = None
        # The step, and the deviation of the motion during the sweep from its share of that.
        self._found: F64 = np.zeros(6)

    @property
    def step(self) -> F64:
        """See the class."""
        return self._found[:3]

    def follow(self, scan: LaserScan, sweep_s: float) -> None:
        """Take the next sweep; ``sweep_s`` is the time from its first to its last beam."""
        self.during = None
        if scan.stamp_s <= self.stamp_s:
            return
        since_s = scan.stamp_s - self.stamp_s
        share = sweep_s / since_s
        before, self.stamp_s = self._before, scan.stamp_s
        hits = scan.is_hit()
        ends, shares = scan.points(hits), np.linspace(0.0, 1.0, len(scan))[hits]
        some = slice(None, None, -(-len(ends) // MOST_HITS) or 1)
        self._before = ends, shares
        if before is None or since_s > LATEST_S:
            self._found = np.zeros(6)
            return
        for reaches_m in (REACHES_M, REACHES_M[-3:]):
            motion = before[1][:, None] * share * self._found[:3]
            surfaces = _Surfaces.of(transform_points(motion, before[0]))
            if surfaces is None:
                return
            self._found = _fit(
                surfaces, ends[some], shares[some], self._found, STIFF, share, reaches_m
            )[0]
        self.during = share * self._found[:3] + self._found[3:]


class SkewTest:
    """Tests whether the beams of scans have different times.

    A scan taken during a turn is matched with one taken during another turn: as they are, and
    deskewed by the scans' own duration of a sweep, or else as if a turn of the lidar took the whole
    period. Skew deforms a room, so the result does not depend on the odometry's error.

    Attributes:
        cases: pairs compared so far.
        agreeing: those that fit better when deskewed.
        sweep_s: from the first to the last beam; 0: not skewed; None: undecided.
    """

    def __init__(self) -> None:
        self.cases = self.agreeing = 0
        self.sweep_s: float | None = None
        self._scans: deque[tuple[LaserScan, F64]] = deque(maxlen=LOOK_BACK + 2)

    def add(self, scan: LaserScan, odometry: Pose2, told_s: float) -> None:
        """Take the next scan, the odometry at its stamp, and its own duration of a sweep."""
        if self._scans and scan.stamp_s <= self._scans[-1][0].stamp_s:
            self._scans.clear()
        self._scans.append((scan, np.array((odometry.x, odometry.y, odometry.yaw_rad))))
        if self.sweep_s is not None or len(self._scans) <= 2 or len(scan) < 2:
            return
        stamps = np.array([one.stamp_s for one, _ in self._scans])
        poses = np.array([pose for _, pose in self._scans])
        period_s = float(np.median(np.diff(stamps)))
        view_share = abs(scan.angle_increment_rad) * (len(scan) - 1) / math.tau
        sweep_s = told_s or period_s * view_share
        steps = compose_poses(invert_poses(poses[:-1]), poses[1:])
        motions = steps * (sweep_s / np.diff(stamps))[:, None]
        turns = np.abs(motions[:, 2] - motions[-1, 2])
        other = int(turns.argmax())
        if turns[other] < TURN_RAD:
            return
        start = compose_poses(invert_poses(poses[other]), poses[-2])
        self.cases += 1
        self.agreeing += self._error(other, start, motions) < self._error(
            other, start, np.zeros_like(motions)
        )
        # The scans' own value holds until most cases contradict it.
        few = CASES - AGREEING + 1
        if self.agreeing >= (few if told_s else AGREEING):
            self.sweep_s = sweep_s
        elif self.cases - self.agreeing >= (AGREEING if told_s else few):
            self.sweep_s = 0.0

    def _error(self, other: int, start: F64, motions: F64) -> float:
        """Return the mean distance of the last scan but one from another, with both motions."""
        placed = []
        for scan, motion in (
            (self._scans[other][0], motions[other]),
            (self._scans[-2][0], motions[-1]),
        ):
            hits = scan.is_hit()
            shares = np.linspace(0.0, 1.0, len(scan))[hits]
            placed.append(transform_points(shares[:, None] * motion, scan.points(hits)))
        fixed = np.array((0.0, 0.0, 0.0, np.inf, np.inf, np.inf))
        guess = np.concatenate((start, np.zeros(3)))
        surfaces = _Surfaces.of(placed[0])
        ends = placed[1][:: len(placed[1]) // MOST_HITS or 1]
        if surfaces is None or len(ends) == 0:
            return 0.0
        return _fit(surfaces, ends, np.zeros(len(ends)), guess, fixed)[1]


class _Surfaces(NamedTuple):
    """The surfaces of a sweep: points (P, 2) with their normals (P, 2)."""

    points: F64
    normals: F64

    @classmethod
    def of(cls, ends: F64) -> _Surfaces | None:
        """Return the surfaces of hits (M, 2) in the order of the beams, or None."""
        along = ends[2:] - ends[:-2]
        length = np.hypot(*along.T)
        is_near = np.hypot(*np.diff(ends, axis=0).T) < SURFACE_M
        is_one = (length > 0.0) & is_near[1:] & is_near[:-1]
        if not is_one.any():
            return None
        along, points = along[is_one] / length[is_one, None], ends[1:-1][is_one]
        normals = np.stack((-along[:, 1], along[:, 0]), axis=1)
        return cls(points, normals)

    def nearest(self, places: F64) -> tuple[npt.NDArray[np.intp], F64]:
        """Return the nearest point of each place (M, 2), and half of its squared distance, m^2.

        All pairs: for few points they take no longer than a tree, and SciPy takes 0.3 s to import.
        """
        away = places @ -self.points.T
        away += 0.5 * np.square(self.points).sum(axis=1)
        nearest = away.argmin(axis=1)
        return nearest, away[np.arange(len(places)), nearest] + 0.5 * np.square(places).sum(axis=1)


def _fit(
    surfaces: _Surfaces,
    ends: F64,
    shares: F64,
    guess: F64,
    stiff: F64,
    pace: float = 0.0,
    reaches_m: Sequence[float] = REACHES_M,
) -> tuple[F64, float]:
    """Match the hits of a sweep with surfaces; return its start, its motion, and the mean distance.

    Gauss-Newton on the distances along the surfaces' normals, robust by Geman and McClure.

    Args:
        surfaces: of another sweep, in its frame.
        ends: (M, 2) hits in the robot's frame at their own time, metres.
        shares: (M,) time within the sweep, 0 to 1.
        guess: (6,) start pose, and the deviation of the motion during the sweep from ``pace`` times
            it; x and y in metres, yaw in radians.
        stiff: (6,) weights of the guess; infinite: fixed.
        reaches_m: of each round; the mean distance is at most the last one.
    """
    is_free = np.isfinite(stiff)
    found, error_m = guess.copy(), reaches_m[0]
    for reach_m in reaches_m:
        moved = shares[:, None] * (found[3:] + pace * found[:3])
        inner = transform_points(moved, ends)
        placed = transform_points(np.tile(found[:3], (len(inner), 1)), inner)
        nearest, half_squares = surfaces.nearest(placed)
        near = half_squares < 0.5 * reach_m * reach_m
        error_m = reach_m
        if not near.any():
            break
        normals, at = surfaces.normals[nearest[near]], placed[near]
        apart = ((at - surfaces.points[nearest[near]]) * normals).sum(axis=1)
        error_m = float((np.abs(apart).sum() + reach_m * np.count_nonzero(~near)) / len(near))
        weights = 1.0 / (NOISE_M * (1.0 + np.square(3.0 * apart / reach_m))) ** 2
        cos, sin = np.cos(found[2]), np.sin(found[2])
        own = normals @ np.array(((cos, -sin), (sin, cos)))
        arm, inner_arm = at - found[:2], inner[near] - moved[near, :2]
        start = np.column_stack((normals, arm[:, 0] * normals[:, 1] - arm[:, 1] * normals[:, 0]))
        during = np.column_stack((own, inner_arm[:, 0] * own[:, 1] - inner_arm[:, 1] * own[:, 0]))
        during *= shares[near, None]
        rows = np.column_stack((start + pace * during, during))[:, is_free]
        pull = np.diag(stiff[is_free])
        slope = rows.T @ (weights * apart) + pull @ (found - guess)[is_free]
        bend = rows.T @ (weights[:, None] * rows) + pull
        found[is_free] -= np.linalg.lstsq(bend, slope, rcond=None)[0]
    return found, error_m
