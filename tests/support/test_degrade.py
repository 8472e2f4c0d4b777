"""Degraded maps: the returned transform is the truth, and each fault is the asked one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from slamfusion.errors import GridError
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.sim import draw_building
from tests.support.degrade import Degradation, degrade_map, draw_degradation


@pytest.fixture(scope="module")
def truth() -> OccupancyGrid:
    return draw_building(np.random.default_rng(11), 14.0, 9.0)


def wall_errors(truth: OccupancyGrid, grid: OccupancyGrid, pose: Pose2) -> np.ndarray:
    """Distance of each wall of ``grid``, mapped by ``pose``, to the nearest true wall, cells."""
    field, nearest = ndimage.distance_transform_edt(truth.cells != OCCUPIED, return_indices=True)
    points = pose.transform(grid.cell_centres(*np.nonzero(grid.cells == OCCUPIED)))
    row, col = truth.cell_indices(points)
    row, col = np.clip(row, 0, truth.height - 1), np.clip(col, 0, truth.width - 1)
    assert nearest.shape[0] == 2
    return np.asarray(field[row, col])


CASES = {
    "nothing": Degradation(),
    "turned": Degradation(yaw_rad=0.7, shift_share=(0.5, -0.31)),
    "only the origin": Degradation(yaw_rad=2.1, shift_share=(0.2, 0.1), resample=False),
    "origin yaw": Degradation(yaw_rad=-1.1, shift_share=(0.1, 0.4), origin_yaw_rad=0.9),
    "fine": Degradation(yaw_rad=3.0, resolution=0.04),
    "coarse": Degradation(yaw_rad=1.0, resolution=0.1),
    "cropped": Degradation(yaw_rad=1.0, crop_share=0.5),
    "thin": Degradation(yaw_rad=1.0, wall_change_cells=-1),
    "thick": Degradation(yaw_rad=1.0, wall_change_cells=1),
    "bent": Degradation(yaw_rad=1.0, bend_cells=1.5),
    "margin": Degradation(yaw_rad=1.0, margin_share=0.9, speckle_share=0.1),
}


@pytest.mark.parametrize("case", CASES)
def test_transform_maps_walls_onto_walls(truth: OccupancyGrid, case: str) -> None:
    grid, pose = degrade_map(truth, np.random.default_rng(1), CASES[case])
    assert np.mean(wall_errors(truth, grid, pose)) < 1.0


@pytest.mark.parametrize("case", sorted(set(CASES) - {"bent", "coarse"}))
def test_transform_has_no_bias(truth: OccupancyGrid, case: str) -> None:
    """Moving the map by half a cell any way from the returned pose fits no better."""
    grid, pose = degrade_map(truth, np.random.default_rng(2), CASES[case])
    here = np.mean(wall_errors(truth, grid, pose) ** 2)
    for angle in np.arange(4) * math.pi / 2:
        step = 0.6 * truth.resolution
        aside = Pose2(step * math.cos(angle), step * math.sin(angle)).compose(pose)
        assert np.mean(wall_errors(truth, grid, aside) ** 2) > here


@pytest.mark.parametrize("seed", range(12))
def test_drawn_cases_stay_in_their_ranges_and_fit(truth: OccupancyGrid, seed: int) -> None:
    rng = np.random.default_rng(seed)
    drawn = draw_degradation(rng)
    assert 0.5 <= drawn.crop_share <= 1.0
    assert 0.0 <= drawn.flip_share <= 0.05
    assert abs(drawn.wall_change_cells) <= 1
    assert drawn.resolution in {None, 0.04, 0.05, 0.1}
    grid, pose = degrade_map(truth, rng, replace(drawn, flip_share=0.0))
    coarser = max(1.0, grid.resolution / truth.resolution)
    assert np.mean(wall_errors(truth, grid, pose)) < coarser


def test_same_seed_same_bytes(truth: OccupancyGrid) -> None:
    results = []
    for _ in range(2):
        rng = np.random.default_rng(21)
        results.append(degrade_map(truth, rng, draw_degradation(rng, bend_cells=3.0)))
    (first, first_pose), (second, second_pose) = results
    assert first.cells.tobytes() == second.cells.tobytes()
    assert first.origin == second.origin
    assert first_pose == second_pose


def test_impossible_requests_are_refused() -> None:
    with pytest.raises(ValueError, match="crop_share"):
        Degradation(crop_share=0.0)
    with pytest.raises(ValueError, match="resample"):
        Degradation(resample=False, bend_cells=1.0)
    unknown = OccupancyGrid(np.full((4, 4), UNKNOWN, dtype=np.int8), 0.05)
    with pytest.raises(GridError, match="unknown"):
        degrade_map(unknown, np.random.default_rng(0), Degradation())
