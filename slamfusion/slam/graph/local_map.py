"""``LocalMap``: submaps, of which the last one or two grow under the robot, and known places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.geometry import B8, F64, I64, Pose2, pose_of, wrapped_row_of
from slamfusion.grid import IDENTITY
from slamfusion.pose_graph.uncertainty import turned
from slamfusion.slam.common.matcher import ScanOnTiles, information_of, response_hessian
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.map_graph import INFORMATION_SHARE, Constraint
from slamfusion.slam.graph.node_map import Node
from slamfusion.slam.graph.submap import Submap, fill_walls

# Distance between hits that are filled in on a wall, cells: a submap's walls have no gaps.
WALL_CELLS = 1.0


class LocalMap(Stateful):
    """Submaps in the order of their anchors, and the map components they are in.

    The robot is followed in the frame of the active submap. In a new place that one grows: half way
    through it the next one starts, and when it is full that one becomes the active one. In a known
    place it is ``drawn``, made from earlier nodes, and none grows. Matches place the submaps of one
    component relative to each other; only odometry places components.

    Attributes:
        components: number of the map component of each submap.
        finished: number of finished submaps; those after them grow, none in a known place.
        drawn: the map of known places, in the frame of one of its nodes; None before the first.
        node, node_pose: number of the node that the robot's pose is kept relative to, and its pose
            in the active submap's frame.
        seen_from: pose in that frame at the last node; in a known place, at the last scan that was
            a node's distance from the one before.
    """

    STATE = (
        *("components", "finished", "node", "node_pose", "seen_from"),
        *("_next_pose", "_drawn_nodes", "_drawn_poses"),
    )

    def __init__(self, config: GraphConfig, device: ComputeDevice) -> None:
        self.submaps: list[Submap] = []
        self.components: list[int] = []
        self.finished = self.node = 0
        self.node_pose = self.seen_from = IDENTITY
        self.drawn: Submap | None = None
        # The nodes in it, (K,), its anchor first, and their poses in the map frame, (K, 3).
        self._drawn_nodes, self._drawn_poses = np.zeros(0, np.int64), np.zeros((0, 3))
        self._config = config
        self._device = device
        # Of the finished submaps: anchors (S,), and corners (S, 2), metres, of the boxes around
        # the robot's places.
        self._boxes = (np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
        # Pose of the submap that grows next to the active one, in the frame of that.
        self._next_pose = IDENTITY

    # -- what there is -------------------------------------------------------------------------

    @property
    def active_submap(self) -> Submap:
        """The submap in whose frame the robot is followed."""
        if self.finished < len(self.submaps) or self.drawn is None:
            return self.submaps[self.finished]
        return self.drawn

    @property
    def active_component(self) -> int:
        """Number of the map component that the robot is in."""
        return self.components[-1]

    @property
    def is_known(self) -> bool:
        """Whether the robot is in a known place, where no submap grows."""
        return self.finished == len(self.submaps)

    @property
    def settled_nodes(self) -> int | None:
        """Number of nodes before those of the submaps that grow; None: all."""
        return None if self.is_known else self.active_submap.anchor

    @property
    def component_count(self) -> int:
        """Map components that nothing but odometry places to each other."""
        return len(set(self.components))

    @property
    def memory_bytes(self) -> int:
        """Bytes of all submaps, and of the map of known places."""
        maps = self.submaps if self.drawn is None else [*self.submaps, self.drawn]
        return sum(submap.memory_bytes for submap in maps)

    def in_other_components(self) -> list[int]:
        """Return the finished submaps of the components that the robot is not in."""
        own = self.active_component
        return [index for index in range(self.finished) if self.components[index] != own]

    def distances_m(self, pose: Pose2, poses: F64) -> F64:
        """Return the distance of a pose to the robot's places in each finished submap, (S,) metres.

        The pose and the nodes' poses (N, 3) are in the map frame; 0 within the places' box.
        """
        if len(self._boxes[0]) != self.finished:
            finished = self.submaps[: self.finished]
            self._boxes = (
                np.array([submap.anchor for submap in finished], dtype=np.int64),
                np.array([submap.low for submap in finished]).reshape(-1, 2),
                np.array([submap.high for submap in finished]).reshape(-1, 2),
            )
        numbers, low, high = self._boxes
        anchors = poses[numbers]
        x, y = pose.x - anchors[:, 0], pose.y - anchors[:, 1]
        cos, sin = np.cos(anchors[:, 2]), np.sin(anchors[:, 2])
        places = np.column_stack((cos * x + sin * y, cos * y - sin * x))
        outside = np.maximum(low - places, places - high).clip(min=0.0)
        return np.asarray(np.hypot(outside[:, 0], outside[:, 1]))

    # -- how it grows --------------------------------------------------------------------------

    def begin(self, number: int, node: Node, component: int) -> None:
        """Start a submap at a node that no other overlaps; the earlier ones are finished."""
        self._finish()
        self._append(number, component).insert(*self._walls_of(node), IDENTITY)
        self._set_node(number, IDENTITY)

    def leave(self, number: int, around: I64, nodes: Sequence[Node], poses: F64) -> None:
        """Start a submap at a node where a known place ends; it shows the nodes around it too."""
        self.begin(number, nodes[number], self.active_component)
        self._draw(self.active_submap, around, nodes, poses)

    def draw(self, numbers: I64, nodes: Sequence[Node], poses: F64) -> Submap:
        """Draw nodes (K,), the nearest one first, into the map of known places; return that.

        It is redrawn if nodes in it have moved. Poses of all nodes (N, 3) are in the map
        frame.
        """
        drawn, own = self.drawn, self._drawn_nodes
        if drawn is None or not np.array_equal(poses[own], self._drawn_poses):
            drawn, own = self._make(int(numbers[0])), np.zeros(0, np.int64)
        fresh = numbers[~np.isin(numbers, own)]
        self._draw(drawn, fresh, nodes, poses)
        self.drawn, self._drawn_nodes = drawn, np.concatenate((own, fresh))
        self._drawn_poses = poses[self._drawn_nodes]
        if self.is_known:
            anchor, node = pose_of(poses[drawn.anchor]), pose_of(poses[self.node])
            self.node_pose = anchor.inverse().compose(node)
        return drawn

    def follow(self, local: Pose2) -> None:
        """Follow the robot from a pose in the drawn map on, and finish the submaps that grow.

        One with too few scans to be found again is dropped: it overlaps the one before it.
        """
        least = self._config.loop_match_minimum_chain_size
        if not self.is_known and self.submaps[-1].scans < least:
            del self.submaps[-1], self.components[-1]
        self._finish()
        anchor = pose_of(self._drawn_poses[0])
        pose = anchor.compose(local)
        away_m = np.hypot(*(self._drawn_poses[:, :2] - (pose.x, pose.y)).T)
        nearest = int(away_m.argmin())
        to_node = anchor.inverse().compose(pose_of(self._drawn_poses[nearest]))
        self._set_node(int(self._drawn_nodes[nearest]), to_node)
        self.seen_from = local

    def constraints(
        self, number: int, points: F64, local: Pose2, hessian: F64 | None
    ) -> list[Constraint]:
        """Return the constraints between a node and the anchors of the growing submaps.

        In a known place it is one to the node that the robot's pose is kept relative to.

        Hits (P, 2) are in the robot's frame, metres; ``hessian`` is that of the response (3, 3).
        """
        active = self.active_submap
        row = wrapped_row_of(local)
        if hessian is None:
            beams = self._config.matcher.beams
            scan = ScanOnTiles(self._device, active.walls(), points, beams)
            hessian = response_hessian(scan, row)
        information = INFORMATION_SHARE * information_of(hessian)
        frames = [(self.node, self.node_pose) if self.is_known else (active.anchor, IDENTITY)]
        if self.finished + 1 < len(self.submaps):
            frames.append((self.submaps[-1].anchor, self._next_pose))
        found = []
        for start, frame in frames:
            motion = wrapped_row_of(frame.inverse().compose(local))
            seen = turned(information[None], np.array([-frame.yaw_rad]))[0]
            found.append(Constraint(start, number, motion, seen))
        return found

    def insert(self, number: int, node: Node, local: Pose2) -> Pose2:
        """Write a node into the growing submaps; return its pose in the then active submap."""
        walls, active = self._walls_of(node), self.active_submap
        active.insert(*walls, local)
        if self.finished + 1 < len(self.submaps):
            inside = self._next_pose.inverse().compose(local)
            self.submaps[-1].insert(*walls, inside)
            if active.scans >= self._config.scan_buffer_size:
                active.finish()
                self.finished += 1
                local = inside
        elif active.scans >= self._config.scan_buffer_size // 2:
            self._next_pose = local
            self._append(number, self.active_component).insert(*walls, IDENTITY)
        self._set_node(number, local)
        return local

    def join(self, other: int, node_count: int) -> tuple[B8, bool]:
        """Join the robot's and another component; return which nodes moved, (N,), and if it did.

        The later component joins the earlier one.
        """
        own = self.active_component
        joining, kept = (own, other) if own > other else (other, own)
        anchors = np.array([submap.anchor for submap in self.submaps])
        owners = np.searchsorted(anchors, np.arange(node_count), side="right") - 1
        is_joining = np.array(self.components)[owners] == joining
        self.components = [kept if part == joining else part for part in self.components]
        return is_joining, joining == own

    # -- state ---------------------------------------------------------------------------------

    def to_state(self) -> dict[str, Any]:
        """Return the state, see ``Stateful``, with the submaps' contents."""
        submaps = [submap.to_state() for submap in self.submaps]
        drawn = None if self.drawn is None else self.drawn.to_state()
        return {**super().to_state(), "submaps": submaps, "drawn": drawn}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over what ``to_state`` returned."""
        for arrays, component in zip(state["submaps"], state["components"], strict=True):
            self._append(0, component).restore(arrays)
        if state["drawn"] is not None:
            self.drawn = self._make(0)
            self.drawn.restore(state["drawn"])
        super().restore(state)

    def _set_node(self, number: int, pose: Pose2) -> None:
        self.node, self.node_pose, self.seen_from = number, pose, pose

    def _finish(self) -> None:
        for submap in self.submaps[self.finished :]:
            submap.finish()
        self.finished = len(self.submaps)

    def _make(self, anchor: int) -> Submap:
        config = self._config
        sigma_m = config.correlation_search_space_smear_deviation
        return Submap(self._device, anchor, config.resolution, sigma_m)

    def _append(self, anchor: int, component: int) -> Submap:
        submap = self._make(anchor)
        self.submaps.append(submap)
        self.components.append(component)
        return submap

    def _draw(self, submap: Submap, numbers: I64, nodes: Sequence[Node], poses: F64) -> None:
        """Draw nodes (K,) into a submap; the walls of many scans have no gaps to be filled."""
        to_anchor = pose_of(poses[submap.anchor]).inverse()
        for number in numbers.tolist():
            node, place = nodes[number], to_anchor.compose(pose_of(poses[number]))
            submap.draw(node.points(), node.laser.astype(np.float64), place)

    def _walls_of(self, node: Node) -> tuple[F64, F64]:
        """Return a node's walls and laser as a submap takes them."""
        laser = node.laser.astype(np.float64)
        return fill_walls(node.points(), laser, WALL_CELLS * self._config.resolution), laser
