"""Where the particles of a filter have been: a tree of poses, and the scans between its nodes."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2, compose_poses, wrap_angles
from slamfusion.slam.common.state import Stateful
from slamfusion.trajectory import Trajectory

F64 = npt.NDArray[np.float64]

# Least standard deviations of a cloud, metres, metres, radians: its entropy stays finite.
LEAST_SIGMAS = (1e-3, 1e-3, 1e-3)


class ParticlePaths(Stateful):
    """The paths of N particles.

    A node is a filter step: a pose of each particle and its parent in the node before. Scans
    between two nodes are the same small motion for every particle, counted from the last node.
    """

    STATE = ("_poses", "_parents", "_entropies", "_stamps", "_nodes", "_motions")

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


def _entropy(poses: F64) -> float:
    """Return the entropy of a Gaussian around poses (N, 3), nats."""
    away = poses - poses[0]
    away[:, 2] = wrap_angles(away[:, 2])
    spread = away - away.mean(axis=0)
    covariance = spread.T @ spread / len(poses) + np.diag(np.square(LEAST_SIGMAS))
    _, log_determinant = np.linalg.slogdet(covariance)
    return 0.5 * (3.0 * math.log(math.tau * math.e) + float(log_determinant))
