"""``LocalMap``: the submaps, of which the last one or two grow under the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.geometry import B8, F64, Pose2, wrapped_row_of
from slamfusion.grid import IDENTITY
from slamfusion.pose_graph.uncertainty import turned
from slamfusion.slam.common.matcher import ScanOnTiles, information_of, response_hessian
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.map_graph import INFORMATION_SHARE, Constraint
from slamfusion.slam.graph.node_map import Node
from slamfusion.slam.graph.submap import Submap, fill_walls

# Distance between hits that are filled in on a wall, cells: a submap's walls have no gaps.
WALL_CELLS = 1.0
# Scans, as far apart as nodes, that are written into a new submap where the robot leaves a known
# place.
RECENT_SCANS = 6


@dataclass(frozen=True, eq=False)
class KnownScan:
    """A scan in a known place: its pose in the active submap, and its row of the driven path."""

    node: Node
    local: Pose2
    row: int


class LocalMap(Stateful):
    """Submaps in the order of their anchors, and the map components they are in.

    The robot is followed in the frame of the active submap. In a new place that one grows: half way
    through it the next one starts, and when it is full that one becomes the active one. In a known
    place it is a finished one, and none grows; the robot leaves it with a new one. Matches place
    the submaps of one component relative to each other; only odometry places components.

    Attributes:
        components: number of the map component of each submap.
        finished: number of finished submaps; those after them grow.
        active: index of the active submap.
        node, node_pose: number of the node that the robot's pose is kept relative to, and its pose
            in the active submap's frame.
        recent: the last scans in a known place.
    """

    STATE = ("components", "finished", "active", "node", "node_pose", "recent", "_next_pose")

    def __init__(self, config: GraphConfig, device: ComputeDevice) -> None:
        self.submaps: list[Submap] = []
        self.components: list[int] = []
        self.finished = self.active = self.node = 0
        self.node_pose = IDENTITY
        self._config = config
        self._device = device
        # Of the finished submaps: anchors (S,), and corners (S, 2), metres, of the boxes around
        # the robot's places.
        self._boxes = (np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
        self.recent: list[KnownScan] = []
        # Pose of the submap that grows next to the active one, in the frame of that.
        self._next_pose = IDENTITY

    # -- what there is -------------------------------------------------------------------------

    @property
    def active_submap(self) -> Submap:
        """The submap in whose frame the robot is followed."""
        return self.submaps[self.active]

    @property
    def active_component(self) -> int:
        """Number of the map component that the robot is in."""
        return self.components[self.active]

    @property
    def seen_from(self) -> Pose2:
        """Pose in the active submap at the last node or known scan."""
        return self.recent[-1].local if self.recent else self.node_pose

    @property
    def is_known(self) -> bool:
        """Whether the robot is in a known place, where no submap grows."""
        return self.finished == len(self.submaps)

    @property
    def component_count(self) -> int:
        """Map components that nothing but odometry places to each other."""
        return len(set(self.components))

    @property
    def memory_bytes(self) -> int:
        """Bytes of all submaps."""
        return sum(submap.memory_bytes for submap in self.submaps)

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
        self.active = self.finished
        self._append(number, component).insert(*self._walls_of(node), IDENTITY)
        self.node, self.node_pose, self.recent = number, IDENTITY, []

    def follow(self, index: int, change: Pose2) -> None:
        """Follow the robot in a finished submap, and finish the others.

        ``change`` is the pose of the active one in its frame. One with too few scans to be found
        again is dropped: it overlaps the one before it.
        """
        self.recent = [replace(one, local=change.compose(one.local)) for one in self.recent]
        if (
            not self.is_known
            and self.submaps[-1].scans < self._config.loop_match_minimum_chain_size
        ):
            del self.submaps[-1], self.components[-1]
        self._finish()
        self.active, self.node, self.node_pose = index, self.submaps[index].anchor, IDENTITY

    def remember(self, scan: KnownScan) -> None:
        """Keep a scan in a known place, one of the last few, for when the robot leaves it."""
        self.recent = [*self.recent[1 - RECENT_SCANS :], scan]

    def leave(self, number: int) -> None:
        """Start a submap at the last scan in a known place, which is a node now."""
        *before, last = self.recent
        self.begin(number, last.node, self.active_component)
        back = last.local.inverse()
        for scan in before:
            self.active_submap.insert(*self._walls_of(scan.node), back.compose(scan.local))

    def constraints(
        self, number: int, points: F64, local: Pose2, hessian: F64 | None
    ) -> list[Constraint]:
        """Return the constraints between a node and the anchors of the growing submaps.

        Hits (P, 2) are in the robot's frame, metres; ``hessian`` is that of the response (3, 3).
        """
        active = self.active_submap
        row = wrapped_row_of(local)
        if hessian is None:
            beams = self._config.matcher.beams
            scan = ScanOnTiles(self._device, active.walls(), points, beams)
            hessian = response_hessian(scan, row)
        information = INFORMATION_SHARE * information_of(hessian)
        found = [Constraint(active.anchor, number, row, information)]
        if self.finished + 1 < len(self.submaps):
            between = self._next_pose
            motion = wrapped_row_of(between.inverse().compose(local))
            seen = turned(information[None], np.array([-between.yaw_rad]))[0]
            found.append(Constraint(self.submaps[-1].anchor, number, motion, seen))
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
                self.finished = self.active = len(self.submaps) - 1
                local = inside
        elif active.scans >= self._config.scan_buffer_size // 2:
            self._next_pose = local
            self._append(number, self.active_component).insert(*walls, IDENTITY)
        self.node, self.node_pose = number, local
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
        return {**super().to_state(), "submaps": submaps}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over what ``to_state`` returned."""
        for arrays, component in zip(state["submaps"], state["components"], strict=True):
            self._append(0, component).restore(arrays)
        super().restore(state)

    def _finish(self) -> None:
        for submap in self.submaps[self.finished :]:
            submap.finish()
        self.finished = len(self.submaps)

    def _append(self, anchor: int, component: int) -> Submap:
        config = self._config
        sigma_m = config.correlation_search_space_smear_deviation
        submap = Submap(self._device, anchor, config.resolution, sigma_m)
        self.submaps.append(submap)
        self.components.append(component)
        return submap

    def _walls_of(self, node: Node) -> tuple[F64, F64]:
        """Return a node's walls and laser as a submap takes them."""
        laser = node.laser.astype(np.float64)
        return fill_walls(node.points(), laser, WALL_CELLS * self._config.resolution), laser
