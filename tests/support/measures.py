"""Measures of a map against a simulated truth: walls that are not there, and what people leave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from slamfusion.config import NormalizeConfig
from slamfusion.evaluation.cells import wall_centres
from slamfusion.geometry import Pose2, compose_poses, invert_poses
from slamfusion.grid import FREE, UNKNOWN, OccupancyGrid, trinary_cells
from slamfusion.trajectory import Trajectory

# A wall cell this near to a true one is that wall.
WALL_M = 0.15
# Distances between centres are whole cells where both grids lie alike; digits must not decide.
SLACK_M = 1e-6
# A person fills this much around the middle of the way.
PERSON_M = 0.3


@dataclass(frozen=True)
class Share:
    """How many cells of some are occupied in a map."""

    occupied: int
    cells: int

    @property
    def percent(self) -> float:
        """NaN where there is no cell."""
        return 100.0 * self.occupied / self.cells if self.cells else float("nan")


@dataclass(frozen=True, eq=False)
class _Known:
    """The known cells of a map: (N, 2) centres in the truth's frame, metres; (N,) occupied."""

    centres: npt.NDArray[np.float64]
    occupied: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, grid: OccupancyGrid, transform: Pose2) -> _Known:
        classes = trinary_cells(grid.cells, NormalizeConfig())
        rows, cols = np.nonzero(classes != UNKNOWN)
        return cls(transform.transform(grid.cell_centres(rows, cols)), classes[rows, cols] == 1)

    def wall_distance_m(self, truth: OccupancyGrid) -> npt.NDArray[np.float64]:
        """Return the distance of each centre to that of the nearest true wall cell, (N,)."""
        classes = trinary_cells(truth.cells, NormalizeConfig())
        distance, _ = KDTree(wall_centres(classes, truth)).query(self.centres)
        return np.asarray(distance)


def false_walls(grid: OccupancyGrid, truth: OccupancyGrid, transform: Pose2) -> Share:
    """Count the known cells of a map that are walls and over 0.15 m from every true one.

    Args:
        grid: the map.
        truth: with at least one wall.
        transform: maps a point of the map's frame into the truth's, metres.
    """
    known = _Known.of(grid, transform)
    wrong = known.occupied & (known.wall_distance_m(truth) > WALL_M + SLACK_M)
    return Share(int(np.count_nonzero(wrong)), len(wrong))


def cells_of_people(
    grid: OccupancyGrid,
    truth: OccupancyGrid,
    people: npt.NDArray[np.float64],
    transform: Pose2,
) -> tuple[Share, Share]:
    """Count the known cells that are truly free and over 0.15 m from every true wall.

    Args:
        grid: the map.
        truth: with at least one wall.
        people: (N, P, 2) where people were, metres, the truth's frame.
        transform: maps a point of the map's frame into the truth's, metres.

    Returns:
        Those within 0.3 m of where someone was, which only people touched; and the others.
    """
    known = _Known.of(grid, transform)
    rows, cols = truth.cell_indices(known.centres)
    inside = (rows >= 0) & (cols >= 0) & (rows < truth.height) & (cols < truth.width)
    free = np.zeros(len(inside), dtype=np.bool_)
    free[inside] = truth.cells[rows[inside], cols[inside]] == FREE
    free &= known.wall_distance_m(truth) > WALL_M + SLACK_M
    tracks = people.reshape(-1, 2)
    apart = KDTree(tracks).query(known.centres)[0] if len(tracks) else np.full(len(free), np.inf)
    touched, others = free & (apart <= PERSON_M), free & (apart > PERSON_M)
    at_tracks, elsewhere = (
        Share(int(np.count_nonzero(known.occupied & some)), int(np.count_nonzero(some)))
        for some in (touched, others)
    )
    return at_tracks, elsewhere


def closure_error(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Return how wrong the last pose is, seen from the first: metres, degrees.

    Args:
        estimate: at the same times as the truth.
        truth: poses of the same body.
    """
    motions = [
        compose_poses(invert_poses(path.poses[0]), path.poses[-1]) for path in (truth, estimate)
    ]
    x, y, yaw_rad = compose_poses(invert_poses(motions[0]), motions[1])
    return float(np.hypot(x, y)), float(np.degrees(abs(yaw_rad)))
