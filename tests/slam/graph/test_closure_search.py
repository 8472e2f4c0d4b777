"""A closure is found where the robot is, and every reason against one is real."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.geometry import F64, Pose2, row_of, wrap_angle
from slamfusion.slam.common.matcher import LEAST_SIGMA, MOST_SIGMA
from slamfusion.slam.graph.closure_search import LOCAL_DRIFT_M, ClosureSearch, Found
from slamfusion.slam.graph.submap import Submap
from tests.slam.drives import CELL_M, draw_flat, true_poses
from tests.slam.places import NO_LASER, U8, draw_corridor, draw_regular_ring, read
from tests.support.examples import examples

pytestmark = pytest.mark.once

MEAN_SCORE = 0.75


@pytest.fixture(scope="module")
def search(device: ComputeDevice) -> ClosureSearch:
    return ClosureSearch(GraphConfig(), device, np.random.default_rng(0))


def hits(cells: U8, pose: Pose2, reach_m: float = 8.0) -> F64:
    """Return (P, 2) what a laser of 181 beams hits, in the robot's frame."""
    return read(cells, [pose], reach_m, beams=181)[0].points()


def seen(device: ComputeDevice, cells: U8, poses: list[Pose2], reach_m: float = 8.0) -> Submap:
    """Return a finished submap, in the map frame."""
    submap = Submap(device, 0, CELL_M, 0.1)
    for scan, pose in zip(read(cells, poses, reach_m, beams=361), poses, strict=True):
        submap.insert(scan.points(), NO_LASER, pose)
    submap.finish()
    return submap


@pytest.fixture(scope="module")
def flat(device: ComputeDevice) -> Submap:
    return seen(device, draw_flat(), true_poses(120)[::8])


def is_at(found: Found | str, truth: Pose2, *, most_m: float = 0.1, most_rad: float = 0.03) -> bool:
    """Return whether a place was found, and the true one."""
    if isinstance(found, str):
        return False
    away = math.hypot(found.pose[0] - truth.x, found.pose[1] - truth.y)
    return away < most_m and abs(wrap_angle(found.pose[2] - truth.yaw_rad)) < most_rad


# -- a place that is found -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("drift_m", "wrong"),
    [
        (0.3, (0.2, -0.1, 0.03)),
        (LOCAL_DRIFT_M, (-0.3, 0.3, -0.05)),
        (LOCAL_DRIFT_M + 0.01, (0.6, -0.6, 0.1)),
        (2.5, (2.4, -2.4, 0.25)),
        (20.0, (-3.9, 3.9, 0.34)),
    ],
)
def test_a_place_is_found_as_far_off_as_it_may_be(
    search: ClosureSearch, flat: Submap, drift_m: float, wrong: tuple[float, float, float]
):
    for index in (40, 62, 80):
        truth = true_poses(120)[index]
        expected = row_of(truth) + np.array(wrong)
        found = search.near(flat, hits(draw_flat(), truth), expected, drift_m, MEAN_SCORE)
        assert is_at(found, truth), f"{index}: {found}"
        assert isinstance(found, Found)
        arm = np.outer([1.0, 1.0, 5.0], [1.0, 1.0, 5.0])
        values = np.linalg.eigvalsh(found.information / arm)
        assert values.min() > 0.99 * MOST_SIGMA**-2.0
        assert values.max() < 1.01 * LEAST_SIGMA**-2.0


@pytest.mark.parametrize("index", [0, 40, 80, 110])
def test_a_robot_that_may_be_anywhere_is_found(search: ClosureSearch, flat: Submap, index: int):
    truth = true_poses(120)[index]
    assert is_at(search.anywhere(flat, hits(draw_flat(), truth), MEAN_SCORE), truth)


@given(
    at=st.tuples(st.floats(0.8, 8.0), st.floats(0.8, 2.6), st.floats(-math.pi, math.pi)),
    wrong=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    drift_m=st.sampled_from((0.5, 1.5, 3.0)),
)
@settings(max_examples=examples(40), deadline=None)
def test_no_other_place_than_the_true_one_is_found(
    search: ClosureSearch,
    flat: Submap,
    at: tuple[float, float, float],
    wrong: tuple[float, float, float],
    drift_m: float,
):
    """From anywhere in the flat, also where the robot never was: few walls in common blur it."""
    truth = Pose2(*at)
    expected = row_of(truth) + np.array(wrong) * (drift_m, drift_m, 0.05)
    found = search.near(flat, hits(draw_flat(), truth), expected, drift_m, MEAN_SCORE)
    if not isinstance(found, str):
        assert is_at(found, truth, most_m=0.4, most_rad=0.1), found.pose - row_of(truth)


# -- why one is not found --------------------------------------------------------------------------


@pytest.mark.parametrize("drift_m", [0.3, 0.7])
def test_a_bare_corridor_leaves_the_place_open(
    device: ComputeDevice, search: ClosureSearch, drift_m: float
):
    cells = draw_corridor()
    submap = seen(device, cells, [Pose2(9.0 + 0.3 * index, 1.5) for index in range(30)])
    reasons = []
    for index in range(10):
        truth = Pose2(12.0 + 0.2 * index, 1.5)
        found = search.near(submap, hits(cells, truth), row_of(truth), drift_m, MEAN_SCORE)
        reasons.append(found if isinstance(found, str) else "found")
    assert reasons.count("degenerate direction") >= 8
    # The end of the same corridor is told.
    submap = seen(device, cells, [Pose2(0.8 + 0.2 * index, 1.5) for index in range(12)])
    truth = Pose2(1.5, 1.5, 3.0)
    assert is_at(search.near(submap, hits(cells, truth), row_of(truth), drift_m, MEAN_SCORE), truth)


def test_pillars_at_every_metre_fit_twice(device: ComputeDevice, search: ClosureSearch):
    """A robot that may have drifted by more than from one to the next."""
    cells = draw_regular_ring()
    submap = seen(device, cells, [Pose2(3.0 + 0.4 * i, 1.5) for i in range(16)], 3.0)
    for index in range(5):
        truth = Pose2(6.0 + 0.17 * index, 1.5)
        points = hits(cells, truth, 3.0)
        assert search.near(submap, points, row_of(truth), 1.2, MEAN_SCORE) == "two places fit"
        assert search.anywhere(submap, points, MEAN_SCORE) == "two places fit"
        # Of one that has hardly drifted it is known which.
        assert is_at(search.near(submap, points, row_of(truth), 0.3, MEAN_SCORE), truth)
