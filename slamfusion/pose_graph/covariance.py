"""Covariances of x, y and yaw under a change of axes or of the point they speak of."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def inverted(information: Array) -> Array:
    """Return the covariances of informations, (K, 3, 3)."""
    return np.asarray(np.linalg.inv(information), np.float64)


def turned(covariance: Array, yaw_rad: Array) -> Array:
    """Return covariances as seen in a frame in which their own frame has the yaw ``yaw_rad``.

    Args:
        covariance: (K, 3, 3) of x, y, yaw.
        yaw_rad: (K,).
    """
    turn = _turns(yaw_rad)
    return np.asarray(turn @ covariance @ turn.transpose(0, 2, 1))


def turned_vectors(vectors: Array, yaw_rad: Array) -> Array:
    """Return vectors of x, y, yaw, (K, 3), as seen in such a frame."""
    return np.asarray((_turns(yaw_rad) @ vectors[..., None])[..., 0])


def moved(covariance: Array, way: Array) -> Array:
    """Return covariances of another point of the same rigid body.

    Args:
        covariance: (K, 3, 3) of x, y, yaw.
        way: (K, 2 or more) x and y from the old to the new point, in the same axes.
    """
    lever = np.tile(np.eye(3), (len(covariance), 1, 1))
    lever[:, 0, 2], lever[:, 1, 2] = -way[:, 1], way[:, 0]
    return np.asarray(lever @ covariance @ lever.transpose(0, 2, 1))


def _turns(yaw_rad: Array) -> Array:
    """Return the matrices that turn x and y, (K, 3, 3)."""
    turn = np.zeros((len(yaw_rad), 3, 3))
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    turn[:, 0, 0] = turn[:, 1, 1] = cos
    turn[:, 0, 1], turn[:, 1, 0] = -sin, sin
    turn[:, 2, 2] = 1.0
    return turn
