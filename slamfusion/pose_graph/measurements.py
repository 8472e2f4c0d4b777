"""What edges measured, and how far poses are from it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import wrap_angles

Array = npt.NDArray[np.float64]


class Measurements:
    """The measured motions of a graph's edges, or of some of them.

    Errors are those of g2o: of an edge with the measured motion z from pose i to pose j,
    ``e = z^-1 (x_i^-1 x_j)`` as x, y and wrapped yaw.

    Attributes:
        edges: (M, 2) int64, from and to.
        motions: (M, 3) float64 x, y, yaw.
        information: (M, 3, 3) float64.
        start: (M,) int64, from.
        end: (M,) int64, to.
        motion: (3, M), the same motions.
        cos: (M,) of the motions' yaws.
        sin: (M,) of the motions' yaws.
        upper: (6, M), the upper triangles of the information, row by row.
    """

    def __init__(self, edges: npt.NDArray[np.int64], motions: Array, information: Array) -> None:
        self.edges, self.motions, self.information = edges, motions, information
        self.start, self.end = edges[:, 0].copy(), edges[:, 1].copy()
        self.motion = np.ascontiguousarray(motions.T)
        self.cos, self.sin = np.cos(motions[:, 2]), np.sin(motions[:, 2])
        triangle = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        self.upper = np.stack([information[:, row, column] for row, column in triangle])

    def __len__(self) -> int:
        """Edges."""
        return len(self.edges)

    def chosen(self, which: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> Measurements:
        """Return those of some edges, by (M,) bool or by their indices."""
        return Measurements(self.edges[which], self.motions[which], self.information[which])

    def errors(self, poses: Array) -> Array:
        """Return the errors in the frames of the measured poses, (3, M): x, y, wrapped yaw."""
        cos, sin = np.cos(poses[:, 2])[self.start], np.sin(poses[:, 2])[self.start]
        x, y = self.ways(poses)
        across_x = cos * x + sin * y - self.motion[0]
        across_y = cos * y - sin * x - self.motion[1]
        return np.stack(
            (
                self.cos * across_x + self.sin * across_y,
                self.cos * across_y - self.sin * across_x,
                self.turns(poses),
            )
        )

    def squared_errors(self, poses: Array) -> Array:
        """Return each edge's squared error in its own deviations (chi-square), (M,)."""
        e = self.errors(poses)
        i00, i01, i02, i11, i12, i22 = self.upper
        return np.asarray(
            e[0] * (i00 * e[0] + 2.0 * (i01 * e[1] + i02 * e[2]))
            + e[1] * (i11 * e[1] + 2.0 * i12 * e[2])
            + i22 * e[2] * e[2]
        )

    def ways(self, poses: Array) -> tuple[Array, Array]:
        """Return x and y of the way from the first to the last pose of each edge, world's axes."""
        x, y = poses[:, 0], poses[:, 1]
        return x[self.end] - x[self.start], y[self.end] - y[self.start]

    def turns(self, poses: Array) -> Array:
        """Return the errors in yaw, wrapped, (M,)."""
        yaw = poses[:, 2]
        return wrap_angles(yaw[self.end] - yaw[self.start] - self.motion[2])

    def turned_information(self, cos: Array, sin: Array) -> Array:
        """Return the upper triangles of the information in the world's axes, (6, M).

        Args:
            cos: (M,) of the yaws of the first poses.
            sin: (M,) of the same.
        """
        c, s = cos * self.cos - sin * self.sin, sin * self.cos + cos * self.sin
        i00, i01, i02, i11, i12, i22 = self.upper
        return np.stack(
            (
                c * (c * i00 - s * i01) - s * (c * i01 - s * i11),
                s * (c * i00 - s * i01) + c * (c * i01 - s * i11),
                c * i02 - s * i12,
                s * (s * i00 + c * i01) + c * (s * i01 + c * i11),
                s * i02 + c * i12,
                i22,
            )
        )
