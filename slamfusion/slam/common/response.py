"""How surely a match tells where the robot is, from the response around it [O09].

The response is the mean wall value under a scan's hits. Where it falls off steeply around its
peak the place is certain; along a corridor it stays level: that direction is degenerate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.slam.common.matcher import ScanOnTiles

F64 = npt.NDArray[np.float64]

# Steps of the finite differences, metres and radians: a cell's width, and what moves a hit at 5 m
# by as much.
SURFACE_M, SURFACE_RAD = 0.05, 0.01
# Inverse of the response's loss (a share, 0 to 1) that makes a pose e^-0.5 as likely: the spread of
# repeated noisy matches asks for it.
RESPONSE_GAIN = 240.0
# Least and greatest standard deviation of a match, metres (of yaw: at ``_ARM_M``): no match is
# better than a tenth of a cell, and one that tells nothing still keeps the equations solvable.
LEAST_SIGMA, MOST_SIGMA = 0.005, 0.5
# Standard deviation, metres, from which on a direction is degenerate and left to odometry. In rooms
# even the weakest direction is told better by half of it; in a bare corridor far worse.
DEGENERATE_SIGMA_M = 0.06
# Distance of a typical hit, metres: at it a radian weighs as a metre where eigenvalues are limited.
_ARM_M = 5.0
_UNITS = np.outer([1.0, 1.0, 1.0 / _ARM_M], [1.0, 1.0, 1.0 / _ARM_M])


def response_information(scan: ScanOnTiles, pose: F64) -> F64:
    """Return (3, 3) the information of a match along the axes of the map it was matched on.

    Args:
        scan: over the map.
        pose: (3,) the match, metres and radians.
    """
    return information_of(response_hessian(scan, pose))


def information_of(hessian: F64) -> F64:
    """Return (3, 3) the information of a match from the response's negative Hessian, (3, 3)."""
    values, vectors = np.linalg.eigh(RESPONSE_GAIN * hessian * _UNITS)
    kept = np.clip(values, MOST_SIGMA**-2.0, LEAST_SIGMA**-2.0)
    is_place = np.hypot(vectors[0], vectors[1]) > np.abs(vectors[2])
    kept[is_place & (values < DEGENERATE_SIGMA_M**-2.0)] = MOST_SIGMA**-2.0
    return np.asarray((vectors * kept) @ vectors.T / _UNITS)


def keep_degenerate_prior(hessian: F64, pose: F64, expected: F64) -> F64:
    """Return a match moved to the expected pose along its degenerate direction, if it has one.

    Where walls run along, new readings lie thinner than old ones, which draws a match back;
    odometry knows better.

    Args:
        hessian: (3, 3) negative Hessian of the response at the match.
        pose: (3,) the match; it is this array that comes back where no direction is degenerate.
        expected: (3,) where odometry has the robot.
    """
    values, vectors = np.linalg.eigh(RESPONSE_GAIN * hessian[:2, :2])
    if values[0] >= DEGENERATE_SIGMA_M**-2.0:
        return pose
    moved, along = pose.copy(), vectors[:, 0]
    moved[:2] += along * (along @ (expected[:2] - pose[:2]))
    return moved


def response_hessian(scan: ScanOnTiles, pose: F64) -> F64:
    """Return (3, 3) the negative Hessian of the response: how fast it falls.

    Measured along x and y and then once more along their own axes: a wall's response is no
    parabola, and across it differences along other axes see a curvature where there is none.

    Args:
        scan: over the map.
        pose: (3,) the match, metres and radians.
    """
    flat = _hessian_along(scan, pose, np.eye(3), _FLAT)
    turn = 0.5 * math.atan2(2.0 * flat[0, 1], flat[0, 0] - flat[1, 1])
    cos, sin = math.cos(turn), math.sin(turn)
    axes = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return _hessian_along(scan, pose, axes, _FULL)


def _hessian_along(scan: ScanOnTiles, pose: F64, axes: F64, stencil: _Stencil) -> F64:
    """Return the same by differences along the columns of ``axes``, (3, 3).

    Args:
        scan, pose: see ``response_hessian``.
        axes: (3, 3).
        stencil: ``_FULL``, or ``_FLAT``: then only derivatives by x and y are right.
    """
    scores = scan.scores(pose + stencil.steps @ axes.T)
    local = -(stencil.weights @ scores).reshape(3, 3)
    return np.asarray(axes @ local @ axes.T)


class _Stencil(NamedTuple):
    """Where a surface is read, and what makes its second derivatives of that.

    Attributes:
        steps: (K, 3) metres and radians.
        weights: (9, K) of the values read, per metre and radian squared.
    """

    steps: F64
    weights: F64

    def without_turns(self) -> _Stencil:
        """Return the places where the yaw stays: enough for x and y alone."""
        stays = self.steps[:, 2] == 0.0
        return _Stencil(self.steps[stays], self.weights[:, stays])


def _stencil() -> _Stencil:
    """Return the one of all second derivatives."""
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
    sizes = np.array([SURFACE_M, SURFACE_M, SURFACE_RAD])
    seconds = np.array(weights) / np.outer(sizes, sizes)
    return _Stencil(np.array(places) * sizes, seconds.reshape(-1, 9).T.copy())


_FULL = _stencil()
_FLAT = _FULL.without_turns()
