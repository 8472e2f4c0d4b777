"""``Tracker``: where the robot may be at the next scan, and where it fits the map best.

Used by every producer that matches each scan against a map of its own. Two guesses are searched:
what odometry says, and that the robot goes on as it went; so odometry that stalls, slips or jumps
for a moment does not decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from slamfusion.compute.backend import Backend
from slamfusion.config import MatcherConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY
from slamfusion.slam.common.mapper import Health
from slamfusion.slam.common.matcher import FieldMap, Guess, Match, ScanOnTiles, Spread, search_pose
from slamfusion.slam.common.response import response_bend, settled_by

__all__ = ["Tracker"]

# Below this share of the usual score the search is done again, wider and with more draws.
LOW_SHARE = 0.5
SECOND_LOOK_SPREAD = 3.0
SECOND_LOOK_POSES = 4
# The wider search must find this much more, since it finds more by chance too.
SECOND_LOOK_GAIN = 0.1
# The usual score is a mean with this memory, in scans.
SCORE_MEMORY = 50
# A robot that does more between two scans has not driven: its odometry was set anew.
JUMP_M = 5.0
# A step is drawn out to at most this many times its length where scans are missing.
MOST_ONWARD = 3.0
# Without odometry the first look is this much wider.
NO_ODOMETRY_SPREAD = 2.0


@dataclass
class Tracker:
    """Follows the robot from scan to scan.

    Attributes:
        config: of the search.
        backend: where the maps live.
        rng: of the search's draws.
        health: the producer's record; match scores and disbelieved odometry are written there.
        looks_twice: search again, wider, where little fits; False leaves that to the producer.
        minds_open: where walls run along and a match tells nothing that way, odometry decides.
        holds: without odometry the robot is expected to stand rather than to go on as it went.
        pose: of the robot at the last scan; None before the first.
        odometry: at the last scan.
        step: what the robot did before the last scan, in its own frame.
        step_s: how long that took.
        stamp_s: time of the last scan.
        has_jumped: whether odometry has just been set anew.
        usual_score: what a match is worth lately; None before the first.
    """

    config: MatcherConfig
    backend: Backend
    rng: np.random.Generator
    health: Health
    holds: bool = False
    looks_twice: bool = True
    minds_open: bool = False
    pose: Pose2 | None = None
    odometry: Pose2 | None = None
    step: Pose2 = IDENTITY
    step_s: float = 0.0
    stamp_s: float = 0.0
    has_jumped: bool = False
    usual_score: float | None = None

    def guesses(self, stamp_s: float, odometry: Pose2 | None) -> list[Guess]:
        """Return where the robot may be: by its odometry, and if it goes on as it went."""
        self.has_jumped = False
        if self.pose is None:
            return [Guess(_vector(odometry or IDENTITY), self._spread(IDENTITY, 1.0))]
        onward = self._onward(stamp_s - self.stamp_s)
        if odometry is None or self.odometry is None:
            return [self._guess(IDENTITY if self.holds else onward, NO_ODOMETRY_SPREAD, 0.0)]
        step = self.odometry.inverse().compose(odometry)
        if math.hypot(step.x, step.y) > JUMP_M:
            reason = f"odometry jumped by more than {JUMP_M:g} m: not believed"
            self.health.skips.add(reason, self.health.scans)
            self.has_jumped = True
            return [self._guess(onward, NO_ODOMETRY_SPREAD, 0.0)]
        # Odometry that stalls and then catches up, or wheels that slip, are what this one is for.
        return [self._guess(step, 1.0, 0.0), self._guess(onward, 1.0, self.config.drift_loss)]

    def match(
        self, walls: FieldMap, points: npt.NDArray[np.float64], guesses: list[Guess]
    ) -> Match:
        """Search around the guesses; where little fits once more, wider, if it is to.

        Args:
            walls: the map.
            points: (P, 2) hits in the robot's frame, metres; at least one.
            guesses: at least one.
        """
        config = self.config
        scan = ScanOnTiles(self.backend, walls, points, config.beams)
        match = search_pose(scan, guesses, config, self.rng)
        is_low = self.usual_score is not None and match.score < LOW_SHARE * self.usual_score
        if is_low and self.looks_twice:
            more = replace(config, first_poses=SECOND_LOOK_POSES * config.first_poses)
            around = [replace(g, spread=g.spread.wider(SECOND_LOOK_SPREAD)) for g in guesses]
            again = search_pose(scan, around, more, self.rng)
            if again.score > match.score + SECOND_LOOK_GAIN:
                match = again
        if self.minds_open and len(guesses) > 1:
            bend = response_bend(scan, match.pose)
            pose = settled_by(bend, match.pose, guesses[0].pose)
            is_settled = pose is not match.pose  # the bend is that of another place then
            match = replace(match, pose=pose, bend=None if is_settled else bend)
        self._remember(match.score)
        return match

    def advance(self, pose: Pose2, odometry: Pose2 | None, stamp_s: float) -> None:
        """Take a pose as where the robot is at a scan."""
        if self.pose is not None:
            self.step = self.pose.inverse().compose(pose)
            self.step_s = stamp_s - self.stamp_s
        self.pose, self.odometry, self.stamp_s = pose, odometry, stamp_s

    def _onward(self, duration_s: float) -> Pose2:
        """Return the step of a robot that goes on as it went between the last two scans."""
        if self.step_s <= 0.0:
            return IDENTITY
        times = min(duration_s / self.step_s, MOST_ONWARD)
        step = self.step
        return Pose2(step.x * times, step.y * times, step.yaw_rad * times)

    def _guess(self, step: Pose2, wider: float, loss: float) -> Guess:
        start = self.pose or IDENTITY
        return Guess(_vector(start.compose(step)), self._spread(step, wider), loss)

    def _spread(self, step: Pose2, wider: float) -> Spread:
        config = self.config
        spread = Spread(
            config.sigma_m + config.sigma_m_per_m * math.hypot(step.x, step.y),
            config.sigma_rad + config.sigma_rad_per_rad * abs(step.yaw_rad),
        )
        return spread.wider(wider)

    def _remember(self, score: float) -> None:
        """Keep the record of match scores."""
        health = self.health
        mean = health.mean_match_score
        if mean is not None and score < LOW_SHARE * mean:
            health.low_scores += 1
        health.match_score = score
        matched = max(1, health.scans_used)  # the first scan was mapped without a match
        health.mean_match_score = score if mean is None else mean + (score - mean) / matched
        usual = self.usual_score
        self.usual_score = score if usual is None else usual + (score - usual) / SCORE_MEMORY


def _vector(pose: Pose2) -> npt.NDArray[np.float64]:
    return np.array([pose.x, pose.y, pose.yaw_rad])
