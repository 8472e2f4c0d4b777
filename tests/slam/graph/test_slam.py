"""The graph SLAM: it knows where it is, closes loops, and believes no false one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import MOST_BEAMS
from slamfusion.config import GraphConfig
from slamfusion.geometry import F64, Pose2
from slamfusion.io.log import LogScan
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import BLIND
from slamfusion.slam.graph.slam import GraphSlam
from tests.slam.drives import CELL_M, draw_flat, drive, scan_at, true_poses
from tests.slam.places import (
    around,
    away,
    draw_corridor,
    draw_regular_ring,
    draw_ring,
    draw_two_rooms,
    errors,
    everything,
    false_closures,
    feed,
    log_of,
    near,
    odometry_error,
    on_truth,
    read,
    ring,
    run,
    through_two_rooms,
)

pytestmark = pytest.mark.once


def bare_scan(ranges: F64, stamp_s: float = 0.0) -> LaserScan:
    """A scan of any ranges over 270 degrees."""
    step = math.radians(270.0) / max(1, len(ranges) - 1)
    return LaserScan(stamp_s, ranges, math.radians(-135.0), step, 0.02, 8.0)


# -- where the robot is ----------------------------------------------------------------------------


@pytest.mark.parametrize("count", [MOST_BEAMS + 1, 12_000])
def test_more_beams_than_a_cell_can_count(device: ComputeDevice, count: int):
    """All over a quarter of the view, at a wall that bends; the robot drives 2 m."""
    angles = np.linspace(-0.8, 0.8, count)
    scans = []
    for index in range(11):
        x = 0.2 * index
        ranges = np.sqrt((3.5 - x) ** 2 + 4.0 * np.sin(angles) ** 2) / (1.0 + 0.2 * np.cos(angles))
        step = float(angles[1] - angles[0])
        scans.append(
            LogScan(LaserScan(0.1 * index, ranges, -0.8, step, 0.02, 8.0), Pose2(x), index)
        )
    slam = run(device, scans)
    assert slam.health.scans_used == 11
    grid = slam.grid()
    assert (grid.cells >= 65).sum() > 40
    assert slam.memory_bytes() < 5e6 + slam.health.nodes * (200_000 + 8 * count)


def test_readings_beyond_the_usable_range_are_none(device: ComputeDevice):
    scans, _ = drive(10)
    far = bare_scan(np.full(181, 4.0), 0.45)
    log = [*scans[:5], LogScan(far, scans[4].odometry, 6), *scans[5:]]
    slam = run(device, log, usable_range_m=3.99)
    assert slam.health.skips.counts == {BLIND: 1}
    assert slam.health.scans_used == 10
    assert run(device, log, usable_range_m=4.01).health.skips.counts == {}
    grid = slam.grid()
    x, y = true_poses(1)[0].x, true_poses(1)[0].y
    rows, cols = np.nonzero(grid.cells >= 65)
    assert np.hypot(*(grid.cell_centres(rows, cols) - (x, y)).T).max() < 4.8


def test_one_scan(device: ComputeDevice):
    pose = Pose2(-3.0, 7.0, 2.5)
    slam = GraphSlam(GraphConfig(), device)
    step = slam.feed(scan_at(true_poses(1)[0], 5.0), pose)
    assert (step.used, step.match_score, step.reason) == (True, None, "")
    assert slam.health.nodes == slam.health.submaps == slam.health.scans_used == 1
    assert slam.trajectory().poses.tolist() == [[-3.0, 7.0, 2.5]]
    moved = pose.compose(true_poses(1)[0].inverse())
    assert on_truth(slam.grid(), draw_flat(), moved)[0] > 0.95
    assert slam.last_stamp_s == 5.0


def test_standing_adds_no_node_and_leaves_the_map_as_it_is(device: ComputeDevice):
    scans, truth = drive(30)
    slam = run(device, scans)
    before, nodes, memory = slam.grid(), slam.health.nodes, slam.memory_bytes()
    rng = np.random.default_rng(0)
    still = scans[-1]
    for index in range(150):
        noise = rng.normal(0.0, 0.02, still.scan.ranges.shape).astype(np.float32)
        stamp_s = still.scan.stamp_s + 0.1 * (index + 1)
        scan = replace(still.scan, ranges=still.scan.ranges + noise, stamp_s=stamp_s)
        step = slam.feed(scan, still.odometry)
    assert slam.health.nodes == nodes
    assert slam.health.scans_used == 180
    assert slam.memory_bytes() == memory
    after = slam.grid()
    assert after.cells.tobytes() == before.cells.tobytes()
    assert after.origin == before.origin
    pose = step.pose_map_base
    assert math.hypot(pose.x - truth[-1].x, pose.y - truth[-1].y) < 0.1


def test_where_nothing_tells_the_way_odometry_decides(device: ComputeDevice):
    truth = [Pose2(1.5 + 0.15 * index, 1.5) for index in range(95)]
    slam = run(device, log_of(read(draw_corridor(), truth, 8.0), truth))
    assert errors(slam, truth)[0] < 0.35


# -- closures --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def closed(device: ComputeDevice) -> GraphSlam:
    """The ring with its loop closed."""
    return run(device, ring()[0])


def test_a_loop_closes(closed: GraphSlam):
    log, truth = ring()
    assert odometry_error(log, truth) > 1.0
    assert closed.health.closures_accepted > 20
    assert closed.health.solutions > 1
    path = closed.trajectory()
    assert away(path, truth)[-1] < 0.15
    assert away(path, truth).max() < 0.3
    assert false_closures(closed, truth) == []
    correct, found = on_truth(closed.grid(), draw_ring())
    assert correct > 0.9
    assert found > 0.9


def test_no_closure_is_one_pillar_off(device: ComputeDevice):
    """A ring that looks the same at every metre, and a robot that has drifted by one."""
    truth = around(1.5, 1.5, 11.5, 8.5)
    scans = read(draw_regular_ring(), truth, 3.0)
    slam = run(device, log_of(scans, truth, turn_bias=0.01, longer=1.05))
    assert false_closures(slam, truth) == []


def test_the_path_as_first_reported_is_kept(device: ComputeDevice, closed: GraphSlam):
    truth, log = ring()[1], ring()[0]
    online, last = closed.other_paths()[0], closed.trajectory()
    assert online.name == "as first reported"
    np.testing.assert_array_equal(online.stamps_s, last.stamps_s)
    assert len(online) == len(log)
    assert np.abs(online.poses - last.poses)[:, :2].max() > 0.1
    first, final = (float(np.square(away(path, truth)).mean()) for path in (online, last))
    assert final < first
    slam = GraphSlam(GraphConfig(), device)
    told = [slam.feed(item.scan, item.odometry).pose_map_base for item in log[:60]]
    np.testing.assert_array_equal(
        slam.other_paths()[0].poses, [(pose.x, pose.y, pose.yaw_rad) for pose in told]
    )


def test_asking_on_the_way_changes_nothing(device: ComputeDevice, closed: GraphSlam):
    slam = GraphSlam(GraphConfig(), device)
    for index, item in enumerate(ring()[0]):
        slam.feed(item.scan, item.odometry)
        if index in {90, 160, 230}:
            slam.grid()
            slam.trajectory()
    # But the memory: tiles of a map that was drawn on the way stay, some of them empty.
    assert everything(slam)[:4] == everything(closed)[:4]


@pytest.mark.parametrize(("turn_bias", "longer"), [(-0.02, 1.15)])
def test_two_rooms_that_look_the_same_stay_two(
    device: ComputeDevice, turn_bias: float, longer: float
):
    truth = through_two_rooms()
    log = log_of(read(draw_two_rooms(), truth, 6.0), truth, turn_bias=turn_bias, longer=longer)
    slam = run(device, log)
    assert slam.health.closures_accepted > 20
    assert false_closures(slam, truth) == []
    path = slam.trajectory()
    assert away(path, truth)[-1] < 0.1
    assert away(path, truth).max() < 0.4
    assert min(on_truth(slam.grid(), draw_two_rooms())) > 0.8


# -- known places ----------------------------------------------------------------------------------


def crowded(item: LogScan) -> LogScan:
    """Return a scan in which people 0.6 m away hide nearly half of the beams."""
    ranges = item.scan.ranges.copy()
    ranges[: 9 * len(ranges) // 20] = 0.6
    return replace(item, scan=replace(item.scan, ranges=ranges))


def test_in_a_known_place_the_graph_does_not_grow(device: ComputeDevice):
    """Twice around a ring, the same way back, and again: driving on costs nothing.

    An occasional crowd does not make it grow either.
    """
    log, truth = ring()
    back = [*log[-2::-1], *log[1:], *log[-2::-1]]
    on = [
        replace(item, scan=replace(item.scan, stamp_s=log[-1].scan.stamp_s + 0.1 * (index + 1)))
        for index, item in enumerate(back)
    ]
    slam = feed(run(device, log), on[: len(log)])
    health = slam.health
    before = health.nodes, health.submaps
    saved = slam.memory_bytes()
    later = on[len(log) :]
    feed(slam, [item if index % 60 else crowded(item) for index, item in enumerate(later)])
    assert health.nodes <= before[0] + 10
    assert health.submaps <= before[1] + 2
    assert slam.memory_bytes() < 1.1 * saved
    way = [*truth, *truth[-2::-1], *truth[1:], *truth[-2::-1]]
    assert len(slam.trajectory()) == len(way)
    assert away(slam.trajectory(), way).max() < 0.4
    assert health.warnings() == ()


# -- the map ---------------------------------------------------------------------------------------


def test_free_space_is_free_and_behind_walls_is_unknown(device: ComputeDevice):
    scans, truth = drive(120)
    grid = run(device, scans).grid()
    rows, cols = grid.cell_indices(np.array([(pose.x, pose.y) for pose in truth]))
    assert ((grid.cells[rows, cols] >= 0) & (grid.cells[rows, cols] <= 25)).all()
    own = np.full((140, 180), -1, dtype=np.int8)
    rows, cols = np.indices(grid.cells.shape)
    x, y = np.floor(grid.cell_centres(rows.ravel(), cols.ravel()).T / CELL_M).astype(int)
    inside = (x >= 0) & (y >= 0) & (x < 180) & (y < 140)
    own[y[inside], x[inside]] = grid.cells.ravel()[inside]
    solid = near(1 - draw_flat(), 4) == 0
    assert (own[solid] == -1).mean() > 0.99
    clear = near(draw_flat(), 3) == 0
    known = own[clear] != -1
    assert known.mean() > 0.8
    assert (own[clear][known] <= 25).mean() > 0.999


def fan(lengths: list[float]) -> LaserScan:
    """Beams that all run through the same cells."""
    return LaserScan(0.0, np.array(lengths), 0.0, 1e-5, 0.02, 8.0)


@pytest.mark.parametrize(("least", "known"), [(1, True), (10, True), (11, False)])
def test_min_pass_through_is_honoured(device: ComputeDevice, least: int, known: bool):
    slam = GraphSlam(GraphConfig(min_pass_through=least), device)
    slam.feed(fan([3.025] * 10), Pose2(0.025, 0.025))
    grid = slam.grid()
    assert (grid.cells != -1).any() == known
    if known:
        assert grid.cells.shape == (1, 61)
        assert (grid.cells[0, :-1] == 0).all()
        assert grid.cells[0, -1] == 100


@pytest.mark.parametrize(
    ("threshold", "is_wall"), [(0.05, True), (0.19, True), (0.21, False), (0.9, False)]
)
def test_occupancy_threshold_is_honoured(device: ComputeDevice, threshold: float, is_wall: bool):
    """Of ten beams two end 2 m away and eight go on: a share of a fifth."""
    slam = GraphSlam(GraphConfig(occupancy_threshold=threshold), device)
    slam.feed(fan([2.025] * 2 + [3.025] * 8), Pose2(0.025, 0.025))
    row = slam.grid().cells[0]
    assert (row[40] >= 65) == is_wall
    assert row[40] >= 0
    assert (row[:40] == 0).all()
    assert row[60] == 100


@pytest.mark.parametrize("resolution", [0.02, 0.2])
def test_other_cell_sizes(device: ComputeDevice, resolution: float):
    scans, truth = drive(60, turn_bias=0.005)
    slam = run(device, scans, resolution=resolution)
    assert slam.grid().resolution == resolution
    assert errors(slam, truth)[0] < 0.15
