"""Shifts at the yaws at which walls are parallel: the right one is among the best, at any size."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from slamfusion.align.align import align_features
from slamfusion.align.features import GridFeatures
from slamfusion.align.frames import motion_of
from slamfusion.align.motions import displacement
from slamfusion.align.parallel_walls import (
    CELL_MAX_M,
    CELLS,
    KeptSpectra,
    TurnedMap,
    level_for,
    parallel_motions,
    parallel_yaws,
    wall_directions,
)
from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import AlignConfig
from slamfusion.fusion import parallel_walls
from slamfusion.geometry import Pose2
from tests.fusion.drawings import features_of
from tests.support.sites import ManyMaps, many_maps


@pytest.fixture(scope="module")
def device() -> ComputeDevice:
    return open_device()


@pytest.fixture(scope="module")
def site() -> ManyMaps:
    return many_maps(4, 1, 400)


@pytest.fixture(scope="module")
def features(site: ManyMaps, device: ComputeDevice) -> list[GridFeatures]:
    return [features_of(grid, device) for grid in site.grids]


def transform(site: ManyMaps, a: int, b: int) -> Pose2:
    return site.poses[a].inverse().compose(site.poses[b])


@pytest.mark.parametrize("turn", [0, 20, 135])
def test_walls_are_parallel_under_the_turn_between_two_maps(turn: int) -> None:
    walls = np.zeros((120, 120), dtype=np.uint8)
    walls[20, 20:100] = walls[20:70, 99] = 1
    own = wall_directions(walls)
    yaws = parallel_yaws(np.roll(own, turn), own)
    assert yaws[0] == pytest.approx(turn, abs=0.1)
    assert any(abs(yaw - (turn + 90) % 180) < 1.0 for yaw in yaws)


@pytest.mark.parametrize("turn_deg", [7.3, 33.8, 61.4])
def test_the_turn_between_two_maps_is_found_to_a_quarter_of_a_degree(turn_deg: float) -> None:
    """Drawn anew, so that walls lie on other cells."""
    directions = []
    for turn in (0.0, turn_deg):
        picture = np.zeros((500, 500), dtype=np.uint8)
        cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        for corners in ([(-150, -90), (170, -90), (170, 120)], [(-150, 30), (60, 30), (60, -90)]):
            points = np.rint(np.array(corners) @ [[cos, sin], [-sin, cos]] + 250).astype(np.int32)
            cv2.polylines(picture, [points], isClosed=False, color=1, thickness=2)
        directions.append(wall_directions(picture))
    yaws = parallel_yaws(directions[1], directions[0])
    assert min(abs(yaw - turn_deg) for yaw in yaws) < 0.25


def test_the_right_motion_is_among_the_best(
    site: ManyMaps, features: list[GridFeatures], device: ComputeDevice
) -> None:
    for (a, b), share in site.neighbours.items():
        if share < 0.3:
            continue
        reference, moving = features[a], features[b]
        motions, step, yaw_step = parallel_motions(reference, moving, 8, device)
        wanted = motion_of(reference, moving, transform(site, a, b))
        near = [displacement(motion, wanted) for motion in motions]
        assert any(shift <= 2.0 * step and turn <= yaw_step for shift, turn in near)


def test_the_larger_a_map_is_the_larger_are_its_spectra() -> None:
    assert level_for(700, 0.05) == (12, 1)
    for side, growth in ((1400, 2), (3700, 4), (6000, 8)):
        step, found = level_for(side, 0.05)
        assert found == growth
        assert step * 0.05 <= CELL_MAX_M
        assert side / step <= CELLS * growth
    # Beyond, cells grow.
    assert level_for(30000, 0.05)[1] == parallel_walls.GROWTH_MAX


def test_half_a_turn_more_is_read_off_the_spectrum(
    features: list[GridFeatures], device: ComputeDevice
) -> None:
    item, kept = features[0], KeptSpectra()
    turned = TurnedMap(item, 8, 1, wall_directions(item.grid.solid), device, kept)
    for read, drawn in zip(turned.spectra(203.0), turned._turned(203.0), strict=True):
        # Walls are put on whole cells: one on the edge of two may be on the other.
        assert np.abs(read - drawn).max() < 0.02 * np.abs(drawn).max()


def test_of_many_spectra_the_last_ones_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    spectra = (np.zeros((4, 4), np.complex64), np.zeros((4, 4), np.complex64))
    monkeypatch.setattr(parallel_walls, "KEPT_BYTES", 3 * sum(item.nbytes for item in spectra))
    kept = KeptSpectra()
    for key in range(3):
        kept.keep(key, spectra)
    assert kept.get(0) is spectra
    kept.keep(3, spectra)
    assert [kept.get(key) is not None for key in range(4)] == [True, False, True, True]


@pytest.mark.once
def test_where_walls_fill_the_coarse_cells_parallel_walls_lead_to_the_answer(
    site: ManyMaps,
    features: list[GridFeatures],
    device: ComputeDevice,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As in maps of hundreds of metres, of which no finer cells can be searched at every yaw."""
    config = replace(AlignConfig(), coarse_cells=16)
    monkeypatch.setattr("slamfusion.align.search.LEVEL_WORK_MAX", 1.0)
    a, b = max(site.neighbours, key=lambda pair: site.neighbours[pair])
    found = align_features(features[a], features[b], config, device)
    assert found.accepted
    assert found.reason.endswith("on finer ones only yaws with parallel walls were")
    error = transform(site, a, b).inverse().compose(found.transform)
    assert math.hypot(error.x, error.y) < 0.3
    monkeypatch.setattr("slamfusion.align.search.PARALLEL", 0)
    assert not align_features(features[a], features[b], config, device).accepted
