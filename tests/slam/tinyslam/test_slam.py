"""tinySLAM: it knows where it is, it draws what is there, and it says what it could not use."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import TinySlamConfig
from slamfusion.geometry import Pose2
from slamfusion.io.log import LogScan
from slamfusion.scan import LaserScan
from slamfusion.slam.tinyslam.slam import TinySlam
from tests.slam.drives import drive
from tests.slam.places import errors, feed

pytestmark = pytest.mark.once


def run(device: ComputeDevice, scans: list[LogScan], seed: int = 0, **settings: object) -> TinySlam:
    return feed(TinySlam(TinySlamConfig(**settings), device, seed), scans)


@pytest.mark.parametrize("begin", [60, 47])
def test_one_that_begins_while_the_robot_drives_back_goes_with_it(
    device: ComputeDevice, begin: int
):
    # The beams of one scan mark some cells of the side walls alone: where that scan was taken the
    # next fits best, and no wall ahead comes nearer, which would say otherwise.
    there, poses = drive(80, turn_bias=0.003)
    scans = [
        replace(item, scan=replace(item.scan, stamp_s=0.1 * index))
        for index, item in enumerate(there[begin : begin - 40 : -1])
    ]
    truth = poses[begin : begin - 40 : -1]
    odometry = scans[0].odometry
    moved = odometry.compose(truth[0].inverse())
    slam = run(device, scans)
    assert errors(slam, [moved.compose(pose) for pose in truth])[0] < 0.3


def test_free_space_is_free_and_behind_walls_is_unknown(device: ComputeDevice):
    scans, _ = drive(40)
    grid = run(device, scans).grid()
    rows, cols = grid.cell_indices(np.array([[2.0, 1.0], [5.0, 2.0], [3.0, 0.2], [-3.0, 0.0]]))
    inside = (rows >= 0) & (rows < grid.height) & (cols >= 0) & (cols < grid.width)
    assert inside.tolist() == [True, True, False, False]
    assert (grid.cells[rows[:2], cols[:2]] <= 25).all()
    assert (grid.cells[rows[:2], cols[:2]] >= 0).all()


@pytest.mark.parametrize("estimator", ["constant", "area"])
def test_every_estimator_and_coarse_cells_complete(device: ComputeDevice, estimator: str):
    scans, _ = drive(30)
    slam = run(device, scans, occupancy_estimator=estimator, resolution=0.3)
    assert slam.grid().resolution == 0.3
    assert slam.health.scans_used == 30


def test_health_tells_a_strange_place(device: ComputeDevice):
    scans, _ = drive(40)
    slam = run(device, scans)
    good = slam.health.mean_match_score
    assert good > 0.5
    assert slam.health.low_scores == 0
    rng = np.random.default_rng(0)
    for index in range(5):
        noise = rng.uniform(0.5, 7.0, 181)
        slam.feed(LaserScan(10.0 + index, noise, -2.0, 0.02, 0.02, 8.0), scans[-1].odometry)
    assert slam.health.low_scores == 5


def test_memory_of_40_m_by_40_m(device: ComputeDevice):
    """Beams that sweep a square of 40 m: about 10 MB at 0.05 m."""
    slam = TinySlam(TinySlamConfig(), device)
    angles = -math.pi + 2.0 * math.pi / 4000 * np.arange(4000)
    ranges = 20.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    slam.feed(LaserScan(0.0, ranges, -math.pi, 2.0 * math.pi / 4000, 0.0, 60.0), Pose2())
    assert 8e6 < slam.memory_bytes() < 12e6
    assert max(slam.grid().cells.shape) == pytest.approx(800, abs=2)
