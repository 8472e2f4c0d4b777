"""Claims about the tree of transforms that are sent live."""

from __future__ import annotations

import math

import pytest
from hypothesis import strategies as st

from slamfusion.geometry import Pose2
from slamfusion.io.transforms import KEEP_S, TransformError, TransformTree

numbers = st.floats(-20.0, 20.0)

Sent = tuple[str, str, float, tuple[float, ...]]


def sent(parent: str, child: str, pose: Pose2, time_s: float = 0.0) -> Sent:
    half_rad = pose.yaw_rad / 2.0
    turn = (0.0, 0.0, math.sin(half_rad), math.cos(half_rad))
    return parent, child, time_s, (pose.x, pose.y, 0.0, *turn)


def near(one: Pose2, other: Pose2) -> bool:
    turn = math.remainder(one.yaw_rad - other.yaw_rad, 2.0 * math.pi)
    return math.hypot(one.x - other.x, one.y - other.y) < 1e-6 and abs(turn) < 1e-7


def test_between_two_stamps_a_pose_is_interpolated_the_short_way() -> None:
    tree = TransformTree(KEEP_S)
    tree.add(*sent("odom", "base", Pose2(1.0, 0.0, 3.0), 10.0))
    tree.add(*sent("odom", "base", Pose2(2.0, 4.0, -3.0), 10.4))
    found = tree.mount("odom", "base", 10.1).pose
    step = (2.0 * math.pi - 6.0) / 4.0
    assert near(found, Pose2(1.25, 1.0, 3.0 + step))
    assert near(tree.mount("odom", "base", 10.4).pose, Pose2(2.0, 4.0, -3.0))


def test_a_time_outside_of_what_is_known_is_refused_and_says_whether_to_wait() -> None:
    tree = TransformTree(KEEP_S)
    tree.add(*sent("odom", "base", Pose2(), 10.0))
    with pytest.raises(TransformError, match=r"from 'base' to 'odom' is 0\.500 s too old") as late:
        tree.mount("odom", "base", 10.5)
    assert late.value.may_come
    with pytest.raises(TransformError, match=r"is 1\.000 s too new") as early:
        tree.mount("odom", "base", 9.0)
    assert not early.value.may_come
    assert near(tree.mount("odom", "base", 10.04).pose, Pose2())


def test_a_gap_between_two_stamps_is_refused() -> None:
    tree = TransformTree(KEEP_S)
    for time_s in (10.0, 12.0):
        tree.add(*sent("odom", "base", Pose2(), time_s), arrived_s=time_s)
    with pytest.raises(TransformError, match=r"no transform from 'base' to 'odom' within 0\.5 s"):
        tree.mount("odom", "base", 11.0)


def test_frames_that_nothing_connects_are_named() -> None:
    tree = TransformTree(KEEP_S)
    tree.add(*sent("odom", "base", Pose2()), is_static=True)
    with pytest.raises(TransformError, match=r"from 'laser' to 'base'; known frames: base, odom"):
        tree.mount("base", "laser", 0.0)


def test_time_that_jumps_back_begins_again_when_three_say_so() -> None:
    tree = TransformTree(KEEP_S)
    tree.add(*sent("odom", "base", Pose2(1.0, 0.0, 0.0), 100.0))
    assert not tree.add(*sent("odom", "base", Pose2(2.0, 0.0, 0.0), 99.5))
    for index in range(3):
        assert tree.mount("odom", "base", 100.0).pose.x == pytest.approx(1.0)
        assert tree.heard_s("odom", "base") == pytest.approx(4.9 + 0.1 * index if index else 99.5)
        assert tree.add(*sent("odom", "base", Pose2(3.0 + index, 0.0, 0.0), 5.0 + 0.1 * index))
    assert near(tree.mount("odom", "base", 5.0).pose, Pose2(3.0, 0.0, 0.0))
    assert near(tree.mount("odom", "base", 5.2).pose, Pose2(5.0, 0.0, 0.0))
    with pytest.raises(TransformError):
        tree.mount("odom", "base", 100.0)
    assert tree.strays == 0


@pytest.mark.parametrize("offset_s", [-1.8, -95.0, 3600.0])
def test_one_stray_stamp_takes_no_transform_away(offset_s: float) -> None:
    tree = TransformTree(KEEP_S)
    for index in range(20):
        time_s = 100.0 + 0.1 * index
        tree.add(*sent("odom", "base", Pose2(float(index), 0.0, 0.0), time_s))
        if index == 10:
            assert tree.add(*sent("odom", "base", Pose2(500.0, 0.0, 0.0), time_s + offset_s))
    for index in range(20):
        assert tree.mount("odom", "base", 100.0 + 0.1 * index).pose.x == pytest.approx(float(index))
    assert tree.strays == 1


def test_what_is_held_back_is_let_in_when_time_is_known_to_be_there() -> None:
    tree = TransformTree(KEEP_S)
    for time_s in (100.0, 100.1, 5.0):
        tree.add(*sent("odom", "base", Pose2(time_s, 0.0, 0.0), time_s))
    tree.settle(99.0)
    assert tree.mount("odom", "base", 100.0).pose.x == pytest.approx(100.0)
    tree.settle(5.1)
    assert tree.mount("odom", "base", 5.0).pose.x == pytest.approx(5.0)
    assert tree.heard_s("base", "odom") == 5.0
    assert tree.heard_s("map", "odom") is None


def test_an_upside_down_frame_is_told_and_a_tilted_one_refused() -> None:
    tree = TransformTree(KEEP_S)
    half_a_turn_about_x = (0.3, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0)
    tree.add("base", "laser", 0.0, half_a_turn_about_x, is_static=True)
    mount = tree.mount("base", "laser", 0.0)
    assert mount.is_flipped
    assert near(mount.pose, Pose2(0.3, 0.1, 0.0))
    for half_rad, tilt in ((0.5, 57), (0.6, None)):
        row = (0.3, 0.1, 0.0, math.sin(half_rad), 0.0, 0.0, math.cos(half_rad))
        tree.add("base", "laser", 0.0, row, is_static=True)
        if tilt is not None:
            found = tree.mount("base", "laser", 0.0)
            assert round(math.degrees(found.tilt_rad)) == tilt
            assert not found.is_flipped
    with pytest.raises(TransformError, match="tilted by 69 degrees"):
        tree.mount("base", "laser", 0.0)


def test_a_frame_has_the_parent_that_was_sent_last() -> None:
    tree = TransformTree(KEEP_S)
    tree.add(*sent("odom", "base", Pose2(1.0, 0.0, 0.0)), is_static=True)
    assert tree.is_connected("odom", "base")
    tree.add(*sent("map", "base", Pose2(2.0, 0.0, 0.0)), is_static=True)
    assert tree.mount("map", "base", 0.0).pose.x == pytest.approx(2.0)
    assert not tree.is_connected("odom", "base")
    assert tree.frames == {"map", "base"}
