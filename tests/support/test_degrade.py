"""Degraded maps: the returned transform is the truth, and each fault is the asked one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from slamfusion.errors import GridError
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
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


def test_flips_are_the_only_walls_out_of_place(truth: OccupancyGrid) -> None:
    plain, _ = degrade_map(truth, np.random.default_rng(3), Degradation())
    grid, _ = degrade_map(truth, np.random.default_rng(3), Degradation(flip_share=0.05))
    known = np.sum(plain.cells != UNKNOWN)
    assert np.sum(plain.cells != grid.cells) == pytest.approx(0.05 * known, abs=1)
    assert np.array_equal(plain.cells == UNKNOWN, grid.cells == UNKNOWN)


def test_crop_keeps_the_asked_share_of_known_cells(truth: OccupancyGrid) -> None:
    grid, _ = degrade_map(
        truth, np.random.default_rng(4), Degradation(crop_share=0.5, resample=False)
    )
    kept = np.sum(grid.cells != UNKNOWN) / np.sum(truth.cells != UNKNOWN)
    assert kept == pytest.approx(0.5, abs=0.02)


def test_walls_get_thinner_and_thicker_without_holes(truth: OccupancyGrid) -> None:
    walls = {}
    for change in (-1, 0, 1):
        wanted = Degradation(yaw_rad=0.4, wall_change_cells=change)
        grid, _ = degrade_map(truth, np.random.default_rng(5), wanted)
        wall = grid.cells == OCCUPIED
        walls[change] = np.sum(wall)
        pieces = ndimage.label(wall, np.ones((3, 3)))[1]
        if change == -1:
            plain = plain_pieces(truth)
            assert plain - 2 <= pieces <= plain, "walls stay whole; a table leg may go"
    assert 0.4 < walls[-1] / walls[0] < 0.85
    assert 1.2 < walls[1] / walls[0] < 1.8


def plain_pieces(truth: OccupancyGrid) -> int:
    grid, _ = degrade_map(truth, np.random.default_rng(5), Degradation(yaw_rad=0.4))
    return int(ndimage.label(grid.cells == OCCUPIED, np.ones((3, 3)))[1])


@pytest.mark.parametrize("resolution", [None, 0.04, 0.1])
def test_one_cell_walls_keep_no_holes_when_rendered(resolution: float | None) -> None:
    cells = np.full((120, 120), FREE, dtype=np.int8)
    cells[20, 20:100] = cells[100, 20:101] = OCCUPIED
    cells[20:100, 20] = cells[20:100, 100] = OCCUPIED
    grid, _ = degrade_map(
        OccupancyGrid(cells, 0.05),
        np.random.default_rng(0),
        Degradation(yaw_rad=0.5, resolution=resolution),
    )
    ring = grid.cells == OCCUPIED
    assert ndimage.label(ring, np.ones((3, 3)))[1] == 1
    assert ndimage.label(~ring)[1] == 2, "the ring of wall still separates inside from outside"


def test_speckle_makes_free_cells_unknown(truth: OccupancyGrid) -> None:
    grid, _ = degrade_map(
        truth, np.random.default_rng(6), Degradation(resample=False, speckle_share=0.2)
    )
    free = np.sum(truth.cells == FREE)
    assert np.sum(grid.cells == FREE) == pytest.approx(0.8 * free, abs=1)
    assert np.sum(grid.cells == OCCUPIED) == np.sum(truth.cells == OCCUPIED)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_margin_is_the_asked_share_of_the_area(truth: OccupancyGrid, share: float) -> None:
    wanted = Degradation(yaw_rad=0.3, margin_share=share)
    grid, _ = degrade_map(truth, np.random.default_rng(7), wanted)
    box = grid.known_box()
    assert box is not None
    assert 1 - box.area / grid.cells.size == pytest.approx(share, abs=0.01)


def test_lattice_and_origin_are_as_asked(truth: OccupancyGrid) -> None:
    wanted = Degradation(yaw_rad=0.3, origin_yaw_rad=0.8, resolution=0.04)
    grid, pose = degrade_map(truth, np.random.default_rng(8), wanted)
    assert grid.resolution == 0.04
    assert grid.origin.yaw_rad == 0.8
    assert pose.yaw_rad == pytest.approx(0.3)
    kept, pose = degrade_map(
        truth, np.random.default_rng(8), Degradation(yaw_rad=0.3, resample=False)
    )
    assert kept.cells.shape == truth.cells.shape
    assert np.array_equal(kept.cells, truth.cells)
    assert pose.compose(kept.origin).yaw_rad == pytest.approx(truth.origin.yaw_rad)


def test_shift_moves_the_centre_by_its_share_of_the_longer_side(truth: OccupancyGrid) -> None:
    wanted = Degradation(yaw_rad=1.3, shift_share=(0.5, -0.25))
    _, pose = degrade_map(truth, np.random.default_rng(9), wanted)
    middle = np.array([truth.width, truth.height]) / 2 * truth.resolution
    centre = truth.origin.transform(middle)
    moved = pose.inverse().transform(centre) - centre
    assert moved == pytest.approx([0.5 * 14.0, -0.25 * 14.0], abs=0.01)


def test_bend_moves_walls_by_no_more_than_its_amplitude(truth: OccupancyGrid) -> None:
    straight, _ = degrade_map(truth, np.random.default_rng(10), Degradation())
    bent, pose = degrade_map(truth, np.random.default_rng(10), Degradation(bend_cells=4.0))
    assert straight.cells.tobytes() != bent.cells.tobytes()
    errors = wall_errors(truth, bent, pose)
    assert 0.1 < np.mean(errors) < 4.0
    assert np.max(errors) < 10.0


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
