"""The fusion node as a process over DDS: what it publishes, answers, survives and names."""

from __future__ import annotations

import itertools
import math
import resource
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetMap
from rosgraph_msgs.msg import Clock
from scipy import ndimage
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger

from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox
from slamfusion.io.map_server import load_map, save_map
from slamfusion.ros import messages, qos
from slamfusion.ros.frames import TransformInput
from tests.fusion.live.maps import assert_same_lattice, share_standing, three, touched
from tests.ros import tf2
from tests.ros.fused import (
    Makers,
    Robot,
    fused_without_ros,
    share_equal,
    start_fusion,
    told_transforms,
    unlike,
)
from tests.ros.live import Observer, Processes, values

pytestmark = pytest.mark.ros

FUSION = "fusion: fusion"


def wait_for_all(observer: Observer, timeout_s: float = 40.0) -> Any:
    return observer.wait_status(FUSION, "all 3 inputs vote", timeout_s=timeout_s)


@pytest.fixture
def makers(observer: Observer) -> Makers:
    return Makers(observer)


def test_three_maps_become_one_as_without_ros(
    processes: Processes, observer: Observer, makers: Makers, tmp_path: Path
):
    maps = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    agreements = observer.collect(OccupancyGrid, "fused/agreement", qos.MAP)
    makers.send_all()
    (tmp_path / "saved").mkdir()
    node = start_fusion(processes, save_path=str(tmp_path / "saved" / "lab"))
    wait_for_all(observer)
    wanted = fused_without_ros()

    def have_come() -> bool:
        both = maps and agreements and share_equal(maps[-1], wanted) > 0.9
        return both and agreements[-1].info == maps[-1].info

    observer.wait(have_come, what="the map of all three and its agreement")
    assert maps[-1].header.frame_id == "fused_map"
    assert messages.stamp_s(maps[-1]) == makers.stamp_s
    assert max(agreements[-1].data) == 100

    status = observer.wait_status("fusion: input b", "walls match")
    figures = values(status)
    assert figures["accepted"] == "yes"
    assert float(figures["score"]) > 0.3
    assert int(figures["maps"]) >= 1
    assert figures["frame"] == "b_map"
    fused = values(observer.statuses()[FUSION])
    assert fused["reference"] == "a"
    assert float(fused["latency p95 [ms]"]) > 0.0

    # Who comes late gets the map at once; the services answer it and write it.
    late = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    observer.wait(lambda: late, 5.0, "the kept map")
    assert late[-1] == maps[-1]
    assert observer.call(GetMap, "get_map", GetMap.Request()).map == maps[-1]
    answer = observer.call(Trigger, "save_map", Trigger.Request())
    assert answer.success
    saved = load_map(answer.message)
    assert np.array_equal(saved.cells, messages.grid_from_message(maps[-1], "fused").cells)
    assert observer.call(Trigger, "reset", Trigger.Request()).success
    observer.wait(lambda: values(observer.statuses()[FUSION])["resets"] == "1")
    wait_for_all(observer)

    assert node.interrupt() == 0
    assert "Traceback" not in node.text()


def test_who_listens_late_gets_the_agreement_of_the_newest_map(
    processes: Processes, observer: Observer, makers: Makers
):
    maps = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    start_fusion(processes)
    makers.send_all()
    wait_for_all(observer)
    for number in range(2):
        makers.send(touched(three()["b"], number))
        observer.wait(
            lambda: maps and abs(messages.stamp_s(maps[-1]) - makers.stamp_s) < 1e-6,
            what="the fused map",
        )
        # Nobody listened before; the second time somebody has left.
        agreements: list[Any] = []
        late = observer.node.create_subscription(
            OccupancyGrid, "fused/agreement", agreements.append, qos.MAP
        )
        observer.wait(
            lambda heard=agreements: heard and heard[-1].header == maps[-1].header,
            what="the agreement",
        )
        assert agreements[-1].info == maps[-1].info
        observer.node.destroy_subscription(late)


def test_updates_make_each_fused_map_of_the_one_before(
    processes: Processes, observer: Observer, makers: Makers
):
    tf2.skip_without("map_msgs")
    from map_msgs.msg import OccupancyGridUpdate  # noqa: PLC0415 - only where it was built

    maps = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    updates = observer.collect(OccupancyGridUpdate, "fused/map_updates")
    start_fusion(processes)
    makers.send_all()
    wait_for_all(observer)
    for number in range(3):
        observer.listen(0.5)
        before, count = maps[-1], len(updates)
        makers.send(touched(three()["b"], number))
        observer.wait(lambda count=count: len(updates) > count, what="an update")
        observer.wait(lambda: maps[-1].header == updates[-1].header, what="the map of the update")
        assert messages.updated_map(before, updates[-1]).data == maps[-1].data
        assert len(updates[-1].data) < len(maps[-1].data) / 2


def test_before_two_agree_nothing_is_published_and_the_services_say_so(
    processes: Processes, observer: Observer, makers: Makers
):
    maps = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    makers.send(three()["a"])
    start_fusion(processes)
    observer.wait_status("fusion: input a", "waits for 2 inputs", timeout_s=40.0)
    observer.wait_status("fusion: input b", "no map on '/b/map' yet")
    observer.wait_status(FUSION, "nothing is fused")
    assert not maps
    answer = observer.call(Trigger, "save_map", Trigger.Request())
    assert not answer.success
    assert "waits for 2 inputs" in answer.message
    assert not observer.call(GetMap, "get_map", GetMap.Request()).map.data
    # The second starts much later, the third never.
    makers.send(three()["b"])
    observer.wait_status(FUSION, "2 of 3 inputs vote; not: c")
    observer.wait(lambda: maps, what="the fused map")
    observer.wait(lambda: "not saved" not in observer.statuses()[FUSION].message, 3.0)


def test_one_that_starts_ten_minutes_late_and_grows_by_its_origin(
    processes: Processes, observer: Observer, makers: Makers
):
    maps = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    clock = observer.publisher(Clock, "/clock")
    start_fusion(processes, use_sim_time=True, max_publish_rate_hz=50.0)
    observer.wait(clock.get_subscription_count, what="the node")
    clock.publish(Clock(clock=messages.to_stamp(makers.stamp_s)))
    for name in "ab":
        makers.send(three()[name])
    observer.wait_status(FUSION, "2 of 3 inputs vote; not: c")
    observer.wait(lambda: maps, what="the fused map")
    for minute in range(1, 11):
        clock.publish(Clock(clock=messages.to_stamp(100.0 + 60.0 * minute)))
        observer.listen(0.05)
    observer.wait_status(FUSION, "time jumped forward by 60.000 s")
    makers.stamp_s = 700.0
    first = messages.grid_from_message(maps[-1], "fused")
    # Its first cell lies elsewhere in every map, by cells and by parts of a cell.
    whole = three()["c"]
    for share in (0.55, 0.7, 0.85, 1.0):
        row, col = (int(size * (1.0 - share) / 2.0) for size in whole.cells.shape)
        part = whole.crop(CellBox(row, col, whole.height - row, whole.width - col))
        x, y = part.origin.transform((0.013 * share, -0.021 * share))
        origin = Pose2(float(x), float(y), part.origin.yaw_rad)
        count = len(maps)
        makers.send(replace(part, origin=origin))
        wait_for_all(observer)
        observer.wait(lambda count=count: len(maps) > count, what=f"a map with {share} of c")
        fused = messages.grid_from_message(maps[-1], "fused")
        assert_same_lattice(first, fused)
        assert share_standing(first, fused) > 0.9
    assert messages.stamp_s(maps[-1]) == makers.stamp_s > 700.0


def test_writers_that_keep_nothing_and_saved_maps_take_part(
    processes: Processes, observer: Observer, tmp_path: Path
):
    yaml, _ = save_map(three()["c"], tmp_path / "lab")
    # As map savers with other defaults write it: unknown reads as free, unless it is mended.
    yaml.write_text(yaml.read_text().replace("0.196", "0.25"))
    told: list[str] = []
    plain = load_map(yaml, warn=told.append)
    assert (plain.cells == -1).sum() == 0
    assert "cells of grey 205" in told[0]
    writers = {name: observer.publisher(OccupancyGrid, f"{name}/map", qos.STREAM) for name in "ab"}
    inputs = ["a/map", "b/map", f"file:{yaml}"]
    node = start_fusion(processes, inputs=inputs, legacy_unknown=True)
    statuses = observer.statuses()
    until_s = time.monotonic() + 40.0
    while FUSION not in statuses or "all 3 inputs vote" not in statuses[FUSION].message:
        assert time.monotonic() < until_s, {k: v.message for k, v in statuses.items()}
        for name, writer in writers.items():
            stamp = messages.to_stamp(5.0)
            writer.publish(messages.grid_to_message(three()[name], f"{name}_map", stamp))
        observer.listen(0.5)
    assert values(statuses["fusion: input lab"])["accepted"] == "yes"
    assert "grey 205" not in node.text()


def test_a_place_that_cannot_be_written_is_the_answer(
    processes: Processes, observer: Observer, makers: Makers, tmp_path: Path
):
    makers.send_all()
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "away").symlink_to(tmp_path)
    node = start_fusion(processes, save_path=str(tmp_path / "maps" / "lab"))
    wait_for_all(observer)
    # Nothing leads out of the folder, no folder is made, and each time the answer says why.
    root = tmp_path / "maps"
    for path, words in (
        (f"{root}/../lab", "leads out of"),
        (f"{root}/a/../../lab", "leads out of"),
        (f"{root}/away/lab", "leads out of"),
        (f"{tmp_path}/lab", "leads out of"),
        ("/dev/full/map", "leads out of"),
        (f"{root}/new/lab", f"there is no folder '{root}/new'"),
        (f"{root}/", "names no file"),
        ("", "names no file"),
        (f"{root}/..", "names no file"),
    ):
        answer = observer.set_parameter("fusion", "save_path", path)
        assert not answer.successful, path
        assert answer.reason.startswith("save_path")
        assert words in answer.reason
    assert {item.name for item in tmp_path.rglob("*")} <= {"maps", "away", "0-fusion.txt"}
    # A place that is full after 8 kB: nothing is left behind.
    pid = node.process.pid
    (root / "lab").mkdir()
    observer.set_parameter("fusion", "save_path", str(root / "lab" / "map"))
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (8000, before[1]))
    answer = observer.call(Trigger, "save_map", Trigger.Request())
    assert not answer.success
    assert "not saved" in answer.message
    assert not list((root / "lab").rglob("*.*"))
    observer.wait_status(FUSION, "not saved")
    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
    answer = observer.call(Trigger, "save_map", Trigger.Request())
    assert answer.success
    assert load_map(answer.message).cells.size > 8000
    observer.listen(1.5)  # shorter than a refusal is shown
    assert "not saved" not in observer.statuses()[FUSION].message
    assert node.is_running


def test_wrong_settings_end_it_with_one_line(processes: Processes):
    refused: dict[str, dict[str, Any]] = {
        "/nowhere/lab.yaml": {"inputs": ["file:/nowhere/lab.yaml"]},
        "twice": {"inputs": ["a/map", "a/map"]},
        "no OpenCL device fits 'absent'": {"device": "absent"},
        "stale_after_s": {"live__stale_after_s": -1.0},
        "start.a: wanted x,y,yaw or": {"start__a": [1.0, 2.0]},
        "start.lab names no input; the inputs are a, b, c": {"start__lab": [1.0, 2.0, 0.0]},
        "the start of 'a' alone says nothing": {"start__a": [1.0, 2.0, 0.0]},
    }
    for words, given in refused.items():
        node = start_fusion(processes, **given)
        assert node.wait(60.0) == 1
        assert words in node.text()
        assert "Traceback" not in node.text()


def assert_near(a: Pose2, b: Pose2, metres: float, radians: float) -> None:
    assert math.hypot(a.x - b.x, a.y - b.y) < metres, (a, b)
    assert abs(math.remainder(a.yaw_rad - b.yaw_rad, math.tau)) < radians, (a, b)


def test_pose_and_transforms_agree_and_a_point_lands_on_its_fused_cell(
    processes: Processes, observer: Observer, makers: Makers
):
    tf2.skip_without()
    fused = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    poses = observer.collect(PoseWithCovarianceStamped, "fused/pose")
    frames = TransformInput(observer.node)
    start_fusion(processes, publish_tf=True)
    robot = Robot(observer)
    makers.send_all()
    wait_for_all(observer)
    transforms = told_transforms(observer)
    place = Pose2(2.0, 1.5, 0.3)
    stamp_s = 200.0

    def drive() -> bool:
        nonlocal stamp_s
        stamp_s += 0.1
        robot.at(stamp_s, place, transforms)
        observer.listen(0.1)
        # The transforms of the kept maps are a minute and a half older: three bear out the jump.
        sent = ("odom", "a_map", "b_map", "c_map")
        return len(poses) > 3 and all(frames.heard_s("fused_map", frame) for frame in sent)

    observer.wait(drive, what="the fused pose and the transforms")
    observer.listen(0.5)
    last = poses[-1]
    time_s = messages.stamp_s(last)
    told = messages.pose2_from_message(last.pose.pose)
    assert last.header.frame_id == "fused_map"
    assert_near(told, place, 0.02, 0.01)
    # fused_map -> odom, then the odometry, is the pose.
    to_odom = frames.lookup("fused_map", "odom", time_s)
    assert_near(to_odom.compose(robot.drift.compose(place)), told, 1e-3, 1e-3)
    # A wall as the odometry knows it lands on its own cell of the fused map.
    grid = messages.grid_from_message(fused[-1], "fused")
    walls = np.nonzero(grid.cells == 100)
    from_robot = told.inverse().transform(grid.cell_centres(*walls))
    in_odom = robot.drift.compose(place).transform(from_robot)
    assert np.array_equal(grid.cell_indices(to_odom.transform(in_odom)), walls)
    # Walls of each input, driven through its transform, land on walls that are fused.
    near_wall = ndimage.binary_dilation(grid.cells == 100, np.ones((3, 3)))
    for name in "abc":
        moved = frames.lookup("fused_map", f"{name}_map", time_s)
        assert_near(moved, transforms[name], 0.01, 0.01)
        own = three()[name]
        rows, cols = np.nonzero(own.cells == 100)
        row, col = grid.cell_indices(moved.transform(own.cell_centres(rows, cols)))
        inside = (row >= 0) & (col >= 0) & (row < grid.height) & (col < grid.width)
        # The rest are walls that this map alone has: cells turned over at random.
        assert near_wall[row[inside], col[inside]].mean() > 0.85
    # The one that leads falls silent: the pose goes on by another.
    leader = observer.wait(
        lambda: values(observer.statuses()[FUSION])["pose from"].replace("-", ""),
        what="the name of the one that leads",
    )
    silent = robot.poses.pop(leader)
    count = len(poses)

    def go_on() -> bool:
        nonlocal stamp_s
        stamp_s += 0.1
        robot.at(stamp_s, place, transforms)
        observer.listen(0.1)
        return len(poses) > count + 10

    observer.wait(go_on, what="the pose of another input")
    assert_near(messages.pose2_from_message(poses[-1].pose.pose), place, 0.02, 0.01)
    observer.node.destroy_publisher(silent)


class Followed:
    """A robot whose SLAMs send poses from 200 s on, and the fused poses of a started fusion."""

    def __init__(
        self, processes: Processes, observer: Observer, makers: Makers, names: str, **more: str
    ) -> None:
        self.poses = observer.collect(PoseWithCovarianceStamped, "fused/pose")
        start_fusion(processes, publish_tf=True, **more)
        makers.send_all()
        wait_for_all(observer)
        self.transforms = told_transforms(observer)
        self.robot = Robot(observer, names)
        self._observer, self.stamps_s = observer, itertools.count(200.0, 0.1)

    def is_at(self, place: Pose2) -> bool:
        """Whether the last fused pose is within 3 cm of a place."""
        found = messages.pose2_from_message(self.poses[-1].pose.pose) if self.poses else Pose2()
        return math.hypot(found.x - place.x, found.y - place.y) < 0.03

    def wait_at(self, place: Pose2, what: str) -> None:
        """Send poses at a place until the fused pose is there."""

        def stand() -> bool:
            self.robot.at(next(self.stamps_s), place, self.transforms)
            self._observer.listen(0.1)
            return self.is_at(place)

        self._observer.wait(stand, what=what)


def test_a_robot_that_stands_still_gets_its_corrected_pose(
    processes: Processes, observer: Observer, makers: Makers
):
    frames = TransformInput(observer.node)
    followed, place = Followed(processes, observer, makers, "b"), Pose2(2.0, 1.5, 0.3)
    followed.wait_at(place, "the fused pose")
    # As a SLAM whose robot stands still, b sends no pose; the odometry goes on.
    silent = followed.robot.poses.pop("b")

    def stand(seconds: float) -> Pose2:
        """Return where the transforms have the robot after a time."""
        for _ in range(round(10.0 * seconds)):
            stamp_s = next(followed.stamps_s)
            followed.robot.at(stamp_s, place, followed.transforms)
            observer.listen(0.1)
        to_odom = frames.lookup("fused_map", "odom", frames.heard_s("fused_map", "odom") or 0.0)
        assert stamp_s - (frames.heard_s("fused_map", "odom") or 0.0) < 1.0
        return to_odom.compose(followed.robot.drift.compose(place))

    assert_near(stand(11.0), place, 0.03, 0.01)  # longer than transforms are kept
    # A closed loop moves the map of b, and its pose stays.
    shift, grid = Pose2(0.2, 0.0, 0.0), three()["b"]
    makers.send(replace(grid, origin=shift.compose(grid.origin)))
    frame = followed.transforms["b"]
    wanted = frame.compose(shift.inverse()).compose(frame.inverse()).compose(place)
    observer.wait(lambda: followed.is_at(wanted), what="the corrected pose")
    assert_near(stand(3.0), wanted, 0.03, 0.01)
    observer.node.destroy_publisher(silent)


def test_a_silent_input_gives_no_pose_once_another_has_moved_on(
    processes: Processes, observer: Observer, makers: Makers
):
    followed, second = Followed(processes, observer, makers, "ab"), Pose2(4.0, 1.5, 0.3)
    followed.wait_at(Pose2(2.0, 1.5, 0.3), "the fused pose")
    # As of slam_toolbox, which other nodes had the name of before.
    observer.node.destroy_publisher(followed.robot.poses["b"])
    other = observer.publisher(Odometry, "b/pose")
    words = "'/b/pose' carries nav_msgs/msg/Odometry, which is not read; wanted geometry_msgs"
    observer.wait_status(FUSION, words)
    observer.node.destroy_publisher(other)
    followed.robot.poses["b"] = observer.publisher(PoseWithCovarianceStamped, "b/pose")
    silent = followed.robot.poses.pop("a")
    observer.listen(2.5)
    followed.wait_at(second, "the pose by b")
    makers.send(unlike(three()["b"]))
    observer.wait_status(FUSION, "2 of 3 inputs vote; not: b")
    observer.listen(1.0)
    last = messages.pose2_from_message(followed.poses[-1].pose.pose)
    assert_near(last, second, 0.03, 0.01)
    observer.node.destroy_publisher(silent)


@pytest.mark.parametrize(("frame", "count"), [("odom", 1), ("fused_map", 0)])
def test_poses_ahead_of_the_odometry_are_named_once_while_scans_have_theirs(
    processes: Processes, observer: Observer, makers: Makers, frame: str, count: int
):
    """Not at all if the odometry has the frame of the fused map, which gets no transform."""
    robot = Followed(processes, observer, makers, "abc", odom_frame=frame).robot
    place = Pose2(2.0, 1.5, 0.3)
    topic, scan = observer.publisher(LaserScan, "scan"), LaserScan(range_max=8.0, ranges=[1.0])
    scan.header.frame_id = "base_link"
    observer.wait(topic.get_subscription_count, what="the fusion")
    for step in range(10):
        for name, publisher in robot.poses.items():
            ahead = messages.to_stamp(210.0)
            publisher.publish(messages.pose_to_message(place, f"{name}_map", ahead))
        observer.listen(0.1)
        scan.header.stamp = stamp = messages.to_stamp(200.0 + 0.1 * step)
        robot.odometry.publish(messages.odometry_to_message(place, "odom", "base_link", stamp))
        topic.publish(scan)
        observer.listen(0.1)
    text = processes.running[-1].text()
    words = f"no odometry for fused_map -> {frame}"
    assert text.count(words) == count, text
    observer.wait_status(FUSION, words if count else "")
    assert observer.set_parameter("fusion", "publish_tf", False).successful
    observer.wait(lambda: words not in observer.statuses()[FUSION].message, what="the end of it")
