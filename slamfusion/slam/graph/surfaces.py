"""Walls between a scan's hits.

Where a wall runs along, a laser's hits lie far apart on it. A map of the bare hits is a comb whose
teeth draw the next scan's hits back onto themselves: a robot in a corridor stands still, or lags.
Between hits of neighbouring beams that lie on one straight line with the hits beside them there is
a wall; hits are put there too.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

# Distance between hits, metres, from which on they are not joined: there may be a door.
MOST_GAP_M = 1.5
# Distance of the hits on both sides from the line through a gap, metres and a share of the gap, up
# to which they are on one wall: the noise of a laser.
STRAIGHT_M, STRAIGHT_SHARE = 0.03, 0.05
# Angle between two beams, in the median one, up to which they are neighbours: none is missing.
NEIGHBOUR_STEPS = 1.5


def fill_walls(points: F64, laser: F64, step_m: float) -> F64:
    """Return hits and, between those on one wall, further ones.

    Args:
        points: (P, 2) hits in the order of the beams, metres.
        laser: (2,) in the same frame.
        step_m: hits are no farther apart on a wall than this, above 0.

    Returns:
        (Q, 2), the hits first.
    """
    if len(points) < 4:
        return points
    away = points - laser
    bearing = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    turn = np.abs(np.diff(bearing))
    along = np.diff(points, axis=0)
    gap = np.hypot(along[:, 0], along[:, 1])
    is_next = turn <= NEIGHBOUR_STEPS * np.median(turn)
    # The gap from hit i + 1 to hit i + 2, by the hits i and i + 3.
    gaps, lines = gap[1:-1], along[1:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = np.column_stack((-lines[:, 1], lines[:, 0])) / gaps[:, None]
    before = np.abs(np.einsum("ij,ij->i", normal, along[:-2]))
    after = np.abs(np.einsum("ij,ij->i", normal, along[2:]))
    is_wall = (
        (is_next[:-2] & is_next[1:-1] & is_next[2:])
        & ((gaps > step_m) & (gaps <= MOST_GAP_M))
        & (np.maximum(before, after) <= STRAIGHT_M + STRAIGHT_SHARE * gaps)
    )
    first = np.flatnonzero(is_wall)
    if len(first) == 0:
        return points
    counts = np.ceil(gaps[first] / step_m).astype(np.int64) - 1
    owner = np.repeat(first, counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    share = number / np.repeat(counts + 1, counts)
    return np.concatenate((points, points[owner + 1] + share[:, None] * lines[owner]))
