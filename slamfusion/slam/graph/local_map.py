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
from slamfusion.slam.common.matcher import Match, ScanOnTiles, information_of, response_information
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.graph.map_graph import BELIEVED_SHARE, Constraint, GraphHealth, turned
from slamfusion.slam.graph.node_map import Node
from slamfusion.slam.graph.submap import UNSEEN_WALL, Submap, fill_walls, seen_score

# Distance between hits that are filled in on a wall, cells: a submap's walls have no gaps.
WALL_CELLS = 1.0
# A scan with this share of its hits where the local map has seen nothing is not bad.
MOST_UNSEEN = 0.8
# A match worth less than this share of the usual one is bad. Right after a reset of the odometry
# one that is worth less than the second share is enough: the robot was perhaps switched off and
# moved.
BAD_SHARE, RESET_SHARE = 0.6, 0.8


class LocalMap(Stateful):
    """Submaps in the order of their anchors; it owns them, and the map components they are in.

    The robot is followed in the frame of the active submap. Half way through it the next one
    begins beside it, and when it is full that one becomes the active one. Submaps of one component
    are placed to each other by matches; those of another, begun by a kidnapped robot, are not.

    Attributes:
        components: number of the map component of each.
        active: index of the one in whose frame the robot is followed; those before it are finished.
        node_pose: pose of the last node in that frame.
    """

    STATE = ("components", "active", "node_pose", "_begun")

    def __init__(self, config: GraphConfig, device: ComputeDevice, health: GraphHealth) -> None:
        """Start empty."""
        self.submaps: list[Submap] = []
        self.components: list[int] = []
        self.active = 0
        self.node_pose = IDENTITY
        self._config = config
        self._device = device
        self._health = health
        # Of the finished submaps: anchors (S,), and corners of the boxes around
        # the robot's places in them, metres (S, 2).
        self._boxes = (np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
        # Where a submap was begun in the frame of the one before it, by their anchors.
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
        """Return the finished submaps of other components than the robot's."""
        own = self.active_component
        return [index for index in range(self.active) if self.components[index] != own]

    def distances_m(self, pose: Pose2, poses: F64) -> F64:
        """Return how far a pose is from where the robot was in each finished submap, (S,).

        Args:
            pose: in the map frame.
            poses: (N, 3) of the nodes, likewise.

        Returns:
            Metres; 0 within a box around the robot's places there.
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
        """Return what a match is worth where the active submap has seen something.

        Args:
            points: (P, 2) hits in the robot's frame, metres.
            mean_score: running mean score of the matches before; None: there are none.

        Returns:
            Its score in the mean score; 1 where it is not much lower, or says little.
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
        """Begin a submap that no other overlaps, at a node; those before grow no more."""
        for submap in self.submaps[self.active :]:
            submap.finish()
        begun = self._append(number, component)
        self.active = len(self.submaps) - 1
        begun.insert(*self._walls_of(node), IDENTITY)
        self.node_pose = IDENTITY

    def constraints(
        self, number: int, points: F64, local: Pose2, hessian: F64 | None
    ) -> list[Constraint]:
        """Return what a match tells of a node and the anchors of the growing submaps.

        Args:
            points: (P, 2) its hits in the robot's frame, metres.
            hessian: (3, 3) negative Hessian of the response there; None: not measured yet.
        """
        active = self.active_submap
        row = wrapped_row_of(local)
        if hessian is None:
            information = response_information(self._scan(points), row)
        else:
            information = information_of(hessian)
        information = BELIEVED_SHARE * information
        found = [Constraint(active.anchor, number, row, information)]
        for other in self.submaps[self.active + 1 :]:
            between = self._begun[active.anchor, other.anchor]
            motion = wrapped_row_of(between.inverse().compose(local))
            seen = turned(information, -between.yaw_rad)
            found.append(Constraint(other.anchor, number, motion, seen))
        return found

    def insert(self, number: int, node: Node, local: Pose2) -> Pose2:
        """Write a node into the growing submaps; return its pose in the one that is active then."""
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
        """Make one component of the robot's and another one: the later joins the earlier.

        Returns:
            (N,) whether each node was in the component that joins; whether that is the robot's.
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
        """Return the state, see ``Stateful``, with what each submap holds."""
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
