"""Claims about poses and rigid motions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.geometry import (
    Pose2,
    fit_motion,
    quaternion_yaw_rad,
    transform_points,
    travelled,
    with_levers,
    wrap_angle,
)

LENGTHS = st.floats(-1e3, 1e3)
ANGLES = st.floats(-20.0, 20.0)
POSES = st.builds(Pose2, LENGTHS, LENGTHS, ANGLES)


def assert_same(left: Pose2, right: Pose2) -> None:
    assert (left.x, left.y) == pytest.approx((right.x, right.y), abs=1e-8)
    assert wrap_angle(left.yaw_rad - right.yaw_rad) == pytest.approx(0.0, abs=1e-9)


@given(ANGLES)
def test_a_wrapped_angle_lies_in_the_half_open_turn(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


@given(POSES)
def test_a_pose_composed_with_its_inverse_is_the_identity(pose: Pose2) -> None:
    assert_same(pose.compose(pose.inverse()), Pose2())
    assert_same(pose.inverse().compose(pose), Pose2())


@given(POSES, POSES, LENGTHS, LENGTHS)
def test_composing_is_transforming_twice(a: Pose2, b: Pose2, x: float, y: float) -> None:
    once = a.compose(b).transform((x, y))
    twice = a.transform(b.transform((x, y)))
    assert once == pytest.approx(twice, abs=1e-8)


def test_a_quarter_turn_is_counter_clockwise() -> None:
    pose = Pose2(1.0, 2.0, math.pi / 2)
    assert pose.transform((1.0, 0.0)) == pytest.approx(np.array([1.0, 3.0]))
    assert pose.transform([[1.0, 0.0], [0.0, 1.0]]) == pytest.approx(
        np.array([[1.0, 3.0], [0.0, 2.0]])
    )


def test_points_are_mapped_by_many_poses_as_by_one() -> None:
    rng = np.random.default_rng(5)
    poses, points = rng.normal(size=(4, 3)), rng.normal(size=(4, 2))
    for found, pose, point in zip(transform_points(poses, points), poses, points, strict=True):
        assert found == pytest.approx(Pose2(*pose).transform(point))
    of = np.array([2, 0, 2, 3, 3, 1])
    more = rng.normal(size=(6, 2))
    assert np.array_equal(transform_points(poses, more, of), transform_points(poses[of], more))


def test_way_is_as_long_as_its_steps() -> None:
    places = np.array([(1.0, 1.0, 9.0), (4.0, 5.0, -9.0), (4.0, 5.0, 0.0), (4.0, 4.0, 0.0)])
    assert travelled(places).tolist() == [0.0, 5.0, 5.0, 6.0]
    assert travelled(places[:1]).tolist() == [0.0]


def test_levers_stand_before_and_behind_each_pose() -> None:
    found = with_levers(np.array([(1.0, 2.0, 0.0), (0.0, 0.0, math.pi / 2)]))
    wanted = [(4, 2, 0), (0, 3, math.pi / 2), (-2, 2, 0), (0, -3, math.pi / 2)]
    assert found == pytest.approx(np.array(wanted, dtype=np.float64))


def test_headings_count_in_a_fit_with_levers() -> None:
    """Of poses that hardly move the places say that nothing turned, the headings a radian."""
    moving = np.array([(0.0, 0.0, 0.2), (0.01, 0.0, 0.3)])
    still = moving + np.array((0.0, 0.0, 1.0))
    assert fit_motion(moving, still).yaw_rad == pytest.approx(0.0, abs=1e-9)
    motion = fit_motion(with_levers(moving), with_levers(still))
    assert motion.yaw_rad == pytest.approx(1.0, abs=1e-4)


def test_weights_of_a_fit_count_as_often_as_poses_do() -> None:
    rng = np.random.default_rng(3)
    moving, still = rng.normal(size=(2, 20, 3))
    times = np.arange(20) % 4
    found = fit_motion(moving, still, times / 7.0)
    wanted = fit_motion(*(np.repeat(poses, times, axis=0) for poses in (moving, still)))
    assert_same(found, wanted)
    assert_same(fit_motion(moving, still, np.full(20, 0.3)), fit_motion(moving, still))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_pose_is_finite(bad: float) -> None:
    for values in ((bad, 0.0, 0.0), (0.0, bad, 0.0), (0.0, 0.0, bad)):
        with pytest.raises(ValueError, match="must be finite"):
            Pose2(*values)


@pytest.mark.parametrize("length", [1.0, 0.5, 20.0])
def test_the_heading_of_a_quaternion_does_not_depend_on_its_length(length: float) -> None:
    quaternion = np.array((0.0, 0.0, math.sin(0.4), math.cos(0.4))) * length
    assert quaternion_yaw_rad(*quaternion) == pytest.approx(0.8)


def test_roll_does_not_change_the_heading() -> None:
    # Yaw 0.8, then roll 0.3 about the turned x axis.
    yaw, roll = 0.4, 0.15
    quaternion = (
        math.cos(yaw) * math.sin(roll),
        math.sin(yaw) * math.sin(roll),
        math.sin(yaw) * math.cos(roll),
        math.cos(yaw) * math.cos(roll),
    )
    assert quaternion_yaw_rad(*quaternion) == pytest.approx(0.8)


def test_the_quaternion_0_has_no_heading() -> None:
    assert math.isnan(quaternion_yaw_rad(0.0, 0.0, 0.0, 0.0))
