"""What a match tells of where the robot is, and what odometry decides where it tells nothing."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.geometry import F64, Pose2, row_of
from slamfusion.pose_graph.uncertainty import turned
from slamfusion.slam.common.matcher import (
    MOST_SIGMA,
    PoseHypothesis,
    ScanOnTiles,
    keep_degenerate_prior,
    response_hessian,
    search_pose,
    spread_of,
)
from slamfusion.slam.graph.submap import Submap
from tests.slam.drives import CELL_M, draw_flat, scan_at, true_poses
from tests.slam.places import NO_LASER, Place, draw_corridor, place_of
from tests.support.examples import examples

pytestmark = pytest.mark.once


@pytest.fixture(scope="module")
def corridor(device: ComputeDevice) -> Place:
    """The middle of the corridor, far from its features and its end."""
    return place_of(device, draw_corridor(), [Pose2(9.0 + 0.3 * i, 1.5) for i in range(30)])


@pytest.fixture(scope="module")
def flat(device: ComputeDevice) -> Place:
    return place_of(device, draw_flat(), true_poses(120)[30:90:4])


@pytest.mark.parametrize("yaw_rad", [0.0, 1.3])
def test_a_match_in_a_corridor_tells_little_along_it(corridor: Place, yaw_rad: float):
    """What far and lonely hits say of it is by chance."""
    along, sigmas = [], []
    for index in range(20):
        pose = Pose2(12.0 + 0.1 * index, 1.5, yaw_rad)
        found = corridor.information(pose, corridor.points(pose, 100 + index, 0.015))
        assert found[1, 1] > 1000.0
        along.append(found[0, 0])
        sigmas.append(np.sqrt(np.diag(np.linalg.inv(found))))
    assert min(along) < 1.1 * MOST_SIGMA**-2.0
    assert np.median(along) < 60.0
    assert np.median(sigmas, axis=0)[0] > 0.15
    assert np.max(sigmas, axis=0)[1:].max() < 0.05


@given(
    x=st.floats(0.0, 9.0),
    y=st.floats(0.0, 6.0),
    yaw_rad=st.floats(-4.0, 4.0),
    angle_rad=st.floats(-4.0, 4.0),
    count=st.integers(1, 181),
)
@settings(max_examples=examples(60), deadline=None)
def test_information_is_symmetric_and_positive_definite(
    flat: Place, x: float, y: float, yaw_rad: float, angle_rad: float, count: int
):
    points = scan_at(true_poses(120)[60], 0.0).points()[:count]
    found = flat.information(Pose2(x, y, yaw_rad), points)
    for matrix in (found, turned(found[None], np.array([angle_rad]))[0]):
        assert np.isfinite(matrix).all()
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9, atol=1e-9)
        assert np.linalg.eigvalsh(matrix).min() > 0.0


@functools.cache
def spread_of_matches(place: Place, index: int) -> tuple[F64, F64]:
    """Return (3,) the deviations of 100 matches of noisy scans, and what the response says.

    From hypotheses around the truth, and without weight on their places.
    """
    beams = GraphConfig().matcher.beams
    pose = true_poses(120)[index]
    rng, truth = np.random.default_rng(1), row_of(pose)
    found, told = [], []
    for seed in range(100):
        points = place.points(pose, 1000 + seed, 0.015)
        scan = ScanOnTiles(place.device, place.submap.walls(), points, beams)
        hypothesis = PoseHypothesis(
            truth + rng.normal(0.0, (0.05, 0.05, 0.02)), spread_of(0.1, 0.05)
        )
        pose_found = search_pose(scan, [hypothesis], rng, trust=0.0).pose
        found.append(pose_found)
        information = place.information(Pose2(*(float(v) for v in pose_found)), points)
        told.append(np.sqrt(np.diag(np.linalg.inv(information))))
    return np.std(found, axis=0), np.mean(told, axis=0)


def test_the_response_agrees_with_the_spread_of_matches(flat: Place):
    ratios = []
    for index in (40, 62, 80):
        spread, told = spread_of_matches(flat, index)
        ratios.append(told / spread)
    typical = np.exp(np.log(ratios).mean(axis=0))
    assert (typical > 0.5).all()
    assert (typical < 2.0).all()


# -- what odometry decides -------------------------------------------------------------------------


def two_walls(half_m: float) -> F64:
    """Return (N, 2) hits on two walls along x, 2 m apart, one at every centimetre."""
    along = np.arange(-half_m, half_m, 0.01)
    return np.concatenate([np.column_stack((along, np.full_like(along, y))) for y in (-1.0, 1.0)])


def scan_of(device: ComputeDevice, frame: Pose2, written: F64, points: F64) -> ScanOnTiles:
    """Return hits over a submap of others, written at a pose."""
    submap = Submap(device, 0, CELL_M, 0.1)
    submap.insert(written, NO_LASER, frame)
    return ScanOnTiles(device, submap.walls(), points, 100_000)


def keep_prior(scan: ScanOnTiles, match: F64, expected: F64) -> F64:
    """Return a match as odometry settles it."""
    return keep_degenerate_prior(response_hessian(scan, match), match, expected)


@pytest.mark.parametrize("yaw_rad", [0.0, math.pi / 2, -math.pi])
@pytest.mark.parametrize("ahead_m", [-0.4, 0.07, 1.5])
@pytest.mark.parametrize("aside_m", [-0.3, 0.0, 0.2])
def test_along_bare_walls_odometry_has_its_way(
    device: ComputeDevice, yaw_rad: float, ahead_m: float, aside_m: float
):
    """A match in the middle of two walls; odometry is ahead of it, aside, and turned."""
    frame = Pose2(0.4, -0.3, yaw_rad)
    scan = scan_of(device, frame, two_walls(6.0), two_walls(3.0))
    match = row_of(frame)
    expected = row_of(frame.compose(Pose2(ahead_m, aside_m, 0.1)))
    before = match.copy()
    kept = keep_prior(scan, match, expected)
    wanted = row_of(frame.compose(Pose2(ahead_m, 0.0, 0.0)))
    np.testing.assert_allclose(kept[:2], wanted[:2], atol=1e-3)
    assert kept[2] == match[2]
    assert match.tobytes() == before.tobytes()


@pytest.mark.parametrize("index", [40, 52, 62, 80])
def test_in_a_room_a_match_stays_where_it_is(flat: Place, index: int):
    pose = true_poses(120)[index]
    for seed in range(5):
        points = flat.points(pose, seed, 0.015)
        scan = ScanOnTiles(flat.device, flat.submap.walls(), points, 180)
        match = row_of(pose)
        kept = keep_prior(scan, match, match + np.array([1.0, -2.0, 0.5]))
        assert kept.tobytes() == row_of(pose).tobytes()
