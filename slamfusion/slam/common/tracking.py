"""``Tracker``: where the robot may be at the next scan, and where it fits the map best.

Used by every mapper that matches each scan against its own map. Two pose hypotheses are searched:
the odometry, and an unchanged motion; so odometry that stalls, slips or jumps for a moment does not
decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import MatcherConfig
from slamfusion.geometry import F64, Pose2, row_of
from slamfusion.grid import IDENTITY
from slamfusion.slam.common.mapper import LOW_SHARE, Health
from slamfusion.slam.common.matcher import (
    FIRST_POSES,
    PRIOR_WEIGHT_XY,
    FieldMap,
    Match,
    PoseHypothesis,
    ScanOnTiles,
    keep_degenerate_prior,
    response_hessian,
    search_pose,
    spread_of,
)
from slamfusion.slam.common.state import Stateful

# Spread of the first look, metres and radians, and what a metre and a radian of odometry add.
SIGMA_M, SIGMA_M_PER_M = 0.1, 0.15
SIGMA_RAD, SIGMA_RAD_PER_RAD = 0.05, 0.2
# Spread and draws of the second search after a low match, as factors of the first one's; wide
# enough for a wheel that has slipped.
SECOND_SEARCH_SPREAD, SECOND_SEARCH_POSES = 3.0, 4
# Gain in score, 0 to 1, that the second search needs: more draws find more by chance too.
SECOND_SEARCH_GAIN = 0.1
# Memory of the running mean score, scans: some seconds, so that it follows the place.
SCORE_MEMORY = 50
# A step is extrapolated over missing scans to at most this many times its length: a robot that went
# on for longer may have turned.
MOST_ONWARD = 3.0
# Factor on the spread of the first look without odometry: acceleration is not known.
NO_ODOMETRY_SPREAD = 2.0
# Without scans and odometry a robot may have stopped anywhere on its way. At most this number of
# further places is searched, MOST_ONWARD steps apart.
PLACES_ON_THE_WAY = 8
# Scans in a map below which leaving the odometry costs more. The beams of one scan mark some cells
# of a wall alone, so the next scans fit best at its place: a moving robot seems to stand, and
# mapping it there confirms that.
YOUNG_SCANS = 20
# Cost of standing still in a young map, of the score, if the odometry moved. Long steps cost that
# anyway, so a match can still reject bad odometry.
STANDING_LOSS = 0.1
# Cost of continuing the last motion against the odometry, of the score.
DRIFT_LOSS = 0.05


@dataclass
class Tracker(Stateful):
    """Follows the robot from scan to scan.

    Attributes:
        health: the producer's record; receives match scores and rejected odometry.
        resolves_degeneracy: follow odometry along a match's degenerate direction, as in a corridor,
            instead of a wider search after a low match.
        doubts_young_map: trust odometry more while few scans are in the map.
        expects_standstill: without odometry expect the robot to stand, not to continue.
        pose, odometry: at the last scan; None before the first or without odometry.
        step: motion of the robot before the last scan, in its own frame.
        running_mean_score: of the last matches, 0 to 1; None before the first.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "rng",
        "pose",
        "odometry",
        "step",
        "step_s",
        "stamp_s",
        "running_mean_score",
    )

    config: MatcherConfig
    device: ComputeDevice
    rng: np.random.Generator
    health: Health
    expects_standstill: bool = False
    resolves_degeneracy: bool = False
    doubts_young_map: bool = False
    pose: Pose2 | None = None
    odometry: Pose2 | None = None
    step: Pose2 = IDENTITY
    step_s: float = 0.0
    stamp_s: float = 0.0
    has_jumped: bool = False
    running_mean_score: float | None = None

    def hypotheses(self, stamp_s: float, odometry: Pose2 | None) -> list[PoseHypothesis]:
        """Return where the robot may be: by its odometry, and by continuing its motion."""
        self.has_jumped = False
        if self.pose is None:
            return [PoseHypothesis(row_of(odometry or IDENTITY), self._spread(IDENTITY, 1.0))]
        onward = self._onward(stamp_s - self.stamp_s)
        if odometry is None or self.odometry is None:
            return self._without_odometry(onward, stamp_s - self.stamp_s)
        step = self.odometry.inverse().compose(odometry)
        if math.hypot(step.x, step.y) > self.config.jump_m:
            reason = f"odometry jumped by more than {self.config.jump_m:g} m: ignored"
            self.health.skips.add(reason, self.health.scans)
            self.has_jumped = True
            return [self._hypothesis(onward, NO_ODOMETRY_SPREAD, 0.0)]
        trust = self._trust(step)
        return [
            self._hypothesis(step, 1.0, 0.0, by_odometry=True, trust=trust),
            # For odometry that stalls and then catches up, and for wheels that slip.
            self._hypothesis(onward, 1.0, DRIFT_LOSS * trust),
        ]

    def match(self, walls: FieldMap, points: F64, hypotheses: list[PoseHypothesis]) -> Match:
        """Search points (P, 2), metres in the robot's frame, around at least one hypothesis."""
        scan = ScanOnTiles(self.device, walls, points, self.config.beams)
        by_odometry, trust = hypotheses[0].by_odometry, hypotheses[0].trust
        # Without odometry as many draws around each place on the way.
        count = FIRST_POSES * (1 if by_odometry else len(hypotheses))
        match = search_pose(scan, hypotheses, self.rng, trust, first_poses=count)
        mean = self.running_mean_score
        is_low = mean is not None and match.score < LOW_SHARE * mean
        if is_low and not self.resolves_degeneracy:
            around = [replace(g, spread=SECOND_SEARCH_SPREAD * g.spread) for g in hypotheses]
            more = SECOND_SEARCH_POSES * count
            again = search_pose(scan, around, self.rng, trust, first_poses=more)
            if again.score > match.score + SECOND_SEARCH_GAIN:
                match = again
        if self.resolves_degeneracy and by_odometry:
            hessian = response_hessian(scan, match.pose)
            pose = keep_degenerate_prior(hessian, match.pose, hypotheses[0].pose)
            is_moved = pose is not match.pose  # the Hessian belongs to the old place
            match = replace(match, pose=pose, hessian=None if is_moved else hessian)
        self._remember(match.score)
        return match

    def advance(self, pose: Pose2, odometry: Pose2 | None, stamp_s: float) -> None:
        """Set the robot's pose at a scan."""
        if self.pose is not None:
            self.step = self.pose.inverse().compose(pose)
            self.step_s = stamp_s - self.stamp_s
        self.pose, self.odometry, self.stamp_s = pose, odometry, stamp_s

    def _onward(self, duration_s: float) -> Pose2:
        """Return the step that continues the motion between the last two scans."""
        if self.step_s <= 0.0:
            return IDENTITY
        times = min(duration_s / self.step_s, MOST_ONWARD)
        step = self.step
        return Pose2(step.x * times, step.y * times, step.yaw_rad * times)

    def _without_odometry(self, onward: Pose2, duration_s: float) -> list[PoseHypothesis]:
        """Return where the robot may be: as expected, and all the way on if scans are missing.

        The farther a place is from the expected one, the more it costs, up to ``DRIFT_LOSS``.
        """
        missing = duration_s / (MOST_ONWARD * self.step_s) if self.step_s > 0.0 else 0.0
        if missing <= 1.0 or self.step == IDENTITY:
            expected = IDENTITY if self.expects_standstill else onward
            return [self._hypothesis(expected, NO_ODOMETRY_SPREAD, 0.0)]
        gone = [IDENTITY, onward]
        while len(gone) <= min(math.ceil(missing), PLACES_ON_THE_WAY):
            gone.append(gone[-1].compose(onward))
        likely = 0 if self.expects_standstill else len(gone) - 1
        found = [
            self._hypothesis(
                step, NO_ODOMETRY_SPREAD, DRIFT_LOSS * abs(index - likely) / (len(gone) - 1)
            )
            for index, step in enumerate(gone)
        ]
        first = 0 if self.expects_standstill else 1
        return [found[first], *found[:first], *found[first + 1 :]]

    def _trust(self, step: Pose2) -> float:
        """Return the factor on the cost of leaving the odometry, 1 on a map of many scans."""
        if not self.doubts_young_map:
            return 1.0
        gone = math.hypot(step.x, step.y)
        spreads = gone / (SIGMA_M + SIGMA_M_PER_M * gone)
        standing = PRIOR_WEIGHT_XY * spreads**2
        if standing * YOUNG_SCANS < STANDING_LOSS:
            return 1.0
        return max(1.0, min(YOUNG_SCANS / max(1, self.health.scans_used), STANDING_LOSS / standing))

    def _hypothesis(self, step: Pose2, wider: float, loss: float, **more: Any) -> PoseHypothesis:
        start = self.pose or IDENTITY
        spread = self._spread(step, wider)
        return PoseHypothesis(row_of(start.compose(step)), spread, loss, **more)

    def _spread(self, step: Pose2, wider: float) -> F64:
        return spread_of(
            wider * (SIGMA_M + SIGMA_M_PER_M * math.hypot(step.x, step.y)),
            wider * (SIGMA_RAD + SIGMA_RAD_PER_RAD * abs(step.yaw_rad)),
        )

    def _remember(self, score: float) -> None:
        health = self.health
        mean = health.mean_match_score
        if mean is not None and score < LOW_SHARE * mean:
            health.low_scores += 1
        health.match_score = score
        matched = max(1, health.scans_used)  # the first scan was mapped without a match
        health.mean_match_score = score if mean is None else mean + (score - mean) / matched
        recent = self.running_mean_score
        self.running_mean_score = (
            score if recent is None else recent + (score - recent) / SCORE_MEMORY
        )
