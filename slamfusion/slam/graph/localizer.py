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
from slamfusion.slam.common.matcher import PoseHypothesis, ScanOnTiles
from slamfusion.slam.common.tracking import Tracker
from slamfusion.slam.graph.closure_search import ClosureSearch
from slamfusion.slam.graph.local_map import LocalMap
from slamfusion.slam.graph.map_graph import GraphHealth
from slamfusion.slam.graph.node_map import Node
from slamfusion.slam.graph.submap import UNSEEN_WALL, seen_score

TrackingStatus = Literal["tracked", "unsure", "failed", "kidnapped"]

# A match below this share of the usual score is bad, unless the local map has seen nothing at the
# third share of its hits. Right after a reset of the odometry the second share applies: the robot
# may have been switched off and moved.
BAD_SHARE, RESET_SHARE, MOST_UNSEEN = 0.6, 0.8, 0.8
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


class Localizer(Tracker):
    """The tracker of the local map, and the quality of its matches.

    Its ``pose`` is in the frame of the active submap.
    """

    STATE = (*Tracker.STATE, "_unsure_row", "_bad")

    def __init__(
        self,
        config: GraphConfig,
        device: ComputeDevice,
        rng: np.random.Generator,
        local_map: LocalMap,
        search: ClosureSearch,
        health: GraphHealth,
    ) -> None:
        super().__init__(config.matcher, device, rng, health, resolves_degeneracy=True)
        self._local_map, self._search = local_map, search
        # Consecutive uncertain scans, and the bad ones among the last ``FAILED_SCANS``.
        self._unsure_row = 0
        self._bad: list[int] = []

    def localize(self, seen: Observation, hypotheses: list[PoseHypothesis]) -> Estimate:
        """Return where a scan lies; if it fits badly, search far around."""
        submap, mean_score = self._local_map.active_submap, self.running_mean_score
        match = self.match(submap.walls(), seen.points, hypotheses)
        # The score relative to the mean, where the submap is known; 1 if it is not much lower.
        fit = 1.0
        if mean_score is not None and match.score < RESET_SHARE * mean_score:
            scan = ScanOnTiles(self.device, submap.walls(), seen.points, self.config.beams)
            unseen = scan.unseen_share(match.pose, UNSEEN_WALL)
            if unseen < MOST_UNSEEN:
                fit = seen_score(match.score, unseen) / mean_score
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
        self.advance(local, seen.odometry, seen.scan.stamp_s)
        return Estimate(local, match.score, hessian, self._judge(fit, is_sure=is_sure))

    def _judge(self, fit: float, *, is_sure: bool) -> TrackingStatus:
        """Update the tracking quality and return the status.

        ``kidnapped``: the robot has left the local map; ``failed``: its place relative to
        earlier scans is uncertain; ``unsure``: the scan is placed by dead reckoning only.
        """
        number = self.health.scans
        self._unsure_row = 0 if is_sure else self._unsure_row + 1
        if self._unsure_row >= LOST_SCANS or (self.has_jumped and fit < RESET_SHARE):
            return "kidnapped"
        self._bad = [bad for bad in self._bad if number - bad < FAILED_SCANS]
        if fit < BAD_SHARE:
            self._bad.append(number)
        if not is_sure:
            return "unsure"
        return "failed" if len(self._bad) >= FAILED_BAD else "tracked"

    def restart(self) -> None:
        """Follow the robot in the frame of a submap that starts at its pose."""
        self.pose, self._unsure_row, self._bad = IDENTITY, 0, []
