"""The matcher finds a shifted scan, keeps to a hypothesis where nothing tells, and stays near."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.geometry import Pose2
from slamfusion.slam.common.matcher import PoseHypothesis, ScanOnTiles, search_pose, spread_of
from slamfusion.slam.graph.submap import Submap
from tests.slam.drives import scan_at, true_poses

POSE = true_poses(1)[0]


@pytest.fixture(scope="module")
def mapped() -> ScanOnTiles:
    """A scan over the map that it has made itself."""
    submap = Submap(NumpyDevice(), 0, 0.05, 0.1)
    scan = scan_at(POSE, 0.0)
    submap.insert(scan.points(), (scan.mount.x, scan.mount.y), POSE)
    return ScanOnTiles(NumpyDevice(), submap.walls(), scan.points(), 180)


def at(x: float, y: float, yaw: float, loss: float = 0.0, wide: float = 1.0) -> PoseHypothesis:
    pose = np.array([POSE.x + x, POSE.y + y, POSE.yaw_rad + yaw])
    return PoseHypothesis(pose, spread_of(0.15 * wide, 0.1 * wide), loss)


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.12, -0.1, 0.06), (-0.1, 0.1, -0.08)])
def test_a_shift_is_found(mapped: ScanOnTiles, off: tuple[float, float, float]):
    for seed in range(5):
        match = search_pose(mapped, [at(*off)], np.random.default_rng(seed))
        assert math.hypot(match.pose[0] - POSE.x, match.pose[1] - POSE.y) < 0.05
        assert abs(match.pose[2] - POSE.yaw_rad) < 0.03
        assert 0.6 < match.score <= 1.0


def test_one_good_hypothesis_among_bad_ones_is_enough(mapped: ScanOnTiles):
    hypotheses = [at(2.0, 0.5, 2.0), at(0.1, 0.1, 0.05, loss=0.05)]
    match = search_pose(mapped, hypotheses, np.random.default_rng(0))
    assert math.hypot(match.pose[0] - POSE.x, match.pose[1] - POSE.y) < 0.05
    assert match.moved > 5.0


def test_a_heading_across_pi(mapped: ScanOnTiles):
    """Hypotheses a whole turn apart are one and the same."""
    for turn in (2.0 * math.pi, -2.0 * math.pi):
        match = search_pose(mapped, [at(0.1, 0.0, turn)], np.random.default_rng(1))
        assert math.hypot(match.pose[0] - POSE.x, match.pose[1] - POSE.y) < 0.07
        assert match.moved < 1.5


def test_where_nothing_tells_the_hypothesis_is_kept(mapped: ScanOnTiles):
    away = Pose2(500.0, 500.0, 0.0)
    nowhere = PoseHypothesis(np.array([away.x, away.y, 0.3]), spread_of(0.15, 0.1))
    match = search_pose(mapped, [nowhere], np.random.default_rng(0))
    np.testing.assert_allclose(match.pose, nowhere.pose, atol=1e-4)


def test_a_hypothesis_that_is_trusted_more_is_left_less(mapped: ScanOnTiles):
    found = [
        search_pose(mapped, [at(0.1, 0.1, 0.0)], np.random.default_rng(2), trust)
        for trust in (1.0, 20.0, 1000.0)
    ]
    left = [float(np.hypot(*(match.pose[:2] - at(0.1, 0.1, 0.0).pose[:2]))) for match in found]
    assert left[0] > 0.1
    assert left[0] > left[1] > left[2]
    assert left[2] < 0.01
    # The heading is as free as before.
    turned = at(0.0, 0.0, 0.06)
    match = search_pose(mapped, [turned], np.random.default_rng(2), 1000.0)
    assert abs(match.pose[2] - POSE.yaw_rad) < 0.03
