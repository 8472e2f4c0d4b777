"""What a graph SLAM knows of its nodes, and the poses that fit all of it best.

A constraint tells the pose of one node in the frame of another. Constraints from one scan to the
next are believed; closures may be false, and the robust solution leaves outliers, which do not go
with the rest, out of the inlier set (graduated non-convexity, ``slamfusion.pose_graph.robust``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.pose_graph import Optimized, PoseGraph, optimize

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Constraint:
    """What is known of two nodes.

    Attributes:
        start: number of the node in whose frame it is told.
        end: the other node.
        motion: (3,) pose of ``end`` in the frame of ``start``, metres and radians.
        information: (3, 3) inverse covariance of the motion, along the axes of ``start``.
        is_closure: whether it may be false.
    """

    start: int
    end: int
    motion: F64
    information: F64
    is_closure: bool = False


def solve_constraints(
    poses: F64,
    constraints: Sequence[Constraint],
    weights: F64 | None = None,
    tolerated: int = 0,
) -> Optimized:
    """Return the poses that fit the constraints best; the first node is held.

    Args:
        poses: (N, 3) where the nodes are believed to be: where the search starts.
        constraints: together they join all nodes; at least one.
        weights: of the first of them by the last solution: its outliers are not tried again from
            the start.
        tolerated: closures that may be new outliers before all of them are re-evaluated.
    """
    motions = np.array([one.motion for one in constraints])
    information = np.array([one.information for one in constraints])
    graph = PoseGraph(
        poses=poses,
        edges=np.array([(one.start, one.end) for one in constraints], dtype=np.int64),
        motions=motions,
        information=_in_end_frame(information, motions[:, 2]),
        is_closure=np.array([one.is_closure for one in constraints]),
    )
    return optimize(graph, robust="gnc", start="given", weights=weights, tolerated=tolerated)


def turned(information: F64, angle_rad: float) -> F64:
    """Return an information matrix of x, y and yaw, (3, 3), in a frame turned by an angle."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(turn @ information @ turn.T)


def _in_end_frame(information: F64, yaws: F64) -> F64:
    """Return (M, 3, 3) information along the axes of each constraint's end, exactly symmetric."""
    turns = np.zeros((len(yaws), 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(yaws)
    turns[:, 0, 1], turns[:, 1, 0] = np.sin(yaws), -np.sin(yaws)
    turns[:, 2, 2] = 1.0
    seen = turns @ information @ turns.transpose(0, 2, 1)
    return np.asarray(0.5 * (seen + seen.transpose(0, 2, 1)))
