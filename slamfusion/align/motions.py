"""Rigid motions of one grid onto another, in cells.

A motion is in cells of the common lattice: (x, y, yaw) maps the moving grid's lattice into the
reference's, as x_ref = R(yaw) (x - centre of moving) + (x, y): (x, y) is where the centre lands.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import FIXED_ONE

F64 = npt.NDArray[np.float64]
Columns = tuple[F64, F64, F64, F64]


def to_lattice(motions: F64, centre: tuple[float, float]) -> F64:
    """Return motions given by where the centre lands as (x, y, yaw) that map lattice origins."""
    cos, sin = np.cos(motions[:, 2]), np.sin(motions[:, 2])
    x = motions[:, 0] - cos * centre[0] + sin * centre[1]
    y = motions[:, 1] - sin * centre[0] - cos * centre[1]
    return np.stack((x, y, motions[:, 2]), axis=1)


def invert(motions: F64) -> F64:
    """Return the inverse of lattice motions (N, 3)."""
    cos, sin = np.cos(motions[:, 2]), np.sin(motions[:, 2])
    x = -cos * motions[:, 0] - sin * motions[:, 1]
    y = sin * motions[:, 0] - cos * motions[:, 1]
    return np.stack((x, y, -motions[:, 2]), axis=1)


def fixed_similarities(
    motions: F64, centre: tuple[float, float], scales: F64 | None = None
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return (P, 4) fixed poses from the moving lattice to the reference's, and back.

    Args:
        motions: (P, 3) where the moving centre lands, cells, and yaw.
        centre: the moving map's, cells.
        scales: (P,) how much longer the moving map's metre is taken, about its centre; None: 1.
    """
    there, back = (_fixed(*columns) for columns in both_ways(motions, centre, scales))
    return there, back


def both_ways(
    motions: F64, centre: tuple[float, float], scales: F64 | None = None
) -> tuple[Columns, Columns]:
    """Return cos, sin, x and y from the moving lattice to the reference's, and back.

    Args:
        motions, centre, scales: see ``fixed_similarities``.

    Returns:
        Twice four columns (P,), x and y in cells.
    """
    # By columns: each is one stretch of memory, which is what makes many poses quick.
    x, y, yaw = np.ascontiguousarray(motions.T)
    cos, sin = np.cos(yaw), np.sin(yaw)
    if scales is not None:
        cos, sin = scales * cos, scales * sin
    x = x - cos * centre[0] + sin * centre[1]
    y = y - sin * centre[0] - cos * centre[1]
    there = cos, sin, x, y
    if scales is not None:
        cos, sin = cos / scales**2, sin / scales**2
    return there, (cos, -sin, -(cos * x + sin * y), sin * x - cos * y)


def _fixed(cos: F64, sin: F64, x: F64, y: F64) -> npt.NDArray[np.int64]:
    """Return columns (P,) in fixed point, side by side: (P, 4), each one stretch."""
    fixed = np.empty((4, len(cos)), dtype=np.int64)
    for row, column in zip(fixed, (cos, sin, 2.0 * x, 2.0 * y), strict=True):
        row[:] = np.rint(column * float(FIXED_ONE))
    return fixed.T


def turned_about(motion: F64, middle: F64, turns: F64) -> F64:
    """Return (P, 3) a motion, turned further about a place that stays.

    Args:
        motion: (3,).
        middle: (2,) the place, x and y in cells of the reference.
        turns: (P,) rad.
    """
    x, y = motion[:2] - middle
    cos, sin = np.cos(turns), np.sin(turns)
    return np.stack(
        (middle[0] + cos * x - sin * y, middle[1] + sin * x + cos * y, motion[2] + turns), axis=1
    )


def displacement(a: F64, b: F64) -> tuple[float, float]:
    """Return how far two motions carry the moving centre apart (cells), and the turn (rad)."""
    turn = (a[2] - b[2] + math.pi) % (2.0 * math.pi) - math.pi
    return float(math.hypot(a[0] - b[0], a[1] - b[1])), abs(float(turn))


def distinct(motions: F64, shift: float, turn: float, most: int | None = None) -> F64:
    """Return motions (best first) without those within ``shift`` cells and ``turn`` of a better.

    Args:
        motions: (P, 3).
        shift: cells.
        turn: rad.
        most: at most this many; None: all.
    """
    return np.asarray(motions[distinct_rows(motions, shift, turn, most)])


def distinct_rows(
    motions: F64, shift: float, turn: float, most: int | None = None
) -> npt.NDArray[np.intp]:
    """Return which rows ``distinct`` keeps, ascending."""
    kept: list[int] = []
    left = np.arange(len(motions))
    while len(left) and (most is None or len(kept) < most):
        best = motions[left[0]]
        kept.append(int(left[0]))
        left = left[1:]
        away = np.hypot(motions[left, 0] - best[0], motions[left, 1] - best[1]) >= shift
        turned = np.mod(motions[left, 2] - best[2] + math.pi, 2.0 * math.pi) - math.pi
        left = left[away | (np.abs(turned) >= turn)]
    return np.array(kept, dtype=np.intp)
