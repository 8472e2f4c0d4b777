"""``MapGraph``: nodes and constraints, and the poses that fit them best; and the driven path.

Constraints from one scan to the next are trusted; closures may be false, and the robust solution
rejects outliers (graduated non-convexity, ``slamfusion.pose_graph.robust``).
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from slamfusion.errors import counted
from slamfusion.geometry import (
    B8,
    F64,
    Pose2,
    compose_poses,
    invert_poses,
    pose_of,
    row_of,
    wrap_angle,
    wrapped_row_of,
)
from slamfusion.grid import IDENTITY
from slamfusion.json_values import printed_as
from slamfusion.pose_graph.graph import PoseGraph
from slamfusion.pose_graph.least_squares import Steps, take_steps
from slamfusion.pose_graph.optimize import Optimized, optimize_in_steps
from slamfusion.pose_graph.uncertainty import turned
from slamfusion.slam.common.mapper import Health
from slamfusion.slam.common.state import Rows, Stateful
from slamfusion.slam.graph.node_map import Node
from slamfusion.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Constraint:
    """A relative measurement of two nodes.

    Attributes:
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
    poses: F64, constraints: Sequence[Constraint], weights: F64 | None = None, tolerated: int = 0
) -> Steps[Optimized]:
    """Return the poses that fit the constraints best; the first node is fixed.

    The search starts at ``poses`` (N, 3). The constraints must join all nodes. ``weights`` are the
    last solution's, of the first constraints: its outliers are not re-evaluated at the start.
    """
    # A quarter of the time of ``np.array``.
    motions = np.concatenate([one.motion for one in constraints]).reshape(-1, 3)
    information = np.concatenate([one.information for one in constraints]).reshape(-1, 3, 3)
    information = turned(information, -motions[:, 2])  # along the axes of the end
    graph = PoseGraph(
        poses=poses,
        edges=np.array([(one.start, one.end) for one in constraints], dtype=np.int64),
        motions=motions,
        information=0.5 * (information + information.transpose(0, 2, 1)),
        is_closure=np.array([one.is_closure for one in constraints]),
    )
    return optimize_in_steps(
        graph, robust="gnc", start="given", weights=weights, tolerated=tolerated
    )


# Node of the scans before the first node: their poses are relative to the start.
NO_NODE = -1


class DrivenPath(Stateful):
    """The scans' poses relative to the graph's nodes, so that the path moves with them.

    Attributes:
        start: the robot's pose in the map frame at the first scan.
        responses: (K, 2) stamp and response, 0 to 1, of each node's match.
    """

    STATE = ("start", "responses", "_scans", "_reported")

    def __init__(self) -> None:
        self.start = IDENTITY
        self.responses = Rows(2)
        # Stamp, node, and motion since the node; poses as reported.
        self._scans, self._reported = Rows(5), Rows(3)

    def add(self, stamp_s: float, node: int, moved: Pose2, pose: Pose2) -> None:
        """Add a scan: its pose in the frame of the node or the start, and as reported."""
        self._scans.append(stamp_s, node, moved.x, moved.y, moved.yaw_rad)
        self._reported.append(pose.x, pose.y, pose.yaw_rad)

    def trajectory(self, poses: F64, name: str) -> Trajectory:
        """Return the path by the nodes' poses (N, 3) in the map frame."""
        scans = self._scans.array()
        nodes = scans[:, 1].astype(np.int64)
        frames = np.concatenate((poses, row_of(self.start)[None]))  # NO_NODE is the last one
        return Trajectory(scans[:, 0], compose_poses(frames[nodes], scans[:, 2:]), name)

    def as_reported(self, name: str) -> Trajectory:
        """Return the path as first reported."""
        return Trajectory(self._scans.array()[:, 0], self._reported.array(), name)

    def node_stamps(self) -> dict[int, float]:
        """Return the time of each node's scan, seconds."""
        stamps: dict[int, float] = {}
        for stamp, node in self._scans.array()[:, :2].tolist():
            stamps.setdefault(int(node), stamp)
        return stamps


# Share of the information of matches and odometry that is used: scans on one submap share its
# errors, and errors of odometry are systematic. Without it true closures of long loops count as
# outliers.
INFORMATION_SHARE = 0.5
# Standard deviations of a step of odometry: metres and metres per metre, radians and per radian.
ODOMETRY_M, ODOMETRY_M_PER_M = 0.05, 0.1
ODOMETRY_RAD, ODOMETRY_RAD_PER_RAD = 0.05, 0.1
# Difference between odometry and match, in these deviations, above which a step is left out.
ODOMETRY_GATE = 3.0
# Difference above which the odometry is not looked at: it was reset.
MOST_DOUBT_M = 5.0
# Deviations of the constraint between two local maps that no match joins, metres and radians: it
# only keeps the equations solvable.
FREE_SIGMAS = (10.0, 10.0, 3.0)
# Deviations of odometry across such a gap, metres and radians: may be rejected like a closure.
GAP_SIGMAS = (0.3, 0.3, 0.2)
# Nodes from one solution to the next: poses are kept relative to the local map, so it can wait.
SOLVE_NODES = 30
# New closures, and their share, that may be outliers without re-evaluating all, which takes many
# times as long.
NEW_OUTLIERS, NEW_OUTLIERS_SHARE = 3, 1.0 / 6.0
# Work of a solution at one scan, in linearised constraints; a step costs some more. About 40 ms:
# the rest continues at the next scans, with the same number of steps on any machine.
SCAN_WORK, STEP_WORK = 28_000, 400
# Memory of a constraint: motion, information and ends.
CONSTRAINT_BYTES = 112


@dataclass
class GraphHealth(Health):
    """How well a pose graph of submaps is doing."""

    UNDER = "graph"

    nodes: int = 0
    """Scans that became nodes."""
    submaps: int = 0
    """Submaps, each of which holds some of the nodes."""
    kidnappings: int = field(default=0, metadata=printed_as("restarts"))
    """Times that tracking was lost and a new submap was started."""
    tracking_failures: int = field(default=0, metadata=printed_as("breaks"))
    """Times that tracking failed for a while and only odometry bridges the gap."""
    relocalizations: int = field(default=0, metadata=printed_as("refound"))
    """Times that the robot was relocalized on submaps of before."""
    map_components: int = field(default=1, metadata=printed_as("parts"))
    """Parts of the map that nothing but odometry holds together; 1 for a whole map."""
    closures_tried: int = 0
    """Searches of an older submap."""
    closures_accepted: int = 0
    """Of these, the ones that became an edge."""
    closures_rejected: dict[str, int] = field(default_factory=dict)
    """Of these, the others, by reason."""
    closure_outliers: int = field(default=0, metadata=printed_as("closures_doubted"))
    """Edges that the last solution left less than half of their weight."""
    largest_correction_m: float = 0.0
    """How far a closure has moved the robot at most, metres."""
    pauses: int = 0
    """Times that no scan came for long."""
    longest_pause_s: float = 0.0
    """The longest of them, seconds."""
    chi2: float | None = None
    """Chi-square of the graph after the last solution; null before the first."""
    solutions: int = 0
    """How often the graph was solved."""
    solve_s: float | None = None
    """Duration of the last solution, seconds; null before the first."""

    def warnings(self) -> tuple[str, ...]:
        """Return what contradicts the map, a sentence each."""
        sentences = []
        if self.map_components > 1:
            sentences.append(
                f"the map is in {self.map_components} components: the robot was kidnapped "
                f"{counted(self.kidnappings, 'time')} and relocalized "
                f"{counted(self.relocalizations, 'time')}; only odometry tells how the "
                "components lie"
            )
        elif self.kidnappings:
            sentences.append(
                f"kidnappings of the robot, each relocalized in the map: {self.kidnappings}; look "
                "at the map"
            )
        if self.tracking_failures:
            sentences.append(
                "places where scans fitted badly for a while, and only odometry and later closures "
                f"tell how the map goes on: {self.tracking_failures}; look at the map"
            )
        return tuple(sentences)

    def reject_closure(self, reason: str) -> None:
        """Count a closure that was not accepted."""
        self.closures_rejected[reason] = self.closures_rejected.get(reason, 0) + 1


@dataclass
class Solution:
    """A solution in progress, of the nodes and the first constraints known at its start.

    Attributes:
        poses: (N, 3) to start from.
        closures: number of closure events that it is the first to solve.
        tolerated: outliers without re-evaluation, see ``optimize``.
        weights: of the previous solution.
    """

    poses: F64
    constraints: int
    closures: int
    tolerated: int
    weights: F64
    taken: int = 0
    time_s: float = 0.0

    def steps(self, constraints: Sequence[Constraint]) -> Steps[Optimized]:
        """Return all its steps."""
        known = constraints[: self.constraints]
        return solve_constraints(self.poses, known, self.weights, self.tolerated)


class MapGraph(Stateful):
    """The pose graph; decides when it is solved. ``poses`` (N, 3) are in the map frame."""

    STATE = (
        "nodes",
        "poses",
        "constraints",
        "_node_bytes",
        "_weights",
        "_new_outliers",
        "_unsolved",
        "_is_urgent",
        "_solved_at",
        "_solution",
    )

    def __init__(self, health: GraphHealth) -> None:
        # Loads slowly: not while the robot drives.
        importlib.import_module("scipy.sparse.linalg")
        self.nodes: list[Node] = []
        self.poses: F64 = np.zeros((0, 3))
        self.constraints: list[Constraint] = []
        self._health = health
        self._node_bytes = 0
        # Weights of the constraints in the last solution.
        self._weights = np.zeros(0)
        # Outliers since all closures were last re-evaluated.
        self._new_outliers = 0
        # Closure events since the last solution, and whether several closures came at once.
        self._unsolved = 0
        self._is_urgent = False
        self._solved_at = 0
        self._solution: Solution | None = None
        self._steps: Steps[Optimized] | None = None
        self._left = 0
        # Poses by all closures, and the number of constraints they were solved with.
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
        """Add a node at a pose in the map frame, and return its number."""
        self.nodes.append(node)
        self._node_bytes += node.ends.nbytes
        self.poses = np.vstack((self.poses, (pose.x, pose.y, wrap_angle(pose.yaw_rad))))
        return len(self.nodes) - 1

    def add_matches(self, number: int, matches: Sequence[Constraint], moved: Pose2) -> None:
        """Add the matches of a node, and join it to the previous one by odometry.

        ``moved`` is the match's pose in the frame of the previous node. Where it contradicts the
        odometry, there is no such join, and the matches get the difference as a deviation along its
        direction: along walls that look alike a match may stay behind.
        """
        node, before = self.nodes[number], self.nodes[number - 1]
        if node.odometry is None or before.odometry is None:
            self.constraints += matches
            return
        step = before.odometry.inverse().compose(node.odometry)
        driven_m, turn_rad = math.hypot(step.x, step.y), abs(wrap_angle(step.yaw_rad))
        sigma_m = ODOMETRY_M + ODOMETRY_M_PER_M * driven_m
        sigmas = np.array([sigma_m, sigma_m, ODOMETRY_RAD + ODOMETRY_RAD_PER_RAD * turn_rad])
        away = wrapped_row_of(step.inverse().compose(moved))
        if (np.abs(away / sigmas) < ODOMETRY_GATE).all():
            information = INFORMATION_SHARE * np.diag(sigmas**-2.0)
            odometry = Constraint(number - 1, number, wrapped_row_of(step), information)
            self.constraints += [*matches, odometry]
            return
        off = np.array([away[0], away[1], 0.0])
        if math.hypot(away[0], away[1]) >= MOST_DOUBT_M:
            off[:] = 0.0
        for one in matches:
            doubt = turned(np.outer(off, off)[None], one.motion[2:] - away[2:])[0]
            information = np.linalg.inv(np.linalg.inv(one.information) + doubt)
            self.constraints.append(replace(one, information=information))

    def add_beyond_gap(self, node: Node, before: int, moved: Pose2) -> int:
        """Add a node joined to an earlier one by odometry only; return its number.

        ``moved`` is its pose in the frame of the earlier node.
        """
        number = self.add_node(node, self.pose(before).compose(moved))
        ends, motion = (before, number), wrapped_row_of(moved)
        for sigmas, is_closure in ((FREE_SIGMAS, False), (GAP_SIGMAS, True)):
            information = np.diag(np.square(1.0 / np.array(sigmas)))
            self.constraints.append(Constraint(*ends, motion, information, is_closure=is_closure))
        return number

    def add_closures(self, closures: Sequence[Constraint]) -> None:
        """Add accepted closures; several at once are urgent."""
        self.constraints += closures
        self._unsolved += 1
        self._is_urgent = self._is_urgent or len(closures) > 1

    def move_nodes(self, chosen: B8, motion: Pose2) -> None:
        """Move the chosen nodes (N,) by a motion of the map frame, and drop a running solution."""
        motions = np.broadcast_to(wrapped_row_of(motion), (int(chosen.sum()), 3))
        self.poses[chosen] = compose_poses(motions, self.poses[chosen])
        if self._solution is not None:
            self._unsolved += self._solution.closures
            self._solution = self._steps = None

    def closures(self) -> list[tuple[Constraint, float]]:
        """Return the closures and the weight that the last solution gave each, 1 for new ones."""
        new = len(self.constraints) - len(self._weights)
        weights = np.concatenate((self._weights, np.ones(new))).tolist()
        pairs = zip(self.constraints, weights, strict=True)
        return [(one, weight) for one, weight in pairs if one.is_closure]

    # -- the solution --------------------------------------------------------------------------

    def settled_poses(self) -> F64:
        """Return the nodes' poses by all closures, without changing the graph's state."""
        if not (self._unsolved or self._new_outliers or self._solution):
            return self.poses
        if self._settled is None or self._settled[0] != len(self.constraints):
            # Outliers without re-evaluation are evaluated too.
            weights = None if self._new_outliers else self._weights
            solved = take_steps(solve_constraints(self.poses, self.constraints, weights))
            self._settled = (len(self.constraints), cast("Optimized", solved).poses)
        return self._settled[1]

    def go_on(self) -> None:
        """Take this scan's steps of a running solution."""
        self._left = max(1, SCAN_WORK // (len(self.constraints) + STEP_WORK))
        self._take_steps()

    def solve_if_due(self, number: int) -> None:
        """Start a solution if closures wait for it and it is due or urgent."""
        is_due = number - self._solved_at >= SOLVE_NODES
        if self._solution is None and self._unsolved and (is_due or self._is_urgent):
            share = int(NEW_OUTLIERS_SHARE * self._unsolved)
            tolerated = min(NEW_OUTLIERS - self._new_outliers, share)
            self._solution = Solution(
                self.poses, len(self.constraints), self._unsolved, tolerated, self._weights
            )
            self._steps = self._solution.steps(self.constraints)
            self._unsolved, self._is_urgent, self._solved_at = 0, False, number
            self._take_steps()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore what ``to_state`` returned; a running solution continues."""
        super().restore(state)
        if self._solution is not None:
            self._steps = self._solution.steps(self.constraints)
            take_steps(self._steps, self._solution.taken)

    def _take_steps(self) -> None:
        """Take this scan's remaining steps, and use the poses of a finished solution."""
        solution = self._solution
        if solution is None or self._steps is None or not self._left:
            return
        begun_s = time.perf_counter()
        solved = take_steps(self._steps, self._left)
        solution.taken += self._left
        solution.time_s += time.perf_counter() - begun_s
        self._left = 0
        if solved is not None:
            self._solution = self._steps = None
            self._take_over(solution, solved)

    def _take_over(self, solution: Solution, solved: Optimized) -> None:
        """Replace the poses by a solution's; a later node moves with that it was placed by."""
        before, count = self.poses, len(solved.poses)
        self.poses = np.concatenate((solved.poses, before[count:]))
        later = reversed(self.constraints[solution.constraints :])
        anchors = {one.end: one.start for one in later}  # of a node's constraints the first
        for number in range(count, len(before)):
            anchor = anchors[number]
            since = compose_poses(invert_poses(before[anchor]), before[number])
            self.poses[number] = compose_poses(self.poses[anchor], since)
        outliers = int(solved.is_outlier.sum())
        more = outliers - int((self._weights < 0.5).sum())
        self._weights = solved.weights
        self._new_outliers = 0 if solved.is_reevaluated else self._new_outliers + max(0, more)
        health = self._health
        health.chi2, health.solve_s = solved.chi2, solution.time_s
        health.closure_outliers = outliers
        health.solutions += 1
