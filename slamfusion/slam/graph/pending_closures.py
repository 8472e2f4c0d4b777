"""Closures that wait for others to say the same before they are believed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.constraints import Constraint

# How a place was searched: where the graph has the robot; where odometry has a kidnapped one; all
# over.
How = Literal["known", "odometry", "anywhere"]

# A closure that moves the robot by no more is accepted alone, metres and radians.
SMALL_STEP_M, SMALL_STEP_RAD = 0.4, 0.1
# Closures that put the robot nearer to each other than this say the same, metres and radians.
AGREEMENT_M, AGREEMENT_RAD = 0.3, 0.05
# Nodes whose closures must agree before one that moves the robot far is accepted, and nodes for
# which it waits for them.
AGREEING_NODES, WAIT_NODES = 2, 12
# The same where odometry has a kidnapped robot: nodes, and the way between them, metres.
ODOMETRY_NODES, ODOMETRY_M = 3, 0.8


@dataclass(frozen=True, eq=False)
class PendingClosure:
    """A closure that is not believed yet.

    Attributes:
        constraint: what it says.
        correction: what it would do to the robot's pose in the map frame.
        travelled_m: distance that the robot has travelled up to it.
        how: it was searched.
    """

    constraint: Constraint
    correction: Pose2
    travelled_m: float
    how: How


class PendingClosures(Stateful):
    """Closures that wait for others to say the same.

    Attributes:
        closures: the ones of the last nodes.
    """

    STATE = ("closures",)

    def __init__(self) -> None:
        """Start with none."""
        self.closures: list[PendingClosure] = []

    def confirmed(self, closure: PendingClosure, pose: Pose2) -> list[PendingClosure]:
        """Return the closures that may be believed now, this one among them; often none.

        Args:
            closure: a new one, not found ``anywhere``.
            pose: of its node in the map frame, before any correction.
        """
        number = closure.constraint.end
        moved = closure.correction.compose(pose)
        self.closures = [c for c in self.closures if number - c.constraint.end <= WAIT_NODES]
        if closure.how == "known" and _is_small(pose, moved):
            return [closure]
        earlier = [c for c in self.closures if c.constraint.end != number]
        agreeing = [c for c in earlier if is_same_place(c.correction.compose(pose), moved)]
        self.closures.append(closure)
        least_nodes, least_m = AGREEING_NODES, 0.0
        if closure.how != "known":  # see ``Relocalization`` for those that are found anywhere
            least_nodes, least_m = ODOMETRY_NODES, ODOMETRY_M
        nodes = {c.constraint.end for c in agreeing}
        driven_m = closure.travelled_m - min((c.travelled_m for c in agreeing), default=math.inf)
        if len(nodes) + 1 < least_nodes or driven_m < least_m:
            return []
        if closure.how != "known" and len(earlier) - len(agreeing) >= len(nodes):
            return []
        self.closures = []
        return [closure, *agreeing]


def is_same_place(one: Pose2, other: Pose2) -> bool:
    """Return whether two corrected poses of the robot are one place."""
    away = math.hypot(one.x - other.x, one.y - other.y)
    turn = abs(wrap_angle(one.yaw_rad - other.yaw_rad))
    return away < AGREEMENT_M and turn < AGREEMENT_RAD


def _is_small(pose: Pose2, moved: Pose2) -> bool:
    """Return whether a closure leaves the robot about where it was believed to be."""
    away = math.hypot(moved.x - pose.x, moved.y - pose.y)
    turn = abs(wrap_angle(moved.yaw_rad - pose.yaw_rad))
    return away <= SMALL_STEP_M and turn <= SMALL_STEP_RAD
