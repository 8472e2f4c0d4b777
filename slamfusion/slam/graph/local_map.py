"""``LocalMap``: the submaps, of which the last one or two grow under the robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.geometry import F64, Pose2, wrapped_row_of
from slamfusion.grid import IDENTITY
from slamfusion.pose_graph.uncertainty import turned
from slamfusion.slam.common.matcher import Match, ScanOnTiles, information_of, response_information
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.map_graph import INFORMATION_SHARE, Constraint, GraphHealth
from slamfusion.slam.graph.node_map import Node
from slamfusion.slam.graph.submap import UNSEEN_WALL, Submap, fill_walls, seen_score

# Distance between hits that are filled in on a wall, cells: a submap's walls have no gaps.
WALL_CELLS = 1.0
# A scan with this share of its hits where the local map has seen nothing is not bad.
MOST_UNSEEN = 0.8
# A match below this share of the usual score is bad. Right after a reset of the odometry the second
# share applies: the robot may have been switched off and moved.
BAD_SHARE, RESET_SHARE = 0.6, 0.8


class LocalMap(Stateful):
    """Submaps in the order of their anchors, and the map components they are in.

    The robot is followed in the frame of the active submap; those before it are finished. Half way
    through it the next one starts, and when it is full that one becomes the active one. Matches
    place the submaps of one component relative to each other; only odometry places components.

    Attributes:
        components: number of the map component of each submap.
        active: index of the active submap.
        node_pose: pose of the last node in its frame.
    """

    STATE = ("components", "active", "node_pose", "_begun")

    def __init__(self, config: GraphConfig, device: ComputeDevice, health: GraphHealth) -> None:
        self.submaps: list[Submap] = []
        self.components: list[int] = []
        self.active = 0
        self.node_pose = IDENTITY
        self._config = config
        self._device = device
        self._health = health
        # Of the finished submaps: anchors (S,), and corners (S, 2), metres, of the boxes around
        # the robot's places.
        self._boxes = (np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
        # Pose of each new submap in the frame of the one before it, by their anchors.
        self._begun: dict[tuple[int, int], Pose2] = {}

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
        return [index for index in range(self.active) if self.components[index] != own]

    def distances_m(self, pose: Pose2, poses: F64) -> F64:
        """Return the distance of a pose to the robot's places in each finished submap, (S,) metres.

        The pose and the nodes' poses (N, 3) are in the map frame; 0 within the places' box.
        """
        if len(self._boxes[0]) != self.active:
            finished = self.submaps[: self.active]
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

    def fit(self, points: F64, match: Match, mean_score: float | None) -> float:
        """Return a match's score relative to the mean, where the active submap is known.

        1 if there is no mean yet, or the score is not much lower or covers little. Hits (P, 2) are
        in the robot's frame, metres.
        """
        if mean_score is None:
            return 1.0
        if match.score >= RESET_SHARE * mean_score:
            return 1.0
        unseen = self._scan(points).unseen_share(match.pose, UNSEEN_WALL)
        if unseen >= MOST_UNSEEN:
            return 1.0
        return seen_score(match.score, unseen) / mean_score

    # -- how it grows --------------------------------------------------------------------------

    def begin(self, number: int, node: Node, component: int) -> None:
        """Start a submap at a node that no other overlaps; the earlier ones are finished."""
        for submap in self.submaps[self.active :]:
            submap.finish()
        begun = self._append(number, component)
        self.active = len(self.submaps) - 1
        begun.insert(*self._walls_of(node), IDENTITY)
        self.node_pose = IDENTITY

    def constraints(
        self, number: int, points: F64, local: Pose2, hessian: F64 | None
    ) -> list[Constraint]:
        """Return the constraints between a node and the anchors of the growing submaps.

        Hits (P, 2) are in the robot's frame, metres; ``hessian`` is that of the response (3, 3).
        """
        active = self.active_submap
        row = wrapped_row_of(local)
        if hessian is None:
            information = response_information(self._scan(points), row)
        else:
            information = information_of(hessian)
        information = INFORMATION_SHARE * information
        found = [Constraint(active.anchor, number, row, information)]
        for other in self.submaps[self.active + 1 :]:
            between = self._begun[active.anchor, other.anchor]
            motion = wrapped_row_of(between.inverse().compose(local))
            seen = turned(information[None], np.array([-between.yaw_rad]))[0]
            found.append(Constraint(other.anchor, number, motion, seen))
        return found

    def insert(self, number: int, node: Node, local: Pose2) -> Pose2:
        """Write a node into the growing submaps; return its pose in the then active submap."""
        config, walls, active = self._config, self._walls_of(node), self.active_submap
        active.insert(*walls, local)
        if self.active + 1 < len(self.submaps):
            other = self.submaps[self.active + 1]
            inside = self._begun[active.anchor, other.anchor].inverse().compose(local)
            other.insert(*walls, inside)
            if active.scans >= config.scan_buffer_size:
                active.finish()
                self.active += 1
                local = inside
        elif active.scans >= config.scan_buffer_size // 2:
            self._begun[active.anchor, number] = local
            self._append(number, self.components[-1]).insert(*walls, IDENTITY)
        self.node_pose = local
        return local

    def join(self, other: int, node_count: int) -> tuple[npt.NDArray[np.bool_], bool]:
        """Join the robot's and another component; return which nodes moved, (N,), and if it did.

        The later component joins the earlier one.
        """
        own = self.active_component
        joining, kept = (own, other) if own > other else (other, own)
        anchors = np.array([submap.anchor for submap in self.submaps])
        owners = np.searchsorted(anchors, np.arange(node_count), side="right") - 1
        is_joining = np.array(self.components)[owners] == joining
        self.components = [kept if part == joining else part for part in self.components]
        self._health.map_components = self.component_count
        return is_joining, joining == own

    # -- state ---------------------------------------------------------------------------------

    def to_state(self) -> dict[str, Any]:
        """Return the state, see ``Stateful``, with the submaps' contents."""
        submaps = [submap.to_arrays() for submap in self.submaps]
        return {**super().to_state(), "submaps": submaps}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over what ``to_state`` returned."""
        for arrays, component in zip(state["submaps"], state["components"], strict=True):
            self._append(0, component).restore(arrays)
        super().restore(state)

    def _append(self, anchor: int, component: int) -> Submap:
        config = self._config
        sigma_m = config.correlation_search_space_smear_deviation
        submap = Submap(self._device, anchor, config.resolution, sigma_m)
        self.submaps.append(submap)
        self.components.append(component)
        self._health.submaps = len(self.submaps)
        self._health.map_components = self.component_count
        return submap

    def _scan(self, points: F64) -> ScanOnTiles:
        walls = self.active_submap.walls()
        return ScanOnTiles(self._device, walls, points, self._config.matcher.beams)

    def _walls_of(self, node: Node) -> tuple[F64, F64]:
        """Return a node's walls and laser as a submap takes them."""
        laser = node.laser.astype(np.float64)
        return fill_walls(node.points(), laser, WALL_CELLS * self._config.resolution), laser
