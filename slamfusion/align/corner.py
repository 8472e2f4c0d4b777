"""Are the walls that two maps share more than one corner?

Two straight walls that meet hold a motion in every direction and fit the corner of any other
building as well as their own: where nearly all common walls lie on two straight lines, three
numbers were fitted to three, and nothing is left that bears the answer out.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.align.features import GridFeatures
from slamfusion.align.scale import common_walls
from slamfusion.align.search import wall_widths
from slamfusion.compute import ComputeDevice

F64 = npt.NDArray[np.float64]

# A line takes what lies within such a band, metres, and the least in cells: a wall with both faces.
BAND_M, BAND_CELLS_MIN = 0.3, 3.0
# Directions that are tried, degrees: all in coarse steps, fine ones around the best of them.
COARSE, FINE = np.arange(0.0, 180.0, 1.0), np.arange(-0.9, 0.91, 0.1)
# Points that are looked at, each stands for its share; fewer find the direction.
POINTS, COARSE_POINTS = 1024, 256
# Rounding, cells: a point that a band begins with lies on it.
NIL = 1e-6


def beside_lines_m(
    reference: GridFeatures, moving: GridFeatures, motion: F64, device: ComputeDevice
) -> float:
    """Return the metres of common wall beside the two straight lines that take most of it.

    Args:
        reference, moving: the two grids.
        motion: (3,) where the moving centre lands, cells, and yaw.
        device: holds the distances of walls.
    """
    size = reference.grid.grid.resolution
    walls = common_walls(reference, moving, motion, wall_widths(reference)[0], device)
    if not len(walls):
        return 0.0
    points = _sample(walls, POINTS)
    beside = beside_lines(points, max(BAND_M / size, BAND_CELLS_MIN))
    return size * len(walls) * beside / len(points)


def beside_lines(points: F64, band: float) -> int:
    """Return how many points, (N, 2), lie beside the two straight bands that take most of them.

    The direction of a band is that of a sample; of many long walls it may take the second longest.

    Args:
        points: x and y.
        band: width of one, in the unit of the points.
    """
    left = points
    for _ in range(2):
        if not len(left):
            break
        degrees, _ = _widest(_sample(left, COARSE_POINTS), COARSE, band)
        degrees, first = _widest(left, degrees + FINE, band)
        across = left @ _normal(degrees)
        left = left[(across < first - NIL) | (across > first + band + NIL)]
    return len(left)


def _sample(points: F64, most: int) -> F64:
    """Return at most so many of the points, evenly strided."""
    return points[:: -(-len(points) // most)]


def _widest(points: F64, degrees: F64, band: float) -> tuple[float, float]:
    """Return direction and beginning of the band that takes most points."""
    across = np.sort(_normal(degrees).T @ points.T, axis=1)
    taken = np.stack([np.searchsorted(row, row + band, side="right") for row in across])
    taken -= np.arange(len(points))
    best = np.unravel_index(taken.argmax(), taken.shape)
    return float(degrees[best[0]]), float(across[best])


def _normal(degrees: float | F64) -> F64:
    """Return the unit vector, or (2, K) of them, across lines that run at an angle."""
    return np.stack((np.cos(np.radians(degrees)), np.sin(np.radians(degrees))))
