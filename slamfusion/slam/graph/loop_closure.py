"""``LoopClosure``: older submaps are searched for new nodes, and what is found is believed or not.

What a search finds becomes a closure at once where it changes little; where it would move the robot
it is pending until others say the same. A kidnapped robot is searched too; once it is relocalized
the map component that it has begun joins the older one.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.config import GraphConfig
from slamfusion.geometry import Pose2
from slamfusion.slam.common.pose_rows import pose_of, wrapped_row_of
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.closure_search import LOW_RESPONSE, ClosureSearch, Found
from slamfusion.slam.graph.constraints import Constraint
from slamfusion.slam.graph.health import GraphHealth
from slamfusion.slam.graph.local_map import LocalMap
from slamfusion.slam.graph.loop_candidates import LoopCandidate
from slamfusion.slam.graph.map_graph import BELIEVED_SHARE, MapGraph
from slamfusion.slam.graph.pending_closures import PendingClosure, PendingClosures
from slamfusion.slam.graph.relocalization import DRIFT_SHARE, KIDNAPPED_DRIFT_M, Relocalization

F64 = npt.NDArray[np.float64]

# Why a closure is not accepted yet, in the published words of the health record.
PENDING = "not confirmed by another"

# Drift since a submap that the robot has just left, metres.
LEAST_DRIFT_M = 0.3
# Nodes between two searches of one submap, and submaps that are searched at a node: what a node may
# cost.
RETRY_NODES, TRIES_PER_NODE = 2, 2


class LoopClosure(Stateful):
    """Searches older submaps for the newest node; it owns the pending closures.

    Attributes:
        relocalization: the search for a kidnapped robot.
    """

    STATE = ("_pending", "relocalization", "_last_searched", "_linked_m", "_failure_node")

    def __init__(
        self,
        config: GraphConfig,
        graph: MapGraph,
        local_map: LocalMap,
        search: ClosureSearch,
        health: GraphHealth,
    ) -> None:
        """Take what it works on.

        Args:
            config: where closures are looked for.
            graph: that closures are added to.
            local_map: its submaps are searched.
            search: of one submap.
            health: where closures are counted.
        """
        self.relocalization = Relocalization()
        self._config = config
        self._graph = graph
        self._local_map = local_map
        self._search = search
        self._health = health
        self._pending = PendingClosures()
        # By submap: the node that was last searched in it, and the distance travelled when it was
        # last tied to the robot by a closure.
        self._last_searched: dict[int, int] = {}
        self._linked_m: dict[int, float] = {}
        # The node at which tracking has failed, until a closure ties what came after to what was
        # before.
        self._failure_node: int | None = None

    def kidnapped(self) -> None:
        """Take note that the robot was kidnapped after the last node."""
        self.relocalization.begin(self._graph.travelled_m)

    def tracking_failed(self) -> None:
        """Take note that tracking has failed before the next node."""
        self._failure_node = len(self._graph.nodes)

    def close(self, number: int, points: F64, mean_score: float) -> None:
        """Search older submaps for a node, and solve the graph where that is due.

        Args:
            number: of the node, the last one.
            points: (P, 2) its hits in the robot's frame, metres.
            mean_score: running mean score of the tracker, 0 to 1.
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
                break  # all else was expected where the robot is not
        graph.solve_if_due(number)

    # -- where to search -----------------------------------------------------------------------

    def _candidates(self, number: int, pose: Pose2) -> list[LoopCandidate]:
        """Return older submaps that the robot may be in again, the nearest ones."""
        config, local_map, travelled_m = self._config, self._local_map, self._graph.travelled_m
        away_m = local_map.distances_m(pose, self._graph.poses)
        reach_m = config.loop_search_maximum_distance
        farthest_m = reach_m + LEAST_DRIFT_M + DRIFT_SHARE * travelled_m + KIDNAPPED_DRIFT_M
        found = []
        for index in np.flatnonzero(away_m < farthest_m).tolist():
            submap = local_map.submaps[index]
            if submap.scans < config.loop_match_minimum_chain_size:
                continue
            if number - self._last_searched.get(index, -RETRY_NODES) < RETRY_NODES:
                continue
            if local_map.components[index] != local_map.active_component:
                continue
            drift_m = LEAST_DRIFT_M + DRIFT_SHARE * (travelled_m - self._tied_m(index))
            if self._failure_node is not None and submap.anchor < self._failure_node:
                drift_m += KIDNAPPED_DRIFT_M
            if away_m[index] < reach_m + drift_m:
                found.append((float(away_m[index]), index, drift_m))
        nearest = sorted(found)[:TRIES_PER_NODE]
        return [LoopCandidate(index, pose, drift_m) for _, index, drift_m in nearest]

    def _tied_m(self, index: int) -> float:
        """Return the distance travelled up to where a submap was last tied to the robot."""
        nodes = self._graph.nodes
        following = self._local_map.submaps[index + 1].anchor
        last = min(following + self._config.scan_buffer_size // 2, len(nodes) - 1)
        return max(nodes[last].travelled_m, self._linked_m.get(index, 0.0))

    # -- what is found -------------------------------------------------------------------------

    def _take(self, candidate: LoopCandidate, number: int, pose: Pose2, found: Found | str) -> None:
        """Take what a search has found into the graph, or count why not."""
        self._health.closures_tried += 1
        if candidate.hypothesis is not None and found == LOW_RESPONSE:
            self.relocalization.hypotheses.miss(candidate.hypothesis)
        if isinstance(found, str):
            self._health.reject_closure(found)
            return
        closure = self._closure(candidate, number, pose, found)
        confirmed = self._confirmed(closure, pose)
        if not confirmed:
            self._health.reject_closure(PENDING)
            return
        self._accept(candidate, closure, confirmed, pose)

    def _closure(
        self, candidate: LoopCandidate, number: int, pose: Pose2, found: Found
    ) -> PendingClosure:
        """Return what was found as a closure, which is not believed yet."""
        anchor = self._local_map.submaps[candidate.index].anchor
        information = BELIEVED_SHARE * found.information
        constraint = Constraint(anchor, number, found.pose, information, is_closure=True)
        there = self._graph.pose(anchor).compose(pose_of(found.pose))
        correction = there.compose(pose.inverse())
        return PendingClosure(constraint, correction, self._graph.travelled_m, candidate.how)

    def _confirmed(self, closure: PendingClosure, pose: Pose2) -> list[PendingClosure]:
        """Return the closures that may be believed now; often none."""
        if closure.how == "anywhere":
            return self.relocalization.confirmed(closure, pose, self._local_map)
        return self._pending.confirmed(closure, pose)

    def _accept(
        self,
        candidate: LoopCandidate,
        closure: PendingClosure,
        confirmed: list[PendingClosure],
        pose: Pose2,
    ) -> None:
        """Add closures that are believed to the graph; relocalize the robot where they do."""
        graph, health = self._graph, self._health
        graph.add_closures([one.constraint for one in confirmed])
        moved = closure.correction.compose(pose)
        correction_m = math.hypot(moved.x - pose.x, moved.y - pose.y)
        health.largest_correction_m = max(health.largest_correction_m, correction_m)
        health.closures_accepted += len(confirmed)
        self._linked_m[candidate.index] = graph.travelled_m
        start, end = closure.constraint.start, closure.constraint.end
        if self._failure_node is not None and start < self._failure_node <= end:
            self._failure_node = None
        if candidate.how != "known":
            self._relocalize(self._local_map.components[candidate.index], closure.correction)

    def _relocalize(self, other: int, correction: Pose2) -> None:
        """Join the robot's map component and another one, now that it is known how they lie.

        Args:
            other: the component where the robot was found.
            correction: what moves the robot's component, in the map frame.
        """
        graph, local_map = self._graph, self._local_map
        is_joining, is_own = local_map.join(other, len(graph.nodes))
        graph.move_nodes(is_joining, correction if is_own else correction.inverse())
        self._health.relocalizations += 1
        self.relocalization.forget()
