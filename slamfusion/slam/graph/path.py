"""``DrivenPath``: where the robot was at every scan, each told from the last node before it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2, compose_poses
from slamfusion.grid import IDENTITY
from slamfusion.slam.common.mapper import Series
from slamfusion.slam.common.pose_rows import row_of
from slamfusion.slam.common.state import Stateful
from slamfusion.trajectory import Trajectory

F64 = npt.NDArray[np.float64]
# Node of the scans before there is one: their poses are told from the start.
NO_NODE = -1


class DrivenPath(Stateful):
    """The scans' poses relative to the graph's nodes, so that the path moves with them.

    Attributes:
        start: pose of the robot in the map frame at the first scan.
    """

    STATE = ("start", "_scans", "_reported", "_responses")

    def __init__(self) -> None:
        self.start = IDENTITY
        self._scans: list[tuple[float, int, tuple[float, float, float]]] = []
        self._reported: list[tuple[float, float, float]] = []
        self._responses: list[tuple[float, float]] = []

    def add(self, stamp_s: float, node: int, moved: Pose2) -> None:
        """Add a scan.

        Args:
            stamp_s: its time.
            node: the last one before it; ``NO_NODE`` for none.
            moved: pose of the robot in the node's frame, or in that of the start.
        """
        self._scans.append((stamp_s, node, (moved.x, moved.y, moved.yaw_rad)))

    def report(self, pose: Pose2) -> None:
        """Keep what was told of the last scan's pose, in the map frame."""
        self._reported.append((pose.x, pose.y, pose.yaw_rad))

    def add_response(self, stamp_s: float, score: float) -> None:
        """Keep the response, 0 to 1, of a node's match."""
        self._responses.append((stamp_s, score))

    def series(self) -> tuple[Series, ...]:
        """Return the responses of the nodes' matches, to be plotted."""
        if not self._responses:
            return ()
        stamps, values = np.array(self._responses).T
        return (Series("response", "", stamps, values),)

    def trajectory(self, poses: F64, name: str) -> Trajectory:
        """Return the pose at every scan by the nodes' poses (N, 3) in the map frame."""
        stamps = np.array([stamp for stamp, _, _ in self._scans])
        nodes = np.array([node for _, node, _ in self._scans], dtype=np.int64)
        motions = np.array([motion for _, _, motion in self._scans]).reshape(-1, 3)
        frames = np.concatenate((poses, row_of(self.start)[None]))  # NO_NODE is the last one
        return Trajectory(stamps, compose_poses(frames[nodes], motions), name)

    def as_reported(self, name: str) -> Trajectory:
        """Return the pose at every scan as it was first told."""
        stamps = np.array([stamp for stamp, _, _ in self._scans])
        return Trajectory(stamps, np.array(self._reported).reshape(-1, 3), name)

    def node_stamps(self) -> dict[int, float]:
        """Return the time of each node's scan, seconds."""
        stamps: dict[int, float] = {}
        for stamp, node, _ in self._scans:
            stamps.setdefault(node, stamp)
        return stamps
