"""Shifts at the yaws at which walls are parallel: the right one is among the best, at any size."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from slamfusion.align.align import align_pair
from slamfusion.align.features import GridFeatures, wall_directions
from slamfusion.align.pair import Pair, displacement
from slamfusion.align.search import greatest_rows
from slamfusion.align.shifts import parallel_shifts, parallel_yaws
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.geometry import Pose2
from tests.fusion.drawings import features_of
from tests.support.sites import ManyMaps, many_maps


@pytest.fixture(scope="module")
def site() -> ManyMaps:
    return many_maps(4, 1, 400)


@pytest.fixture(scope="module")
def features(site: ManyMaps, device: ComputeDevice) -> list[GridFeatures]:
    return [features_of(grid, device) for grid in site.grids]


def transform(site: ManyMaps, a: int, b: int) -> Pose2:
    return site.poses[a].inverse().compose(site.poses[b])


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


def test_the_right_motion_is_among_the_best(site: ManyMaps, features: list[GridFeatures]) -> None:
    for (a, b), share in site.neighbours.items():
        if share < 0.3:
            continue
        reference, moving = features[a], features[b]
        shifts = parallel_shifts(Pair(reference, moving))
        motions = shifts.motions(greatest_rows(shifts.evidence.ravel(), 48))
        wanted = Pair(reference, moving).motion_of(transform(site, a, b))
        near = [displacement(motion, wanted) for motion in motions]
        assert any(shift <= 2.0 * shifts.step and turn <= shifts.yaw_step for shift, turn in near)


@pytest.mark.once
def test_where_walls_fill_the_coarse_cells_parallel_walls_lead_to_the_answer(
    site: ManyMaps, features: list[GridFeatures], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in maps of hundreds of metres, of which no finer cells can be searched at every yaw."""
    config = replace(AlignConfig(), coarse_cells=16)
    monkeypatch.setattr("slamfusion.align.search.LEVEL_WORK_MAX", 1.0)
    a, b = max(site.neighbours, key=lambda pair: site.neighbours[pair])
    found = align_pair(Pair(features[a], features[b]), config)
    assert found.accepted
    assert found.reason.endswith("fine cells were searched only at yaws with parallel walls")
    error = transform(site, a, b).inverse().compose(found.transform)
    assert math.hypot(error.x, error.y) < 0.3
