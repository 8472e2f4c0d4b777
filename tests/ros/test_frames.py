from __future__ import annotations

import math
from typing import Any

import pytest

pytest.importorskip(
    "geometry_msgs", reason="rclpy is absent: install the extra ros, or source a ROS"
)

from hypothesis import given
from hypothesis import strategies as st

from slamfusion.geometry import Pose2
from slamfusion.ros.frames import TransformBuffer, TransformError
from slamfusion.ros.messages import to_stamp, transform_to_message

pytestmark = pytest.mark.ros

numbers = st.floats(-20.0, 20.0)
poses = st.builds(Pose2, numbers, numbers, st.floats(-3.1, 3.1))


def sent(parent: str, child: str, pose: Pose2, time_s: float = 0.0) -> Any:
    return transform_to_message(pose, parent, child, to_stamp(time_s))


def near(one: Pose2, other: Pose2) -> bool:
    turn = math.remainder(one.yaw_rad - other.yaw_rad, 2.0 * math.pi)
    return math.hypot(one.x - other.x, one.y - other.y) < 1e-6 and abs(turn) < 1e-7


@given(poses, poses, poses)
def test_frames_are_chained_in_both_directions(a: Pose2, b: Pose2, c: Pose2):
    buffer = TransformBuffer()
    buffer.add(sent("map", "odom", a), is_static=True)
    buffer.add(sent("odom", "base", b), is_static=True)
    buffer.add(sent("map", "dock", c), is_static=True)
    assert near(buffer.lookup("map", "base", 5.0), a.compose(b))
    assert near(buffer.lookup("base", "map", 5.0), a.compose(b).inverse())
    assert near(buffer.lookup("dock", "base", 5.0), c.inverse().compose(a.compose(b)))
    assert near(buffer.lookup("base", "base", 5.0), Pose2())


def test_between_two_stamps_a_pose_is_interpolated_the_short_way():
    buffer = TransformBuffer()
    buffer.add(sent("odom", "base", Pose2(1.0, 0.0, 3.0), 10.0), is_static=False)
    buffer.add(sent("odom", "base", Pose2(2.0, 4.0, -3.0), 10.4), is_static=False)
    found = buffer.lookup("odom", "base", 10.1)
    step = (2.0 * math.pi - 6.0) / 4.0
    assert near(found, Pose2(1.25, 1.0, 3.0 + step))
    assert near(buffer.lookup("odom", "base", 10.4), Pose2(2.0, 4.0, -3.0))


def test_a_time_outside_of_what_is_known_is_refused_and_says_whether_to_wait():
    buffer = TransformBuffer()
    buffer.add(sent("odom", "base", Pose2(), 10.0), is_static=False)
    with pytest.raises(TransformError, match=r"from 'base' to 'odom' is 0\.500 s too old") as late:
        buffer.lookup("odom", "base", 10.5)
    assert late.value.may_come
    with pytest.raises(TransformError, match=r"is 1\.000 s too new") as early:
        buffer.lookup("odom", "base", 9.0)
    assert not early.value.may_come
    assert near(buffer.lookup("odom", "base", 10.04), Pose2())


def test_a_gap_between_two_stamps_is_refused():
    buffer = TransformBuffer()
    for time_s in (10.0, 12.0):
        moved = sent("odom", "base", Pose2(), time_s)
        buffer.add(moved, is_static=False, arrived_s=time_s)
    with pytest.raises(TransformError, match=r"no transform from 'base' to 'odom' within 0\.5 s"):
        buffer.lookup("odom", "base", 11.0)


def test_frames_that_nothing_connects_are_named():
    buffer = TransformBuffer()
    buffer.add(sent("odom", "base", Pose2()), is_static=True)
    with pytest.raises(TransformError, match=r"from 'laser' to 'base'; known frames: base, odom"):
        buffer.lookup("base", "laser", 0.0)


def test_time_that_jumps_back_begins_again_when_three_say_so():
    buffer = TransformBuffer()
    buffer.add(sent("odom", "base", Pose2(1.0, 0.0, 0.0), 100.0), is_static=False)
    assert not buffer.add(sent("odom", "base", Pose2(2.0, 0.0, 0.0), 99.5), is_static=False)
    for index in range(3):
        assert buffer.lookup("odom", "base", 100.0).x == pytest.approx(1.0)
        assert buffer.heard_s("odom", "base") == pytest.approx(4.9 + 0.1 * index if index else 99.5)
        moved = sent("odom", "base", Pose2(3.0 + index, 0.0, 0.0), 5.0 + 0.1 * index)
        assert buffer.add(moved, is_static=False)
    assert near(buffer.lookup("odom", "base", 5.0), Pose2(3.0, 0.0, 0.0))
    assert near(buffer.lookup("odom", "base", 5.2), Pose2(5.0, 0.0, 0.0))
    with pytest.raises(TransformError):
        buffer.lookup("odom", "base", 100.0)
    assert buffer.strays == 0


@pytest.mark.parametrize("offset_s", [-1.8, -95.0, 3600.0])
def test_one_stray_stamp_takes_no_transform_away(offset_s: float):
    buffer = TransformBuffer()
    for index in range(20):
        time_s = 100.0 + 0.1 * index
        buffer.add(sent("odom", "base", Pose2(float(index), 0.0, 0.0), time_s), is_static=False)
        if index == 10:
            odd = sent("odom", "base", Pose2(500.0, 0.0, 0.0), time_s + offset_s)
            assert buffer.add(odd, is_static=False)
    for index in range(20):
        assert buffer.lookup("odom", "base", 100.0 + 0.1 * index).x == pytest.approx(float(index))
    assert buffer.strays == 1


def test_what_is_held_back_is_let_in_when_time_is_known_to_be_there():
    buffer = TransformBuffer()
    for time_s in (100.0, 100.1, 5.0):
        buffer.add(sent("odom", "base", Pose2(time_s, 0.0, 0.0), time_s), is_static=False)
    buffer.settle(99.0)
    assert buffer.lookup("odom", "base", 100.0).x == pytest.approx(100.0)
    buffer.settle(5.1)
    assert buffer.lookup("odom", "base", 5.0).x == pytest.approx(5.0)
    assert buffer.heard_s("base", "odom") == 5.0
    assert buffer.heard_s("map", "odom") is None


def test_what_is_newer_than_a_clock_that_jumped_back_is_forgotten():
    buffer = TransformBuffer()
    buffer.add(sent("base", "laser", Pose2()), is_static=True)
    for time_s in (5.0, 5.2, 5.4):
        buffer.add(sent("odom", "base", Pose2(time_s, 0.0, 0.0), time_s), is_static=False)
    buffer.forget_after(5.3)
    assert buffer.lookup("odom", "laser", 5.2).x == pytest.approx(5.2)
    with pytest.raises(TransformError):
        buffer.lookup("odom", "laser", 5.4)
    buffer.forget_after(1.0)
    with pytest.raises(TransformError, match="known frames: base, laser"):
        buffer.lookup("odom", "laser", 5.2)


def test_old_transforms_are_forgotten():
    buffer = TransformBuffer()
    for index in range(1000):
        buffer.add(sent("odom", "base", Pose2(), 0.1 * index), is_static=False)
    (edge,) = buffer._edges.values()
    assert len(edge.stamps_s) <= 201
    assert len(edge.rows) == len(edge.stamps_s)
    assert near(buffer.lookup("odom", "base", 95.0), Pose2())


def test_an_upside_down_frame_is_told_and_a_tilted_one_refused():
    buffer = TransformBuffer()
    message = sent("base", "laser", Pose2(0.3, 0.1, 0.0))
    turn = message.transform.rotation
    turn.x, turn.y, turn.z, turn.w = 1.0, 0.0, 0.0, 0.0  # half a turn about x
    buffer.add(message, is_static=True)
    mount = buffer.mount("base", "laser", 0.0)
    assert mount.is_flipped
    assert mount.is_static
    assert near(mount.pose, Pose2(0.3, 0.1, 0.0))
    turn.x, turn.w = math.sin(0.6), math.cos(0.6)
    buffer.add(message, is_static=True)
    with pytest.raises(TransformError, match="tilted by 69 degrees"):
        buffer.mount("base", "laser", 0.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e12])
def test_a_transform_to_nowhere_is_left_out(value: float):
    message = sent("odom", "base", Pose2())
    message.transform.translation.x = value
    buffer = TransformBuffer()
    assert not buffer.add(message, is_static=False)
    assert buffer.frames == set()


def test_a_transform_without_rotation_is_left_out():
    message = sent("odom", "base", Pose2())
    message.transform.rotation.w = 0.0
    assert not TransformBuffer().add(message, is_static=False)


def test_a_ring_of_frames_is_no_way():
    buffer = TransformBuffer()
    buffer.add(sent("a", "b", Pose2()), is_static=True)
    buffer.add(sent("b", "a", Pose2()), is_static=True)
    with pytest.raises(TransformError, match="no transforms from 'c' to 'a'"):
        buffer.lookup("a", "c", 0.0)
