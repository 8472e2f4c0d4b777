"""Two robots whose maps share a part of one building and have frames of one name, over DDS."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.msg import OccupancyGrid

from slamfusion.ros import messages, qos
from slamfusion.ros.frames import TransformInput
from tests.fusion.drawings import off_by
from tests.fusion.live.test_part_in_common import CELLS, DEGREES, wings
from tests.ros.fused import start_fusion
from tests.ros.live import Observer, Processes, values

pytestmark = pytest.mark.ros

FUSION = "fusion: fusion"
TOPICS = ["robot1/graph/map", "robot2/graph/map"]
INPUTS = [topic.removesuffix("/map") for topic in TOPICS]
# What both robots call the frame of their map, and what the fusion calls them.
FRAME, CHILDREN = "graph_map", ("graph_map", "robot2/graph_map")
STAMP_S = 101.0


def test_maps_in_frames_of_one_name_fuse_in_frames_of_their_own(
    processes: Processes, observer: Observer
):
    listener = TransformInput(observer.node)
    publishers = [observer.publisher(OccupancyGrid, topic, qos.MAP) for topic in TOPICS]
    node = start_fusion(processes, inputs=TOPICS)
    drawn, wanted = wings()
    first, second = drawn(3.0, 7.0)
    for publisher, grid in zip(publishers, (first, second), strict=True):
        publisher.publish(messages.grid_to_message(grid, FRAME, messages.to_stamp(STAMP_S)))
    words = f"the map of '{INPUTS[1]}' is in frame '{FRAME}' as another map is"
    status = observer.wait_status(FUSION, "all 2 inputs vote", words, f"sent to '{CHILDREN[1]}'")
    assert status.level == b"\x01"
    for name, child in zip(INPUTS, CHILDREN, strict=True):
        assert values(observer.statuses()[f"fusion: input {name}"])["frame"] == child

    def is_told() -> bool:
        return [listener.heard_s("fused_map", child) for child in CHILDREN] == [STAMP_S] * 2

    observer.wait(is_told, what="both transforms")
    there, here = (listener.lookup("fused_map", child, STAMP_S) for child in CHILDREN)
    cells, degrees = off_by(second, there.inverse().compose(here), wanted)
    assert cells <= CELLS
    assert degrees <= DEGREES
    assert node.interrupt() == 0
    assert "Traceback" not in node.text()
