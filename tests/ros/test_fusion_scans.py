"""The fusion node hears scans: it names who is contradicted, and draws the map along its path."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as PathMessage
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger

from slamfusion.compute import NumpyDevice
from slamfusion.evidence.beams import scan_hits
from slamfusion.evidence.drawn_map import draw_map
from slamfusion.geometry import Pose2
from slamfusion.io import read_trajectory
from slamfusion.ros import messages, qos
from slamfusion.ros.base import FINAL
from slamfusion.trajectory import Trajectory
from tests.evidence.rooms import circuit, recorded
from tests.evidence.test_conditions import CHANGED, UPSTAIRS
from tests.fusion.live.maps import share_standing
from tests.ros.live import Observer, Processes, values
from tests.slam.drives import drive

pytestmark = pytest.mark.ros

SCANS, FIRST_S = 140, 100.0


def test_scans_say_who_is_wrong_and_the_map_is_drawn_from_them(
    processes: Processes, observer: Observer, tmp_path: Path
):
    """The input b turns away slowly in its poses, while its map stays as it was.

    And the odometry stands still from some time on.
    """
    scans, truth = drive(SCANS)
    rows = np.array([(pose.x, pose.y, pose.yaw_rad) for pose in truth])
    path = Trajectory([item.scan.stamp_s for item in scans], rows)
    grid = draw_map([*scan_hits(scans)], path, NumpyDevice(), resolution=0.05)
    maps = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    poses = observer.collect(PoseWithCovarianceStamped, "fused/pose")
    paths = observer.collect(PathMessage, "fused/path", qos.MAP)
    scan_topic = observer.publisher(LaserScan, "scan")
    odometry = observer.publisher(Odometry, "odom")
    pose_topics = {name: observer.publisher(PoseStamped, f"{name}/pose") for name in "ab"}
    map_topics = {name: observer.publisher(OccupancyGrid, f"{name}/map", qos.MAP) for name in "ab"}
    save = str(tmp_path / "lab")
    processes.node("fusion", inputs=["a/map", "b/map"], save_path=save)
    observer.wait(lambda: scan_topic.get_subscription_count() == 1, what="the fusion")

    for number, (item, place) in enumerate(zip(scans, truth, strict=True)):
        message = messages.scan_to_message(item.scan, "base_link")
        message.header.stamp = stamp = messages.to_stamp(FIRST_S + item.scan.stamp_s)
        turned = Pose2(0.0, 0.0, 0.005 * max(0, number - 50))
        odometry.publish(
            messages.odometry_to_message(truth[min(number, 90)], "odom", "base_link", stamp)
        )
        for name, topic in pose_topics.items():
            pose = turned.compose(place) if name == "b" else place
            topic.publish(messages.pose_to_message(pose, f"{name}_map", stamp))
        scan_topic.publish(message)
        if number % 20 == 0:
            for name, topic in map_topics.items():
                topic.publish(messages.grid_to_message(grid, f"{name}_map", stamp))
        observer.listen(0.1)
    why = "the scans contradict its path"
    status = observer.wait_status("fusion: input b", why, timeout_s=90.0)
    assert values(status)["state"] == "doubted"
    assert "1 of 2 inputs votes; not: b" in observer.wait_status("fusion: fusion", "not: b").message
    observer.wait_status("fusion: fusion", "the odometry stands still from 9 s to")
    observer.wait(lambda: paths and len(paths[-1].poses) > SCANS // 2, 60.0, "the fused path")

    # The fused frame is a's or b's map frame; both maps are the same.
    last = paths[-1]
    assert last.header.frame_id == "fused_map"
    for item in last.poses:
        number = round((messages.stamp_s(item) - FIRST_S) * 10.0)
        place = messages.pose2_from_message(item.pose)
        assert math.hypot(place.x - truth[number].x, place.y - truth[number].y) < 0.05

    def off_m() -> float:
        number = round((messages.stamp_s(poses[-1]) - FIRST_S) * 10.0)
        place = messages.pose2_from_message(poses[-1].pose.pose)
        return math.hypot(place.x - truth[number].x, place.y - truth[number].y)

    # On a busy machine b is contradicted after its last pose, which is corrected then.
    observer.wait(lambda: off_m() < 0.1, what="the corrected pose")
    fused = messages.grid_from_message(maps[-1], "fused")
    assert not np.array_equal(fused.cells, grid.cells)  # drawn, and no vote of equal maps
    assert share_standing(grid, fused) > 0.9
    assert share_standing(fused, grid) > 0.9

    # No scan comes any more: the map is drawn as ``run`` draws it.
    told = observer.statuses()
    observer.wait(
        lambda: values(told["fusion: fusion"])[FINAL] == f"{FIRST_S + scans[-1].scan.stamp_s:.3f}",
        60.0,
        "the final map",
    )
    assert observer.call(Trigger, "save_map", Trigger.Request()).success
    assert len(read_trajectory(f"{save}.tum")) > SCANS // 2


def test_on_another_floor_a_new_map_starts_if_that_is_wanted(
    processes: Processes, observer: Observer
):
    told = circuit()
    scans = [*recorded(told)[:CHANGED], *recorded(told, walls=UPSTAIRS)[CHANGED:]]
    scan_topic = observer.publisher(LaserScan, "scan")
    odometry = observer.publisher(Odometry, "odom")
    pose_topic = observer.publisher(PoseStamped, "a/pose")
    node = processes.node("fusion", inputs=["a/map"], on_new_place="reset")
    observer.wait_status("fusion: fusion", "nothing is fused")
    for number, item in enumerate(scans):
        message = messages.scan_to_message(item.scan, "base_link")
        message.header.stamp = stamp = messages.to_stamp(FIRST_S + item.scan.stamp_s)
        odometry.publish(
            messages.odometry_to_message(told.pose(number), "odom", "base_link", stamp)
        )
        pose_topic.publish(messages.pose_to_message(told.pose(number), "a_map", stamp))
        scan_topic.publish(message)
        observer.listen(0.05)
    observer.wait(lambda: values(observer.statuses()["fusion: fusion"])["resets"] == "1", 60.0)
    assert "was carried away, or is on another floor; a new map starts" in node.text()
