"""Anybody on a DDS domain may publish: a peer that floods, lies about sizes, and sends rubbish.

A tenth of the messages go out in each run of the suite, all 5000 with ``--full``.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.serialization import serialize_message

from slamfusion.geometry import Pose2
from slamfusion.ros import messages, qos
from tests.fusion.drawings import building
from tests.fusion.live.maps import three, touched
from tests.ros.drives import scans
from tests.ros.fused import Makers, fused_without_ros, share_equal, start_fusion
from tests.ros.live import Observer, Process, Processes
from tests.ros.test_producer_node import Robot

pytestmark = pytest.mark.ros

FUSION = "fusion: fusion"
MESSAGES = 5000
# What a node may grow by while it hears them, MB: buffers of DDS and of the allocator.
GROWTH_MB = 40.0
# CDR begins with four bytes that name the encoding.
ENCODING = 4
NUMBERS = (math.nan, math.inf, -math.inf, 1e308, -1e308, 1e-320, 0.0, -1.0)
WORDS = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 10**9)
BEFORE = 100


def resident_mb(process: Process) -> float:
    """Return the memory that a node holds now, MB."""
    status = Path(f"/proc/{process.process.pid}/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("VmRSS"))
    return float(line.split()[1]) / 1024.0


def mutant(good: bytes, rng: np.random.Generator) -> bytes:
    """Return a serialised message with something else in it: bytes, a number, a size, its end."""
    data = bytearray(good)
    kind = rng.integers(6)
    at = int(rng.integers(ENCODING, len(data)))
    if kind == 0:
        for place in rng.integers(ENCODING, len(data), 8):
            data[place] = int(rng.integers(256))
    elif kind == 1:
        word = ENCODING + (at - ENCODING) // 4 * 4
        data[word : word + 4] = struct.pack("<I", int(rng.choice(WORDS)))
    elif kind == 2:
        place = ENCODING + (at - ENCODING) // 8 * 8
        data[place : place + 8] = struct.pack("<d", float(rng.choice(NUMBERS)))
    elif kind == 3:
        word = ENCODING + (at - ENCODING) // 4 * 4
        data[word : word + 4] = struct.pack("<f", float(np.float32(rng.choice(NUMBERS[:3]))))
    elif kind == 4:
        del data[at:]
    else:
        data += bytes(rng.integers(0, 256, int(rng.integers(1, 4000)), dtype=np.uint8))
    return bytes(data)


def flood(
    observer: Observer,
    goods: list[tuple[Any, Callable[[int], Any]]],
    count: int,
    rng: np.random.Generator,
) -> None:
    """Publish mutants of every kind of message, faster than a robot would."""
    for number in range(count):
        publisher, make = goods[number % len(goods)]
        publisher.publish(mutant(serialize_message(make(number)), rng))
        if number % 10 == 0:
            observer.listen(0.002)


def count_of(request: pytest.FixtureRequest) -> int:
    return MESSAGES if request.config.getoption("--full") else MESSAGES // 10


@pytest.mark.full
def test_a_hostile_peer_moves_no_cell_of_the_fused_map(
    processes: Processes, observer: Observer, request: pytest.FixtureRequest
):
    """It speaks as an input of another place, and on the topics that all inputs share."""
    heard = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    makers = Makers(observer)
    fusion = start_fusion(processes, inputs=["a/map", "b/map", "c/map", "d/map"])
    wanted = fused_without_ros()
    makers.send_all()
    observer.wait_status(FUSION, "3 of 4 inputs vote; not: d", timeout_s=60.0)
    elsewhere = building(9, 9.0, 7.0, three()["a"].resolution).with_name("d")
    goods: list[tuple[Any, Callable[[int], Any]]] = [
        (
            observer.publisher(OccupancyGrid, "d/map", qos.MAP),
            lambda n: messages.grid_to_message(elsewhere, "d_map", messages.to_stamp(float(n))),
        ),
        (
            observer.publisher(PoseStamped, "d/pose"),
            lambda n: messages.pose_to_message(
                Pose2(1.0, 2.0, 0.3), "d_map", messages.to_stamp(float(n))
            ),
        ),
        (
            observer.publisher(Odometry, "odom"),
            lambda n: messages.odometry_to_message(
                Pose2(1.0, 2.0, 0.3), "odom", "base_link", messages.to_stamp(float(n))
            ),
        ),
    ]
    rng = np.random.default_rng(1)
    flood(observer, goods, BEFORE, rng)
    observer.listen(0.5)
    before_mb, before = resident_mb(fusion), heard[-1]
    flood(observer, goods, count_of(request), rng)
    assert heard[-1].data == before.data
    assert share_equal(heard[-1], wanted) > 0.9
    # It goes on: news of a good input are heard, and change what they should.
    count = len(heard)
    makers.send(touched(three()["c"], 1))
    observer.wait(lambda: len(heard) > count, what="a fused map after the flood", timeout_s=60.0)
    observer.wait_status(FUSION, "3 of 4 inputs vote; not: d", timeout_s=60.0)
    assert share_equal(heard[-1], wanted) > 0.9
    assert fusion.is_running
    assert resident_mb(fusion) - before_mb < GROWTH_MB
    assert "Traceback" not in fusion.text()


def test_a_hostile_peer_ends_no_producer(
    processes: Processes, observer: Observer, request: pytest.FixtureRequest
):
    """Its scans and odometry stand beside the robot's own; what cannot be used is left out."""
    maps = observer.collect(OccupancyGrid, "tinyslam/map", qos.MAP)
    node = processes.node("tinyslam", map_update_interval_s=0.2)
    robot = Robot(observer)
    robot.wait_for()
    ahead = iter(scans(300))

    def drive_on() -> bool:
        robot.send(next(ahead))
        return bool(maps)

    observer.wait(drive_on, what="a first map", timeout_s=60.0)
    last = next(ahead)
    stamp = messages.to_stamp(last.scan.stamp_s)
    goods: list[tuple[Any, Callable[[int], Any]]] = [
        (robot.scans, lambda _: messages.scan_to_message(last.scan, "base_link")),
        (
            robot.odometry,
            lambda _: messages.odometry_to_message(last.odometry, "odom", "base_link", stamp),
        ),
    ]
    rng = np.random.default_rng(2)
    flood(observer, goods, BEFORE, rng)
    observer.listen(0.5)
    before_mb = resident_mb(node)
    flood(observer, goods, count_of(request), rng)
    observer.listen(0.5)
    assert node.is_running
    assert resident_mb(node) - before_mb < GROWTH_MB
    assert "Traceback" not in node.text()
    assert node.interrupt() == 0
