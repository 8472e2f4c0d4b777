"""tinySLAM: it knows where it is, it draws what is there, and it says what it could not use."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice, NumpyDevice, open_device
from slamfusion.config import TinySlamConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import OccupancyGrid
from slamfusion.io.log import LogScan
from slamfusion.scan import LaserScan
from slamfusion.slam.tinyslam import TinySlam
from tests.slam.drives import (
    CELL_M,
    ONE_JUMP,
    draw_flat,
    drive,
    jumped,
    scan_at,
    stalled,
    true_poses,
)

pytestmark = pytest.mark.once


@pytest.fixture(scope="module")
def device() -> ComputeDevice:
    return open_device()


def run(device: ComputeDevice, scans: list[LogScan], seed: int = 0, **settings: object) -> TinySlam:
    slam = TinySlam(TinySlamConfig(**settings), device, seed)
    for item in scans:
        slam.feed(item.scan, item.odometry)
    return slam


def errors(slam: TinySlam, truth: list[Pose2]) -> tuple[float, float]:
    """Return the greatest errors of place (m) and heading (rad)."""
    away = [
        (math.hypot(pose.x - x, pose.y - y), abs(wrap_angle(pose.yaw_rad - yaw)))
        for pose, (x, y, yaw) in zip(truth, slam.trajectory().poses, strict=True)
    ]
    return max(a for a, _ in away), max(a for _, a in away)


def occupied_share_on_truth(grid: OccupancyGrid, moved: Pose2) -> float:
    """Return the share of the map's walls that lie within two cells of a true wall."""
    rows, cols = np.nonzero(grid.cells >= 65)
    own = moved.inverse().transform(grid.cell_centres(rows, cols)) / CELL_M
    col, row = np.floor(own).astype(int).T
    flat = np.pad(draw_flat(), 40)
    near = np.zeros_like(flat)
    for down in range(-2, 3):
        for right in range(-2, 3):
            near |= np.roll(flat, (down, right), axis=(0, 1))
    return float(near[row + 40, col + 40].mean())


@pytest.mark.parametrize("cell_model", ["mean", "base"])
def test_biased_odometry_is_corrected(device: ComputeDevice, cell_model: str):
    scans, truth = drive(120, turn_bias=0.01)
    last = scans[-1].odometry
    assert last is not None
    assert math.hypot(last.x - truth[-1].x, last.y - truth[-1].y) > 1.0
    slam = run(device, scans, cell_model=cell_model)
    metres, radians = errors(slam, truth)
    assert metres < 0.1
    assert radians < 0.03
    assert occupied_share_on_truth(slam.grid(), Pose2()) > 0.95


@pytest.mark.parametrize("begin", [60, 55, 51, 47])
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
    assert odometry is not None
    moved = odometry.compose(truth[0].inverse())
    slam = run(device, scans)
    assert errors(slam, [moved.compose(pose) for pose in truth])[0] < 0.3


def test_without_odometry(device: ComputeDevice):
    scans, truth = drive(120)
    bare = [replace(item, odometry=None) for item in scans]
    slam = run(device, bare)
    start = truth[0].inverse()
    assert max(errors(slam, [start.compose(pose) for pose in truth])) < 0.1


def test_odometry_that_stalls_and_catches_up(device: ComputeDevice):
    scans, truth = drive(120)
    assert errors(run(device, stalled(scans)), truth)[0] < 0.1


def test_an_odometry_jump_is_named_and_not_believed(device: ComputeDevice):
    scans, truth = drive(60)
    slam = run(device, jumped(scans))
    assert errors(slam, truth)[0] < 0.1
    assert slam.health.skips.to_json() == ONE_JUMP


def test_a_start_far_from_zero_costs_nothing(device: ComputeDevice):
    near, truth = drive(30)
    far_start = Pose2(512_345.6, -98_765.4, 2.0)
    far, far_truth = drive(30, start=far_start)
    slam, away = run(device, near), run(device, far)
    assert away.memory_bytes() == pytest.approx(slam.memory_bytes(), rel=0.1)
    assert errors(away, far_truth)[0] < 0.1
    assert errors(slam, truth)[0] < 0.1
    moved = far_start.compose(true_poses(30)[0].inverse())
    assert occupied_share_on_truth(away.grid(), moved) > 0.95


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_mounted_laser_draws_the_same_flat(device: ComputeDevice, *, clockwise: bool):
    scans, truth = drive(60, mount=Pose2(0.3, -0.1, 0.7), clockwise=clockwise, turn_bias=0.005)
    slam = run(device, scans)
    assert errors(slam, truth)[0] < 0.1
    assert occupied_share_on_truth(slam.grid(), Pose2()) > 0.95


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


def test_blind_scans_are_counted_and_dead_reckoned(device: ComputeDevice):
    scans, truth = drive(40)
    blind = LaserScan(1.05, np.full(7, np.inf), 0.0, 0.1, 0.0, 8.0)
    failed = LaserScan(1.06, np.full(7, np.nan), 0.0, 0.1, 0.0, 8.0)
    slam = TinySlam(TinySlamConfig(), device)
    for item in scans[:11]:
        slam.feed(item.scan, item.odometry)
    for number, scan in ((12, blind), (13, failed)):
        step = slam.feed(scan, scans[10].odometry)
        assert not step.used
        assert step.reason == "no reading within the usable range"
        assert slam.health.scans == number
    for item in scans[11:]:
        assert slam.feed(item.scan, item.odometry).used
    assert slam.health.scans_used == 40
    assert slam.health.skips.counts == {"no reading within the usable range": 2}
    assert len(slam.trajectory()) == 42
    last = slam.trajectory().pose(41)
    assert math.hypot(last.x - truth[-1].x, last.y - truth[-1].y) < 0.1


def test_no_scan_at_all_has_no_map(device: ComputeDevice):
    slam = TinySlam(TinySlamConfig(), device)
    with pytest.raises(SlamFusionError, match="no scan could be used, so there is no map"):
        slam.grid()
    slam.feed(LaserScan(0.0, np.full(3, np.inf), 0.0, 0.1, 0.0, 8.0), None)
    with pytest.raises(SlamFusionError, match="no map"):
        slam.grid()


def test_a_scan_of_100_000_beams(device: ComputeDevice):
    ranges = 3.0 + 0.5 * np.sin(np.linspace(0.0, 40.0, 100_000))
    scans = [LaserScan(t, ranges, -math.pi, 2e-5 * math.pi, 0.0, 8.0) for t in (0.0, 0.1)]
    slam = TinySlam(TinySlamConfig(), device)
    assert [slam.feed(scan, Pose2()).used for scan in scans] == [True, True]
    assert max(abs(value) for value in slam.trajectory().poses[1]) < 0.02


def test_an_hour_without_scans_is_survived(device: ComputeDevice):
    scans, truth = drive(40)
    late = [
        replace(item, scan=replace(item.scan, stamp_s=item.scan.stamp_s + 3600.0))
        if index >= 20
        else item
        for index, item in enumerate(scans)
    ]
    assert errors(run(device, late), truth)[0] < 0.1


def test_same_seed_same_bytes_and_another_seed_agrees(device: ComputeDevice):
    scans, truth = drive(40, turn_bias=0.005)
    first, again, other = (run(device, scans, seed) for seed in (3, 3, 4))
    assert first.trajectory().poses.tobytes() == again.trajectory().poses.tobytes()
    assert first.grid().cells.tobytes() == again.grid().cells.tobytes()
    assert other.trajectory().poses.tobytes() != first.trajectory().poses.tobytes()
    assert errors(other, truth)[0] < 0.1


def test_the_twins_find_the_same_way(device: ComputeDevice):
    scans, _ = drive(12, turn_bias=0.005)
    plain = run(NumpyDevice(), scans)
    on_device = run(device, scans)
    np.testing.assert_array_equal(plain.trajectory().poses, on_device.trajectory().poses)
    np.testing.assert_array_equal(plain.grid().cells, on_device.grid().cells)


def test_health_tells_a_strange_place(device: ComputeDevice):
    scans, _ = drive(40)
    slam = run(device, scans)
    good = slam.health.mean_match_score
    assert good is not None
    assert good > 0.5
    assert slam.health.low_scores == 0
    rng = np.random.default_rng(0)
    for index in range(5):
        noise = rng.uniform(0.5, 7.0, 181)
        slam.feed(LaserScan(10.0 + index, noise, -2.0, 0.02, 0.02, 8.0), scans[-1].odometry)
    assert slam.health.low_scores == 5


def test_quality_drops_where_the_matcher_moved_the_pose(device: ComputeDevice):
    """A first map, then a scan whose odometry is 0.6 m off: the map believes it less."""
    pose = true_poses(1)[0]
    maps = {}
    for quality_moved in (1.0, 0.1):
        slam = TinySlam(TinySlamConfig(quality_moved=quality_moved), device)
        for index in range(3):
            slam.feed(scan_at(pose, 0.1 * index), pose)
        off = pose.compose(Pose2(0.45, 0.45, 0.0))
        step = slam.feed(scan_at(pose, 0.4), off)
        assert math.hypot(step.pose_map_base.x - pose.x, step.pose_map_base.y - pose.y) < 0.05
        maps[quality_moved] = slam.grid().cells.astype(int)
    walls = maps[1.0] >= 90
    assert maps[0.1][walls].mean() < maps[1.0][walls].mean()


def test_memory_of_40_m_by_40_m(device: ComputeDevice):
    """Beams that sweep a square of 40 m: about 10 MB at 0.05 m."""
    slam = TinySlam(TinySlamConfig(), device)
    angles = -math.pi + 2.0 * math.pi / 4000 * np.arange(4000)
    ranges = 20.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    slam.feed(LaserScan(0.0, ranges, -math.pi, 2.0 * math.pi / 4000, 0.0, 60.0), Pose2())
    assert 8e6 < slam.memory_bytes() < 12e6
    assert max(slam.grid().cells.shape) == pytest.approx(800, abs=2)
