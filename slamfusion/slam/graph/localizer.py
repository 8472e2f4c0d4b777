"""``Localizer``: where a scan lies on the local map, and whether the robot is still tracked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.geometry import F64, Pose2, pose_of
from slamfusion.grid import IDENTITY
from slamfusion.scan import LaserScan
from slamfusion.slam.common.matcher import PoseHypothesis
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.common.tracking import Tracker
from slamfusion.slam.graph.closure_search import ClosureSearch
from slamfusion.slam.graph.local_map import BAD_SHARE, RESET_SHARE, LocalMap
from slamfusion.slam.graph.map_graph import GraphHealth
from slamfusion.slam.graph.node_map import Node

TrackingStatus = Literal["tracked", "unsure", "failed", "kidnapped"]

# Consecutive scans without a certain place after which the robot is kidnapped. One or two bad scans
# are a door or a crowd.
LOST_SCANS = 4
# Tracking has failed after this number of bad scans among this number of the last ones.
FAILED_BAD, FAILED_SCANS = 3, 10


@dataclass(frozen=True, eq=False)
class Observation:
    """A scan, its usable hits (P, 2) in the robot's frame, metres, and its odometry if usable."""

    scan: LaserScan
    points: F64
    odometry: Pose2 | None

    def node(self, travelled_m: float) -> Node:
        """Return it as a node."""
        laser = np.array([self.scan.mount.x, self.scan.mount.y], dtype=np.float32)
        return Node(self.points.astype(np.float32), laser, travelled_m, self.odometry)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pose in the active submap, score of the match, 0 to 1, and Hessian (3, 3) of its response."""

    local: Pose2
    score: float
    hessian: F64 | None
    status: TrackingStatus


class Localizer(Stateful):
    """Follows the robot on the local map; it owns the tracker and the quality of its matches."""

    STATE = ("_tracker", "_unsure_row", "_bad")

    def __init__(
        self,
        config: GraphConfig,
        device: ComputeDevice,
        rng: np.random.Generator,
        local_map: LocalMap,
        search: ClosureSearch,
        health: GraphHealth,
    ) -> None:
        self._local_map = local_map
        self._search = search
        self._health = health
        self._tracker = Tracker(
            config.matcher, device, rng, health, searches_again=False, resolves_degeneracy=True
        )
        # Consecutive uncertain scans, and the bad ones among the last ``FAILED_SCANS``.
        self._unsure_row = 0
        self._bad: list[int] = []

    @property
    def has_pose(self) -> bool:
        """Whether it has received a scan."""
        return self._tracker.pose is not None

    @property
    def has_jumped(self) -> bool:
        """Whether odometry jumped at the last scan."""
        return self._tracker.has_jumped

    @property
    def mean_score(self) -> float:
        """Running mean score of the matches, 0 to 1; 0 before the first."""
        return self._tracker.running_mean_score or 0.0

    def hypotheses(self, stamp_s: float, odometry: Pose2 | None) -> list[PoseHypothesis]:
        """Return where the robot may be; see ``Tracker.hypotheses``."""
        return self._tracker.hypotheses(stamp_s, odometry)

    def localize(self, seen: Observation, hypotheses: list[PoseHypothesis]) -> Estimate:
        """Return where a scan lies; if it fits badly, search far around."""
        local_map, mean_score = self._local_map, self._tracker.running_mean_score
        submap = local_map.active_submap
        match = self._tracker.match(submap.walls(), seen.points, hypotheses)
        fit = local_map.fit(seen.points, match, mean_score)
        at, hessian, is_sure = match.pose, match.hessian, True
        if fit < BAD_SHARE and mean_score is not None:
            hessian = None
            at, is_sure = self._search.around(
                submap,
                seen.points,
                hypotheses[0].pose,
                mean_score,
                by_odometry=hypotheses[0].by_odometry,
            )
        local = pose_of(at)
        self._tracker.advance(local, seen.odometry, seen.scan.stamp_s)
        status = self._judge(fit, is_sure=is_sure)
        return Estimate(local, match.score, hessian, status)

    def _judge(self, fit: float, *, is_sure: bool) -> TrackingStatus:
        """Update the tracking quality and return the status.

        ``kidnapped``: the robot has left the local map; ``failed``: its place relative to
        earlier scans is uncertain; ``unsure``: the scan is placed by dead reckoning only.
        """
        number = self._health.scans
        self._unsure_row = 0 if is_sure else self._unsure_row + 1
        if self._unsure_row >= LOST_SCANS or (self._tracker.has_jumped and fit < RESET_SHARE):
            return "kidnapped"
        self._bad = [bad for bad in self._bad if number - bad < FAILED_SCANS]
        if fit < BAD_SHARE:
            self._bad.append(number)
        if not is_sure:
            return "unsure"
        return "failed" if len(self._bad) >= FAILED_BAD else "tracked"

    def dead_reckon(self, seen: Observation, hypothesis: PoseHypothesis) -> Pose2:
        """Accept a hypothesis as the robot's pose at an unusable scan; return it."""
        local = pose_of(hypothesis.pose)
        self._tracker.advance(local, seen.odometry, seen.scan.stamp_s)
        return local

    def start(self, seen: Observation) -> None:
        """Follow the robot from the first node on, in its frame."""
        self._tracker.pose = None
        self._tracker.advance(IDENTITY, seen.odometry, seen.scan.stamp_s)

    def restart(self) -> None:
        """Follow the robot in the frame of a submap that starts at its pose."""
        self._tracker.pose = IDENTITY
        self._unsure_row, self._bad = 0, []

    def change_frame(self, local: Pose2) -> None:
        """Follow the robot in the frame of the active submap, where its pose is ``local``."""
        self._tracker.pose = local
