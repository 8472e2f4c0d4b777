"""A robot's bad day: producers die, scans stop, time jumps back; the fused frame never moves."""

from __future__ import annotations

import dataclasses
import functools
import signal
from collections.abc import Callable, Mapping
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import LaserScan

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid as Grid
from slamfusion.io import LogScan
from slamfusion.ros import messages, qos
from tests.fusion.live.maps import (
    assert_same_lattice,
    mirrored,
    moved_frame,
    noise,
    share_standing,
    trio,
)
from tests.ros.drives import scans
from tests.ros.fused import Makers, start_fusion
from tests.ros.live import Observer, Process, Processes, values

pytestmark = pytest.mark.ros

PRODUCERS = {"tinyslam": {}, "gmapping": {"gmapping__particles": 6}, "graph": {}}
FUSION = "fusion: fusion"
WARN = DiagnosticStatus.WARN
PERIOD_S = 0.12
SILENT = "lost: its process gave no sign of life for 1 s"


class Robot:
    """Drives to and fro, and sends scans and odometry while it listens."""

    def __init__(self, observer: Observer) -> None:
        self.observer = observer
        self.scans = observer.publisher(LaserScan, "scan")
        self.odometry = observer.publisher(Odometry, "odom")
        there = scans(80)
        self.way = [*there, *there[-2:0:-1]]
        self.count = 0
        self.has_odometry = True

    def next(self) -> LogScan:
        """Return the next scan of the way, a tenth of a second after the last."""
        item = self.way[self.count % len(self.way)]
        self.count += 1
        scan = dataclasses.replace(item.scan, stamp_s=100.0 + 0.1 * self.count)
        return dataclasses.replace(item, scan=scan)

    def drive_until(self, is_done: Callable[[], bool], what: str, most: int = 1000) -> None:
        """Drive until something is so."""
        for _ in range(most):
            item = self.next()
            message = messages.scan_to_message(item.scan, "base_link")
            assert item.odometry is not None
            stamp = message.header.stamp
            if self.has_odometry:
                self.odometry.publish(
                    messages.odometry_to_message(item.odometry, "odom", "base_link", stamp)
                )
            self.scans.publish(message)
            self.observer.listen(PERIOD_S)
            if is_done():
                return
        said = {name: status.message for name, status in self.observer.statuses().items()}
        message_text = f"drove {most} scans for {what}; it did not come: {said}"
        raise AssertionError(message_text)


def is_said(statuses: Mapping[str, Any], *words: str) -> Callable[[], bool]:
    """Return whether the fusion says all the words, to be asked again and again."""
    return lambda: FUSION in statuses and all(w in statuses[FUSION].message for w in words)


def miss_the_killed_and_the_frozen(observer: Observer, killed: Process, frozen: Process) -> None:
    """Kill one and freeze another, of which no news of the others tells and DDS after 20 s.

    The one that wakes up votes again by its last map.
    """
    observer.wait_status(FUSION, "all 3 inputs vote")
    killed.kill()
    frozen.signal(signal.SIGSTOP)
    for process in (killed, frozen):
        observer.wait_status(f"fusion: input {process.name}", SILENT, timeout_s=10.0)
    observer.wait_status(FUSION, "1 of 3 inputs votes", "it goes on alone")
    frozen.signal(signal.SIGCONT)
    observer.wait_status(FUSION, f"2 of 3 inputs vote; not: {killed.name}")


# A minute of processor time. A node is killed in tests/ros/test_live_page.py, too, one is silent in
# tests/ros/test_input_health.py, and the rest is in tests/ros/test_producer_node.py.
@pytest.mark.full
def test_the_fused_map_goes_on_through_a_bad_day(processes: Processes, observer: Observer):
    heard = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    statuses = observer.statuses()

    says = functools.partial(is_said, statuses)

    def fused() -> Grid:
        return messages.grid_from_message(heard[-1], "fused")

    def is_unmoved() -> bool:
        assert_same_lattice(first, fused())
        return share_standing(first, fused()) > 0.9

    def start(kind: str) -> None:
        running[kind] = processes.node(kind, map_update_interval_s=0.6, **PRODUCERS[kind])

    running = {}
    processes.node("fusion", live__stale_after_s=4.0, lost_after_s=1.0, live__search_pause_s=0.5)
    for kind in PRODUCERS:
        start(kind)
    robot = Robot(observer)
    observer.wait(lambda: robot.scans.get_subscription_count() == 4, 60.0, "all four nodes")
    robot.drive_until(says("all 3 inputs vote"), "the first fused map")
    robot.drive_until(lambda: robot.count >= 80, "a fair map")
    first = fused()

    # One is killed and comes back, in the middle of the drive, with an empty map.
    running["tinyslam"].kill()
    robot.drive_until(says("2 of 3 inputs vote", "tinyslam"), "tinyslam is missed")
    count = len(heard)
    robot.drive_until(lambda count=count: len(heard) > count + 1, "maps without it")
    assert is_unmoved()
    start("tinyslam")
    robot.drive_until(says("all 3 inputs vote"), "tinyslam is taken back")
    assert is_unmoved()

    # One freezes, and goes on with what it was about.
    running["gmapping"].signal(signal.SIGSTOP)
    robot.drive_until(says("2 of 3 inputs vote", "gmapping"), "gmapping is missed")
    assert SILENT in statuses["fusion: input gmapping"].message
    count = len(heard)
    robot.drive_until(lambda: len(heard) > count + 1, "maps without it")
    running["gmapping"].signal(signal.SIGCONT)
    robot.drive_until(says("all 3 inputs vote"), "gmapping is taken back")
    assert is_unmoved()

    # Nobody sends odometry: every producer says so, and maps by scans alone.
    robot.has_odometry = False
    robot.drive_until(
        lambda: all(
            "no odometry for the scans, which are matched without it"
            in statuses[f"{kind}: slam"].message
            for kind in PRODUCERS
        ),
        "the odometry is missed",
    )
    count = len(heard)
    robot.drive_until(lambda: len(heard) > count + 1, "maps without odometry")
    robot.drive_until(says("all 3 inputs vote"), "all without odometry")
    robot.has_odometry = True
    assert is_unmoved()

    # Nobody sends scans: no map is any staler than the others, and all stay but the dead.
    observer.listen(3.0)
    miss_the_killed_and_the_frozen(observer, running["graph"], running["tinyslam"])
    start("graph")
    # Time jumps back to the beginning: every producer begins a new map.
    robot.count = 0
    observer.listen(1.0)
    count = len(heard)
    robot.drive_until(lambda: robot.count > 60 and len(heard) > count, "maps after the jump")
    robot.drive_until(says("all 3 inputs vote"), "all after the jump")
    # Producers that compete for a core are behind the robot, and have new maps to draw.
    robot.drive_until(is_unmoved, "the walls of before the jump")
    for process in processes.running:
        assert "Traceback" not in process.text(), process.name


class Tellers:
    """The inputs of a fusion tell where one robot is, a quarter of a metre further each time."""

    def __init__(self, observer: Observer, names: str) -> None:
        self.observer = observer
        self.count = 0
        self.topics = {
            name: observer.publisher(PoseStamped, f"{name}/pose", qos.SENSOR) for name in names
        }
        for topic in self.topics.values():
            observer.wait(lambda topic=topic: topic.get_subscription_count(), what="a reader")

    def tell_until(self, is_done: Callable[[], bool], **aside_m: float) -> None:
        """Tell poses, those of some inputs aside of the way, until something is so."""
        statuses = self.observer.statuses()
        for _ in range(400):
            self.count += 1
            stamp = messages.to_stamp(200.0 + 0.25 * self.count)
            for name, topic in self.topics.items():
                figures = values(statuses[f"fusion: input {name}"])
                frame = Pose2(*(float(figures[key]) for key in ("x [m]", "y [m]", "yaw [rad]")))
                there = Pose2(0.25 * self.count, aside_m.get(name, 0.0), 0.0)
                here = frame.inverse().compose(there)
                topic.publish(messages.pose_to_message(here, f"{name}_map", stamp))
            self.observer.listen(0.03)
            if is_done():
                return
        text = f"it never came: {[item.message for item in statuses.values()]}"
        raise AssertionError(text)


def test_what_an_input_says_wrong_takes_its_vote_and_nothing_else(
    processes: Processes, observer: Observer
):
    heard = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    makers, statuses = Makers(observer), observer.statuses()
    fusion = start_fusion(processes, live__confirm_s=1.0)
    good = trio()

    def fused() -> Grid:
        return messages.grid_from_message(heard[-1], "fused")

    def send_wrong(grid: Grid, *words: str) -> None:
        """Send a map that must be refused with these words while the others go on."""
        makers.send(grid.with_name("b"))
        assert observer.wait_status("fusion: input b", *words).level == WARN
        observer.wait_status(FUSION, "2 of 3 inputs vote; not: b")

    # Mirrored from the start; the other two fix the frame.
    makers.send(good["a"])
    makers.send(good["c"])
    observer.wait_status(FUSION, "2 of 3 inputs vote; not: b", timeout_s=60.0)
    send_wrong(mirrored(good["b"]), "mirrored or transposed")
    makers.send(good["b"])
    observer.wait_status(FUSION, "all 3 inputs vote")
    first = fused()

    # Its frame jumps by 14 km, and no further message comes: a robot stands after a loop closure.
    send_wrong(moved_frame(good["b"], Pose2(1e4, 1e4, 0.0)), "jumped by", "must confirm it")
    observer.wait_status(FUSION, "all 3 inputs vote")

    # What no place has, and what says nothing.
    send_wrong(dataclasses.replace(good["b"], resolution=1e-9), "resolution must lie in")
    send_wrong(moved_frame(good["b"], Pose2(1e12, 0.0, 0.0)), "x of the origin must lie")
    send_wrong(dataclasses.replace(good["b"], resolution=5.0), "100 times coarser")
    send_wrong(noise(1000), "is it noise?")
    makers.send(good["b"])
    observer.wait_status(FUSION, "all 3 inputs vote")
    observer.wait(lambda: fused().cells.shape == first.cells.shape, what="the map of the three")
    assert_same_lattice(first, fused())
    assert share_standing(first, fused()) > 0.97

    # Its poses leave those of the others, and come back.
    tellers = Tellers(observer, "abc")
    tellers.tell_until(lambda: tellers.count > 40)
    assert statuses[FUSION].message == "all 3 inputs vote"
    contradicts = "its poses contradict those of a, c: 7.0 m"
    tellers.tell_until(lambda: contradicts in statuses["fusion: input b"].message, b=7.0)
    assert statuses["fusion: input b"].level == WARN
    observer.wait_status(FUSION, "2 of 3 inputs vote; not: b")
    tellers.tell_until(lambda: statuses[FUSION].message == "all 3 inputs vote")
    assert_same_lattice(first, fused())
    for word in ("Traceback", "MemoryError"):
        assert word not in fusion.text()
