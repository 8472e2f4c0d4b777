"""Producers as processes over DDS, against the same scans fed without ROS."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import MapMetaData, OccupancyGrid, Odometry, Path
from sensor_msgs.msg import LaserScan

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid as Grid
from slamfusion.io import LogScan, open_log
from slamfusion.io.carmen import write_carmen
from slamfusion.ros import messages, qos
from slamfusion.ros.frames import TransformStore
from tests.ros import tf2
from tests.ros.drives import FIRST_S, as_sent, offline, offline_log, scans, write_log
from tests.ros.live import Observer, Processes, values
from tests.test_deskew import sweeps

pytestmark = pytest.mark.ros

COUNT = 40
LAST_S = FIRST_S + 0.1 * (COUNT - 1)
SETTINGS = {"tinyslam": {}, "gmapping": {"particles": 3}, "graph": {}}
MOUNT = Pose2(0.21, -0.04, 0.3)


def wait_for_last_map(observer: Observer, maps: list[Any], stamp_s: float = LAST_S) -> Any:
    """Listen until the map of a scan has come, and return it."""
    return observer.wait(
        lambda: next((m for m in maps if abs(messages.stamp_s(m) - stamp_s) < 1e-6), None),
        what=f"the map of {stamp_s} s",
    )


def wait_for_pose(observer: Observer, poses: list[Any], stamp_s: float) -> None:
    """Listen until the pose at a scan has come."""
    observer.wait(
        lambda: poses and abs(messages.stamp_s(poses[-1]) - stamp_s) < 1e-6,
        what=f"the pose at {stamp_s} s",
    )


def wait_for_figures(observer: Observer, name: str, figure: str, count: int) -> dict[str, str]:
    """Listen until a figure of a producer has come to a count; return all figures."""

    def figures() -> Any:
        status = observer.statuses().get(f"{name}: slam")
        found = {} if status is None else values(status)
        return found if found.get(figure) == str(count) else None

    return observer.wait(figures, what=f"{count} {figure}")


def assert_same_map(message: Any, wanted: Grid) -> None:
    """Cell by cell."""
    found = messages.grid_from_message(message, "found")
    assert (found.width, found.height) == (wanted.width, wanted.height)
    assert found.resolution == wanted.resolution
    assert (found.origin.x, found.origin.y) == (wanted.origin.x, wanted.origin.y)
    assert np.array_equal(found.cells, wanted.cells)
    assert (found.cells >= 65).sum() > 100


class Robot:
    """The test itself sends scans and odometry."""

    def __init__(self, observer: Observer, *, odometry: bool = True) -> None:
        self.observer = observer
        self.scans = observer.publisher(LaserScan, "scan")
        self.odometry = observer.publisher(Odometry, "odom") if odometry else None

    def wait_for(self, listeners: int = 1) -> None:
        """Wait until producers listen."""

        def are_there() -> bool:
            topics = [self.scans] if self.odometry is None else [self.scans, self.odometry]
            return all(item.get_subscription_count() >= listeners for item in topics)

        self.observer.wait(are_there, 40.0, "a producer that listens")
        self.observer.listen(0.5)

    def send(self, item: LogScan) -> None:
        """Send a scan and its odometry."""
        if self.odometry is not None and item.odometry is not None:
            self.tell(item.odometry, item.scan.stamp_s)
        self.send_scan(item)

    def send_scan(self, item: LogScan) -> None:
        """Send a scan alone."""
        self.scans.publish(messages.scan_to_message(item.scan, "base_link"))

    def tell(self, pose: Pose2, stamp_s: float) -> None:
        """Send odometry alone."""
        stamp = messages.to_stamp(stamp_s)
        self.odometry.publish(messages.odometry_to_message(pose, "odom", "base_link", stamp))

    def drive(self, items: list[LogScan], poses: list[Any]) -> None:
        """Send scans one by one, each when the pose at the last one has come."""
        for item in items:
            self.send(item)
            wait_for_pose(self.observer, poses, item.scan.stamp_s)


def started(
    processes: Processes, observer: Observer, **parameters: Any
) -> tuple[Robot, list[PoseStamped]]:
    """Start a producer that listens to a robot; return that, and the poses that come."""
    poses = observer.collect(PoseStamped, "tinyslam/pose")
    robot = Robot(observer)
    processes.node("tinyslam", **parameters)
    robot.wait_for()
    return robot, poses


@pytest.mark.parametrize("kind", ["gmapping", "graph"])
def test_in_lockstep_the_map_is_that_of_the_offline_run(
    kind: str, processes: Processes, observer: Observer, tmp_path: FilePath
):
    log = write_log(tmp_path, COUNT, mount=MOUNT)
    maps = observer.collect(OccupancyGrid, f"{kind}/map", qos.MAP)
    metadata = observer.collect(MapMetaData, f"{kind}/map_metadata", qos.MAP)
    paths = observer.collect(Path, f"{kind}/path", qos.MAP)
    poses = observer.collect(PoseStamped, f"{kind}/pose")
    settings = {f"{kind}__{name}": value for name, value in SETTINGS[kind].items()}
    producer = processes.node(kind, map_update_interval_s=0.2, **settings)
    # Poses are not kept for who comes late. The first node of a fresh installation compiles Python.
    observer.wait(
        lambda: observer.node.count_publishers(f"{kind}/pose"), 120.0, what="the producer"
    )
    observer.listen(0.5)
    player = processes.node("player", file=str(log), lockstep=True, wait_for=[kind])
    message = wait_for_last_map(observer, maps)
    assert player.wait() == 0
    assert f"end of {log}: {COUNT} scans sent" in player.text()

    wanted = offline_log(kind, log, **SETTINGS[kind])
    assert_same_map(message, wanted)
    assert message.header.frame_id == f"{kind}_map"
    observer.wait(lambda: metadata and metadata[-1] == message.info, what="the map's metadata")
    # A scan that was not acknowledged soon is sent again, and so is its pose.
    heard = observer.wait(
        lambda: {messages.stamp_s(pose) for pose in poses} if len(poses) >= COUNT else None,
        what="a pose for every scan",
    )
    assert sorted(heard) == pytest.approx([FIRST_S + 0.1 * index for index in range(COUNT)])
    assert {pose.header.frame_id for pose in poses} == {f"{kind}_map"}
    path = observer.wait(lambda: [p for p in paths if len(p.poses) == COUNT], what="the path")[0]
    end, told = path.poses[-1].pose.position, poses[-1].pose.position
    assert math.hypot(end.x - told.x, end.y - told.y) < 0.05
    assert path.header.frame_id == f"{kind}_map"

    assert producer.interrupt() == 0
    assert "Traceback" not in producer.text()


def test_in_a_namespace_under_other_names(
    processes: Processes, observer: Observer, tmp_path: FilePath
):
    log = write_log(tmp_path, COUNT)
    maps = observer.collect(OccupancyGrid, "/robot1/tiny2/map", qos.MAP)
    heard = observer.collect(LaserScan, "/robot1/front/scan", qos.SENSOR)
    names = ("-r", "__ns:=/robot1", "-r", "scan:=front/scan", "-r", "odom:=wheels")
    processes.node("player", *names, file=str(log), lockstep=True, wait_for=["tiny2"])
    # Scans are not kept for who comes late; the player waits for the producer meanwhile.
    observer.wait(lambda: observer.node.count_publishers("/robot1/front/scan"), what="the player")
    observer.listen(0.5)
    processes.node("tinyslam", *names, "-r", "__node:=tiny2", map_update_interval_s=0.2)
    message = wait_for_last_map(observer, maps)
    assert message.header.frame_id == "robot1/tiny2_map"
    assert_same_map(message, offline_log("tinyslam", log))
    assert {scan.header.frame_id for scan in heard} == {"laser"}
    assert observer.wait_status("robot1/tiny2: slam")


WITH_TF2 = pytest.param(True, id="tf2_msgs")
WITHOUT_TF2 = pytest.param(False, id="without tf2_msgs")


@pytest.mark.parametrize("has_tf2", [WITH_TF2, WITHOUT_TF2])
def test_odometry_and_laser_by_transforms(
    has_tf2: bool, processes: Processes, observer: Observer, tmp_path: FilePath
):
    if has_tf2:
        tf2.skip_without()
    # A folder without tf2_msgs in front of everything.
    env = {} if has_tf2 else {"PYTHONPATH": ""}
    log = write_log(tmp_path, COUNT, mount=MOUNT)
    maps = observer.collect(OccupancyGrid, "tinyslam/map", qos.MAP)
    options = {"odometry_source": "tf", "map_update_interval_s": 0.2}
    producer = processes.node("tinyslam", env=env, **options)
    player = processes.node(
        "player", env=env, file=str(log), lockstep=True, wait_for=["tinyslam"], odometry="tf"
    )
    message = wait_for_last_map(observer, maps)
    assert_same_map(message, offline_log("tinyslam", log))
    topics = {name for name, _ in observer.node.get_topic_names_and_types()}
    assert ("/tf" in topics, "/transforms" in topics) == (has_tf2, not has_tf2)
    for process in (producer, player):
        said = process.text().count("tf2_msgs cannot be imported, so there is no /tf")
        assert said == (0 if has_tf2 else 1)


def test_a_laser_offset_by_parameters_and_simulated_time(
    processes: Processes, observer: Observer, tmp_path: FilePath
):
    log = write_log(tmp_path, COUNT, mount=Pose2(0.25, -0.5, 0.0))
    maps = observer.collect(OccupancyGrid, "tinyslam/map", qos.MAP)
    told = observer.collect(DiagnosticArray, "/diagnostics")
    processes.node(
        "tinyslam",
        laser_source="parameter",
        laser_x=0.25,
        laser_y=-0.5,
        use_sim_time=True,
        map_update_interval_s=0.2,
    )
    processes.node("player", file=str(log), lockstep=True, wait_for=["tinyslam"])
    # The log's own offset is rounded to its digits.
    exact = [
        replace(item, scan=replace(item.scan, mount=Pose2(0.25, -0.5, 0.0)))
        for item in open_log(log)
    ]
    assert_same_map(wait_for_last_map(observer, maps), offline("tinyslam", as_sent(exact)))

    def is_simulated() -> Any:
        return [
            item
            for item in told
            if item.status[0].name == "tinyslam: slam" and abs(messages.stamp_s(item) - LAST_S) < 1
        ]

    (_, *_) = observer.wait(is_simulated, what="diagnostics in simulated time")


def test_too_many_scans_are_dropped_oldest_first_and_counted(
    processes: Processes, observer: Observer
):
    poses = observer.collect(PoseStamped, "gmapping/pose")
    robot = Robot(observer)
    # Many particles keep the worker busy.
    processes.node("gmapping", scan_queue=3, gmapping__particles=300)
    robot.wait_for()
    sent = scans(COUNT)
    for item in sent:
        robot.send(item)
    wait_for_pose(observer, poses, LAST_S)
    found = wait_for_figures(observer, "gmapping", "scans received", COUNT)
    dropped, fed = int(found["scans dropped"]), int(found["scans fed"])
    assert dropped > 0
    assert dropped + fed == COUNT
    assert fed == len(poses)
    status = observer.wait_status("gmapping: slam", "too slow for the scans: the oldest that waits")
    assert "take a faster device, fewer scans or a lower --rate" in status.message


def moved_by(item: LogScan, offset_s: float) -> LogScan:
    """A scan with another stamp."""
    return replace(item, scan=replace(item.scan, stamp_s=item.scan.stamp_s + offset_s))


def test_time_that_jumps_back_begins_a_new_map(processes: Processes, observer: Observer):
    maps = observer.collect(OccupancyGrid, "tinyslam/map", qos.MAP)
    robot, poses = started(processes, observer, map_update_interval_s=0.2)
    robot.drive(scans(20), poses)
    late = [moved_by(item, -50.0) for item in scans(COUNT)[15:]]
    # The third confirms the first two, and none is lost.
    for item in late[:2]:
        robot.send(item)
    robot.drive(late[2:3], poses)
    # At once: it is said for ten seconds, in which a busy machine may not come far.
    status = observer.wait_status("tinyslam: slam", "scans jumped back by 50.400 s", "new map")
    # On such a one scans may be missed by now.
    assert status.level in {DiagnosticStatus.WARN, DiagnosticStatus.STALE}
    assert values(status)["maps restarted"] == "1"
    robot.drive(late[3:], poses)
    message = wait_for_last_map(observer, maps, late[-1].scan.stamp_s)
    assert_same_map(message, offline("tinyslam", as_sent(late)))

    # A gap in time is no reason to begin a new map, but worth a word.
    for offset_s in (20.0, 20.1):
        robot.send(moved_by(late[-1], offset_s))
    robot.drive([moved_by(late[-1], 20.2)], poses)
    status = observer.wait_status("tinyslam: slam", "scans jumped forward by 20.000 s")
    assert values(status)["maps restarted"] == "1"


def test_one_stray_stamp_takes_no_map_away(domain: int, processes: Processes, observer: Observer):
    maps = observer.collect(OccupancyGrid, "tinyslam/map", qos.MAP)
    robot, poses = started(processes, observer, map_update_interval_s=0.2)
    driven = scans(COUNT)
    # The last two are a little late, and of the stamp before.
    strays_s = {20: -1.8, 25: 3600.0, 30: -90.0, 32: -0.25, 33: -0.1}
    for index, item in enumerate(driven):
        if index in strays_s:
            robot.send_scan(moved_by(item, strays_s[index]))
        if index == 35:
            # Odometry too.
            robot.tell(Pose2(), 5000.0)
        robot.drive([item], poses)
    # The map is that of the others, cell by cell.
    assert_same_map(wait_for_last_map(observer, maps), offline("tinyslam", as_sent(driven)))
    status = observer.wait_status(
        "tinyslam: slam",
        "3 scans far from the others (the last has 13.000 s, 89.900 s older than those around it)",
        "2 scans not newer than the one before, 1 transform of odometry or others far from the",
    )
    assert status.message.count("check the clocks") == 1
    with Observer(domain, "stranger") as other:
        Robot(other)
        for topic in ("scan", "odom"):
            words = f"2 nodes publish '/{topic}', '/observer' and '/stranger', and their messages"
            observer.wait_status("tinyslam: slam", words)
    found = values(status)
    assert found["maps restarted"] == "0"
    assert found["left out: a stamp far from those before and after it"] == "3"
    assert found["odometry with a stray stamp"] == "1"
    assert found["scans fed"] == str(COUNT)
    assert found["scans without odometry"] == "0"


def test_scans_whose_time_jumps_without_their_odometry_are_left_out_and_named(
    processes: Processes, observer: Observer
):
    robot, poses = started(processes, observer)
    driven = scans(COUNT)
    robot.drive(driven[:20], poses)

    def named() -> Any:
        # The clock of the laser is set back; the wheels go on in their time.
        item = moved_by(next(rest), -50.0)
        robot.send_scan(item)
        robot.tell(item.odometry, item.scan.stamp_s + 50.0)
        observer.listen(0.1)
        status = observer.statuses().get("tinyslam: slam")
        return status if status and "the odometry did not" in status.message else None

    rest = iter(scans(400)[20:])
    status = observer.wait(named, what="the word of the odometry")
    assert status.level == DiagnosticStatus.ERROR
    assert "they are left out, and the map stays; check the clocks of both" in status.message
    assert values(status)["maps restarted"] == "0"
    assert values(status)["scans fed"] == "20"


def test_odometry_of_other_stamps_is_waited_for_and_interpolated(
    processes: Processes, observer: Observer
):
    maps = observer.collect(OccupancyGrid, "tinyslam/map", qos.MAP)
    robot, poses = started(processes, observer, map_update_interval_s=0.2, odometry_wait_s=5.0)
    driven = scans(20)
    store = TransformStore()

    def tell(pose: Pose2, time_s: float) -> None:
        robot.tell(pose, time_s)
        stamp = messages.to_stamp(time_s)
        store.add([messages.transform_to_message(pose, "odom", "base", stamp)])

    tell(driven[0].odometry, driven[0].scan.stamp_s - 0.05)
    moved = []
    for item, following in itertools.pairwise(driven):
        stamp_s = item.scan.stamp_s
        robot.send_scan(item)
        observer.listen(0.05)
        assert not poses or messages.stamp_s(poses[-1]) < stamp_s  # it waits
        tell(following.odometry, stamp_s + 0.05)
        wait_for_pose(observer, poses, stamp_s)
        moved.append(replace(item, odometry=store.lookup("odom", "base", stamp_s)))
    message = wait_for_last_map(observer, maps, moved[-1].scan.stamp_s)
    assert_same_map(message, offline("tinyslam", as_sent(moved)))


def test_silence_is_named_and_ends(processes: Processes, observer: Observer):
    poses = observer.collect(PoseStamped, "tinyslam/pose")
    robot = Robot(observer)
    processes.node("tinyslam", scans_stale_s=0.5, odometry_wait_s=2.0)
    name = "tinyslam: slam"
    status = observer.wait_status(name, "no scans on '/scan' yet; 1 node could publish it")
    assert status.level == DiagnosticStatus.STALE
    robot.wait_for()
    sent = scans(COUNT)
    robot.drive(sent[:10], poses)
    status = observer.wait_status(name, "no scans on '/scan' any more")
    assert status.level == DiagnosticStatus.STALE

    # Odometry stops: the scans go on without it, and say so.
    without = [LogScan(item.scan, None, item.line) for item in sent[10:20]]
    robot.drive(without, poses)
    robot.observer.statuses().clear()
    status = observer.wait_status(name, "no odometry for the scans, which are matched without it")
    assert "check the topic '/odom'" in status.message
    assert status.level in {DiagnosticStatus.WARN, DiagnosticStatus.STALE}
    assert values(status)["scans without odometry"] == "10"

    # Both come back; scans wait for odometry again once it is heard.
    robot.tell(sent[20].odometry, sent[20].scan.stamp_s - 0.05)
    observer.listen(0.5)
    for item in sent[20:]:
        robot.drive([item], poses)
        observer.listen(0.05)
    observer.statuses().clear()
    status = observer.wait(lambda: observer.statuses().get(name), what="the diagnostics")
    assert "odometry" not in status.message
    assert values(status)["scans fed"] == str(COUNT)
    assert values(status)["scans without odometry"] == "10"


def test_scans_of_a_turning_lidar_are_deskewed_and_counted(
    processes: Processes, observer: Observer, tmp_path: FilePath
):
    log = tmp_path / "turning.log"
    write_carmen(log, sweeps(COUNT))
    node = processes.node("tinyslam")
    observer.wait(lambda: observer.node.count_publishers("tinyslam/pose"), what="the producer")
    player = processes.node("player", file=str(log), lockstep=True, wait_for=["tinyslam"])
    assert player.wait() == 0
    figures = wait_for_figures(observer, "tinyslam", "scans fed", COUNT)
    # Nothing says how the robot moves after the last scan.
    assert int(figures["scans deskewed"]) >= COUNT - 5
    assert int(figures["scans not deskewed"]) <= 1
    assert "not deskewed" not in node.text()
    assert float(figures["sweep [ms]"]) == pytest.approx(199.4, abs=0.5)


def test_scans_before_any_odometry_are_left_out_and_named(processes: Processes, observer: Observer):
    robot = Robot(observer, odometry=False)
    processes.node("tinyslam", odometry_wait_s=1.0, scan_queue=2)
    processes.node("fusion", inputs=["tinyslam/map"], odometry_wait_s=1.0)
    robot.wait_for(listeners=2)
    for item in scans(25):
        robot.send(item)
    for name in ("tinyslam: slam", "fusion: fusion"):
        waits = "scans wait for their odometry or transform: the oldest"
        dropped = observer.wait_status(name, waits)
        assert "send it sooner, or raise scan_queue of a producer" in dropped.message
    status = observer.wait_status("tinyslam: slam", "no odometry for the scans, which are left out")
    assert "set odometry_source to none" in status.message
    found = wait_for_figures(observer, "tinyslam", "left out: laser before odometry", 3)
    assert found["scans dropped"] == "22"


def test_a_transform_that_cannot_be_sent_is_named(processes: Processes, observer: Observer):
    robot = Robot(observer, odometry=False)
    # Nobody sends odometry as transforms; the robot without any tells its place all the same.
    processes.node("tinyslam", odometry_source="tf", publish_tf=True, odometry_wait_s=0.0)
    processes.node("graph", odometry_source="none", publish_tf=True)
    robot.wait_for(listeners=2)
    coming = iter(scans(400))

    def named() -> Any:
        robot.send(next(coming))
        observer.listen(0.1)
        status = observer.statuses().get("tinyslam: slam")
        return status if status and "publish_tf is on and" in status.message else None

    status = observer.wait(named, what="the word of the transform")
    assert status.level == DiagnosticStatus.ERROR
    assert "publish_tf is on and 'tinyslam_map' -> 'odom' cannot be sent; no" in status.message
    assert status.message.count("transforms from 'base_link' to 'odom'") == 2, "why, what to check"
    assert "publish_tf" not in observer.statuses()["graph: slam"].message


def test_a_laser_without_a_transform_is_named(processes: Processes, observer: Observer):
    robot = Robot(observer, odometry=False)
    processes.node("tinyslam", odometry_source="none", odometry_wait_s=0.1)
    robot.wait_for()
    message = messages.scan_to_message(scans(1)[0].scan, "front_laser")
    robot.scans.publish(message)
    words = "scans in 'front_laser' cannot be used", "; send the transform, or set"
    status = observer.wait_status("tinyslam: slam", *words, "laser_source to parameter")
    assert status.level == DiagnosticStatus.ERROR
    # Scans in the robot's own frame need none.
    robot.scans.publish(messages.scan_to_message(scans(2)[1].scan, "base_link"))
    statuses = observer.statuses()
    observer.wait(lambda: statuses["tinyslam: slam"].message == "mapping", what="its end")
    tf2.skip_without()
    from tf2_msgs.msg import TFMessage  # noqa: PLC0415

    tilted = messages.transform_to_message(Pose2(), "base_link", "front_laser", Time())
    tilted.transform.rotation.y = 1.0
    topic = observer.publisher(TFMessage, "/tf_static", qos.TF_STATIC)
    for turn_y, words in ((1.0, "is tilted by 90 degrees"), (0.15, "is tilted by 17 degrees; its")):
        tilted.transform.rotation.y = turn_y
        topic.publish(TFMessage(transforms=[tilted]))
        observer.listen(0.5)
        message.header.stamp.sec += 1
        robot.scans.publish(message)
        status = observer.wait_status("tinyslam: slam", words)
        assert ("; correct the transform, or" in status.message) == (turn_y == 1.0)


def test_what_is_no_scan_is_left_out_and_the_node_goes_on(processes: Processes, observer: Observer):
    robot, poses = started(processes, observer)
    sent = scans(12)
    robot.drive(sent[:4], poses)
    for field, value in (("ranges", []), ("angle_increment", 0.0), ("angle_min", math.nan)):
        message = messages.scan_to_message(sent[4].scan, "base_link")
        setattr(message, field, value)
        robot.scans.publish(message)
    odometry = messages.odometry_to_message(Pose2(), "odom", "base_link", Time(sec=100))
    odometry.pose.pose.position.x = math.nan
    robot.odometry.publish(odometry)
    words = "left out: scan at ", "angle step must be finite", "odometry left out"
    observer.wait_status("tinyslam: slam", *words)
    others = messages.odometry_to_message(Pose2(), "r/odom", "r/base", Time(sec=100))
    robot.odometry.publish(others)
    names = "'r/odom', which is taken for odom_frame, 'odom', and 'r/base', which is taken for base"
    observer.wait_status("tinyslam: slam", f"odometry names {names}")
    robot.drive(sent[4:], poses)
    figures = wait_for_figures(observer, "tinyslam", "scans fed", 12)
    assert figures["left out: angles or ranges that cannot be a scan"] == "3"


def test_the_transform_to_the_odometry_leads_to_the_pose(processes: Processes, observer: Observer):
    tf2.skip_without()
    from tf2_msgs.msg import TFMessage  # noqa: PLC0415

    heard = observer.collect(TFMessage, "/tf", qos.TF)
    robot, poses = started(processes, observer, publish_tf=True)
    sent = scans(20)
    robot.drive(sent, poses)
    observer.wait(lambda: len(heard) >= 20, what="the transforms")
    for item, pose, message in zip(sent, poses, heard, strict=True):
        (transform,) = message.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("tinyslam_map", "odom")
        found = messages.pose2_from_message(transform.transform).compose(item.odometry)
        told = messages.pose2_from_message(pose.pose)
        assert (found.x, found.y) == pytest.approx((told.x, told.y), abs=1e-9)
        assert math.remainder(found.yaw_rad - told.yaw_rad, 2.0 * math.pi) == pytest.approx(0.0)


def test_two_nodes_that_send_the_same_transform_are_named(processes: Processes, observer: Observer):
    tinyslam = observer.collect(PoseStamped, "tinyslam/pose")
    graph = observer.collect(PoseStamped, "graph/pose")
    robot = Robot(observer)
    processes.node("tinyslam", publish_tf=True)
    processes.node("graph", publish_tf=True)
    robot.wait_for(listeners=2)
    statuses = observer.statuses()
    words = "another node sends the transform to 'odom' too (from {!r})"
    rivals = {"tinyslam: slam": "graph_map", "graph: slam": "tinyslam_map"}
    # A rival that sends no more is none, so both have to be named while they send.
    named, coming = set(), iter(scans(400))
    for item in coming:
        robot.drive([item], tinyslam)
        wait_for_pose(observer, graph, item.scan.stamp_s)
        observer.listen(0.05)
        named |= {
            name
            for name, other in rivals.items()
            if name in statuses
            and words.format(other) in statuses[name].message
            and statuses[name].level == DiagnosticStatus.ERROR
        }
        if named == rivals.keys():
            break
    assert named == rivals.keys(), {name: item.message for name, item in statuses.items()}
    # The one that leaves it to the other is no rival any more.
    assert observer.set_parameter("tinyslam", "publish_tf", False).successful

    def has_ended() -> bool:
        robot.drive([next(coming)], tinyslam)
        observer.listen(0.1)
        return "another node sends" not in statuses["tinyslam: slam"].message

    observer.wait(has_ended, 20.0, "the end of the rivals")


def test_parameters_may_change_where_that_makes_sense(processes: Processes, observer: Observer):
    node = processes.node("tinyslam", map_update_interval_s=1000.0)
    maps = observer.collect(OccupancyGrid, "tinyslam/map", qos.MAP)
    poses = observer.collect(PoseStamped, "tinyslam/pose")
    robot = Robot(observer)
    robot.wait_for()
    sent = scans(COUNT)
    robot.drive(sent, poses)
    observer.wait(lambda: maps, what="the first map")
    assert observer.set_parameter("tinyslam", "map_update_interval_s", 0.1).successful
    wait_for_last_map(observer, maps)
    assert 1 <= len(maps) <= 3
    # Who listens late gets map and path.
    late = observer.collect(OccupancyGrid, "tinyslam/map", qos.MAP)
    paths = observer.collect(Path, "tinyslam/path", qos.MAP)
    wait_for_last_map(observer, late)
    observer.wait(lambda: paths and len(paths[-1].poses) == COUNT, what="the path")
    refused = observer.set_parameter("tinyslam", "map_update_interval_s", -1.0)
    assert not refused.successful
    refused = observer.set_parameter("tinyslam", "tinyslam.resolution", 0.1)
    assert not refused.successful
    assert "read-only" in refused.reason
    assert node.is_running
