"""The odometry frame in the fused frame; no ROS.

A new pose moves the odometry frame. A planner and a controller cannot follow a jump, so
``OdomFrame`` moves it with limited speed. Between corrections it stands still.
"""

from __future__ import annotations

import math

from slamfusion.geometry import Pose2

# The odometry alone carries the robot over this way or turn, metres and radians: it drifts by about
# a tenth of the way and a twentieth of the turn, so by half a metre or 20 degrees.
CARRIED_M, CARRIED_RAD = 5.0, 2.0 * math.pi
# Smaller steps may be the noise of odometry at rest, and count once they add up to this.
STEP_M, STEP_RAD = 0.1, 0.05
# Odometry that is faster, metres per second, has jumped: its origin was reset.
JUMP_M_S = 10.0
# Longest time between two sent transforms that counts for the speed, seconds.
LONGEST_S = 1.0


class OdomFrame:
    """The pose of the odometry frame in the fused frame, which only moves with limited speed.

    The speed is measured at the robot: a correction of the heading far from the origin of the
    odometry moves that origin by metres and the robot not at all.

    Attributes:
        transform: fused frame to odometry frame, as last sent; None before the first pose.
        posed: stamp of the last pose, seconds, and the odometry there.
        is_too_far: whether the robot has driven or turned too far since that pose.
    """

    def __init__(self) -> None:
        self.transform: Pose2 | None = None
        self._target = Pose2()
        self.posed = -math.inf, Pose2()
        self.is_too_far = False
        # Share of the way or turn that the odometry has carried, and the odometry until then.
        self._carried, self._counted = 0.0, Pose2()
        # Stamp of the last move, and the odometry then.
        self._moved: tuple[float, Pose2] | None = None

    def correct(self, stamp_s: float, pose: Pose2, odometry: Pose2) -> None:
        """Set the target from a pose in the fused frame and the odometry at the same stamp."""
        self._target = pose.compose(odometry.inverse())
        self.posed = stamp_s, odometry
        self._carried, self._counted, self.is_too_far = 0.0, odometry, False
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

        None before the first pose, if the robot is too far from the last one, and if the stamp is
        not newer. A robot that stands still stays where it is, however long no pose comes.
        """
        before = self._moved
        if self.transform is None:
            return None
        if before is not None:
            spent_s = stamp_s - before[0]
            if spent_s <= 0.0:
                return None
            driven_m = math.dist((odometry.x, odometry.y), (before[1].x, before[1].y))
            if driven_m > JUMP_M_S * max(spent_s, 0.1):
                moved = before[1].compose(odometry.inverse())
                self.transform = self.transform.compose(moved)
                self._counted = odometry
                if self.posed[0] <= before[0]:
                    self._target = self._target.compose(moved)
                    self.posed = self.posed[0], moved.inverse().compose(self.posed[1])
            left = self.left(odometry)
            needed_s = max(math.hypot(left.x, left.y) / m_s, abs(left.yaw_rad) / rad_s)
            passed_s = min(spent_s, LONGEST_S)
            share = min(1.0, passed_s / needed_s) if needed_s > 0.0 else 1.0
            step = Pose2(share * left.x, share * left.y, share * left.yaw_rad)
            here = self.transform.compose(odometry)
            self.transform = here.compose(step).compose(odometry.inverse())
        self._moved = stamp_s, odometry
        step = self._counted.inverse().compose(odometry)
        step_m, step_rad = math.hypot(step.x, step.y), abs(step.yaw_rad)
        if step_m > STEP_M or step_rad > STEP_RAD:
            self._carried += max(step_m / CARRIED_M, step_rad / CARRIED_RAD)
            self._counted = odometry
        self.is_too_far = self._carried > 1.0
        return None if self.is_too_far else self.transform
