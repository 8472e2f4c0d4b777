"""Several writers of one topic, stamps of tomorrow, and stamps that come only once."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid

from slamfusion.geometry import Pose2
from slamfusion.ros import messages, qos
from slamfusion.ros.frames import TransformInput
from tests.fusion.live.maps import three, touched
from tests.ros.fused import Makers, Robot, start_fusion, told_transforms
from tests.ros.live import Observer, Processes

pytestmark = pytest.mark.ros

FUSION = "fusion: fusion"
DAY_S = 86400.0


class Told(TransformInput):
    """The stamps of every transform by its child frame, nanoseconds, in the order they came."""

    def __init__(self, node: Any) -> None:
        self.stamps_ns: dict[str, list[int]] = {}
        super().__init__(node)

    def add(self, transforms: Iterable[Any], *, is_static: bool = False) -> None:
        listed = list(transforms)
        for item in listed:
            self.stamps_ns.setdefault(item.child_frame_id, []).append(messages.stamp_ns(item))
        super().add(listed, is_static=is_static)


def test_no_stamp_comes_twice_and_none_is_of_tomorrow(processes: Processes, observer: Observer):
    makers = Makers(observer)
    fused = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    poses = observer.collect(PoseWithCovarianceStamped, "fused/pose")
    told = Told(observer.node)
    start_fusion(processes, publish_tf=True)
    robot = Robot(observer)
    makers.send_all()
    observer.wait_status(FUSION, "all 3 inputs vote")
    transforms = told_transforms(observer)
    # Fusions between two poses, and poses of several SLAMs of one scan, as leaders change.
    for number in range(40):
        robot.at(200.0 + 0.1 * number, Pose2(2.0, 1.5, 0.01 * number), transforms)
        makers.send(touched(three()["abc"[number % 3]], number))
        observer.listen(0.08)
    # All three inputs agree on the pose, to the four digits of their transforms.
    deviations = np.sqrt(np.diag(np.array(poses[-1].pose.covariance).reshape(6, 6)))
    assert deviations == pytest.approx([0.025, 0.025, 0.0, 0.0, 0.0, 0.01], abs=0.01)
    # The next ones are of tomorrow: named, and no stamp of ours is.
    tomorrow = messages.to_stamp(time.time() + DAY_S)
    robot.poses["c"].publish(messages.pose_to_message(Pose2(), "c_map", tomorrow))
    count = len(fused)
    words = f"has a stamp {DAY_S:.0f} s ahead of the clock and other inputs; such poses are"
    observer.wait_status(FUSION, f"'c' {words}")
    numbers = itertools.count(99)

    def is_named() -> bool:
        makers.send(touched(three()["b"], next(numbers)), stamp_s=time.time() + DAY_S)
        observer.listen(1.0)
        return f"'b' {words}" in observer.statuses()[FUSION].message

    observer.wait(is_named, what="the word of the map of tomorrow")
    observer.wait(lambda: len(fused) > count, what="the map with that of tomorrow")
    assert max(messages.stamp_s(item) for item in fused) <= makers.stamp_s

    stamps = {**told.stamps_ns, "pose": [messages.stamp_ns(item) for item in poses]}
    assert {*stamps} == {"odom", "a_map", "b_map", "c_map", "pose"}
    for name, found in stamps.items():
        again = sum(b <= a for a, b in itertools.pairwise(found))
        assert again == 0, f"{again} of {len(found)} stamps of {name} are not newer than the last"
        assert len(found) >= 20, name
        assert max(found) < 1e9 * (makers.stamp_s + 200.0)


def test_rivals_are_named_with_what_to_do(domain: int, processes: Processes, observer: Observer):
    makers = Makers(observer)
    start_fusion(processes, publish_tf=True)
    second = start_fusion(processes, "-r", "__node:=second", publish_tf=True)
    grids = iter(three().values())
    makers.send(next(grids), frame="map")
    # The first map that comes keeps the frame's name.
    observer.wait_status(FUSION, "has 1")
    for grid in grids:
        makers.send(grid, frame="map")
    observer.wait_status(FUSION, "all 3 inputs vote", timeout_s=60.0)
    observer.wait_status("second: fusion", "all 3 inputs vote", timeout_s=60.0)
    observer.wait_status(FUSION, "another node, '/second', publishes '/fused/map' too: end one")
    observer.wait_status("second: fusion", "another node, '/fusion', publishes '/fused/map' too")
    # What is said of a frame holds for the newest map.
    makers.send(three()["b"], frame="")
    words = "'b' is in frame '' and has no transform; 'c' is in frame 'map' as another map is"
    observer.wait_status(FUSION, words)
    # Nobody tells where the robot is.
    words = "publish_tf: fused_map -> odom was never sent: no input that votes has"
    observer.wait_status(FUSION, words)
    robot = Robot(observer)
    transforms = told_transforms(observer)
    stamps = itertools.count(3000)

    def is_said(rival: str) -> bool:
        robot.at(0.1 * next(stamps), Pose2(1.0, 1.0, 0.1), transforms)
        observer.listen(0.1)
        message = observer.statuses()[FUSION].message
        words = (
            "the pose of 'a' is in frame 'a_map' and its map in 'map': it is taken as one in",
            "another node sends the transform to",
            f"the other fusion is {rival!r}; end one",
        )
        return all(word in message for word in words) and "was never sent" not in message

    observer.wait(lambda: is_said("/second"), what="the other fusion, and that ours sends")
    assert observer.statuses()[FUSION].level == b"\x02"
    # A second writer of an input is named until it has gone, as is the other fusion.
    assert second.interrupt() == 0
    with Observer(domain, "stranger") as other:
        Makers(other, "b").send(three()["b"])
        words = "2 nodes publish '/b/map', '/observer' and '/stranger'"
        observer.wait_status(FUSION, words)
    for words in ("publishes '/fused/map'", "nodes publish"):
        observer.wait(lambda words=words: words not in observer.statuses()[FUSION].message)
    # So is one of the same name.
    start_fusion(processes, publish_tf=True)
    observer.wait_status(FUSION, "2 nodes are called '/fusion'")
    observer.wait(lambda: is_said("/fusion"), what="the other fusion of the same name")


def test_two_slams_of_one_name_are_named_while_both_live(processes: Processes, observer: Observer):
    start_fusion(processes, inputs=["tinyslam/map"])
    for _ in range(2):
        processes.node("tinyslam")
    # Sooner than a killed one is forgotten.
    words = "2 nodes publish '/tinyslam/map', '/tinyslam' and '/tinyslam', and their maps take"
    observer.wait_status(FUSION, words, timeout_s=30.0)
    observer.wait_status("tinyslam: slam", "2 nodes are called '/tinyslam'")
