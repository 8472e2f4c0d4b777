from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nav_msgs", reason="rclpy is absent: install the extra ros, or source a ROS")

from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message

from slamfusion.errors import GridError, ScanError, TrajectoryError
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io.transforms import Mount
from slamfusion.ros import messages
from slamfusion.scan import LaserScan
from slamfusion.trajectory import Trajectory

pytestmark = pytest.mark.ros

GRID = OccupancyGrid(
    np.array([[-1, 0, 100], [37, 100, 0]], dtype=np.int8), 0.05, Pose2(-3.5, 2.25, 0.75), "drawn"
)


def sent(grid: OccupancyGrid = GRID) -> Any:
    return messages.grid_to_message(grid, "a_map", Time(sec=7, nanosec=5))


def test_a_grid_comes_back_as_it_was():
    back = messages.grid_from_message(sent(), "drawn")
    assert np.array_equal(back.cells, GRID.cells)
    assert back.resolution == 0.05
    assert (back.origin.x, back.origin.y) == (-3.5, 2.25)
    assert back.origin.yaw_rad == pytest.approx(0.75, abs=1e-12)
    assert back.name == "drawn"


@pytest.mark.parametrize("resolution", [math.nan, 0.0, -0.05, math.inf])
def test_a_resolution_that_is_none_is_refused(resolution: float):
    message = sent()
    message.info.resolution = resolution
    with pytest.raises(GridError, match=r"odd: resolution must be a positive number .* found"):
        messages.grid_from_message(message, "odd")


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ([0] * 5, "odd: 5 cells sent for a map of 3 x 2"),
        *(([0, 0, 0, value, 0, 0], str(value)) for value in (-2, 101, -128, 127)),
    ],
)
def test_cells_that_are_none_are_refused(cells: list[int], words: str):
    message = sent()
    message.data = cells
    with pytest.raises(GridError, match=words):
        messages.grid_from_message(message, "odd")


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        ((1.0, 0.0, 0.0, 0.0), "tilts or turns over"),
        ((0.0, 0.1, 0.0, 1.0), "tilts or turns over"),
        ((0.0, 0.0, 0.0, 0.0), "no rotation"),
        ((0.0, 0.0, 1e308, 1e308), "no rotation"),
        ((0.0, 0.0, 0.0, -1e200), "no rotation"),
        ((0.0, 0.0, math.nan, 1.0), "not finite"),
    ],
)
def test_an_origin_that_is_no_pose_in_the_plane_is_refused(turn: tuple[float, ...], words: str):
    message = sent()
    origin = message.info.origin.orientation
    origin.x, origin.y, origin.z, origin.w = turn
    with pytest.raises(GridError, match=f"odd: the map's origin: .*{words}"):
        messages.grid_from_message(message, "odd")
    with pytest.raises(TrajectoryError, match=words):
        messages.pose2_from_message(message.info.origin)


@given(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0), st.floats(-3.14, 3.14))
def test_a_pose_comes_back_as_it_was(x: float, y: float, yaw_rad: float):
    message = messages.pose_to_message(Pose2(x, y, yaw_rad), "map", Time())
    back = messages.pose2_from_message(message.pose)
    assert (back.x, back.y) == (x, y)
    assert back.yaw_rad == pytest.approx(yaw_rad, abs=1e-12)


@given(st.integers(0, 2**31 - 2), st.integers(0, 999_999_999))
def test_seconds_are_the_double_nearest_to_the_stamp(sec: int, nanosec: int):
    seconds = messages.stamp_s(Time(sec=sec, nanosec=nanosec))
    again = messages.to_stamp(seconds)
    assert abs((again.sec - sec) * 10**9 + again.nanosec - nanosec) <= 120
    assert messages.stamp_s(again) == seconds


@given(st.integers(0, 10**12))
def test_stamps_of_logs_come_back_as_they_were(micros: int):
    seconds = micros / 10**6
    assert messages.stamp_s(messages.to_stamp(seconds)) == seconds


def test_a_time_that_ros_does_not_have_is_refused():
    with pytest.raises(ValueError, match=r"2\^31"):
        messages.to_stamp(1e11)


SCAN = LaserScan(
    12.25,
    np.array([1.0, math.inf, math.nan, 2.5, -math.inf], dtype=np.float32),
    -1.5,
    0.25,
    0.125,
    8.0,
    Pose2(0.2, 0.0, 0.1),
)


def test_a_scan_comes_back_as_it_was():
    message = messages.scan_to_message(SCAN, "laser")
    assert message.header.frame_id == "laser"
    assert message.angle_max == -0.5
    back = messages.scan_from_message(message, Mount(SCAN.mount))
    assert np.array_equal(back.ranges, SCAN.ranges, equal_nan=True)
    assert (back.stamp_s, back.angle_min_rad, back.angle_increment_rad) == (12.25, -1.5, 0.25)
    assert (back.range_min_m, back.range_max_m, back.mount) == (0.125, 8.0, SCAN.mount)


def test_a_laser_upside_down_turns_the_other_way():
    message = messages.scan_to_message(SCAN, "laser")
    back = messages.scan_from_message(message, Mount(is_flipped=True))
    assert (back.angle_min_rad, back.angle_increment_rad) == (1.5, -0.25)
    assert back.points()[0] == pytest.approx([math.cos(1.5), math.sin(1.5)], abs=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("ranges", [], "at least one range"),
        ("angle_increment", 0.0, "must not be 0"),
        ("angle_min", math.nan, "must be finite"),
        ("range_max", 0.0, "range limits"),
    ],
)
def test_what_is_no_scan_is_refused_by_time_and_frame(name: str, value: Any, words: str):
    message = messages.scan_to_message(SCAN, "laser")
    setattr(message, name, value)
    with pytest.raises(ScanError, match=rf"scan at 12\.250 s in 'laser': .*{words}"):
        messages.scan_from_message(message, Mount())


@pytest.mark.parametrize("frame", ["", "m", "a_map", "robot1/graph_map"])
@pytest.mark.parametrize("count", [0, 1, 2, 3000])
def test_a_path_is_the_same_in_bytes_and_as_a_message(frame: str, count: int):
    stamps_s = np.arange(count) / 10.0
    poses = np.column_stack((stamps_s, -stamps_s, np.sin(stamps_s)))
    data = messages.path_to_bytes(Trajectory(stamps_s, poses), frame, Time(sec=100))
    path = deserialize_message(data, Path)
    assert len(path.poses) == min(count, messages.PATH_POSES)
    assert {pose.header.frame_id for pose in path.poses} <= {frame}
    for pose, at in zip(path.poses[:: max(1, len(path.poses) - 1)], (0, -1), strict=False):
        assert pose == messages.pose_to_message(
            Pose2(*poses[at]), frame, messages.to_stamp(stamps_s[at])
        )
    read = messages.path_from_bytes(data, "a")
    assert [messages.pose2_from_message(pose.pose) for pose in path.poses] == [
        read.pose(index) for index in range(len(read))
    ]
    assert read.stamps_s.tolist() == [messages.stamp_s(pose) for pose in path.poses]


def test_a_path_of_others_is_read_and_one_that_is_none_in_the_plane_refused():
    path = deserialize_message(
        messages.path_to_bytes(Trajectory(np.arange(3.0), np.zeros((3, 3))), "map", Time()), Path
    )
    path.poses[1].header.frame_id = "another"
    assert len(messages.path_from_bytes(serialize_message(path), "a")) == 3
    path.poses[1].header.frame_id = "map"
    path.poses[0].header.stamp.sec = -1
    assert messages.path_from_bytes(serialize_message(path), "a").stamps_s[0] == -1.0
    path.poses[1].pose.orientation.x = 1.0
    with pytest.raises(TrajectoryError, match="tilts or turns over"):
        messages.path_from_bytes(serialize_message(path), "a")
