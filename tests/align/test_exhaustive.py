"""The search against all poses: on small maps nothing scores above the place that it finds.

The poses are yaws of which one step moves the farthest wall by at most a cell, and at each all
whole-cell shifts under which the maps overlap. A pose's score is the sum of the reference's wall
evidence (``definitions.Side.value``, widths of a wall as wide as the coarse search's) in the cells
on which walls of the moving map land.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
import scipy

from slamfusion.align.pair import Pair, displacement
from slamfusion.align.search import search
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.grid import OccupancyGrid
from tests.align.definitions import Side, landings, look_up, side_of
from tests.fusion.drawings import building, degraded, features_of

SIGMA, TOP = 4.0, 15
# An answer is refined between cells and yaws: members this near to it count as it.
NEAR_CELLS, NEAR_RAD = 8.0, math.radians(2.0)


def best_pose(reference: Side, moving: Side) -> tuple[int, npt.NDArray[np.float64]]:
    """Return the highest score of all poses, and the pose: x and y in cells, yaw in rad."""
    own = moving.points - np.array(moving.centre)
    reach = math.ceil(np.hypot(*own.T).max()) + 1
    best, pose = 0, np.zeros(3)
    for yaw in np.arange(0.0, 2.0 * math.pi, 1.0 / reach):
        cos, sin = math.cos(yaw), math.sin(yaw)
        at = np.floor(own @ np.array([[cos, sin], [-sin, cos]]) + 0.5).astype(int) + reach
        counts = np.zeros((2 * reach + 1, 2 * reach + 1))
        np.add.at(counts, (at[:, 1], at[:, 0]), 1.0)
        scores = np.rint(scipy.signal.correlate(reference.value, counts, "full")).astype(int)
        row, col = np.unravel_index(int(scores.argmax()), scores.shape)
        if scores[row, col] > best:
            best = int(scores[row, col])
            pose = np.array([col - reach + 0.5, row - reach + 0.5, yaw])
    return best, pose


def score_at(reference: Side, moving: Side, pose: npt.NDArray[np.float64]) -> int:
    """Return the score of one pose, by its definition."""
    places = landings(moving.points, pose, moving.centre)
    return int(look_up(reference.value, places).sum())


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("crop", [1.0, 0.6])
def test_no_pose_is_better_than_what_the_search_finds(
    device: ComputeDevice, seed: int, crop: float
) -> None:
    truth = building(seed, 7.0, 6.0)
    moving, _ = degraded(truth, seed, yaw_rad=0.7 + seed, flip_share=0.02, crop_share=crop)
    found, sides = searched(truth, moving, device)
    best, pose = best_pose(*sides)
    # Their own definition agrees, but for walls that lie on the line between two cells.
    assert score_at(*sides, pose) == pytest.approx(best, rel=0.03)
    shift, turn = displacement(found, pose)
    is_near = shift <= NEAR_CELLS and turn <= NEAR_RAD
    assert is_near or score_at(*sides, found) >= best


def searched(
    reference: OccupancyGrid, moving: OccupancyGrid, device: ComputeDevice
) -> tuple[npt.NDArray[np.float64], tuple[Side, Side]]:
    """Return the motion that the search puts first, and both maps."""
    a, b = (features_of(grid, device) for grid in (reference, moving))
    _, motions = search(Pair(a, b), AlignConfig(), SearchWindow())
    return motions[0], (side_of(a, SIGMA, TOP), side_of(b, SIGMA, TOP))
