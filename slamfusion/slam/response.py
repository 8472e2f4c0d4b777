"""How surely a match tells where the robot is, from the response around it [O09].

The response is the mean wall value under a scan's hits. Where it falls off steeply around its
peak the place is certain; along a corridor it stays level, and nothing is known that way.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.slam.matcher import ScanOnTiles

__all__ = [
    "LEAST_SIGMA",
    "MOST_SIGMA",
    "information_of",
    "response_bend",
    "response_information",
    "settled_by",
]

F64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Steps along which the surface is measured, and what its curvature is worth: a response that is
# lower by 1 / RESPONSE_GAIN makes a pose e^-0.5 as likely. The spread of repeated noisy matches
# asks for it.
SURFACE_M, SURFACE_RAD = 0.05, 0.01
RESPONSE_GAIN = 240.0
# No match tells more, or less, than these standard deviations, metres.
LEAST_SIGMA, MOST_SIGMA = 0.005, 0.5
# A direction in which a match tells less than this deviation is open: it is left to odometry. In
# rooms even the weakest direction is told better by half of it; in a bare corridor far worse.
OPEN_SIGMA = 0.06
# A radian weighs as metres at this distance where eigenvalues are limited.
_ARM_M = 5.0
_UNITS = np.outer([1.0, 1.0, 1.0 / _ARM_M], [1.0, 1.0, 1.0 / _ARM_M])


def response_information(scan: ScanOnTiles, pose: F64) -> F64:
    """Return (3, 3) the information of a match along the axes of the map it was matched on.

    Args:
        scan: over the map.
        pose: (3,) the match, metres and radians.
    """
    return information_of(response_bend(scan, pose))


def information_of(bend: F64) -> F64:
    """Return (3, 3) the information of a match around which the response bends so, (3, 3)."""
    values, vectors = np.linalg.eigh(RESPONSE_GAIN * bend * _UNITS)
    kept = np.clip(values, MOST_SIGMA**-2.0, LEAST_SIGMA**-2.0)
    is_place = np.hypot(vectors[0], vectors[1]) > np.abs(vectors[2])
    kept[is_place & (values < OPEN_SIGMA**-2.0)] = MOST_SIGMA**-2.0
    return np.asarray((vectors * kept) @ vectors.T / _UNITS)


def settled_by(bend: F64, pose: F64, guess: F64) -> F64:
    """Return a match moved to a guess along the direction in which it tells nothing, if any.

    Where walls run along, new readings lie thinner than old ones, which draws a match back;
    odometry knows better.

    Args:
        bend: (3, 3) of the response at the match.
        pose: (3,) the match; it is this array that comes back where every direction is told.
        guess: (3,) where odometry has the robot.
    """
    values, vectors = np.linalg.eigh(RESPONSE_GAIN * bend[:2, :2])
    if values[0] >= OPEN_SIGMA**-2.0:
        return pose
    settled, along = pose.copy(), vectors[:, 0]
    settled[:2] += along * (along @ (guess[:2] - pose[:2]))
    return settled


def response_bend(scan: ScanOnTiles, pose: F64) -> F64:
    """Return (3, 3) how fast the response falls: its second derivatives, negative.

    Measured along x and y and then once more along their own axes: a wall's response is no
    parabola, and across it differences along other axes see a bend where there is none.

    Args:
        scan: over the map.
        pose: (3,) the match, metres and radians.
    """
    _, vectors = np.linalg.eigh(_bend_along(scan, pose, np.eye(3), _LEVEL)[:2, :2])
    axes = np.eye(3)
    axes[:2, :2] = vectors
    return _bend_along(scan, pose, axes)


def _bend_along(scan: ScanOnTiles, pose: F64, axes: F64, places: Mask | slice = slice(None)) -> F64:
    """Return the same by differences along the columns of ``axes``, (3, 3).

    Args:
        scan, pose: see ``response_bend``.
        axes: (3, 3).
        places: of the stencil, (K,) bool; derivatives for which one is left out are wrong.
    """
    steps = np.array([SURFACE_M, SURFACE_M, SURFACE_RAD])
    scores = scan.scores(pose + (_STENCIL[places] * steps) @ axes.T)
    local = -np.einsum("kij,k->ij", _SECOND[places], scores) / np.outer(steps, steps)
    return np.asarray(axes @ local @ axes.T)


def _stencil() -> tuple[F64, F64]:
    """Return (K, 3) places and (K, 3, 3) weights that give the second derivatives there."""
    places = [np.zeros(3)]
    weights = [np.zeros((3, 3))]
    for axis in range(3):
        for sign in (1.0, -1.0):
            place, weight = np.zeros(3), np.zeros((3, 3))
            place[axis], weight[axis, axis] = sign, 1.0
            places.append(place)
            weights.append(weight)
        weights[0][axis, axis] = -2.0
    for one, other in ((0, 1), (0, 2), (1, 2)):
        for a in (1.0, -1.0):
            for b in (1.0, -1.0):
                place, weight = np.zeros(3), np.zeros((3, 3))
                place[one], place[other] = a, b
                weight[one, other] = weight[other, one] = 0.25 * a * b
                places.append(place)
                weights.append(weight)
    return np.array(places), np.array(weights)


_STENCIL, _SECOND = _stencil()
# Where the yaw stays: enough for x and y alone.
_LEVEL = _STENCIL[:, 2] == 0.0
