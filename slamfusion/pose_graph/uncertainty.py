"""The uncertainty of one pose of a graph relative to another."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamfusion.geometry import F64, I64
from slamfusion.pose_graph.least_squares import Measurements, NormalEquations, factorise


def inverted(information: F64) -> F64:
    """Return the covariances of informations, (K, 3, 3)."""
    return np.asarray(np.linalg.inv(information), np.float64)


def turned(covariance: F64, yaw_rad: F64) -> F64:
    """Return covariances (K, 3, 3) in a frame in which their own frame has the yaw (K,)."""
    turn = _turns(yaw_rad)
    return np.asarray(turn @ covariance @ turn.transpose(0, 2, 1))


def moved(covariance: F64, way: F64) -> F64:
    """Return covariances (K, 3, 3) at another point of the body, at an offset (K, 2 or more)."""
    lever = np.tile(np.eye(3), (len(covariance), 1, 1))
    lever[:, 0, 2], lever[:, 1, 2] = -way[:, 1], way[:, 0]
    return np.asarray(lever @ covariance @ lever.transpose(0, 2, 1))


def _turns(yaw_rad: F64) -> F64:
    turn = np.zeros((len(yaw_rad), 3, 3))
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    turn[:, 0, 0] = turn[:, 1, 1] = cos
    turn[:, 0, 1], turn[:, 1, 0] = -sin, sin
    turn[:, 2, 2] = 1.0
    return turn


# Pairs solved for together: with six, BLAS wakes threads that take five to ten times as long.
PAIRS_AT_ONCE = 3
# Half axes of the ellipsoid of all motions: this many deviations of the places, and half a turn.
ROOM_DEVIATIONS = math.sqrt(6.0)


@dataclass(frozen=True, eq=False)
class Gates:
    """How edges agree with a graph they are not in.

    Attributes:
        errors: (K,) by how much the least sum of squares would rise if each were added alone, to
            first order: its squared error in the deviations of itself and the graph together
            (Mahalanobis distance).
        chances: (K,) in [0, 1], of a false edge between the same poses to agree at least as well:
            the share of all motions within the map that do. 1 where the graph knows nothing.
    """

    errors: F64
    chances: F64


def relative_covariances(equations: NormalEquations, poses: F64, pairs: I64) -> F64:
    """Return covariances of the second poses relative to the first, pairs (K, 2), (K, 3, 3).

    Of x, y in metres and yaw in radians, in the world's axes, at poses (N, 3) where the sum of
    squares is least. The equations are linearised there and factorised once.
    """
    equations.linearise(poses)
    place, factor = equations.place, factorise(equations.matrix())
    parts = [np.zeros((0, 3, 3))]
    for start in range(0, len(pairs), PAIRS_AT_ONCE):
        first, second = pairs[start : start + PAIRS_AT_ONCE].T
        count = len(first)
        way = poses[second, :2] - poses[first, :2]
        of_first = np.tile(-np.eye(3), (count, 1, 1))
        of_first[:, 0, 2], of_first[:, 1, 2] = way[:, 1], -way[:, 0]
        of_second = np.tile(np.eye(3), (count, 1, 1))
        sides = np.zeros((3 * len(equations.free), count, 3))
        moves = []
        for ends, jacobian in ((first, of_first), (second, of_second)):
            free = np.flatnonzero(place[ends] >= 0)
            rows = 3 * place[ends[free], None] + np.arange(3)
            sides[rows, free[:, None]] += jacobian[free].transpose(0, 2, 1)
            moves.append((free, rows, jacobian[free]))
        solved = factor.solve(sides.reshape(len(sides), -1)).reshape(sides.shape)
        covariance = np.zeros((count, 3, 3))
        for free, rows, jacobian in moves:
            covariance[free] += jacobian @ solved[rows, free[:, None]]
        parts.append(covariance)
    return np.concatenate(parts)


def gates(equations: NormalEquations, poses: F64, candidates: Measurements) -> Gates:
    """Check edges against a graph at its poses (N, 3), where the sum of squares is least."""
    measured = poses[candidates.start, 2] + candidates.motions[:, 2]
    own = turned(inverted(candidates.information), measured)
    vectors = (_turns(measured) @ candidates.errors(poses).T[..., None])[..., 0]
    covariance = relative_covariances(equations, poses, candidates.edges) + own
    errors = np.einsum("ki,ki->k", vectors, np.linalg.solve(covariance, vectors[..., None])[..., 0])
    # The motions that agree as well fill an ellipsoid, limited to those between places of the map.
    filled, room = errors[:, None, None] * covariance, np.zeros((3, 3))
    room[:2, :2] = ROOM_DEVIATIONS**2 * np.cov(poses[:, :2], rowvar=False)
    room[2, 2] = math.pi**2
    whole = np.maximum(np.linalg.det(filled + room), np.finfo(np.float64).tiny)
    return Gates(errors, np.sqrt(np.clip(np.linalg.det(filled) / whole, 0.0, 1.0)))
