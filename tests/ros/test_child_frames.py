"""Which frame each input's transform is sent to, where several maps claim one."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from slamfusion.ros.child_frames import ChildFrames, in_namespace


@pytest.mark.parametrize(
    ("namespace", "frame"),
    [
        ("/", "graph_map"),
        ("", "graph_map"),
        ("/robot1", "robot1/graph_map"),
        ("/a/b/", "a/b/graph_map"),
    ],
)
def test_a_frame_in_a_namespace_begins_with_it(namespace: str, frame: str):
    assert in_namespace(namespace, "graph_map") == frame


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
    assert frames.renamed() == {
        str(number): ("map", child) for number, child in enumerate(wanted) if child != "map"
    }


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
