"""Two robots on halves of one drive, each with a graph SLAM of its own, fused over DDS."""

from __future__ import annotations

import math
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.msg import OccupancyGrid

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid as Grid
from slamfusion.ros import messages, qos
from slamfusion.ros.frames import TransformInput
from slamfusion.sim import Recording
from tests.ros.live import Observer, Processes, values
from tests.support.two_robots import Halves, cut_drive, drive_through, map_of, off_by_m, off_by_rad

pytestmark = pytest.mark.ros

FUSION = "fusion: fusion"
TOPICS = ["robot1/graph/map", "robot2/graph/map"]
INPUTS = [topic.removesuffix("/map") for topic in TOPICS]
# What both robots call the frame of their map, and what the fusion calls them.
FRAME, CHILDREN = "graph_map", ("graph_map", "robot2/graph_map")
OFF_M, OFF_RAD = 0.2, math.radians(1.5)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return drive_through(2, tmp_path_factory.mktemp("building"), open_device())


class Robots:
    """The test itself publishes the maps of both robots."""

    def __init__(self, observer: Observer) -> None:
        self.observer = observer
        self.stamp_s = 100.0
        self.topics = [observer.publisher(OccupancyGrid, topic, qos.MAP) for topic in TOPICS]

    def send(self, *grids: Grid) -> None:
        """Publish a map of each, a second later than the last ones."""
        self.stamp_s += 1.0
        stamp = messages.to_stamp(self.stamp_s)
        for topic, grid in zip(self.topics, grids, strict=True):
            topic.publish(messages.grid_to_message(grid, FRAME, stamp))


def start(processes: Processes) -> Any:
    """Start the fusion node; however slow the machine, no input grows stale."""
    settings = {"live__search_pause_s": 0.0, "live__stale_after_s": 1000.0}
    return processes.node("fusion", inputs=TOPICS, **settings)


def maps_of(halves: Halves, device: ComputeDevice) -> tuple[Grid, Grid]:
    first, second = (
        map_of(scans, name, device) for scans, name in zip(halves.scans, INPUTS, strict=True)
    )
    return first, second


def transforms_at(listener: TransformInput, stamp_s: float) -> Pose2:
    """Return where the second robot's map frame lies in the first one's, by the transforms."""
    first, second = (listener.lookup("fused_map", child, stamp_s) for child in CHILDREN)
    return first.inverse().compose(second)


@pytest.mark.full
@pytest.mark.parametrize("overlap", [0.2, 0.4, 0.6])
def test_halves_of_one_drive_fuse_in_frames_of_their_own(
    processes: Processes, observer: Observer, drive: Recording, overlap: float
):
    listener = TransformInput(observer.node)
    robots = Robots(observer)
    node = start(processes)
    halves = cut_drive(drive, overlap)
    robots.send(*maps_of(halves, open_device()))
    words = f"the map of '{INPUTS[1]}' is in frame '{FRAME}' as another map is"
    status = observer.wait_status(FUSION, "all 2 inputs vote", words, f"sent to '{CHILDREN[1]}'")
    assert status.level == b"\x01"
    for name, child in zip(INPUTS, CHILDREN, strict=True):
        assert values(observer.statuses()[f"fusion: input {name}"])["frame"] == child

    def is_told() -> bool:
        return [listener.heard_s("fused_map", child) for child in CHILDREN] == [robots.stamp_s] * 2

    observer.wait(is_told, what="both transforms")
    found, wanted = transforms_at(listener, robots.stamp_s), halves.second_in_first
    off = f"{off_by_m(found, wanted):.3f} m, {off_by_rad(found, wanted):.4f} rad"
    assert off_by_m(found, wanted) <= OFF_M, off
    assert off_by_rad(found, wanted) <= OFF_RAD, off
    assert node.interrupt() == 0
    assert "Traceback" not in node.text()
