"""The player on a bag: its scans, with odometry and the laser's offset from its transforms."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from sensor_msgs.msg import LaserScan

from slamfusion.ros import messages
from slamfusion.ros.frames import TransformInput
from tests.io.bags import Bag
from tests.ros.live import Observer, Processes

pytestmark = pytest.mark.ros


def test_a_bag_is_played_with_its_transforms(
    processes: Processes, observer: Observer, tmp_path: Path
):
    bag = Bag().transform(100.0, "base_link", "front_laser", (0.3, 0.1, 0.2), topic="/tf_static")
    for index in range(10):
        stamp_s = 100.0 + 0.1 * index
        bag.transform(stamp_s, "odom", "base_link", (0.05 * index, 0.0, 0.0))
        bag.scan(stamp_s, (1.0, 2.0, 3.0 + index), topic="/front/scan", frame="front_laser")
    path = bag.write(tmp_path)
    heard = observer.collect(LaserScan, "scan")
    transforms = TransformInput(observer.node)
    player = processes.node("player", file=str(path), rate=4.0)
    assert player.wait(40.0) == 0, player.text()
    observer.listen(0.5)
    assert [message.ranges[2] for message in heard] == [3.0 + index for index in range(10)]
    last_s = messages.stamp_s(heard[-1])
    assert last_s == pytest.approx(100.9)
    found = transforms.lookup("odom", "laser", last_s)
    assert (found.x, found.y, found.yaw_rad) == pytest.approx((0.75, 0.1, 0.0))
