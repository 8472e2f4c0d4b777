"""A robot's bad day: producers die, scans stop, time jumps back; the fused frame never moves."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import LaserScan

from slamfusion.grid import OccupancyGrid as Grid
from slamfusion.io import LogScan
from slamfusion.ros import messages, qos
from tests.fusion.live_maps import assert_same_lattice, share_standing
from tests.ros.drives import scans
from tests.ros.live import Observer, Processes

pytestmark = pytest.mark.ros

PRODUCERS = {"tinyslam": {}, "gmapping": {"gmapping__particles": 6}, "graph": {}}
FUSION = "fusion: fusion"
PERIOD_S = 0.06


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


def test_the_fused_map_goes_on_through_a_bad_day(processes: Processes, observer: Observer):
    heard = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    statuses = observer.statuses()

    def says(*words: str) -> Callable[[], bool]:
        return lambda: FUSION in statuses and all(w in statuses[FUSION].message for w in words)

    def fused() -> Grid:
        return messages.grid_from_message(heard[-1], "fused")

    def assert_unmoved() -> None:
        assert_same_lattice(first, fused())
        assert share_standing(first, fused()) > 0.9

    def start(kind: str) -> None:
        running[kind] = processes.node(kind, map_update_interval_s=0.4, **PRODUCERS[kind])

    running = {}
    processes.node("fusion", live__stale_after_s=4.0, lost_after_s=1.0, live__search_pause_s=0.5)
    for kind in PRODUCERS:
        start(kind)
    robot = Robot(observer)
    observer.wait(lambda: robot.scans.get_subscription_count() == 3, 60.0, "three producers")
    robot.drive_until(says("all 3 inputs vote"), "the first fused map")
    robot.drive_until(lambda: robot.count >= 100, "a fair map")
    first = fused()

    # Each is killed and comes back, in the middle of the drive, with an empty map.
    for kind in ("tinyslam", "graph"):
        running[kind].kill()
        robot.drive_until(says("2 of 3 inputs vote", kind), f"{kind} is missed")
        count = len(heard)
        robot.drive_until(lambda count=count: len(heard) > count + 1, "maps without it")
        assert_unmoved()
        start(kind)
        robot.drive_until(says("all 3 inputs vote"), f"{kind} is taken back")
        assert_unmoved()

    # One freezes, and goes on with what it was about.
    running["gmapping"].signal(signal.SIGSTOP)
    robot.drive_until(says("2 of 3 inputs vote", "gmapping"), "gmapping is missed")
    assert "no map for" in statuses["fusion: input gmapping"].message
    count = len(heard)
    robot.drive_until(lambda: len(heard) > count + 1, "maps without it")
    running["gmapping"].signal(signal.SIGCONT)
    robot.drive_until(says("all 3 inputs vote"), "gmapping is taken back")
    assert_unmoved()

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
    assert_unmoved()

    # Nobody sends scans: no map is any staler than the others, and all stay.
    observer.listen(6.0)
    observer.wait_status(FUSION, "all 3 inputs vote")
    # Time jumps back to the beginning: every producer begins a new map.
    robot.count = 0
    observer.listen(1.0)
    count = len(heard)
    robot.drive_until(lambda: robot.count > 60 and len(heard) > count, "maps after the jump")
    robot.drive_until(says("all 3 inputs vote"), "all after the jump")
    assert_unmoved()
    for process in processes.running:
        assert "Traceback" not in process.text(), process.name
