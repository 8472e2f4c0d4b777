"""Where the particles of a filter have been: a tree of poses, and the scans between its nodes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2, compose_poses, wrap_angles
from slamfusion.slam.common.shapes import check_finite, check_indices, check_kinds, check_shapes
from slamfusion.trajectory import Trajectory

__all__ = ["ParticlePaths"]

F64 = npt.NDArray[np.float64]

# Least standard deviations of a cloud, metres, metres, radians: its entropy stays finite.
LEAST_SIGMAS = (1e-3, 1e-3, 1e-3)

# Of what is saved: T nodes of N particles, S scans.
SHAPES = {
    "node_poses": "T N 3",
    "node_parents": "T N",
    "node_entropies": "T",
    "scan_stamps_s": "S",
    "scan_nodes": "S",
    "scan_motions": "S 3",
}
KINDS: dict[str, npt.DTypeLike] = {
    **dict.fromkeys(SHAPES, np.float64),
    "node_parents": np.int32,
    "scan_nodes": np.int64,
}


class ParticlePaths:
    """The paths of N particles.

    A node is a filter step: a pose of each particle and its parent in the node before. Scans
    between two nodes are the same small motion for every particle, counted from the last node.
    """

    def __init__(self, count: int) -> None:
        """Start without a node."""
        self._count = count
        self._poses: list[F64] = []
        self._parents: list[npt.NDArray[np.int32]] = []
        self._entropies: list[float] = []
        self._stamps: list[float] = []
        self._nodes: list[int] = []
        self._motions: list[tuple[float, float, float]] = []

    @property
    def memory_bytes(self) -> int:
        """Bytes of nodes and scans."""
        return len(self._poses) * self._count * 28 + len(self._stamps) * 40

    def add_node(self, poses: F64, parents: npt.NDArray[np.int64] | None) -> None:
        """Add a filter step.

        Args:
            poses: (N, 3), metres and radians.
            parents: (N,) which particle of the node before each descends from; None: itself.
        """
        own = np.arange(self._count) if parents is None else parents
        self._poses.append(poses.copy())
        self._parents.append(own.astype(np.int32))
        self._entropies.append(_entropy(poses))

    def add_scan(self, stamp_s: float, moved: Pose2) -> None:
        """Add a scan that lies so far behind the last node; before the first, behind the origin."""
        self._stamps.append(stamp_s)
        self._nodes.append(len(self._poses) - 1)
        self._motions.append((moved.x, moved.y, moved.yaw_rad))

    def path(self, index: int, name: str) -> Trajectory:
        """Return the path of a particle at every scan."""
        at = np.empty((len(self._poses), 3))
        for number in range(len(self._poses) - 1, -1, -1):
            at[number] = self._poses[number][index]
            index = int(self._parents[number][index])
        # Node -1, before the first, is the frame's origin.
        at = np.concatenate((at, np.zeros((1, 3))))
        nodes = np.array(self._nodes, dtype=np.int64)
        motions = np.array(self._motions).reshape(-1, 3)
        return Trajectory(np.array(self._stamps), compose_poses(at[nodes], motions), name)

    def entropy(self) -> float | None:
        """Return the mean over the nodes of the entropy of the particles there, in nats."""
        return float(np.mean(self._entropies)) if self._entropies else None

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything as arrays, for saving."""
        return {
            "node_poses": np.array(self._poses).reshape(-1, self._count, 3),
            "node_parents": np.array(self._parents, dtype=np.int32).reshape(-1, self._count),
            "node_entropies": np.array(self._entropies),
            "scan_stamps_s": np.array(self._stamps),
            "scan_nodes": np.array(self._nodes, dtype=np.int64),
            "scan_motions": np.array(self._motions).reshape(-1, 3),
        }

    def restore(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Take over what ``to_arrays`` returned.

        Raises:
            ValueError: arrays that do not fit each other.
        """
        arrays = dict(arrays)
        lengths = check_shapes(arrays, SHAPES)
        check_kinds(arrays, KINDS)
        check_finite(arrays)
        check_indices("node_parents", arrays["node_parents"], self._count)
        check_indices("scan_nodes", arrays["scan_nodes"], lengths["T"], first=-1)
        if lengths["N"] != self._count:
            message = f"paths of {lengths['N']} particles, wanted {self._count}"
            raise ValueError(message)
        self._poses = list(arrays["node_poses"])
        self._parents = list(arrays["node_parents"])
        self._entropies = arrays["node_entropies"].tolist()
        self._stamps = arrays["scan_stamps_s"].tolist()
        self._nodes = arrays["scan_nodes"].tolist()
        self._motions = [(x, y, yaw) for x, y, yaw in arrays["scan_motions"].tolist()]


def _entropy(poses: F64) -> float:
    """Return the entropy of a Gaussian around poses (N, 3), nats."""
    away = poses - poses[0]
    away[:, 2] = wrap_angles(away[:, 2])
    spread = away - away.mean(axis=0)
    covariance = spread.T @ spread / len(poses) + np.diag(np.square(LEAST_SIGMAS))
    _, log_determinant = np.linalg.slogdet(covariance)
    return 0.5 * (3.0 * math.log(math.tau * math.e) + float(log_determinant))
