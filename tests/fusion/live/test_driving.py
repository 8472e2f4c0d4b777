"""A robot drives along a path by the fused frame, while corrections come."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np
import pytest

from slamfusion.fusion.live.driving import OdomFrame
from slamfusion.geometry import F64, Pose2, interpolate_poses, wrap_angle
from tests.slam.drives import true_poses

SPEED, M_S, RAD_S = 0.4, 0.2, 0.2
PERIOD_S, SCAN_S, LATE = 0.05, 0.2, 2
AHEAD_M = 0.4


def planned() -> F64:
    """Return the way through the drawn flat as points 1 cm apart, (N, 2)."""
    marks = np.array([(pose.x, pose.y, pose.yaw_rad) for pose in true_poses(220)])
    along = np.r_[0.0, np.cumsum(np.hypot(*np.diff(marks[:, :2], axis=0).T))]
    return interpolate_poses(np.arange(0.0, along[-1], 0.01), along, marks)[:, :2]


class Follower:
    """Pure pursuit by fused_map -> odom and odometry that drifts; a SLAM is late and errs.

    ``wrong`` gives the error of its poses at a time: metres across the map and radians.
    """

    def __init__(
        self, wrong: Callable[[float], Pose2], speeds: tuple[float, float], drift: float = 1.0
    ) -> None:
        self.way, self.wrong, self.speeds, self.drift = planned(), wrong, speeds, drift
        dx, dy = self.way[20] - self.way[0]
        self.truth = Pose2(float(self.way[0, 0]), float(self.way[0, 1]), math.atan2(dy, dx))
        self.odometry = Pose2(-40.0, 25.0, 2.0)
        self.frame = OdomFrame()
        self.now_s = 100.0
        self.waiting: deque[tuple[float, Pose2, Pose2]] = deque()
        self.off_m: list[float] = []
        self.jumps: list[tuple[float, float]] = []

    def drive(self) -> Follower:
        at, before, count = 0, None, 0
        while at < len(self.way) - 5:
            if count % round(SCAN_S / PERIOD_S) == 0:
                pose = self.wrong(self.now_s - 100.0).compose(self.truth)
                self.waiting.append((self.now_s, pose, self.odometry))
                if len(self.waiting) > LATE or not count:
                    self.frame.correct(*self.waiting.popleft())
            moved = self.frame.move(self.now_s, self.odometry, *self.speeds)
            here = moved.compose(self.odometry)
            if before is not None:
                jump = before.compose(self.odometry).inverse().compose(here)
                self.jumps.append((math.hypot(jump.x, jump.y), abs(jump.yaw_rad)))
            before = moved
            near = np.hypot(*(self.way[at : at + 150] - (here.x, here.y)).T)
            at += int(near.argmin())
            goal = self.way[min(at + round(AHEAD_M / 0.01), len(self.way) - 1)]
            bearing = math.atan2(goal[1] - here.y, goal[0] - here.x) - here.yaw_rad
            turn = 2.0 * SPEED * math.sin(wrap_angle(bearing)) / AHEAD_M
            self.step(SPEED * PERIOD_S, max(-2.0, min(2.0, turn)) * PERIOD_S)
            self.off_m.append(float(np.hypot(*(self.way - (self.truth.x, self.truth.y)).T).min()))
            self.now_s += PERIOD_S
            count += 1
            assert count < 2000, "the robot does not arrive"
        return self

    def step(self, forward_m: float, turn_rad: float) -> None:
        self.truth = self.truth.compose(Pose2(forward_m, 0.0, turn_rad))
        # Odometry that reads 4 % too long and turns 1.5 degrees a second too far.
        turned = turn_rad + 0.025 * self.drift * PERIOD_S
        drift = Pose2((1.0 + 0.04 * self.drift) * forward_m, 0.0, turned)
        self.odometry = self.odometry.compose(drift)


def tuple_of(pose: Pose2) -> tuple[float, float, float]:
    return pose.x, pose.y, pose.yaw_rad


def right(_: float) -> Pose2:
    return Pose2()


def closes_loops(time_s: float) -> Pose2:
    """Return the error of a SLAM that drifts away by 0.25 m in 8 s and then closes a loop."""
    share = time_s % 8.0 / 8.0
    return Pose2(0.15 * share, 0.2 * share, 0.02 * share)


@pytest.mark.parametrize(("wrong", "within_m"), [(right, 0.05), (closes_loops, 0.1)])
def test_a_robot_follows_its_path_and_its_pose_never_jumps(
    wrong: Callable[[float], Pose2], within_m: float
) -> None:
    found = Follower(wrong, (M_S, RAD_S)).drive()
    # As near as with perfect odometry, but for the error of the SLAM itself.
    assert max(found.off_m) < max(Follower(right, (M_S, RAD_S), 0.0).drive().off_m) + within_m
    metres, turns = np.array(found.jumps).T
    assert metres.max() <= M_S * PERIOD_S + 1e-9
    assert turns.max() <= RAD_S * PERIOD_S + 1e-9
    # Without a limit the same corrections make it jump.
    at_once = Follower(wrong, (1e3, 1e3)).drive()
    if wrong is closes_loops:
        assert max(metres for metres, _ in at_once.jumps) > 0.2


def test_a_turn_far_from_the_origin_of_the_odometry_moves_the_robot_little() -> None:
    frame, odometry = OdomFrame(), Pose2(300.0, 0.0, 0.0)
    frame.correct(0.0, Pose2(1.0, 1.0, 0.0), odometry)
    assert frame.move(0.0, odometry, M_S, RAD_S) is not None
    frame.correct(0.1, Pose2(1.0, 1.0, 0.1), odometry)
    moved = frame.move(0.1, odometry, M_S, RAD_S)
    assert tuple_of(moved.compose(odometry)) == pytest.approx((1.0, 1.0, 0.02))


def test_no_stamp_comes_twice() -> None:
    frame = OdomFrame()
    assert frame.move(0.0, Pose2(), M_S, RAD_S) is None
    frame.correct(1.0, Pose2(2.0, 0.0, 0.0), Pose2())
    assert frame.move(1.0, Pose2(), M_S, RAD_S) == Pose2(2.0, 0.0, 0.0)
    assert frame.move(1.0, Pose2(0.1, 0.0, 0.0), M_S, RAD_S) is None
    assert frame.move(0.9, Pose2(0.1, 0.0, 0.0), M_S, RAD_S) is None
    assert frame.move(10.9, Pose2(3.0, 0.0, 0.0), M_S, RAD_S) == Pose2(2.0, 0.0, 0.0)


@pytest.mark.parametrize("step", [Pose2(0.04, 0.0, 0.0), Pose2(0.0, 0.0, 0.05)])
def test_without_poses_a_robot_at_rest_keeps_its_place_and_one_that_drives_loses_it(
    step: Pose2,
) -> None:
    frame, odometry, rng = OdomFrame(), Pose2(4.0, 2.0, 1.0), np.random.default_rng(1)
    frame.correct(0.0, Pose2(2.0, 0.0, 0.0), odometry)
    here = pytest.approx(tuple_of(frame.transform))
    for number in range(1, 6001):  # ten minutes, with the noise of odometry at rest
        noise = Pose2(*rng.normal(0.0, (0.01, 0.01, 0.005)).tolist())
        moved = frame.move(0.1 * number, odometry.compose(noise), M_S, RAD_S)
        assert tuple_of(moved) == here
    count = 6000
    while frame.move(0.1 * (count := count + 1), odometry, M_S, RAD_S) is not None:
        odometry = odometry.compose(step)
    assert frame.is_too_far
    assert 100 < count - 6000 < 140  # 5 m, or a whole turn
    frame.correct(0.1 * count, Pose2(2.0, 0.0, 0.0), odometry)
    assert frame.move(0.1 * (count + 1), odometry, M_S, RAD_S) is not None


def test_odometry_that_starts_again_at_its_origin_does_not_move_the_robot() -> None:
    frame, odometry = OdomFrame(), Pose2(20.0, 3.0, 1.0)
    frame.correct(0.0, Pose2(1.0, 2.0, 0.5), odometry)
    frame.move(0.0, odometry, M_S, RAD_S)
    for number in range(3):
        moved = frame.move(0.1 + 0.1 * number, Pose2(), M_S, RAD_S)
        assert tuple_of(moved.compose(Pose2())) == pytest.approx((1.0, 2.0, 0.5))
    # Its last pose is revised by as much as if the origin had stayed.
    assert frame.posed[0] == 0.0
    assert tuple_of(frame.posed[1]) == pytest.approx((0.0, 0.0, 0.0))
