from __future__ import annotations

import threading
from typing import Any

import pytest

pytest.importorskip(
    "geometry_msgs", reason="rclpy is absent: install the extra ros, or source a ROS"
)

from hypothesis import strategies as st

from slamfusion.geometry import Pose2
from slamfusion.ros.frames import TransformStore
from slamfusion.ros.fused_frames import ChildFrames
from slamfusion.ros.messages import to_stamp, transform_to_message
from tests.io.test_transforms import near

pytestmark = pytest.mark.ros

numbers = st.floats(-20.0, 20.0)
# Longer than any test takes: a wait ends by what arrives, or not at all.
LONG_S = 600.0


def sent(parent: str, child: str, pose: Pose2, time_s: float = 0.0) -> Any:
    return transform_to_message(pose, parent, child, to_stamp(time_s))


def test_a_message_of_an_upside_down_frame():
    message = sent("base", "laser", Pose2(0.3, 0.1, 0.0))
    turn = message.transform.rotation
    turn.x, turn.y, turn.z, turn.w = 1.0, 0.0, 0.0, 0.0  # half a turn about x
    store = TransformStore()
    store.add([message], is_static=True)
    mount = store.mount("base", "laser", 0.0)
    assert mount.is_flipped
    assert near(mount.pose, Pose2(0.3, 0.1, 0.0))


def test_who_waits_gets_the_transform_between_two_that_come_later():
    store = TransformStore()
    store.add([sent("odom", "base", Pose2(1.0, 0.0, 0.0), 10.0)])
    found: list[Pose2] = []
    # 10.04 s is near enough to the first to be told without the second, after a wait.
    asking = threading.Thread(
        target=lambda: found.append(store.lookup("odom", "base", 10.04, LONG_S)), daemon=True
    )
    asking.start()
    store.add([sent("odom", "base", Pose2(2.0, 0.0, 0.0), 10.08)])
    asking.join(60.0)
    assert len(found) == 1
    assert near(found[0], Pose2(1.5, 0.0, 0.0))


@pytest.mark.parametrize(
    ("topics", "wanted"),
    [
        (["/robot1/graph/map", "/robot2/graph/map"], ["map", "robot2/map"]),
        (["/robot1/map", "/robot2/map", "/robot3/map"], ["map", "robot2/map", "robot3/map"]),
        (["/r/a/map", "/r/b/map", "/r/c/map"], ["map", "r/b/map", "r/c/map"]),
        (["/f/r1/g/map", "/f/r2/g/map", "/f/r2/h/map"], ["map", "f/r2/map", "f/r2/h/map"]),
        (["/map", "/robot2/map"], ["map", "robot2/map"]),
        (["/robot1/map", "/map"], ["map", "map/map"]),
        (["/robot1/map", "/robot1/map"], ["map", "robot1/map_2"]),
    ],
)
def test_the_first_keeps_a_frame_and_others_have_as_much_namespace_as_tells_them_apart(
    topics: list[str], wanted: list[str]
):
    frames = ChildFrames()
    found = [frames.of(str(number), topic, "map") for number, topic in enumerate(topics)]
    assert found == wanted
    # Asked again, in any order, each has its own.
    again = [frames.of(str(number), topic, "map") for number, topic in enumerate(topics)]
    assert again == wanted


def test_a_name_that_somebody_has_is_not_given():
    frames = ChildFrames(["fused_map"])
    assert frames.of("a", "/robot2/x/map", "robot2/map") == "robot2/map"
    assert frames.of("b", "/robot1/y/map", "map") == "map"
    assert frames.of("c", "/robot2/y/map", "map") == "robot2/y/map"
    assert frames.of("d", "/robot2/y/map", "other") == "other"


def test_an_input_whose_frame_changes_has_a_new_one_and_the_old_stays_its_own():
    frames = ChildFrames()
    assert frames.of("a", "/robot1/map", "map") == "map"
    assert frames.of("a", "/robot1/map", "map_2") == "map_2"
    assert frames.of("b", "/robot2/map", "map") == "robot2/map"
    assert frames.of("a", "/robot1/map", "map") == "map"
