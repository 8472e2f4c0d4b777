"""``IncrementalGraph``: a pose graph that grows while a robot drives, and stays optimised."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from slamfusion.errors import GraphError
from slamfusion.geometry import compose_poses, invert_poses, wrap_angles
from slamfusion.pose_graph.covariance import inverted, moved, turned
from slamfusion.pose_graph.descend import descend
from slamfusion.pose_graph.graph import PoseGraph
from slamfusion.pose_graph.measurements import Measurements
from slamfusion.pose_graph.normal_equations import NormalEquations
from slamfusion.pose_graph.optimize import Optimized, Robust, optimize
from slamfusion.pose_graph.uncertainty import Uncertainty

__all__ = ["IncrementalGraph"]

Array = npt.NDArray[np.float64]

# Poses before the first one that new edges pull at, which may move too between closures.
WINDOW_MARGIN = 10
# A window of more poses is no cheaper than everything.
WINDOW_POSES = 100
WINDOW_ITERATIONS = 4


class IncrementalGraph:
    """Poses and edges that are added one by one; pose 0 is held.

    ``update`` after each scan is cheap: new edges that only carry the path on cost nothing, others
    move the newest poses, and a closure moves all. For an optimisation beside the drive, take a
    ``snapshot``, give it to ``optimize`` elsewhere, and ``apply`` what comes back: poses that came
    meanwhile are carried along.

    Attributes:
        robust: how closures are doubted; see ``optimize``.
    """

    def __init__(self, robust: Robust = "consensus") -> None:
        self.robust: Robust = robust
        self._poses = np.zeros((0, 3))
        self._edges: list[tuple[int, int]] = []
        self._motions: list[Array] = []
        self._information: list[Array] = []
        self._is_closure: list[bool] = []
        self._weights = np.zeros(0)
        self._first_edge: dict[int, int] = {}
        self._settled_edges = 0
        self._known: tuple[Uncertainty, int, Array] | None = None

    def __len__(self) -> int:
        """Poses."""
        return len(self._poses)

    @property
    def poses(self) -> Array:
        """(N, 3) float64 x, y in metres and yaw in radians; a copy."""
        return self._poses.copy()

    @property
    def weights(self) -> Array:
        """(M,) weights of the edges, as the last optimisation left them; new edges have 1."""
        fresh = np.ones(len(self._edges) - len(self._weights))
        return np.concatenate((self._weights, fresh))

    def add_pose(self, pose: Sequence[float] | Array) -> int:
        """Add a pose (x, y, yaw) where it is taken to be, and return its index."""
        row = np.asarray(pose, np.float64).reshape(1, 3)
        if not np.isfinite(row).all():
            message = f"pose {len(self)} is not finite"
            raise GraphError(message)
        self._poses = np.concatenate((self._poses, row))
        return len(self) - 1

    def add_edge(
        self,
        start: int,
        end: int,
        motion: Sequence[float] | Array,
        information: npt.ArrayLike,
        *,
        is_closure: bool = False,
    ) -> int:
        """Add a measurement and return its index.

        Args:
            start: index of the pose from which was measured.
            end: index of the measured pose.
            motion: (3,) pose of ``end`` in the frame of ``start``.
            information: (3, 3) inverse covariance, in the frame of the measured pose.
            is_closure: it may be false.

        Raises:
            GraphError: what ``PoseGraph`` refuses.
        """
        PoseGraph(
            poses=self._poses,
            edges=np.array([(start, end)]),
            motions=np.asarray(motion, np.float64),
            information=np.asarray(information, np.float64),
            is_closure=np.array([is_closure]),
        )
        index = len(self._edges)
        self._edges.append((start, end))
        self._motions.append(np.asarray(motion, np.float64))
        self._information.append(np.asarray(information, np.float64))
        self._is_closure.append(is_closure)
        if not is_closure:
            self._first_edge.setdefault(max(start, end), index)
        return index

    def snapshot(self) -> PoseGraph:
        """Return the graph as it is now."""
        return PoseGraph(
            poses=self._poses,
            edges=np.array(self._edges, np.int64).reshape(-1, 2),
            motions=np.array(self._motions).reshape(-1, 3),
            information=np.array(self._information).reshape(-1, 3, 3),
            is_closure=np.array(self._is_closure, np.bool_),
        )

    def apply(self, optimized: Optimized) -> None:
        """Take over the poses and weights of an optimised snapshot.

        Poses that came since are carried along with the last one of the snapshot.
        """
        count = len(optimized.poses)
        carried = compose_poses(
            optimized.poses[-1],
            compose_poses(invert_poses(self._poses[count - 1]), self._poses[count:]),
        )
        self._poses = np.concatenate((optimized.poses, carried))
        self._weights = optimized.weights
        self._settled_edges = max(self._settled_edges, len(optimized.weights))
        self._known = None

    def optimize(self) -> Optimized:
        """Optimise everything from where it is and take it over.

        Closures left out last time are doubted anew only if new ones do not fit.

        Raises:
            GraphError: poses that no edge joins with the rest.
        """
        optimized = optimize(
            self.snapshot(), robust=self.robust, start="given", weights=self._weights
        )
        self.apply(optimized)
        return optimized

    def update(self) -> Optimized | None:
        """Take the edges since the last update into account, as cheaply as they allow.

        Returns:
            What ``optimize`` found where it was called for: after a closure, or where new edges
            pull at poses long past; else None.
        """
        fresh = range(self._settled_edges, len(self._edges))
        self._settled_edges = len(self._edges)
        if any(self._is_closure[edge] for edge in fresh):
            return self.optimize()
        pulling = [edge for edge in fresh if self._first_edge[max(self._edges[edge])] != edge]
        if not pulling:
            return None
        earliest = min(min(self._edges[edge]) for edge in pulling) - WINDOW_MARGIN
        if len(self) - earliest > WINDOW_POSES:
            return self.optimize()
        self._move_from(max(earliest, 1))
        return None

    def relative_covariance(self, first: int, second: int) -> Array:
        """Return how well one pose is known in the frame of another, (3, 3).

        In the axes of the second pose: what an edge between them could add to. Poses since the last
        optimisation hang on their first edges alone, so theirs is rather too large than too small.

        Raises:
            GraphError: a pose hangs on nothing.
        """
        uncertainty, count, poses = self._uncertainty()
        ways = [self._way_back(pose, count) for pose in (first, second)]
        # Where both ways come together the rest is common and adds nothing.
        shared = set(ways[0][1]) & set(ways[1][1])
        point = self._poses[second]
        total = np.zeros((1, 3, 3))
        for edge in set(ways[0][1]) ^ set(ways[1][1]):
            total += self._noise_at(edge, point)
        roots = (ways[0][0], ways[1][0])
        if not shared and roots[0] != roots[1]:
            between = uncertainty.in_world_axes(np.array([roots]))
            between = turned(between, self._poses[roots[1], 2:] - poses[roots[1], 2:])
            total += moved(between, (point - self._poses[roots[1]])[None])
        return np.asarray(turned(total, -point[2:])[0])

    def _uncertainty(self) -> tuple[Uncertainty, int, Array]:
        """Return the uncertainty of the graph at the last optimisation, and its poses."""
        if self._known is None:
            graph = self.snapshot()
            measured = Measurements(graph.edges, graph.motions, graph.information)
            believed = measured.chosen(self.weights >= 0.5)
            equations = NormalEquations(believed, len(graph), (0,))
            try:
                uncertainty = Uncertainty(equations, graph.poses)
            except RuntimeError:
                message = "the graph has poses that no edge joins with the rest"
                raise GraphError(message) from None
            self._known = (uncertainty, len(graph), graph.poses)
        return self._known

    def _way_back(self, pose: int, count: int) -> tuple[int, list[int]]:
        """Return the first of the poses below ``count`` that a pose hangs on, and the edges."""
        edges = []
        while pose >= count:
            if pose not in self._first_edge:
                message = f"pose {pose} hangs on no earlier pose"
                raise GraphError(message)
            edges.append(self._first_edge[pose])
            pose = min(self._edges[edges[-1]])
        return pose, edges

    def _noise_at(self, edge: int, point: Array) -> Array:
        """Return the covariance of an edge at a point that goes with its far end, (1, 3, 3)."""
        measured = self._poses[self._edges[edge][1]]
        own = turned(inverted(self._information[edge][None]), measured[2:])
        return moved(own, (point - measured)[None])

    def _move_from(self, earliest: int) -> None:
        """Fit the poses from one on, those before held."""
        reaching = [edge for edge, ends in enumerate(self._edges) if max(ends) >= earliest]
        ends = np.array([self._edges[edge] for edge in reaching], np.int64)
        nodes, local = np.unique(ends, return_inverse=True)
        measured = Measurements(
            local.reshape(-1, 2).astype(np.int64),
            np.array([self._motions[edge] for edge in reaching]),
            np.array([self._information[edge] for edge in reaching]),
        )
        held = np.flatnonzero(nodes < earliest).tolist()
        equations = NormalEquations(measured, len(nodes), held)
        weights = self.weights[reaching]
        descent = descend(equations, self._poses[nodes], weights, max_iterations=WINDOW_ITERATIONS)
        moved_poses = descent.poses
        moved_poses[:, 2] = wrap_angles(moved_poses[:, 2])
        self._poses[nodes] = moved_poses
