"""``MapGraph``: the nodes, what is known of their poses, and the solution of all of it."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2, compose_poses, wrap_angle
from slamfusion.pose_graph import Optimized
from slamfusion.slam.common.pose_rows import pose_of, wrapped_row_of
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.constraints import Constraint, solve_constraints
from slamfusion.slam.graph.health import GraphHealth
from slamfusion.slam.graph.node_map import Node

F64 = npt.NDArray[np.float64]

# Share of the information that matches and odometry tell which is believed: scans on one submap
# share its errors, and what wheels do wrong they do all the way. Without it true closures of long
# loops are taken for outliers.
BELIEVED_SHARE = 0.5
# Standard deviations of a step of odometry: metres and metres per metre, radians and per radian.
ODOMETRY_M, ODOMETRY_M_PER_M = 0.05, 0.1
ODOMETRY_RAD, ODOMETRY_RAD_PER_RAD = 0.05, 0.1
# Difference between odometry and the match, in these deviations, from which on a step is left out.
ODOMETRY_GATE = 3.0
# Deviations of the tie between two local maps that no match joins, metres and radians: next to
# nothing, which only keeps the equations solvable.
FREE_SIGMAS = (10.0, 10.0, 3.0)
# Deviations of odometry across such a gap, metres and radians: believed as far as the closures that
# come agree with it.
GAP_SIGMAS = (0.3, 0.3, 0.2)
# Nodes from one solution to the next: poses are kept relative to the local map, so it can wait.
SOLVE_NODES = 30
# New closures, and share of them, that may be left out as outliers without re-evaluating all, which
# takes many times as long.
NEW_OUTLIERS, NEW_OUTLIERS_SHARE = 3, 1.0 / 6.0
# Memory of a constraint: motion, information and ends.
CONSTRAINT_BYTES = 112


class MapGraph(Stateful):
    """The pose graph: it owns nodes, poses and constraints, and decides when it is solved.

    Attributes:
        nodes: scans that are kept, in the order of time.
        poses: (N, 3) of them in the map frame, metres and radians.
        constraints: between them.
    """

    STATE = (
        "nodes",
        "poses",
        "constraints",
        "_node_bytes",
        "_weights",
        "_outliers",
        "_new_outliers",
        "_unsolved",
        "_is_urgent",
        "_solved_at",
    )

    def __init__(self, health: GraphHealth) -> None:
        """Start empty.

        Args:
            health: where nodes and solutions are counted.
        """
        # It loads slowly: here, not while the robot drives.
        importlib.import_module("scipy.sparse.linalg")
        self.nodes: list[Node] = []
        self.poses: F64 = np.zeros((0, 3))
        self.constraints: list[Constraint] = []
        self._health = health
        self._node_bytes = 0
        # Of the constraints that there were at the last solution, and outliers among them.
        self._weights = np.zeros(0)
        self._outliers = 0
        # Of these, the ones left out since all closures were last re-evaluated.
        self._new_outliers = 0
        # Times that closures came since the last solution, and whether several came at once.
        self._unsolved = 0
        self._is_urgent = False
        self._solved_at = 0
        # Poses by all closures, as of a number of constraints.
        self._settled: tuple[int, F64] | None = None

    # -- nodes and constraints -----------------------------------------------------------------

    @property
    def travelled_m(self) -> float:
        """Distance that the robot has travelled up to the last node."""
        return self.nodes[-1].travelled_m if self.nodes else 0.0

    @property
    def memory_bytes(self) -> int:
        """Bytes of nodes and constraints."""
        return self._node_bytes + CONSTRAINT_BYTES * len(self.constraints)

    def pose(self, number: int) -> Pose2:
        """Return a node's pose in the map frame."""
        return pose_of(self.poses[number])

    def add_node(self, node: Node, pose: Pose2) -> int:
        """Add a node where it is taken to be in the map frame, and return its number."""
        self.nodes.append(node)
        self._node_bytes += node.ends.nbytes
        self.poses = np.vstack((self.poses, (pose.x, pose.y, wrap_angle(pose.yaw_rad))))
        self._health.nodes = len(self.nodes)
        return len(self.nodes) - 1

    def add(self, constraints: Sequence[Constraint]) -> None:
        """Add constraints that the solution can wait for."""
        self.constraints += constraints

    def add_odometry(self, number: int, matched: Pose2) -> None:
        """Tie a node to the one before it by odometry, unless a match says something else.

        Args:
            number: of the node.
            matched: its pose in the frame of the one before it, as matches have it.
        """
        node, before = self.nodes[number], self.nodes[number - 1]
        if node.odometry is None or before.odometry is None:
            return
        step = before.odometry.inverse().compose(node.odometry)
        driven_m, turn_rad = math.hypot(step.x, step.y), abs(wrap_angle(step.yaw_rad))
        sigma_m = ODOMETRY_M + ODOMETRY_M_PER_M * driven_m
        sigmas = np.array([sigma_m, sigma_m, ODOMETRY_RAD + ODOMETRY_RAD_PER_RAD * turn_rad])
        away = wrapped_row_of(step.inverse().compose(matched))
        away[2] = wrap_angle(away[2])
        if (np.abs(away / sigmas) < ODOMETRY_GATE).all():
            information = BELIEVED_SHARE * np.diag(sigmas**-2.0)
            self.add([Constraint(number - 1, number, wrapped_row_of(step), information)])

    def add_beyond_gap(self, node: Node, moved: Pose2) -> int:
        """Add a node that no match ties to the one before it, only odometry; return its number.

        Args:
            node: the node.
            moved: its pose in the frame of the one before it.
        """
        number = self.add_node(node, self.pose(len(self.nodes) - 1).compose(moved))
        for sigmas, is_closure in ((FREE_SIGMAS, False), (GAP_SIGMAS, True)):
            information = np.diag(np.square(1.0 / np.array(sigmas)))
            motion = wrapped_row_of(moved)
            self.add([Constraint(number - 1, number, motion, information, is_closure=is_closure)])
        return number

    def add_closures(self, closures: Sequence[Constraint]) -> None:
        """Add closures that are believed; several at once have waited, and are urgent."""
        self.add(closures)
        self._unsolved += 1
        self._is_urgent = self._is_urgent or len(closures) > 1

    def move_nodes(self, chosen: npt.NDArray[np.bool_], motion: Pose2) -> None:
        """Move the chosen nodes, (N,), by a motion of the map frame."""
        motions = np.broadcast_to(wrapped_row_of(motion), (int(chosen.sum()), 3))
        self.poses[chosen] = compose_poses(motions, self.poses[chosen])

    def closures(self) -> list[tuple[Constraint, float]]:
        """Return the closures and the weight that the last solution gave each, 1 for new ones."""
        new = len(self.constraints) - len(self._weights)
        weights = np.concatenate((self._weights, np.ones(new))).tolist()
        pairs = zip(self.constraints, weights, strict=True)
        return [(one, weight) for one, weight in pairs if one.is_closure]

    # -- the solution --------------------------------------------------------------------------

    def settled_poses(self) -> F64:
        """Return the nodes' poses by all closures; asking changes nothing of how it goes on."""
        if not (self._unsolved or self._new_outliers):
            return self.poses
        if self._settled is None or self._settled[0] != len(self.constraints):
            self._settled = (len(self.constraints), self.solution().poses)
        return self._settled[1]

    def solution(self) -> Optimized:
        """Return the solution by all closures, those too that were left out without re-evaluation.

        It is not taken over.
        """
        weights = None if self._new_outliers else self._weights
        return solve_constraints(self.poses, self.constraints, weights)

    def solve_if_due(self, number: int) -> None:
        """Solve the graph if there are closures to be solved for, and enough nodes since or need.

        Args:
            number: of the last node.
        """
        is_due = number - self._solved_at >= SOLVE_NODES
        if self._unsolved and (is_due or self._is_urgent):
            self.solve()

    def solve(self) -> None:
        """Solve the graph and take over its poses."""
        share = int(NEW_OUTLIERS_SHARE * self._unsolved)
        tolerated = min(NEW_OUTLIERS - self._new_outliers, share)
        solved = solve_constraints(self.poses, self.constraints, self._weights, tolerated)
        self.poses, self._weights = solved.poses, solved.weights
        outliers = int(solved.is_outlier.sum())
        more = max(0, outliers - self._outliers)
        self._new_outliers = 0 if solved.is_reevaluated else self._new_outliers + more
        self._outliers = outliers
        self._unsolved, self._is_urgent = 0, False
        self._solved_at = len(self.nodes) - 1
        health = self._health
        health.chi2, health.solve_s = solved.chi2, solved.time_s
        health.closure_outliers = outliers
        health.solutions += 1
