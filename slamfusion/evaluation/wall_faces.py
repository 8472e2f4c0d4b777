"""Measures of walls that do not reward thickness: faces, thickness, and the outside area.

A laser sees only the face of a wall. Filling cells behind it improves cell-by-cell measures against
thick true walls without telling more about free space. Faces are occupied cells next to free ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.compute.lattice import cells_at
from slamfusion.evaluation.distances import wall_centres
from slamfusion.geometry import B8, F64, Pose2
from slamfusion.grid import UNKNOWN, ClassifiedGrid, face_cells

# A wall exactly the tolerance away counts, whatever the rounding of the poses.
_TOLERANCE_SLACK_M = 1e-6


@dataclass(frozen=True)
class WallDistance:
    """Distances from each wall cell of one map to the nearest wall cell of another, metres."""

    mean: float
    """Mean, metres."""
    p95: float
    """95th percentile, metres."""
    max: float
    """The largest, metres."""


# Tolerances of faces, metres: a cell of usual maps, two cells, and a robot's safety margin.
FACE_TOLERANCES_M = (0.05, 0.1, 0.2)

_WALL = 1
# Steps along rows, columns and both diagonals, with their length in cells.
_DIRECTIONS = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, math.sqrt(2.0)), (1, -1, math.sqrt(2.0)))


@dataclass(frozen=True)
class FaceAgreement:
    """How the faces of walls (wall cells next to free ones) agree with the true ones."""

    tolerance_m: float
    """A face this near counts as found, metres."""
    precision: float | None
    """Share of the map's face cells with a true one within the tolerance; null without a face."""
    recall: float | None
    """Share of the true face cells with one of the map within it; null without a face."""
    f1: float | None
    """Harmonic mean of the two; null when one of them is."""


@dataclass(frozen=True)
class WallFaces:
    """The faces of a map's walls against the true ones; thickness counts for nothing."""

    agreements: Sequence[FaceAgreement]
    """At each tolerance, the narrowest first."""
    map_to_truth_m: WallDistance | None
    """From each face cell of the map to the nearest true one; null when a side has none."""
    truth_to_map_m: WallDistance | None
    """From each true face cell to the nearest of the map; null when a side has none."""

    def f1(self, tolerance_m: float) -> float | None:
        """Return F1 at one of the tolerances; None if undefined, KeyError for another one."""
        by_tolerance = {item.tolerance_m: item.f1 for item in self.agreements}
        return by_tolerance[tolerance_m]


@dataclass(frozen=True, eq=False)
class Nearness:
    """Metres from each point of one map to the nearest of another, and back; may be infinite."""

    map_to_truth: F64
    truth_to_map: F64

    @classmethod
    def between(cls, found: F64, expected: F64) -> Nearness:
        """Measure the points of a map, (N, 2) metres, and those of the truth, (M, 2)."""
        # A tree of no points finds nothing: infinitely far.
        there, back = (
            np.asarray(scipy.spatial.KDTree(others).query(points)[0], dtype=np.float64)
            for points, others in ((found, expected), (expected, found))
        )
        return cls(there, back)

    def agreement(self, tolerance_m: float) -> FaceAgreement:
        """Return precision, recall and F1 at a tolerance."""
        near_m = tolerance_m + _TOLERANCE_SLACK_M
        precision, recall = (
            float(np.mean(distances <= near_m)) if len(distances) else None
            for distances in (self.map_to_truth, self.truth_to_map)
        )
        f1 = None
        if precision is not None and recall is not None:
            total = precision + recall
            f1 = 2.0 * precision * recall / total if total else 0.0
        return FaceAgreement(tolerance_m, precision, recall, f1)


def distance_summary(distances: F64) -> WallDistance | None:
    """Return mean, 95th percentile and maximum, or None when a side has no walls."""
    if not len(distances) or not np.isfinite(distances[0]):
        return None
    return WallDistance(
        float(distances.mean()), float(np.percentile(distances, 95)), float(distances.max())
    )


@dataclass(frozen=True)
class WallThickness:
    """How thick walls are, measured through each cell next to a free one, metres."""

    mean: float
    """Mean, metres."""
    median: float
    """The middle one, metres."""
    p95: float
    """95th percentile, metres."""


def compare_faces(grid: ClassifiedGrid, truth: ClassifiedGrid, transform: Pose2) -> WallFaces:
    """Compare the faces of a map's walls with the true ones, both classified.

    Faces are found on each map's own lattice; distances lie between the centres of their cells.
    ``transform`` maps a point of the map's frame into the truth's, metres.
    """
    found, expected = (
        replace(own, cells=face_cells(own.cells).view(np.int8)) for own in (grid, truth)
    )
    faces = Nearness.between(wall_centres(found, transform), wall_centres(expected))
    return WallFaces(
        tuple(map(faces.agreement, FACE_TOLERANCES_M)),
        distance_summary(faces.map_to_truth),
        distance_summary(faces.truth_to_map),
    )


def wall_thickness(grid: ClassifiedGrid) -> WallThickness | None:
    """Measure how thick the walls of a classified map are; None without a face.

    Through each face cell the occupied cells in a row are counted along rows, columns and both
    diagonals; the shortest is the thickness there, so that a slanted wall is hardly thicker.
    """
    faces = face_cells(grid.cells)
    if not faces.any():
        return None
    walls = grid.cells == _WALL
    runs = [
        (_run_behind(walls, row, col) + _run_behind(walls, -row, -col) - 1)[faces] * length
        for row, col, length in _DIRECTIONS
    ]
    thickness_m = np.min(runs, axis=0) * grid.resolution
    return WallThickness(
        float(thickness_m.mean()),
        float(np.median(thickness_m)),
        float(np.percentile(thickness_m, 95)),
    )


def outside_area(
    grid: ClassifiedGrid, truth: ClassifiedGrid, transform: Pose2, *, margin_m: float
) -> float:
    """Return the area that a map knows outside of the truth's outline, square metres.

    The outline holds the known cells of the truth and what they enclose, widened by a margin.
    Beams through glass, reflections and misplaced parts lie outside; the error of [F16] misses what
    is beyond the truth's box.

    Args:
        grid: classified, like ``truth``.
        transform: maps a point of the map's frame into the truth's, metres.
        margin_m: a cell this near to the outline does not count, at least 0.
    """
    outline = scipy.ndimage.binary_fill_holes(truth.cells != UNKNOWN)
    edge = np.argwhere(outline & ~scipy.ndimage.binary_erosion(outline))
    rows, cols = np.nonzero(grid.cells != UNKNOWN)
    points = transform.transform(grid.cell_centres(rows, cols))
    true_rows, true_cols = truth.cell_indices(points)
    is_beyond = ~cells_at(outline, true_rows, true_cols, False)
    beyond = np.column_stack((true_rows, true_cols))[is_beyond]
    away, _ = scipy.spatial.KDTree(edge).query(beyond)
    margin = np.floor(margin_m / truth.resolution + 1e-6)
    return int(np.count_nonzero(away > margin + 1e-6)) * grid.resolution**2


def _run_behind(walls: B8, row_step: int, col_step: int) -> npt.NDArray[np.int_]:
    """Return the length of the unbroken run of wall cells from each in one direction."""
    if row_step == 0:
        return _run_behind(walls.T, col_step, 0).T
    height, width = walls.shape
    runs = np.pad(walls.astype(np.int_), 1)
    for row in range(height, 0, -1) if row_step > 0 else range(1, height + 1):
        following = runs[row + row_step, 1 + col_step : 1 + col_step + width]
        runs[row, 1:-1] *= 1 + following
    return runs[1:-1, 1:-1]
