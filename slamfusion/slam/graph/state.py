"""What each object of the graph SLAM is saved as: one typed record of plain values and arrays each.

``slamfusion.slam.common.state`` writes them into a file and reads them back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2
from slamfusion.slam.common.pose_rows import row_of
from slamfusion.slam.common.shapes import check_finite, check_indices, check_shapes
from slamfusion.slam.common.tracking import TrackerState
from slamfusion.slam.graph.constraints import Constraint
from slamfusion.slam.graph.health import GraphHealth
from slamfusion.slam.graph.node_map import Node
from slamfusion.slam.graph.pending_closures import How, PendingClosure
from slamfusion.slam.graph.tracking_quality import TrackingQuality

__all__ = [
    "ConstraintsState",
    "GraphState",
    "HypothesisState",
    "LocalMapState",
    "LocalizerState",
    "LoopClosureState",
    "MapGraphState",
    "NodesState",
    "PathState",
    "PendingState",
    "RelocalizationState",
]

Bools = npt.NDArray[np.bool_]
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class NodesState:
    """Nodes, one below the other.

    Attributes:
        sizes: (N,) hits of each.
        ends: (B, 2) hits of all.
        lasers: (N, 2).
        travelled_m: (N,).
        has_odometry: (N,).
        odometry: (N, 3) poses, 0 where there is none.
    """

    sizes: I64
    ends: F32
    lasers: F32
    travelled_m: F64
    has_odometry: Bools
    odometry: F64

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit each other.

        Raises:
            ValueError: shapes, sizes, or numbers that are not finite.
        """
        _check(
            self,
            sizes="N",
            ends="B 2",
            lasers="N 2",
            travelled_m="N",
            has_odometry="N",
            odometry="N 3",
        )
        if self.sizes.sum() != len(self.ends) or (self.sizes < 0).any():
            message = f"nodes of {self.sizes.sum()} hits, found {len(self.ends)}"
            raise ValueError(message)

    @classmethod
    def of(cls, nodes: Sequence[Node]) -> NodesState:
        """Return the state of some nodes; none is fine."""
        none = np.zeros((0, 2), dtype=np.float32)
        return cls(
            sizes=np.array([len(node.ends) for node in nodes], dtype=np.int64),
            ends=np.concatenate([none, *(node.ends for node in nodes)]),
            lasers=np.concatenate([none, *(node.laser[None] for node in nodes)]),
            travelled_m=np.array([node.travelled_m for node in nodes], dtype=np.float64),
            has_odometry=np.array([node.odometry is not None for node in nodes], dtype=np.bool_),
            odometry=_rows([node.odometry or Pose2() for node in nodes]),
        )

    def nodes(self) -> list[Node]:
        """Return the nodes again."""
        last = np.cumsum(self.sizes)
        odometry = [
            pose if has else None
            for pose, has in zip(_poses(self.odometry), self.has_odometry.tolist(), strict=True)
        ]
        return [
            Node(self.ends[first:end], laser, travelled_m, pose)
            for first, end, laser, travelled_m, pose in zip(
                last - self.sizes,
                last,
                self.lasers,
                self.travelled_m.tolist(),
                odometry,
                strict=True,
            )
        ]


@dataclass(frozen=True, eq=False)
class ConstraintsState:
    """Constraints as arrays: (M, 2) starts and ends, (M, 3), (M, 3, 3) and (M,)."""

    ends: I64
    motions: F64
    information: F64
    is_closure: Bools

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit each other; see ``NodesState``."""
        _check(self, ends="M 2", motions="M 3", information="M 3 3", is_closure="M")

    @classmethod
    def of(cls, constraints: Sequence[Constraint]) -> ConstraintsState:
        """Return the state of some constraints; none is fine."""
        return cls(
            ends=np.array([(c.start, c.end) for c in constraints], np.int64).reshape(-1, 2),
            motions=np.array([c.motion for c in constraints]).reshape(-1, 3),
            information=np.array([c.information for c in constraints]).reshape(-1, 3, 3),
            is_closure=np.array([c.is_closure for c in constraints], dtype=np.bool_),
        )

    def constraints(self) -> list[Constraint]:
        """Return the constraints again."""
        return [
            Constraint(start, end, motion, information, is_closure)
            for (start, end), motion, information, is_closure in zip(
                self.ends.tolist(),
                self.motions,
                self.information,
                self.is_closure.tolist(),
                strict=True,
            )
        ]


@dataclass(frozen=True, eq=False)
class PendingState:
    """Closures that are not believed yet: their constraints, (K, 3) corrections, (K,) the rest."""

    constraints: ConstraintsState
    corrections: F64
    travelled_m: F64
    how: tuple[How, ...]

    def __post_init__(self) -> None:
        """Refuse parts that do not fit each other; see ``NodesState``."""
        _check(self, corrections="K 3", travelled_m="K")
        if not len(self.how) == len(self.constraints.ends) == len(self.corrections):
            message = f"{len(self.how)} closures with {len(self.corrections)} corrections"
            raise ValueError(message)

    @classmethod
    def of(cls, closures: Sequence[PendingClosure]) -> PendingState:
        """Return the state of some closures; none is fine."""
        return cls(
            constraints=ConstraintsState.of([one.constraint for one in closures]),
            corrections=_rows([one.correction for one in closures]),
            travelled_m=np.array([one.travelled_m for one in closures], dtype=np.float64),
            how=tuple(one.how for one in closures),
        )

    def closures(self) -> list[PendingClosure]:
        """Return the closures again."""
        return [
            PendingClosure(constraint, correction, travelled_m, how)
            for constraint, correction, travelled_m, how in zip(
                self.constraints.constraints(),
                _poses(self.corrections),
                self.travelled_m.tolist(),
                self.how,
                strict=True,
            )
        ]


@dataclass(frozen=True, eq=False)
class MapGraphState:
    """Of ``MapGraph``; see there."""

    nodes: NodesState
    poses: F64
    constraints: ConstraintsState
    weights: F64
    outliers: int
    new_outliers: int
    unsolved: int
    is_urgent: bool
    solved_at: int

    def __post_init__(self) -> None:
        """Refuse parts that do not fit each other; see ``NodesState``."""
        _check(self, poses="N 3", weights="W")
        if len(self.nodes.sizes) != len(self.poses):
            message = f"{len(self.nodes.sizes)} nodes with {len(self.poses)} poses"
            raise ValueError(message)
        if len(self.weights) > len(self.constraints.ends):  # the newest are not solved yet
            message = f"{len(self.constraints.ends)} constraints with {len(self.weights)} weights"
            raise ValueError(message)
        check_indices("constraints", self.constraints.ends, len(self.poses))


@dataclass(frozen=True, eq=False)
class LocalMapState:
    """Of ``LocalMap``: submaps as ``Submap.to_arrays`` has them, the rest see there.

    Attributes:
        begun: anchors of two submaps, and the pose of the second in the frame of the first.
    """

    submaps: tuple[dict[str, npt.NDArray[Any]], ...]
    components: tuple[int, ...]
    active: int
    node_pose: Pose2
    begun: tuple[tuple[int, int, Pose2], ...]

    def __post_init__(self) -> None:
        """Refuse parts that do not fit each other; see ``NodesState``."""
        if len(self.submaps) != len(self.components):
            message = f"{len(self.submaps)} submaps of {len(self.components)} components"
            raise ValueError(message)
        check_indices("components", self.components, len(self.submaps))


@dataclass(frozen=True, eq=False)
class HypothesisState:
    """Of ``RelocalizationHypothesis``; see there."""

    correction: Pose2
    hits: PendingState
    misses: int
    tested: int


@dataclass(frozen=True, eq=False)
class RelocalizationState:
    """Of ``Relocalization``; see there."""

    hypotheses: tuple[HypothesisState, ...]
    searched: tuple[tuple[int, int], ...]
    failed_searches: int
    kidnapped_m: float


@dataclass(frozen=True, eq=False)
class LoopClosureState:
    """Of ``LoopClosure``; see there."""

    pending: PendingState
    relocalization: RelocalizationState
    last_searched: tuple[tuple[int, int], ...]
    linked_m: tuple[tuple[int, float], ...]
    failure_node: int | None


@dataclass(frozen=True, eq=False)
class PathState:
    """Of ``DrivenPath``: of S scans the times, nodes, motions from these and reported poses.

    Attributes:
        responses: (K, 2) times and responses of the nodes' matches.
    """

    start: Pose2
    stamps_s: F64
    nodes: I64
    motions: F64
    reported: F64
    responses: F64

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit each other; see ``NodesState``."""
        _check(self, stamps_s="S", nodes="S", motions="S 3", reported="S 3", responses="K 2")


@dataclass(frozen=True, eq=False)
class LocalizerState:
    """Of ``Localizer``; see there."""

    tracker: TrackerState
    quality: TrackingQuality


@dataclass(frozen=True, eq=False)
class GraphState:
    """Of ``GraphSlam``: its objects, and the last scan's time."""

    health: GraphHealth
    last_stamp_s: float | None
    localizer: LocalizerState
    graph: MapGraphState
    local_map: LocalMapState
    loops: LoopClosureState
    path: PathState

    def __post_init__(self) -> None:
        """Refuse what leads to nodes and submaps that are not there.

        Raises:
            ValueError: an index is out of range.
        """
        nodes, submaps = len(self.graph.poses), len(self.local_map.submaps)
        check_indices("path.nodes", self.path.nodes, nodes, first=-1)
        if submaps:
            check_indices("local_map.active", self.local_map.active, submaps)
        anchors = [int(arrays["own"][0]) for arrays in self.local_map.submaps]
        check_indices("local_map.submaps", anchors, nodes)
        for one, other, _ in self.local_map.begun:
            check_indices("local_map.begun", (one, other), nodes)
        check_indices("loops.pending", self.loops.pending.constraints.ends, nodes)
        for hypothesis in self.loops.relocalization.hypotheses:
            check_indices("loops.relocalization", hypothesis.hits.constraints.ends, nodes)
        for name in ("last_searched", "linked_m"):
            check_indices(f"loops.{name}", [one for one, _ in getattr(self.loops, name)], submaps)


def _check(state: Any, **shapes: str) -> None:
    """Refuse arrays of a state that have other shapes, or numbers that are not finite."""
    arrays = {name: getattr(state, name) for name in shapes}
    check_shapes(arrays, shapes)
    check_finite(arrays)


def _rows(poses: Sequence[Pose2]) -> F64:
    return np.array([row_of(pose) for pose in poses], dtype=np.float64).reshape(-1, 3)


def _poses(rows: F64) -> list[Pose2]:
    return [Pose2(x, y, yaw) for x, y, yaw in rows.tolist()]
