"""Graph SLAM: scans on submaps, loop closures, and a pose graph that makes them agree.

Every scan is matched on the submap that is growing. A scan after some way becomes a node; it is
written into the two submaps that overlap there and tied to both. Nodes that come back to an older
submap are searched there, near where they are expected or over a whole window; what is found, and
is neither open nor contradicted, becomes a closure, and the graph is solved again. Poses are kept
relative to the growing submap, so following the robot never waits for the graph.

Sources: Olson, ICRA 2009 [O09] (correlative matching, its covariance); Konolige et al., IROS 2010
[K10] and the parameters of open_karto; Hess et al., ICRA 2016 [H16c] (submaps, branch and bound).
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.compute.backend import Backend
from slamfusion.config import GraphConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2, compose_poses, wrap_angle
from slamfusion.grid import IDENTITY, OccupancyGrid
from slamfusion.pose_graph import Optimized
from slamfusion.scan import LaserScan
from slamfusion.slam.common import matcher
from slamfusion.slam.common.mapper import Closure, Health, Series, Step
from slamfusion.slam.common.matcher import Match, ScanOnTiles
from slamfusion.slam.common.response import information_of, response_information
from slamfusion.slam.common.state import (
    health_record,
    pose_record,
    read_state,
    recorded_pose,
    restore_health,
    restore_tracker,
    tracker_record,
    write_state,
)
from slamfusion.slam.common.tracking import Tracker
from slamfusion.slam.graph.closure_search import ClosureSearch, Found, How, Waiting, WaitingRoom
from slamfusion.slam.graph.constraints import Constraint, solve_constraints, turned
from slamfusion.slam.graph.node_map import MapJob, Node, NodeMap
from slamfusion.slam.graph.relocalization import Guess, Relocation
from slamfusion.slam.graph.submap import UNSEEN_WALL, Submap
from slamfusion.slam.graph.surfaces import fill_walls
from slamfusion.trajectory import Trajectory

__all__ = ["GraphHealth", "GraphSlam"]

F64 = npt.NDArray[np.float64]
NAME = "graph"

# A robot that has driven this far since a submap may have drifted by this share, and a bit.
DRIFT_SHARE = 0.02
LEAST_DRIFT_M = 0.3
# Of the hits that fall where the growing submap has seen something, a match is worth about as much
# as ever. One worth less than a share of the usual is bad: its scan is not mapped, and odometry is
# believed instead. So many in a row that fit better elsewhere, and the robot is lost.
BAD_SHARE, LOST_SCANS = 0.6, 4
# One scan is enough where odometry has been set anew meanwhile.
CARRIED_SHARE = 0.8
# So many bad ones of the last few, and what comes now may not lie rightly to what was before: the
# submap is ended there, and closures may bend the graph.
BREAK_BAD, BREAK_SCANS = 3, 10
# Of a scan most of whose hits fall into the unseen a match says little.
MOST_UNSEEN = 0.8
# The new submap is held to the old ones by next to nothing, and by odometry as far as the closures
# that come agree with it; metres and radians.
FREE_SIGMAS = (10.0, 10.0, 3.0)
LOST_SIGMAS = (0.3, 0.3, 0.2)
# So far from where odometry has it a lost robot is looked for first, metres.
LOST_DRIFT_M = 1.2
# A robot that is found again may be off by so much from what the first closure says.
REFOUND_DRIFT_M = 0.6
# Once every old submap has been searched all over, it is done again after so many nodes only.
ANYWHERE_NODES = 4
# Submaps that are searched all over at a node.
ANYWHERE_LOOKS = 3
# A lost robot is looked for where odometry has it; after so many nodes in vain it may be anywhere.
# A guess is tested where it puts the robot into an old submap.
IN_VAIN = 12
INSIDE_M = 0.5
# Hits on a wall are no farther apart in a submap, cells.
WALL_CELLS = 1.0
# Nodes between two searches of one submap, and submaps searched at a node.
RETRY_NODES = 2
TRIES_PER_NODE = 2
# Of what matches and odometry tell so much is believed: scans on one submap share its errors, and
# what wheels do wrong they do all the way. Without it true closures of long loops are doubted.
BELIEVED_SHARE = 0.5
# The graph is solved when so many nodes have come since, if there are new closures.
SOLVE_NODES = 30
# Up to so many new closures, and up to this share of them, are left out when they do not fit: all
# closures asked anew take many times as long. One more, and they are.
NEW_DOUBTS, NEW_DOUBTS_SHARE = 3, 1.0 / 6.0
# Odometry between nodes: metres and radians of error, fixed and for a metre and a radian.
ODOMETRY_M, ODOMETRY_M_PER_M = 0.05, 0.1
ODOMETRY_RAD, ODOMETRY_RAD_PER_RAD = 0.05, 0.1
# A step of odometry that differs from the matched one by more spreads is left out.
ODOMETRY_GATE = 3.0
# No scan for longer is named, seconds.
PAUSE_S = 60.0
STATE_FORMAT = 3
# Motion, information and ends of an edge.
EDGE_BYTES = 112


@dataclass
class GraphHealth(Health):
    """How well the graph is doing.

    Attributes:
        nodes: scans that became nodes.
        submaps: of which each holds some of them.
        restarts: times that the robot was lost and a submap of its own was begun.
        breaks: times that scans fitted badly for a while, and only odometry tells how what came
            after lies to what was before, until a closure does.
        refound: times that it was found again on submaps of before.
        parts: of the map, that nothing but odometry holds together; 1 for a whole one.
        closures_tried: searches of an older submap.
        closures_accepted: of these, the ones that became an edge.
        closures_rejected: by reason.
        closures_doubted: edges that the last solution left less than half of their weight.
        largest_correction_m: how far a closure has moved the robot at most.
        pauses: times that no scan came for more than PAUSE_S.
        longest_pause_s: the longest of them.
        chi2: of the graph after the last solution.
        solutions: how often it was solved.
        solve_s: duration of the last solution.
    """

    nodes: int = 0
    submaps: int = 0
    restarts: int = 0
    breaks: int = 0
    refound: int = 0
    parts: int = 1
    closures_tried: int = 0
    closures_accepted: int = 0
    closures_rejected: dict[str, int] = field(default_factory=dict)
    closures_doubted: int = 0
    largest_correction_m: float = 0.0
    pauses: int = 0
    longest_pause_s: float = 0.0
    chi2: float | None = None
    solutions: int = 0
    solve_s: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the record for a JSON document."""
        common = {item.name for item in fields(Health)}
        names = [item.name for item in fields(self) if item.name not in common]
        return {**super().to_json(), "graph": {name: getattr(self, name) for name in names}}

    def doubts(self) -> tuple[str, ...]:
        """Return what speaks against the map; see ``Health.doubts``."""
        sentences = []
        if self.parts > 1:
            sentences.append(
                f"the map is in {self.parts} parts: the robot was lost {self.restarts} times and "
                f"found again {self.refound} times; only odometry tells how the parts lie"
            )
        elif self.restarts:
            sentences.append(
                f"the robot was lost {self.restarts} times, and found again in the map each time; "
                "look at the map"
            )
        if self.breaks:
            sentences.append(
                f"scans fitted badly for a while {self.breaks} times: there only odometry and "
                "later closures tell how the map goes on; look at the map"
            )
        return tuple(sentences)


@dataclass(frozen=True)
class _Look:
    """A submap that is to be searched.

    Attributes:
        index: of the submap.
        expected: pose of the robot in the map frame; None: anywhere.
        drift_m: how far off that may be.
        how: it is looked for.
        guess: that this is to test; None for none.
    """

    index: int
    expected: Pose2 | None
    drift_m: float
    how: How = "known"
    guess: Guess | None = None


class _Boxes(NamedTuple):
    """Where the robot was in some finished submaps.

    Attributes:
        anchors: (S,) int64, numbers of their anchors.
        low: (S, 2) metres, lower-left corners of the robot's places in them.
        high: (S, 2) the other corners.
    """

    anchors: npt.NDArray[np.int64]
    low: F64
    high: F64

    @classmethod
    def of(cls, submaps: Sequence[Submap]) -> _Boxes:
        """Return those of some submaps; none is fine."""
        anchors = np.array([submap.anchor for submap in submaps], dtype=np.int64)
        low = np.array([submap.low for submap in submaps]).reshape(-1, 2)
        return cls(anchors, low, np.array([submap.high for submap in submaps]).reshape(-1, 2))


class GraphSlam:
    """The graph SLAM behind the ``Mapper`` protocol.

    Attributes:
        name: ``graph``.
        health: the record so far.
        last_stamp_s: time of the last scan; None before the first.
    """

    name = NAME

    def __init__(self, config: GraphConfig, backend: Backend, seed: int = 0) -> None:
        """Start with an empty graph.

        Args:
            config: see ``GraphConfig``.
            backend: where the maps live.
            seed: of the matcher's draws.
        """
        self.health: GraphHealth = GraphHealth()
        self.last_stamp_s: float | None = None
        self._config = config
        self._backend = backend
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self._tracker = Tracker(
            config.matcher,
            backend,
            self._rng,
            self.health,
            searches_again=False,
            resolves_degeneracy=True,
        )
        self._nodes: list[Node] = []
        self._node_bytes = 0
        self._poses = np.zeros((0, 3))
        self._edges: list[Constraint] = []
        # Of the edges that there were at the last solution.
        self._weights = np.zeros(0)
        self._submaps: list[Submap] = []
        # The submap in whose frame the robot is followed; the next one grows beside it.
        self._active = 0
        # Of the submaps before that one, which change no more.
        self._old = _Boxes.of([])
        self._start = IDENTITY
        self._node_pose = IDENTITY
        self._travelled_m = 0.0
        # Where a submap was begun, in the frame of the one before it.
        self._begun: dict[tuple[int, int], Pose2] = {}
        self._map = NodeMap(config, backend)
        self._search = ClosureSearch(config, backend, self._rng)
        self._waiting = WaitingRoom()
        self._relocation = Relocation()
        self._is_urgent = False
        self._settled: tuple[int, F64] | None = None
        self._bad_row = 0
        # Numbers of the bad scans among the last few; and the node at which a submap was begun
        # because of them, until a closure tells how it lies to those before.
        self._bad: list[int] = []
        self._broken_at: int | None = None
        # Submaps of one part are placed to each other by matches; those of another, begun by a
        # robot that was lost, are not.
        self._parts: list[int] = []
        # How often submaps of other parts were searched all over.
        self._searched: dict[int, int] = {}
        # Searches for a lost robot where odometry has it, and its way when it was lost.
        self._in_vain = 0
        self._lost_m = 0.0
        self._last_tried: dict[int, int] = {}
        self._linked_m: dict[int, float] = {}
        self._unsolved = 0
        self._solved_at = 0
        self._new_doubts = 0
        self._scans: list[tuple[float, int, tuple[float, float, float]]] = []
        self._online: list[tuple[float, float, float]] = []
        self._responses: list[tuple[float, float]] = []

    # -- the protocol --------------------------------------------------------------------------

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        """Follow the robot to a scan; make it a node where it has gone far enough."""
        self.health.scans += 1
        self._count_pause(scan.stamp_s)
        known = None if self._config.odometry == "none" else odometry
        hypotheses = self._tracker.hypotheses(scan.stamp_s, known)
        if self._tracker.pose is None:
            self._start = _pose(hypotheses[0].pose)
        points = scan.points(scan.is_hit(self._config.usable_range_m))
        if len(points) == 0:
            step = self._skip("no reading within the usable range", hypotheses[0], scan, known)
        elif not self._nodes:
            step = self._begin(scan, points, known)
        else:
            step = self._follow(scan, points, known, hypotheses)
        self.last_stamp_s = scan.stamp_s
        pose = step.pose_map_base
        self._online.append((pose.x, pose.y, pose.yaw_rad))
        return step

    def _count_pause(self, stamp_s: float) -> None:
        pause_s = 0.0 if self.last_stamp_s is None else stamp_s - self.last_stamp_s
        if pause_s > PAUSE_S:
            self.health.pauses += 1
            self.health.longest_pause_s = max(self.health.longest_pause_s, pause_s)

    def trajectory(self) -> Trajectory:
        """Return the pose at every scan by all that is known now."""
        poses = self._settled_poses()
        stamps = np.array([stamp for stamp, _, _ in self._scans])
        nodes = np.array([node for _, node, _ in self._scans], dtype=np.int64)
        motions = np.array([motion for _, _, motion in self._scans]).reshape(-1, 3)
        before = np.array([[self._start.x, self._start.y, self._start.yaw_rad]])
        frames = np.concatenate((poses, before))  # -1: before the first node
        return Trajectory(stamps, compose_poses(frames[nodes], motions), self.name)

    def other_paths(self) -> tuple[Trajectory, ...]:
        """Return the path as it was first reported."""
        stamps = np.array([stamp for stamp, _, _ in self._scans])
        return (Trajectory(stamps, np.array(self._online).reshape(-1, 3), "as first reported"),)

    def closures(self) -> list[Closure]:
        """Return the closures of the graph, as the last solution judged them."""
        stamps: dict[int, float] = {}
        for stamp, node, _ in self._scans:
            stamps.setdefault(node, stamp)
        new = len(self._edges) - len(self._weights)
        weights = np.concatenate((self._weights, np.ones(new)))
        return [
            Closure(stamps[edge.start], stamps[edge.end], _pose(edge.motion), float(weight))
            for edge, weight in zip(self._edges, weights, strict=True)
            if edge.is_closure
        ]

    def series(self) -> tuple[Series, ...]:
        """Return the response of the nodes' matches."""
        if not self._responses:
            return ()
        stamps, values = np.array(self._responses).T
        return (Series("response", "", stamps, values),)

    def grid(self) -> OccupancyGrid:
        """Return the map of all nodes at their poses of today; see ``Mapper.grid``."""
        return self._map.draw(self.map_job(is_settled=True))

    def map_job(self, *, is_settled: bool = False) -> MapJob:
        """Return what a ``NodeMap`` on another backend draws the map from, in another thread.

        Args:
            is_settled: as for ``grid``, by all closures, which may take a solution; else those
                since the last solution are not in it, and asking takes no time.

        Raises:
            SlamFusionError: no scan has been used yet.
        """
        if not self._nodes:
            message = f"{self.name}: no scan could be used, so there is no map"
            raise SlamFusionError(message)
        poses = self._settled_poses() if is_settled else self._poses
        return MapJob(tuple(self._nodes), poses.copy(), self.name)

    def memory_bytes(self) -> int:
        """Return the bytes of submaps, nodes and edges."""
        submaps = sum(submap.memory_bytes for submap in self._submaps)
        return submaps + self._map.memory_bytes + self._node_bytes + EDGE_BYTES * len(self._edges)

    # -- one scan ------------------------------------------------------------------------------

    def _skip(
        self, reason: str, guess: matcher.PoseHypothesis, scan: LaserScan, known: Pose2 | None
    ) -> Step:
        self.health.skips.add(reason, self.health.scans)
        local = _pose(guess.pose)
        self._tracker.advance(local, known, scan.stamp_s)
        if not self._nodes:
            moved = self._start.inverse().compose(local)
            self._scans.append((scan.stamp_s, -1, (moved.x, moved.y, moved.yaw_rad)))
            return Step(local, used=False, match_score=None, reason=reason)
        return self._report(scan, local, None, reason)

    def _begin(self, scan: LaserScan, points: F64, known: Pose2 | None) -> Step:
        """Make the first node."""
        pose = _pose(self._tracker.hypotheses(scan.stamp_s, known)[0].pose)
        self._tracker.pose = None  # from now on relative to the first node
        self._add_node(scan, points, known, pose)
        self._append_submap(0, part=0)
        self._submaps[0].insert(*self._written(0), IDENTITY)
        self.health.scans_used += 1
        self._tracker.advance(IDENTITY, known, scan.stamp_s)
        return self._report(scan, IDENTITY, None)

    def _follow(
        self,
        scan: LaserScan,
        points: F64,
        known: Pose2 | None,
        hypotheses: list[matcher.PoseHypothesis],
    ) -> Step:
        """Match a scan on the growing submap; make it a node where it is due."""
        submap, usual = self._submaps[self._active], self._tracker.running_mean_score
        match = self._tracker.match(submap.walls(), points, hypotheses)
        fit = self._fit(submap, points, match, usual)
        at, bend, is_sure = match.pose, match.hessian, True
        if fit < BAD_SHARE and usual is not None:
            bend = None
            at, is_sure = self._search.around(
                submap, points, hypotheses[0].pose, usual, by_odometry=len(hypotheses) > 1
            )
        local = _pose(at)
        self._tracker.advance(local, known, scan.stamp_s)
        self.health.scans_used += 1
        self._bad_row = 0 if is_sure else self._bad_row + 1
        # Odometry is set anew where the robot was switched off: it may have been carried.
        is_carried = self._tracker.has_jumped and fit < CARRIED_SHARE
        if self._bad_row >= LOST_SCANS or is_carried:
            return self._lose(scan, points, known, local)
        if self._is_broken(is_bad=fit < BAD_SHARE) and is_sure:
            return self._break(scan, points, known, local)
        if not is_sure:
            return self._report(scan, local, match.score)
        moved = self._node_pose.inverse().compose(local)
        way, turn = math.hypot(moved.x, moved.y), abs(wrap_angle(moved.yaw_rad))
        config = self._config
        if way < config.minimum_travel_distance and turn < config.minimum_travel_heading:
            return self._report(scan, local, match.score)
        self._travelled_m += way
        pose = _pose(self._poses[submap.anchor]).compose(local)
        self._responses.append((scan.stamp_s, match.score))
        number = self._add_node(scan, points, known, pose)
        self._tie(number, points, local, bend)
        local = self._grow(number, local)
        self._tracker.pose = local  # another submap may be the growing one now
        if config.do_loop_closing:
            self._close_loops(number, points)
        return self._report(scan, local, match.score)

    def _fit(self, submap: Submap, points: F64, match: Match, usual: float | None) -> float:
        """Return what a match is worth where the submap has seen something, to the usual."""
        if usual is None or match.score >= CARRIED_SHARE * usual:
            return 1.0
        scan = ScanOnTiles(self._backend, submap.walls(), points, self._config.matcher.beams)
        unseen = scan.unseen_share(match.pose, UNSEEN_WALL)
        if unseen >= MOST_UNSEEN:
            return 1.0
        return (match.score - unseen * UNSEEN_WALL / 255.0) / (1.0 - unseen) / usual

    def _is_broken(self, *, is_bad: bool) -> bool:
        """Return whether too many of the last scans were bad."""
        number = self.health.scans
        self._bad = [bad for bad in self._bad if number - bad < BREAK_SCANS]
        if is_bad:
            self._bad.append(number)
        return len(self._bad) >= BREAK_BAD

    def _lose(self, scan: LaserScan, points: F64, known: Pose2 | None, local: Pose2) -> Step:
        """Begin a part for a lost robot; the old ones stay as they are."""
        self.health.restarts += 1
        self._look_anew()
        self._in_vain = 0
        self._lost_m = self._travelled_m
        reason = "the robot is lost: a new submap begins, placed by odometry alone"
        self.health.skips.add(reason, self.health.scans)
        return self._begin_again(scan, points, known, local, part=max(self._parts) + 1)

    def _break(self, scan: LaserScan, points: F64, known: Pose2 | None, local: Pose2) -> Step:
        """Begin a submap where scans have fitted badly for a while."""
        self.health.breaks += 1
        self._broken_at = len(self._nodes)
        return self._begin_again(scan, points, known, local, part=self._parts[self._active])

    def _begin_again(
        self, scan: LaserScan, points: F64, known: Pose2 | None, local: Pose2, part: int
    ) -> Step:
        """Begin a submap that odometry alone ties to those before, and closures may move."""
        before = len(self._nodes) - 1
        moved = self._node_pose.inverse().compose(local)
        odometry = self._nodes[before].odometry
        if known is not None and odometry is not None and not self._tracker.has_jumped:
            moved = odometry.inverse().compose(known)
        self._travelled_m += math.hypot(moved.x, moved.y)
        pose = _pose(self._poses[before]).compose(moved)
        number = self._add_node(scan, points, known, pose)
        for sigmas, is_closure in ((FREE_SIGMAS, False), (LOST_SIGMAS, True)):
            information = np.diag(np.square(1.0 / np.array(sigmas)))
            tie = Constraint(before, number, _vector(moved), information, is_closure=is_closure)
            self._edges.append(tie)
        for submap in self._submaps[self._active :]:
            submap.finish()
        self._append_submap(number, part=part)
        self._active = len(self._submaps) - 1
        self._submaps[self._active].insert(*self._written(number), IDENTITY)
        self._node_pose = self._tracker.pose = IDENTITY
        self._bad_row, self._bad = 0, []
        return self._report(scan, IDENTITY, None)

    def _report(
        self,
        scan: LaserScan,
        local: Pose2,
        score: float | None,
        reason: str = "",
    ) -> Step:
        """Tell a pose in the growing submap's frame in the map frame."""
        last = len(self._nodes) - 1
        moved = self._node_pose.inverse().compose(local)
        self._scans.append((scan.stamp_s, last, (moved.x, moved.y, moved.yaw_rad)))
        pose = _pose(self._poses[last]).compose(moved)
        return Step(_wrapped(pose), not reason, score, reason)

    # -- nodes and submaps -----------------------------------------------------------------------

    def _new_submap(self, anchor: int) -> Submap:
        config = self._config
        return Submap(
            self._backend,
            anchor,
            config.resolution,
            config.correlation_search_space_smear_deviation,
        )

    def _append_submap(self, anchor: int, part: int) -> Submap:
        submap = self._new_submap(anchor)
        self._submaps.append(submap)
        self._parts.append(part)
        self.health.submaps, self.health.parts = len(self._submaps), len(set(self._parts))
        return submap

    def _add_node(
        self,
        scan: LaserScan,
        points: F64,
        known: Pose2 | None,
        pose: Pose2,
    ) -> int:
        laser = np.array([scan.mount.x, scan.mount.y], dtype=np.float32)
        self._keep(Node(points.astype(np.float32), laser, self._travelled_m, known))
        self._poses = np.vstack((self._poses, (pose.x, pose.y, wrap_angle(pose.yaw_rad))))
        self.health.nodes = len(self._nodes)
        return len(self._nodes) - 1

    def _keep(self, node: Node) -> None:
        self._nodes.append(node)
        self._node_bytes += node.ends.nbytes

    def _written(self, number: int) -> tuple[F64, F64]:
        """Return a node's walls and laser as a submap takes them."""
        node = self._nodes[number]
        laser = node.laser.astype(np.float64)
        return fill_walls(node.points(), laser, WALL_CELLS * self._config.resolution), laser

    def _tie(self, number: int, points: F64, local: Pose2, bend: F64 | None) -> None:
        """Tie a node to the anchors of the submaps that it is written into, and to odometry.

        Args:
            number: of the node.
            points: (P, 2) its hits in the robot's frame, metres.
            local: its pose in the growing submap.
            bend: (3, 3) of the response there; None: not measured yet.
        """
        active = self._submaps[self._active]
        if bend is None:
            scan = ScanOnTiles(self._backend, active.walls(), points, self._config.matcher.beams)
            information = response_information(scan, _vector(local))
        else:
            information = information_of(bend)
        information = BELIEVED_SHARE * information
        self._edges.append(Constraint(active.anchor, number, _vector(local), information))
        if self._active + 1 < len(self._submaps):
            other = self._submaps[self._active + 1]
            between = self._between(active, other)
            motion = _vector(between.inverse().compose(local))
            seen = turned(information, -between.yaw_rad)
            self._edges.append(Constraint(other.anchor, number, motion, seen))
        node, before = self._nodes[number], self._nodes[number - 1]
        if node.odometry is None or before.odometry is None:
            return
        step = before.odometry.inverse().compose(node.odometry)
        way, turn = math.hypot(step.x, step.y), abs(wrap_angle(step.yaw_rad))
        sigmas = np.array(
            [ODOMETRY_M + ODOMETRY_M_PER_M * way] * 2 + [ODOMETRY_RAD + ODOMETRY_RAD_PER_RAD * turn]
        )
        found = self._node_pose.inverse().compose(local)
        away = _vector(step.inverse().compose(found))
        away[2] = wrap_angle(away[2])
        if (np.abs(away / sigmas) < ODOMETRY_GATE).all():
            information = BELIEVED_SHARE * np.diag(sigmas**-2.0)
            self._edges.append(Constraint(number - 1, number, _vector(step), information))

    def _between(self, one: Submap, other: Submap) -> Pose2:
        """Return the pose of a growing submap in the frame of another, as it was begun."""
        return self._begun[(one.anchor, other.anchor)]

    def _grow(self, number: int, local: Pose2) -> Pose2:
        """Write a node into the growing submaps; return its pose in the one that is active then."""
        config, points = self._config, self._written(number)
        active = self._submaps[self._active]
        active.insert(*points, local)
        if self._active + 1 < len(self._submaps):
            other = self._submaps[self._active + 1]
            inside = self._between(active, other).inverse().compose(local)
            other.insert(*points, inside)
            if active.scans >= config.scan_buffer_size:
                active.finish()
                self._active += 1
                local = inside
        elif active.scans >= config.scan_buffer_size // 2:
            self._begun[(active.anchor, number)] = local
            begun = self._append_submap(number, part=self._parts[-1])
            begun.insert(*points, IDENTITY)
        self._node_pose = local
        return local

    # -- closures --------------------------------------------------------------------------------

    def _close_loops(self, number: int, points: F64) -> None:
        """Search older submaps for a node."""
        pose = _pose(self._poses[number])
        usual = self._tracker.running_mean_score or 0.0
        for look in (*self._lost_looks(pose), *self._looks(number, pose)):
            submap = self._submaps[look.index]
            self._last_tried[look.index] = number
            if look.expected is None:
                found = self._search.anywhere(submap, points, usual)
            else:
                local = _pose(self._poses[submap.anchor]).inverse().compose(look.expected)
                found = self._search.near(submap, points, _vector(local), look.drift_m, usual)
            parts = self.health.parts
            self._count_closure(look, number, pose, found)
            if self.health.parts != parts:
                break  # all else was looked for where the robot is not
        is_due = number - self._solved_at >= SOLVE_NODES
        if self._unsolved and (is_due or self._is_urgent):
            self._solve()

    def _count_closure(self, look: _Look, number: int, pose: Pose2, found: Found | str) -> None:
        """Take what a search has found into the graph, or count why not."""
        self.health.closures_tried += 1
        reason = found if isinstance(found, str) else self._believe(look, number, pose, found)
        if look.guess is not None and found == "low response":
            self._relocation.miss(look.guess)
        if reason:
            rejected = self.health.closures_rejected
            rejected[reason] = rejected.get(reason, 0) + 1
        else:
            self._unsolved += 1

    def _believe(self, look: _Look, number: int, pose: Pose2, found: Found) -> str:
        """Accept a closure that changes little, or that others confirm; or say why not."""
        anchor = self._submaps[look.index].anchor
        information = BELIEVED_SHARE * found.information
        edge = Constraint(anchor, number, found.pose, information, is_closure=True)
        there = _pose(self._poses[anchor]).compose(_pose(found.pose))
        correction = there.compose(pose.inverse())
        closure = Waiting(edge, correction, self._travelled_m, look.how)
        confirmed = self._confirmed(closure, pose)
        if not confirmed:
            return "not confirmed by another"
        self._edges += [one.edge for one in confirmed]
        moved = correction.compose(pose)
        correction_m = math.hypot(moved.x - pose.x, moved.y - pose.y)
        self.health.largest_correction_m = max(self.health.largest_correction_m, correction_m)
        self.health.closures_accepted += len(confirmed)
        self._linked_m[look.index] = self._travelled_m
        self._is_urgent = self._is_urgent or len(confirmed) > 1
        if self._broken_at is not None and anchor < self._broken_at <= number:
            self._broken_at = None
        if look.how != "known":
            self._join(self._parts[look.index], correction)
        return ""

    def _confirmed(self, closure: Waiting, pose: Pose2) -> list[Waiting]:
        """Return the closures that may be believed now; often none."""
        if closure.how != "anywhere":
            return self._waiting.confirmed(closure, pose)
        self._relocation.add(closure, pose)
        winner = self._relocation.winner()
        if winner is None or any(index not in self._searched for index in self._to_search()):
            return []
        return winner.hits

    def _join(self, other: int, correction: Pose2) -> None:
        """Put the robot's part to another one, now that it is known how they lie.

        Args:
            other: the part where the robot was seen.
            correction: what moves the robot's part, in the map frame.
        """
        own = self._parts[self._active]
        moved, kept = (own, other) if own > other else (other, own)
        move = correction if moved == own else correction.inverse()
        nodes = np.array(
            [self._part_of_node(number) == moved for number in range(len(self._nodes))]
        )
        moves = np.broadcast_to(_vector(move), (int(nodes.sum()), 3))
        self._poses[nodes] = compose_poses(moves, self._poses[nodes])
        self._parts = [kept if part == moved else part for part in self._parts]
        self.health.parts = len(set(self._parts))
        self.health.refound += 1
        self._look_anew()

    def _look_anew(self) -> None:
        """Forget what was searched for a lost robot, and what was guessed."""
        self._searched = {}
        self._relocation = Relocation()

    def _part_of_node(self, number: int) -> int:
        """Return the part of the submap that a node was matched on."""
        anchors = [submap.anchor for submap in self._submaps]
        return self._parts[bisect.bisect_right(anchors, number) - 1]

    def _lost_looks(self, pose: Pose2) -> list[_Look]:
        """Return where to look for a robot that is lost: all over, or where it may have been seen.

        Args:
            pose: of the robot if it were where odometry alone has it.
        """
        if self.health.parts < 2:
            return []
        others = self._others()
        away_m = self._distances_m(pose)
        drift_m = LOST_DRIFT_M + DRIFT_SHARE * (self._travelled_m - self._lost_m)
        looks = [_Look(others[int(away_m[others].argmin())], pose, drift_m, "odometry")]
        self._in_vain += 1
        if self._in_vain <= IN_VAIN:
            return looks
        for guess in self._relocation.to_test():
            guess.tested = len(self._nodes)
            expected = guess.correction.compose(pose)
            outside_m = self._distances_m(expected)[others]
            nearest = int(outside_m.argmin())
            if outside_m[nearest] < INSIDE_M:
                looks.append(_Look(others[nearest], expected, REFOUND_DRIFT_M, "anywhere", guess))
        # The ones that have not been searched yet first, and of these the near ones.
        rounds = sorted(
            (self._searched.get(index, 0), float(away_m[index]), index)
            for index in self._to_search()
        )
        for times, _, index in rounds[:ANYWHERE_LOOKS]:
            if times == 0 or len(self._nodes) % ANYWHERE_NODES == 0:
                self._searched[index] = times + 1
                looks.append(_Look(index, None, 0.0, "anywhere"))
        return looks

    def _to_search(self) -> list[int]:
        """Return submaps that together hold every scan of the other parts: all overlap by half."""
        others = self._others()
        known = set(others)
        return [
            index
            for place, index in enumerate(others)
            if place % 2 == 0 or not {index - 1, index + 1} <= known
        ]

    def _others(self) -> list[int]:
        """Return the submaps of other parts than the robot's."""
        own = self._parts[self._active]
        return [index for index in range(self._active) if self._parts[index] != own]

    def _looks(self, number: int, pose: Pose2) -> list[_Look]:
        """Return older submaps that the robot may be in again, with how far it may have drifted."""
        config = self._config
        away_m = self._distances_m(pose)
        reach_m = config.loop_search_maximum_distance
        farthest_m = reach_m + LEAST_DRIFT_M + DRIFT_SHARE * self._travelled_m + LOST_DRIFT_M
        found = []
        for index in np.flatnonzero(away_m < farthest_m).tolist():
            submap = self._submaps[index]
            if submap.scans < config.loop_match_minimum_chain_size:
                continue
            if number - self._last_tried.get(index, -RETRY_NODES) < RETRY_NODES:
                continue
            if self._parts[index] != self._parts[self._active]:
                continue
            since_m = self._travelled_m - self._linked(index)
            drift_m = LEAST_DRIFT_M + DRIFT_SHARE * since_m
            if self._broken_at is not None and submap.anchor < self._broken_at:
                drift_m += LOST_DRIFT_M
            if away_m[index] < reach_m + drift_m:
                found.append((float(away_m[index]), index, drift_m))
        return [_Look(index, pose, drift_m) for _, index, drift_m in sorted(found)[:TRIES_PER_NODE]]

    def _distances_m(self, pose: Pose2) -> F64:
        """Return how far a pose in the map frame is from where the robot was in old submaps, (S,).

        Of the submaps before the growing one, in their order; 0 within a box around its places.
        """
        if len(self._old.anchors) != self._active:
            self._old = _Boxes.of(self._submaps[: self._active])
        low, high = self._old.low, self._old.high
        anchors = self._poses[self._old.anchors]
        x, y = pose.x - anchors[:, 0], pose.y - anchors[:, 1]
        cos, sin = np.cos(anchors[:, 2]), np.sin(anchors[:, 2])
        places = np.column_stack((cos * x + sin * y, cos * y - sin * x))
        outside = np.maximum(low - places, places - high).clip(min=0.0)
        return np.asarray(np.hypot(outside[:, 0], outside[:, 1]))

    def _linked(self, index: int) -> float:
        """Return the robot's way up to where a submap was last tied to it."""
        following = self._submaps[index + 1].anchor
        own = self._nodes[min(following + self._config.scan_buffer_size // 2, len(self._nodes) - 1)]
        return max(own.travelled_m, self._linked_m.get(index, 0.0))

    # -- the graph -------------------------------------------------------------------------------

    def _settled_poses(self) -> F64:
        """Return the nodes' poses by all closures; asking changes nothing of how it goes on."""
        if not (self._unsolved or self._new_doubts):
            return self._poses
        if self._settled is None or self._settled[0] != len(self._edges):
            self._settled = (len(self._edges), self._solution().poses)
        return self._settled[1]

    def _solution(self) -> Optimized:
        """Return the solution by all closures, also of those left out without asking all anew."""
        weights = None if self._new_doubts else self._weights
        return solve_constraints(self._poses, self._edges, weights)

    def _solve(self) -> None:
        """Solve the graph and take over its poses."""
        share = int(NEW_DOUBTS_SHARE * self._unsolved)
        tolerated = min(NEW_DOUBTS - self._new_doubts, share)
        solved = solve_constraints(self._poses, self._edges, self._weights, tolerated)
        self._poses, self._weights = solved.poses, solved.weights
        self.health.chi2, self.health.solve_s = solved.chi2, solved.time_s
        doubted = int(solved.is_doubted.sum())
        more = max(0, doubted - self.health.closures_doubted)
        self._new_doubts = 0 if solved.is_asked_anew else self._new_doubts + more
        self.health.closures_doubted = doubted
        self.health.solutions += 1
        self._unsolved, self._is_urgent = 0, False
        self._solved_at = len(self._nodes) - 1

    # -- state ---------------------------------------------------------------------------------

    def save_state(self, path: Path) -> None:
        """Write graph, scans and submaps; whole or not at all."""
        hits = [hit for guess in self._relocation.guesses for hit in guess.hits]
        waiting = [*self._waiting.pending, *hits]
        edges = [*self._edges, *(one.edge for one in waiting)]
        record = {
            "health": health_record(self.health),
            "tracker": tracker_record(self._tracker),
            "last_stamp_s": self.last_stamp_s,
            "start": pose_record(self._start),
            "node_pose": pose_record(self._node_pose),
            "numbers": {name: getattr(self, name) for name in _PLAIN},
            "odometry": [pose_record(node.odometry) for node in self._nodes],
            "travelled_m": [node.travelled_m for node in self._nodes],
            "begun": [[*key, *_vector(pose).tolist()] for key, pose in self._begun.items()],
            "last_tried": list(self._last_tried.items()),
            "searched": list(self._searched.items()),
            "linked_m": list(self._linked_m.items()),
            "bad": self._bad,
            "parts": self._parts,
            "edges": len(self._edges),
            "waiting": [[pose_record(one.correction), one.travelled_m, one.how] for one in waiting],
            "pending": len(self._waiting.pending),
            "guesses": [
                [len(guess.hits), pose_record(guess.correction), guess.misses, guess.tested]
                for guess in self._relocation.guesses
            ],
        }
        arrays: dict[str, npt.NDArray[Any]] = {
            "poses": self._poses,
            "weights": self._weights,
            "node_sizes": np.array([len(node.ends) for node in self._nodes], dtype=np.int64),
            "ends": _joined([node.ends for node in self._nodes], 2),
            "lasers": _joined([node.laser[None] for node in self._nodes], 2),
            "edge_ends": np.array([(e.start, e.end) for e in edges], np.int64).reshape(-1, 2),
            "edge_motions": np.array([e.motion for e in edges]).reshape(-1, 3),
            "edge_information": np.array([e.information for e in edges]).reshape(-1, 3, 3),
            "edge_is_closure": np.array([e.is_closure for e in edges], dtype=np.bool_),
            "scans": np.array([(s, n, *m) for s, n, m in self._scans]).reshape(-1, 5),
            "online": np.array(self._online).reshape(-1, 3),
            "responses": np.array(self._responses).reshape(-1, 2),
        }
        for index, submap in enumerate(self._submaps):
            parts = submap.to_arrays()
            arrays.update({f"submap{index}_{name}": part for name, part in parts.items()})
        write_state(
            path,
            name=self.name,
            version=STATE_FORMAT,
            config=self._config,
            seed=self._seed,
            record=record,
            arrays=arrays,
        )

    @classmethod
    def load_state(
        cls, path: Path, config: GraphConfig, backend: Backend, seed: int = 0
    ) -> GraphSlam:
        """Return the graph that ``save_state`` has written.

        Args:
            path: the file.
            config: must be what the state was made with.
            backend: where the submaps are to live.
            seed: likewise.

        Raises:
            SlamFusionError: no state of ours, or one made with other settings.
        """
        record, arrays = read_state(
            path, name=cls.name, version=STATE_FORMAT, config=config, seed=seed
        )
        made = cls(config, backend, seed)
        try:
            made._restore(record, arrays)
        except KeyError as error:
            message = f"{path}: not a whole state, {error} is missing"
            raise SlamFusionError(message) from None
        return made

    def _restore(self, record: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Take over a saved state."""
        restore_health(self.health, record["health"])
        restore_tracker(self._tracker, record["tracker"])
        self.last_stamp_s = record["last_stamp_s"]
        self._start = recorded_pose(record["start"]) or IDENTITY
        self._node_pose = recorded_pose(record["node_pose"]) or IDENTITY
        for name, value in record["numbers"].items():
            setattr(self, name, value)
        last = np.cumsum(arrays["node_sizes"])
        for first, end, laser, odometry, travelled_m in zip(
            last - arrays["node_sizes"],
            last,
            arrays["lasers"],
            record["odometry"],
            record["travelled_m"],
            strict=True,
        ):
            ends = arrays["ends"][first:end]
            self._keep(Node(ends, laser, travelled_m, recorded_pose(odometry)))
        self._poses, self._weights = arrays["poses"], arrays["weights"]
        edges = [
            Constraint(int(start), int(end), motion, information, bool(is_closure))
            for (start, end), motion, information, is_closure in zip(
                arrays["edge_ends"],
                arrays["edge_motions"],
                arrays["edge_information"],
                arrays["edge_is_closure"],
                strict=True,
            )
        ]
        self._bad, self._parts = record["bad"], record["parts"]
        count = record["edges"]
        self._edges = edges[:count]
        waiting = [
            Waiting(edge, recorded_pose(correction) or IDENTITY, travelled_m, how)
            for edge, (correction, travelled_m, how) in zip(
                edges[count:], record["waiting"], strict=True
            )
        ]
        self._waiting.pending, hits = waiting[: record["pending"]], waiting[record["pending"] :]
        for size, correction, misses, tested in record["guesses"]:
            own, hits = hits[:size], hits[size:]
            guess = Guess(recorded_pose(correction) or IDENTITY, own, misses, tested)
            self._relocation.guesses.append(guess)
        self._begun = {
            (int(one), int(other)): Pose2(x, y, yaw) for one, other, x, y, yaw in record["begun"]
        }
        self._last_tried = {int(key): int(value) for key, value in record["last_tried"]}
        self._searched = {int(key): int(value) for key, value in record["searched"]}
        self._linked_m = {int(key): float(value) for key, value in record["linked_m"]}
        self._scans = [
            (float(stamp), int(node), (float(x), float(y), float(yaw)))
            for stamp, node, x, y, yaw in arrays["scans"]
        ]
        self._online = [(x, y, yaw) for x, y, yaw in arrays["online"].tolist()]
        self._responses = [(stamp, value) for stamp, value in arrays["responses"].tolist()]
        for index in range(self.health.submaps):
            prefix = f"submap{index}_"
            parts = {
                name.removeprefix(prefix): part
                for name, part in arrays.items()
                if name.startswith(prefix)
            }
            submap = self._new_submap(0)
            submap.restore(parts)
            self._submaps.append(submap)


# Attributes of ``GraphSlam`` that are plain numbers.
_PLAIN = (
    "_active",
    "_travelled_m",
    "_is_urgent",
    "_bad_row",
    "_broken_at",
    "_in_vain",
    "_lost_m",
    "_unsolved",
    "_solved_at",
    "_new_doubts",
)


def _joined(parts: list[npt.NDArray[np.float32]], width: int) -> npt.NDArray[np.float32]:
    """Return arrays (K, width) one below the other; none is an empty one."""
    return np.concatenate([np.zeros((0, width), dtype=np.float32), *parts])


def _pose(row: F64) -> Pose2:
    x, y, yaw = (float(value) for value in row)
    return Pose2(x, y, wrap_angle(yaw))


def _vector(pose: Pose2) -> F64:
    return np.array([pose.x, pose.y, wrap_angle(pose.yaw_rad)])


def _wrapped(pose: Pose2) -> Pose2:
    return Pose2(pose.x, pose.y, wrap_angle(pose.yaw_rad))
