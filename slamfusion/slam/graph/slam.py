"""``GraphSlam``: the method from a scan to the map, one named step after the other.

Every scan is matched on the local map. A scan after some distance becomes a node; it is written
into the growing submaps and joined to them by constraints. Nodes that return to an older submap are
searched there; results that are neither degenerate nor contradicted become closures, and
the graph is solved again. Poses are kept relative to the local map, so following the robot never
waits for the graph.

Sources: Olson, ICRA 2009 [O09] (correlative matching, its covariance); Konolige et al., IROS 2010
[K10] and the parameters of open_karto; Hess et al., ICRA 2016 [H16c] (submaps, branch and bound).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2, pose_of, wrap_angle
from slamfusion.grid import IDENTITY, OccupancyGrid
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import BLIND, Closure, MapJob, Series, Step
from slamfusion.slam.common.matcher import PoseHypothesis
from slamfusion.slam.common.runner import FIRST_REPORTED
from slamfusion.slam.common.state import SavedMapper
from slamfusion.slam.graph.closure_search import ClosureSearch
from slamfusion.slam.graph.local_map import LocalMap
from slamfusion.slam.graph.localizer import Localizer, Observation
from slamfusion.slam.graph.loop_closure import LoopClosure, PendingClosure, RelocalizationHypothesis
from slamfusion.slam.graph.map_graph import (
    NO_NODE,
    Constraint,
    DrivenPath,
    GraphHealth,
    MapGraph,
    Solution,
)
from slamfusion.slam.graph.node_map import Node, NodeMap
from slamfusion.trajectory import Trajectory

# Time without a scan, seconds, above which it counts as a pause: the robot may have been moved.
PAUSE_S = 60.0


class GraphSlam(SavedMapper):
    """The graph SLAM behind the ``Mapper`` protocol."""

    name = "graph"
    STATE_FORMAT = 12
    STATE_KINDS = (
        Constraint,
        GraphHealth,
        Node,
        PendingClosure,
        RelocalizationHypothesis,
        Solution,
    )
    STATE = ("health", "last_stamp_s", "_localizer", "_graph", "_local_map", "_loops", "_path")

    def __init__(self, config: GraphConfig, device: ComputeDevice, seed: int = 0) -> None:
        self.health: GraphHealth = GraphHealth()
        self.last_stamp_s: float | None = None
        self._config, self._seed = config, seed
        rng = np.random.default_rng(seed)
        search = ClosureSearch(config, device, rng)
        self._local_map = LocalMap(config, device)
        self._localizer = Localizer(config, device, rng, self._local_map, search, self.health)
        self._graph = MapGraph(self.health)
        self._loops = LoopClosure(config, self._graph, self._local_map, search, self.health)
        self._path, self._map = DrivenPath(), NodeMap(config, device)

    # -- from a scan to the graph --------------------------------------------------------------

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        """Follow the robot to a scan; make it a node where it has gone far enough."""
        self.health.scans += 1
        last_s = self.last_stamp_s
        if last_s is not None and (pause_s := scan.stamp_s - last_s) > PAUSE_S:
            self.health.pauses += 1
            self.health.longest_pause_s = max(self.health.longest_pause_s, pause_s)

        self._graph.go_on()

        known = None if self._config.odometry == "none" else odometry
        hypotheses = self._localizer.hypotheses(scan.stamp_s, known)
        if self._localizer.pose is None:
            self._path.start = pose_of(hypotheses[0].pose)

        points = scan.points(scan.is_hit(self._config.usable_range_m))
        seen = Observation(scan, points, known)
        if len(points) == 0:
            step = self._skip(BLIND, hypotheses[0], seen)
        elif not self._graph.nodes:
            step = self._begin(seen, hypotheses[0])
        else:
            step = self._follow(seen, hypotheses)

        self.health.nodes = len(self._graph.nodes)
        self.health.submaps = len(self._local_map.submaps)
        self.health.map_components = max(1, self._local_map.component_count)
        self.last_stamp_s = scan.stamp_s
        return step

    def _follow(self, seen: Observation, hypotheses: list[PoseHypothesis]) -> Step:
        # Find the scan on the local map. Is the robot still there?
        found = self._localizer.localize(seen, hypotheses)
        self.health.scans_used += 1
        if found.status == "kidnapped":
            self.health.kidnappings += 1
            reason = "the robot is lost: a new submap starts, placed by odometry alone"
            self.health.skips.add(reason, self.health.scans)
            self._loops.relocalization.begin(self._graph.travelled_m)
            component = max(self._local_map.components) + 1  # the old ones stay as they are
            return self._begin_again(seen, found.local, component)
        if found.status == "failed":
            self.health.tracking_failures += 1
            self._loops.tracking_failed()
            return self._begin_again(seen, found.local, self._local_map.active_component)

        # Has it gone far enough for a node? In a known place none is needed.
        local = found.local
        if found.status == "unsure" or not self._is_far(local):
            return self._report(seen, local, found.score)
        mean_score = self._localizer.running_mean_score or 0.0
        if self._local_map.is_known:
            return self._follow_known(seen, local, found.score)
        if (place := self._loops.known_place(seen.points, local, mean_score)) is not None:
            return self._stay(seen, place, found.score)

        # Add the node to the graph, with constraints to the submaps and by odometry.
        moved = self._local_map.node_pose.inverse().compose(local)
        travelled_m = self._graph.travelled_m + math.hypot(moved.x, moved.y)
        anchor = self._local_map.active_submap.anchor
        pose = self._graph.pose(anchor).compose(local)
        number = self._graph.add_node(seen.node(travelled_m), pose)
        matches = self._local_map.constraints(number, seen.points, local, found.hessian)
        self._graph.add_matches(number, matches, moved)
        self._path.responses.append(seen.scan.stamp_s, found.score)

        # Write it into the local map, whose active submap may change.
        local = self._local_map.insert(number, self._graph.nodes[number], local)
        self._localizer.pose = local

        if self._config.do_loop_closing:
            self._loops.close(number, seen.points, mean_score)
        return self._report(seen, local, found.score)

    def _is_far(self, local: Pose2) -> bool:
        """Return whether a pose in the active submap is as far from the last one as nodes are."""
        moved = self._local_map.seen_from.inverse().compose(local)
        is_turned = abs(wrap_angle(moved.yaw_rad)) >= self._config.minimum_travel_heading
        way_m = math.hypot(moved.x, moved.y)
        return bool(is_turned or way_m >= self._config.minimum_travel_distance)

    def _stay(self, seen: Observation, place: Pose2, score: float) -> Step:
        """Follow the robot in the map of known places, from a pose there."""
        self._local_map.follow(place)
        self._localizer.pose = place
        return self._report(seen, place, score)

    def _follow_known(self, seen: Observation, local: Pose2, score: float) -> Step:
        """Stay in the known place; if its map shows too little of the scan, start a submap."""
        graph, local_map, loops = self._graph, self._local_map, self._loops
        moved = local_map.node_pose.inverse().compose(local)
        pose = graph.pose(local_map.node).compose(moved)
        if (place := loops.place(seen.points, pose)) is not None:
            return self._stay(seen, place, score)
        around = loops.around(pose)
        number = graph.add_node(seen.node(graph.travelled_m), pose)
        local = local_map.node_pose.compose(moved)  # the map may have been redrawn
        graph.constraints += local_map.constraints(number, seen.points, local, None)
        self._path.responses.append(seen.scan.stamp_s, score)
        local_map.leave(number, around, graph.nodes, graph.poses)
        self._localizer.pose = IDENTITY
        return self._report(seen, IDENTITY, score)

    def _report(
        self, seen: Observation, local: Pose2, score: float | None, reason: str = ""
    ) -> Step:
        """Report a pose in the active submap's frame as one in the map frame."""
        node = self._local_map.node
        moved = self._local_map.node_pose.inverse().compose(local)
        pose = self._graph.pose(node).compose(moved)
        pose = Pose2(pose.x, pose.y, wrap_angle(pose.yaw_rad))
        self._path.add(seen.scan.stamp_s, node, moved, pose)
        return Step(pose, not reason, score, reason)

    # -- where it begins -----------------------------------------------------------------------

    def _skip(self, reason: str, hypothesis: PoseHypothesis, seen: Observation) -> Step:
        """Skip a scan; the robot is where it is expected."""
        self.health.skips.add(reason, self.health.scans)
        local = pose_of(hypothesis.pose)
        self._localizer.advance(local, seen.odometry, seen.scan.stamp_s)
        if self._graph.nodes:
            return self._report(seen, local, None, reason)
        moved = self._path.start.inverse().compose(local)
        self._path.add(seen.scan.stamp_s, NO_NODE, moved, local)
        return Step(local, used=False, match_score=None, reason=reason)

    def _begin(self, seen: Observation, hypothesis: PoseHypothesis) -> Step:
        self._localizer.pose = None  # skipped scans have no place in the submap
        self._localizer.advance(IDENTITY, seen.odometry, seen.scan.stamp_s)
        self._graph.add_node(seen.node(0.0), pose_of(hypothesis.pose))
        self._local_map.begin(0, self._graph.nodes[0], component=0)
        self.health.scans_used += 1
        return self._report(seen, IDENTITY, None)

    def _begin_again(self, seen: Observation, local: Pose2, component: int) -> Step:
        """Start a submap that only odometry joins to the earlier ones; closures may move it."""
        before = self._local_map.node
        moved = self._local_map.node_pose.inverse().compose(local)
        odometry = None if self._local_map.is_known else self._graph.nodes[before].odometry
        if seen.odometry is not None and odometry is not None and not self._localizer.has_jumped:
            moved = odometry.inverse().compose(seen.odometry)
        travelled_m = self._graph.travelled_m + math.hypot(moved.x, moved.y)
        number = self._graph.add_beyond_gap(seen.node(travelled_m), before, moved)
        self._local_map.begin(number, self._graph.nodes[number], component)
        self._localizer.restart()
        return self._report(seen, IDENTITY, None)

    # -- what it has made ----------------------------------------------------------------------

    def trajectory(self, job: MapJob | None = None) -> Trajectory:
        """Return the pose at every scan by all that is known now, or by the poses of a map."""
        poses = self._graph.settled_poses() if job is None else job.poses
        return self._path.trajectory(poses, self.name)

    def other_paths(self) -> tuple[Trajectory, ...]:
        """Return the path as it was first reported."""
        return (self._path.as_reported(FIRST_REPORTED),)

    def closures(self) -> list[Closure]:
        """Return the closures of the graph, as the last solution judged them."""
        stamps = self._path.node_stamps()
        return [
            Closure(stamps[one.start], stamps[one.end], pose_of(one.motion), weight)
            for one, weight in self._graph.closures()
        ]

    def series(self) -> tuple[Series, ...]:
        """Return the series of the path; see ``Mapper.series``."""
        if not len(self._path.responses):
            return ()
        stamps, values = self._path.responses.array().T
        return (Series("response", "", stamps, values),)

    def grid(self) -> OccupancyGrid:
        """Return the map of all nodes at their poses of today; see ``Mapper.grid``."""
        return self._map.draw(self.map_job(is_settled=True))

    def map_drawer(self, device: ComputeDevice) -> Callable[[MapJob], OccupancyGrid]:
        """Return the drawer of maps on another device; see ``DrawsAside``."""
        return NodeMap(self._config, device).draw

    def map_job(self, *, is_settled: bool = False) -> MapJob:
        """Return what a ``NodeMap`` on another device draws the map from, in another thread.

        If ``is_settled``, by all closures, which may need a solution; else the call takes no time.
        SlamFusionError: no scan has been used yet.
        """
        if not self._graph.nodes:
            raise SlamFusionError(f"{self.name}: no scan could be used, so there is no map")
        poses = self._graph.settled_poses() if is_settled else self._graph.poses
        return MapJob(tuple(self._graph.nodes), poses.copy(), self.name)

    def memory_bytes(self) -> int:
        """Return the bytes of submaps, nodes and edges."""
        return self._local_map.memory_bytes + self._map.memory_bytes + self._graph.memory_bytes
