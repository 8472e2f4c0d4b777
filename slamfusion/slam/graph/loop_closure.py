"""Loop closures: which submaps are searched, which results are accepted, and relocalization.

A closure that moves the robot far waits until others agree. A kidnapped
robot is searched near its odometry and then everywhere. Rooms look alike: every place where
a scan fits is a hypothesis that predicts where the next scans must fit too. The robot is
relocalized when one hypothesis has been confirmed over a distance, no other is left, and every old
submap has been searched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from slamfusion.config import GraphConfig
from slamfusion.geometry import (
    F64,
    I64,
    Pose2,
    pose_of,
    row_of,
    wrap_angle,
    wrap_angles,
    wrapped_row_of,
)
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.closure_search import LOW_RESPONSE, ClosureSearch, Found
from slamfusion.slam.graph.local_map import LocalMap
from slamfusion.slam.graph.map_graph import INFORMATION_SHARE, Constraint, GraphHealth, MapGraph

# Where a place was searched: at the graph's pose; at a kidnapped robot's odometry; everywhere.
How = Literal["known", "odometry", "anywhere"]

# A closure that moves the robot by at most this much needs no confirmation, metres and radians.
SMALL_STEP_M, SMALL_STEP_RAD = 0.4, 0.1
# Closures agree if their poses of the robot differ by less than this, metres and radians.
AGREEMENT_M, AGREEMENT_RAD = 0.3, 0.05
# Nodes whose closures must agree before a large correction is accepted, and nodes that it waits.
AGREEING_NODES, WAIT_NODES = 2, 12
# The same at a kidnapped robot's odometry: nodes, and the distance between them, metres.
ODOMETRY_NODES, ODOMETRY_M = 3, 0.8


@dataclass(frozen=True, eq=False)
class PendingClosure:
    """A closure that is not accepted yet; ``correction`` would move the robot in the map frame."""

    constraint: Constraint
    correction: Pose2
    travelled_m: float
    how: How


def confirmed_by_others(
    waiting: list[PendingClosure], closure: PendingClosure, pose: Pose2
) -> list[PendingClosure]:
    """Return the closures that are now accepted, this one among them; often none.

    Args:
        waiting: the closures of the last nodes that wait for others to agree; changed in place.
        pose: that of the closure's node in the map frame, before any correction.
    """
    number = closure.constraint.end
    moved = closure.correction.compose(pose)
    waiting[:] = [c for c in waiting if number - c.constraint.end <= WAIT_NODES]
    if closure.how == "known" and is_same_place(pose, moved, SMALL_STEP_M, SMALL_STEP_RAD):
        return [closure]
    earlier = [c for c in waiting if c.constraint.end != number]
    agreeing = [c for c in earlier if is_same_place(c.correction.compose(pose), moved)]
    waiting.append(closure)
    least_nodes, least_m = AGREEING_NODES, 0.0
    if closure.how != "known":  # see ``Relocalization`` for those that are found anywhere
        least_nodes, least_m = ODOMETRY_NODES, ODOMETRY_M
    nodes = {c.constraint.end for c in agreeing}
    driven_m = closure.travelled_m - min((c.travelled_m for c in agreeing), default=math.inf)
    if len(nodes) + 1 < least_nodes or driven_m < least_m:
        return []
    if closure.how != "known" and len(earlier) - len(agreeing) >= len(nodes):
        return []
    waiting.clear()
    return [closure, *agreeing]


def is_same_place(
    one: Pose2, other: Pose2, most_m: float = AGREEMENT_M, most_rad: float = AGREEMENT_RAD
) -> bool:
    """Return whether two corrected poses of the robot are one place."""
    away = math.hypot(one.x - other.x, one.y - other.y)
    turn = abs(wrap_angle(one.yaw_rad - other.yaw_rad))
    return away <= most_m and turn <= most_rad


# Hypotheses tested per node, and kept at most: bounds on the time of a node.
TESTED, MOST_HYPOTHESES = 2, 12
# A hypothesis is accepted after this number of fitting nodes over this distance, metres: longer
# than rooms look alike. It is dropped after this number of consecutive misses: a door or a person
# may hide a place once or twice.
CONFIRMED_NODES, CONFIRMED_M, MISSES = 14, 4.0, 3
# One with fewer hits, or a smaller share of the best one's, is no rival.
RIVAL_HITS, RIVAL_SHARE = 2, 0.4


@dataclass(eq=False)
class RelocalizationHypothesis:
    """A motion of the map frame that may place the robot's map component.

    Attributes:
        misses: consecutive tests that it has failed.
        tested: node at which it was tested last.
    """

    correction: Pose2
    hits: list[PendingClosure] = field(default_factory=list)
    misses: int = 0
    tested: int = -1


@dataclass(frozen=True)
class LoopCandidate:
    """A submap to be searched, perhaps as a test of a hypothesis.

    ``expected`` is in the map frame, with an error of ``drift_m``; None: search everywhere.
    """

    index: int
    expected: Pose2 | None
    drift_m: float
    how: How = "known"
    hypothesis: RelocalizationHypothesis | None = None


# Submaps searched everywhere per node; and once each has been, nodes until the next round.
SEARCHED_AT_NODE, ROUND_NODES = 3, 4
# Error of the robot's expected pose, metres: at a kidnapped robot's odometry, with its growth per
# metre travelled; and at a hypothesis.
KIDNAPPED_DRIFT_M, DRIFT_SHARE, HYPOTHESIS_DRIFT_M = 1.2, 0.02, 0.6
# Failed searches at the odometry, one per node, after which the robot may be anywhere.
LOCAL_SEARCHES = 12
# A hypothesis is tested on an old submap where the robot was this near to where it is now, metres.
INSIDE_M = 0.5


class Relocalization(Stateful):
    """The search for a kidnapped robot in the other map components."""

    STATE = ("hypotheses", "_searched", "_failed_searches", "_kidnapped_m")

    def __init__(self) -> None:
        self.hypotheses: list[RelocalizationHypothesis] = []
        self._searched: dict[int, int] = {}
        self._failed_searches = 0
        self._kidnapped_m = 0.0

    def begin(self, travelled_m: float) -> None:
        """Start the search for a robot that was kidnapped after ``travelled_m``."""
        self.forget()
        self._failed_searches = 0
        self._kidnapped_m = travelled_m

    def forget(self) -> None:
        """Forget all searches and hypotheses."""
        self._searched, self.hypotheses = {}, []

    def add(self, hit: PendingClosure, pose: Pose2) -> RelocalizationHypothesis:
        """Add a closure to the hypothesis that agrees with it, or to a new one.

        ``pose`` is that of its node in the map frame, before any correction.
        """
        place = hit.correction.compose(pose)
        for one in self.hypotheses:
            if is_same_place(one.correction.compose(pose), place):
                break
        else:
            one = RelocalizationHypothesis(hit.correction)
            self.hypotheses.append(one)
        one.hits.append(hit)
        one.correction, one.misses = hit.correction, 0
        if len(self.hypotheses) > MOST_HYPOTHESES:
            self.hypotheses.remove(min(self.hypotheses, key=lambda other: len(other.hits)))
        return one

    def miss(self, one: RelocalizationHypothesis) -> None:
        """Count that a scan did not fit where a hypothesis predicts it."""
        one.misses += 1
        if one.misses >= MISSES and one in self.hypotheses:
            self.hypotheses.remove(one)

    def winner(self) -> RelocalizationHypothesis | None:
        """Return the hypothesis that enough scans support and that has no rival left."""
        if not self.hypotheses:
            return None
        best = max(self.hypotheses, key=lambda one: len(one.hits))
        enough = max(RIVAL_HITS, RIVAL_SHARE * len(best.hits))
        has_rival = any(len(one.hits) >= enough for one in self.hypotheses if one is not best)
        nodes = {hit.constraint.end for hit in best.hits}
        travelled = [hit.travelled_m for hit in best.hits]
        is_confirmed = (
            len(nodes) >= CONFIRMED_NODES and max(travelled) - min(travelled) >= CONFIRMED_M
        )
        return best if is_confirmed and not has_rival else None

    def candidates(self, graph: MapGraph, local_map: LocalMap, pose: Pose2) -> list[LoopCandidate]:
        """Return the submaps to search at a node, given the odometry's pose in the map frame."""
        if local_map.component_count < 2:
            return []
        others = local_map.in_other_components()
        away_m = local_map.distances_m(pose, graph.poses)
        # First near where odometry has it.
        drift_m = KIDNAPPED_DRIFT_M + DRIFT_SHARE * (graph.travelled_m - self._kidnapped_m)
        nearest = others[int(away_m[others].argmin())]
        candidates = [LoopCandidate(nearest, pose, drift_m, "odometry")]
        self._failed_searches += 1
        if self._failed_searches <= LOCAL_SEARCHES:
            return candidates
        # Then where hypotheses have it.
        for hypothesis in sorted(self.hypotheses, key=lambda one: one.tested)[:TESTED]:
            hypothesis.tested = len(graph.nodes)
            expected = hypothesis.correction.compose(pose)
            outside_m = local_map.distances_m(expected, graph.poses)[others]
            place = int(outside_m.argmin())
            if outside_m[place] < INSIDE_M:
                candidates.append(
                    LoopCandidate(
                        others[place], expected, HYPOTHESIS_DRIFT_M, "anywhere", hypothesis
                    )
                )
        # Then anywhere: submaps that have not been searched yet first, and of these the near ones.
        rounds = sorted(
            (self._searched.get(index, 0), float(away_m[index]), index)
            for index in _covering(others)
        )
        for times, _, index in rounds[:SEARCHED_AT_NODE]:
            if times == 0 or len(graph.nodes) % ROUND_NODES == 0:
                self._searched[index] = times + 1
                candidates.append(LoopCandidate(index, None, 0.0, "anywhere"))
        return candidates

    def confirmed(
        self, closure: PendingClosure, pose: Pose2, local_map: LocalMap
    ) -> list[PendingClosure]:
        """Return the closures found anywhere that are now accepted; often none."""
        self.add(closure, pose)
        winner = self.winner()
        to_search = _covering(local_map.in_other_components())
        if winner is None or any(index not in self._searched for index in to_search):
            return []
        return winner.hits


def _covering(submaps: list[int]) -> list[int]:
    """Return a subset of the submaps that contains every scan: neighbours overlap by half."""
    known = set(submaps)
    return [
        index
        for place, index in enumerate(submaps)
        if place % 2 == 0 or not {index - 1, index + 1} <= known
    ]


# A place is known where the robot has been in this number of submaps, and nodes: some visits make
# the map good, more would only make it larger. Its map is drawn from the nodes around the robot.
KNOWN_SUBMAPS, KNOWN_NODES = 6, 36
# Share of a scan's hits that may be unseen there; and where the robot comes into a known place, how
# far the scan may lie from where graph and odometry expect it, metres and radians.
KNOWN_UNSEEN, KNOWN_M, KNOWN_RAD = 0.05, 0.4, 0.2

# Why a closure is not accepted yet, in the published words of the health record.
PENDING = "not confirmed by another"

# Drift since a submap that the robot has just left, metres.
LEAST_DRIFT_M = 0.3
# Nodes between two searches of one submap, and submaps searched per node: bounds on a node's time.
RETRY_NODES, TRIES_PER_NODE = 2, 2


class LoopClosure(Stateful):
    """Searches older submaps for the newest node; it owns the pending closures."""

    STATE = ("_pending", "relocalization", "_last_searched", "_linked_m", "_failure_node")

    def __init__(
        self,
        config: GraphConfig,
        graph: MapGraph,
        local_map: LocalMap,
        search: ClosureSearch,
        health: GraphHealth,
    ) -> None:
        self.relocalization = Relocalization()
        self._config = config
        self._graph = graph
        self._local_map = local_map
        self._search = search
        self._health = health
        self._pending: list[PendingClosure] = []
        # By submap: the node last searched in it, and the distance travelled at the last closure.
        self._last_searched: dict[int, int] = {}
        self._linked_m: dict[int, float] = {}
        # The node at which tracking failed, until a closure joins the path before and after it.
        self._failure_node: int | None = None

    def tracking_failed(self) -> None:
        """Record that tracking has failed before the next node."""
        self._failure_node = len(self._graph.nodes)

    def close(self, number: int, points: F64, mean_score: float) -> None:
        """Search older submaps for a node, and solve the graph if due.

        Hits (P, 2) are in the robot's frame, metres; ``mean_score`` is the tracker's, 0 to 1.
        """
        graph, local_map = self._graph, self._local_map
        pose = graph.pose(number)
        kidnapped = self.relocalization.candidates(graph, local_map, pose)
        for candidate in (*kidnapped, *self._candidates(number, pose)):
            submap = local_map.submaps[candidate.index]
            self._last_searched[candidate.index] = number
            if candidate.expected is None:
                found = self._search.anywhere(submap, points, mean_score)
            else:
                local = graph.pose(submap.anchor).inverse().compose(candidate.expected)
                expected = wrapped_row_of(local)
                found = self._search.near(submap, points, expected, candidate.drift_m, mean_score)
            components = local_map.component_count
            self._take(candidate, number, pose, found)
            if local_map.component_count != components:
                break  # the other candidates were computed from the old pose
        graph.solve_if_due(number)

    # -- where to search -----------------------------------------------------------------------

    def around(self, pose: Pose2) -> I64:
        """Return the nodes nearest to a pose in the map frame, (K,), the nearest one first.

        A turn of ``minimum_travel_heading`` counts as much as ``minimum_travel_distance``.
        """
        config = self._config
        away = self._graph.poses[: self._local_map.settled_nodes] - row_of(pose)
        way_m, turn_rad = np.hypot(away[:, 0], away[:, 1]), np.abs(wrap_angles(away[:, 2]))
        steps = way_m * config.minimum_travel_heading + turn_rad * config.minimum_travel_distance
        return np.argsort(steps, kind="stable")[:KNOWN_NODES]

    def place(self, points: F64, pose: Pose2) -> Pose2 | None:
        """Return a pose in the frame of the map of known places; None if that shows too little.

        Hits (P, 2) are in the robot's frame, metres; the pose passed is in the map frame.
        """
        graph = self._graph
        drawn = self._local_map.draw(self.around(pose), graph.nodes, graph.poses)
        local = graph.pose(drawn.anchor).inverse().compose(pose)
        return local if self._search.unseen_share(drawn, points, local) <= KNOWN_UNSEEN else None

    def known_place(self, points: F64, local: Pose2, mean_score: float) -> Pose2 | None:
        """Return the robot's pose in the map of known places where it comes into one.

        None where the place is not well known: too few submaps are of it, or it shows something
        new.

        Args:
            points: (P, 2) hits in the robot's frame, metres.
            local: pose in the active submap's frame.
            mean_score: running mean score of the tracker, 0 to 1.
        """
        graph, local_map = self._graph, self._local_map
        least_scans = self._config.loop_match_minimum_chain_size
        # A robot that is lost, or a path with a gap, still needs nodes with closures.
        is_whole = local_map.component_count == 1 and self._failure_node is None
        is_short = local_map.active_submap.scans < least_scans
        if not (self._config.do_loop_closing and is_whole) or is_short:
            return None
        pose = graph.pose(local_map.active_submap.anchor).compose(local)
        is_near = local_map.distances_m(pose, graph.poses) < INSIDE_M
        if np.count_nonzero(is_near) < KNOWN_SUBMAPS:
            return None
        expected, drawn = self.place(points, pose), local_map.drawn
        if expected is None or drawn is None:
            return None
        row = wrapped_row_of(expected)
        found = self._search.near(drawn, points, row, LEAST_DRIFT_M, mean_score)
        if isinstance(found, str):
            return None
        there = pose_of(found.pose)
        if not is_same_place(there, expected, KNOWN_M, KNOWN_RAD):
            return None
        for index in np.flatnonzero(is_near).tolist():
            self._linked_m[index] = graph.travelled_m
        return there

    def _candidates(self, number: int, pose: Pose2) -> list[LoopCandidate]:
        """Return older submaps that the robot may be in again, the nearest ones."""
        config, local_map, graph = self._config, self._local_map, self._graph
        away_m = local_map.distances_m(pose, graph.poses)
        reach_m = config.loop_search_maximum_distance
        # Since the last node of each submap, half way through the following one.
        half, nodes = config.scan_buffer_size // 2, graph.nodes
        following = [submap.anchor for submap in local_map.submaps[1 : len(away_m) + 1]]
        travelled_m = graph.travelled_m - np.array(
            [nodes[min(anchor + half, len(nodes) - 1)].travelled_m for anchor in following]
        )
        if self._linked_m:
            linked = list(self._linked_m)
            since_m = graph.travelled_m - np.array(list(self._linked_m.values()))
            travelled_m[linked] = np.minimum(travelled_m[linked], since_m)
        drift_m = LEAST_DRIFT_M + DRIFT_SHARE * travelled_m
        found = []
        for index in np.flatnonzero(away_m < reach_m + drift_m + KIDNAPPED_DRIFT_M).tolist():
            submap, drift = local_map.submaps[index], float(drift_m[index])
            if self._failure_node is not None and submap.anchor < self._failure_node:
                drift += KIDNAPPED_DRIFT_M
            if (
                away_m[index] < reach_m + drift
                and submap.scans >= config.loop_match_minimum_chain_size
                and number - self._last_searched.get(index, -RETRY_NODES) >= RETRY_NODES
                and local_map.components[index] == local_map.active_component
            ):
                found.append((float(away_m[index]), index, drift))
        nearest = sorted(found)[:TRIES_PER_NODE]
        return [LoopCandidate(index, pose, drift) for _, index, drift in nearest]

    # -- what is found -------------------------------------------------------------------------

    def _take(self, candidate: LoopCandidate, number: int, pose: Pose2, found: Found | str) -> None:
        """Add a search's result to the graph, or count the reason for its rejection."""
        graph, health = self._graph, self._health
        health.closures_tried += 1
        if candidate.hypothesis is not None and found == LOW_RESPONSE:
            self.relocalization.miss(candidate.hypothesis)
        if isinstance(found, str):
            health.reject_closure(found)
            return

        # Which closures may be accepted now?
        anchor = self._local_map.submaps[candidate.index].anchor
        information = INFORMATION_SHARE * found.information
        constraint = Constraint(anchor, number, found.pose, information, is_closure=True)
        moved = graph.pose(anchor).compose(pose_of(found.pose))
        correction = moved.compose(pose.inverse())
        closure = PendingClosure(constraint, correction, graph.travelled_m, candidate.how)
        if closure.how == "anywhere":
            confirmed = self.relocalization.confirmed(closure, pose, self._local_map)
        else:
            confirmed = confirmed_by_others(self._pending, closure, pose)
        if not confirmed:
            health.reject_closure(PENDING)
            return

        graph.add_closures([one.constraint for one in confirmed])
        moved = correction.compose(pose)
        correction_m = math.hypot(moved.x - pose.x, moved.y - pose.y)
        health.largest_correction_m = max(health.largest_correction_m, correction_m)
        health.closures_accepted += len(confirmed)
        self._linked_m[candidate.index] = graph.travelled_m
        if self._failure_node is not None and anchor < self._failure_node <= number:
            self._failure_node = None
        if candidate.how != "known":
            other = self._local_map.components[candidate.index]
            is_joining, is_own = self._local_map.join(other, len(graph.nodes))
            graph.move_nodes(is_joining, correction if is_own else correction.inverse())
            health.relocalizations += 1
            self.relocalization.forget()
