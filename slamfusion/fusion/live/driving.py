"""The odometry frame in the fused frame, and the certainty of the robot's pose; no ROS.

A new pose moves the odometry frame. A planner and a controller cannot follow a jump, so
``OdomFrame`` moves it with limited speed. Between corrections it stands still.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque

import numpy as np

from slamfusion.geometry import F64, Pose2, wrap_angle

# The odometry carries the robot for this long after the last pose, seconds.
CARRIED_S = 10.0
# Odometry that is faster, metres per second, has jumped: its origin was reset.
JUMP_M_S = 10.0
# Longest time between two sent transforms that counts for the speed, seconds.
LONGEST_S = 1.0
# Age, seconds, and number of differences of poses that count at most.
SPREAD_S, MOST_DIFFERENCES = 10.0, 300
# Stamps whose poses wait for those of slower inputs.
STAMPS = 256
# Deviation of a pose that all inputs agree on, metres and radians: of half a cell of 0.05 m.
LEAST_M, LEAST_RAD = 0.025, 0.01


class OdomFrame:
    """The pose of the odometry frame in the fused frame, which only moves with limited speed.

    The speed is measured at the robot: a correction of the heading far from the origin of the
    odometry moves that origin by metres and the robot not at all.

    Attributes:
        transform: fused frame to odometry frame, as last sent; None before the first pose.
    """

    def __init__(self) -> None:
        self.transform: Pose2 | None = None
        self._target = Pose2()
        self._posed_s = -math.inf
        # Stamp of the last move, and the odometry then.
        self._moved: tuple[float, Pose2] | None = None

    def correct(self, stamp_s: float, pose: Pose2, odometry: Pose2) -> None:
        """Set the target from a pose in the fused frame and the odometry at the same stamp."""
        self._target = pose.compose(odometry.inverse())
        self._posed_s = stamp_s
        if self.transform is None:
            self.transform = self._target

    def left(self, odometry: Pose2) -> Pose2:
        """Return the remaining correction, seen from the robot."""
        if self.transform is None:
            return Pose2()
        here = self.transform.compose(odometry)
        return here.inverse().compose(self._target.compose(odometry))

    def move(self, stamp_s: float, odometry: Pose2, m_s: float, rad_s: float) -> Pose2 | None:
        """Move towards the newest pose and return the transform.

        None without a pose of the last ``CARRIED_S``, and if the stamp is not newer.
        """
        before = self._moved
        if self.transform is None or stamp_s - self._posed_s > CARRIED_S:
            return None
        if before is not None:
            spent_s = stamp_s - before[0]
            if spent_s <= 0.0:
                return None
            driven_m = math.dist((odometry.x, odometry.y), (before[1].x, before[1].y))
            if driven_m > JUMP_M_S * max(spent_s, 0.1):
                moved = before[1].compose(odometry.inverse())
                self.transform = self.transform.compose(moved)
                if self._posed_s <= before[0]:
                    self._target = self._target.compose(moved)
            step = self._step(odometry, m_s, rad_s, min(spent_s, LONGEST_S))
            here = self.transform.compose(odometry)
            self.transform = here.compose(step).compose(odometry.inverse())
        self._moved = stamp_s, odometry
        return self.transform

    def _step(self, odometry: Pose2, m_s: float, rad_s: float, spent_s: float) -> Pose2:
        """Return the part of the correction that fits into a time."""
        left = self.left(odometry)
        needed_s = max(math.hypot(left.x, left.y) / m_s, abs(left.yaw_rad) / rad_s)
        share = min(1.0, spent_s / needed_s) if needed_s > 0.0 else 1.0
        return Pose2(share * left.x, share * left.y, share * left.yaw_rad)


class PoseSpread:
    """How far the voters' poses of equal stamps are apart: the covariance of the fused pose.

    The inputs read the same scans, so their errors are correlated. So the mean square of the
    differences counts whole, which is twice the variance of independent inputs.
    """

    def __init__(self) -> None:
        self._leader = ""
        self._poses: OrderedDict[int, dict[str, Pose2]] = OrderedDict()
        self._differences: deque[tuple[float, float, float, float]] = deque(maxlen=MOST_DIFFERENCES)

    def hear(self, leader: str, name: str, stamp_ns: int, pose: Pose2) -> None:
        """Add a voter's pose in the fused frame; ``leader`` is the input whose pose is used."""
        if leader != self._leader:
            self._leader = leader
            self._differences.clear()
        here = self._poses.setdefault(stamp_ns, {})
        for other in here if name == leader else (leader,):
            if other != name and (there := here.get(other)) is not None:
                turn = wrap_angle(pose.yaw_rad - there.yaw_rad)
                self._differences.append(
                    (1e-9 * stamp_ns, pose.x - there.x, pose.y - there.y, turn)
                )
        here[name] = pose
        if len(self._poses) > STAMPS:
            self._poses.popitem(last=False)

    def covariance(self, stamp_s: float, alone_m: float, alone_rad: float) -> F64:
        """Return (3, 3) float64: x and y in metres, yaw in radians, in axes of the fused frame.

        Without other inputs, ``alone_m`` and ``alone_rad`` are the deviations.
        """
        rows = np.array([row[1:] for row in self._differences if stamp_s - row[0] <= SPREAD_S])
        if not len(rows):
            return np.diag((alone_m**2, alone_m**2, alone_rad**2))
        return np.asarray(
            rows.T @ rows / len(rows) + np.diag((LEAST_M**2, LEAST_M**2, LEAST_RAD**2))
        )
