"""Poses of inputs: who tracks one robot, who contradicts whom, on both sides of each threshold."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.fusion.live.poses import APART_M, APART_RAD, APART_S, LINK_M, PoseWatch
from slamfusion.geometry import Pose2

FRAMES = {
    "a": Pose2(),
    "b": Pose2(5.0, -3.0, 1.0),
    "c": Pose2(-20.0, 7.0, -2.2),
    "d": Pose2(1.0, 1.0, 0.1),
}
STEP_S, SPEED = 0.5, 0.5


class Robot:
    """Drives along x in the fused frame while some inputs tell where it is."""

    def __init__(self, names: str) -> None:
        self.watch = PoseWatch()
        self.names = names
        self.watch.place({name: FRAMES[name] for name in names})
        self.stamp_s = 100.0
        self.x = 0.0

    def tell(self, name: str, pose: Pose2, stamp_s: float | None = None) -> None:
        away = FRAMES[name].inverse().compose(pose)
        self.watch.hear(name, self.stamp_s if stamp_s is None else stamp_s, away)

    def drive(self, seconds: float, speed: float = SPEED, **off: tuple[float, float]) -> None:
        """Drive; ``off`` says who is how many metres aside and radians turned."""
        for _ in range(round(seconds / STEP_S)):
            self.stamp_s += STEP_S
            self.x += speed * STEP_S
            for name in self.names:
                aside, turn = off.get(name, (0.0, 0.0))
                self.tell(name, Pose2(self.x, aside, turn))

    def together(self) -> Robot:
        self.drive(2.0 * LINK_M / SPEED)
        assert not self.watch.contradictions()
        return self

    def wrong(self) -> str:
        return "".join(sorted(self.watch.contradictions()))


def sides(limit: float) -> Iterable[tuple[float, bool]]:
    """Values a little below and above a limit, and whether they exceed it."""
    return ((0.99 * limit, False), (1.01 * limit, True))


@pytest.mark.parametrize(("away", "is_wrong"), sides(APART_M))
def test_the_odd_one_of_three_contradicts_beyond_the_distance(away: float, is_wrong: bool) -> None:
    robot = Robot("abc").together()
    robot.drive(APART_S + 1.0, b=(away, 0.0))
    assert robot.wrong() == ("b" if is_wrong else "")


@pytest.mark.parametrize(("turn", "is_wrong"), sides(APART_RAD))
def test_the_odd_one_of_three_contradicts_beyond_the_turn(turn: float, is_wrong: bool) -> None:
    robot = Robot("abc").together()
    robot.drive(APART_S + 1.0, c=(0.0, turn))
    assert robot.wrong() == ("c" if is_wrong else "")


def test_a_contradiction_takes_its_time_without_a_break_and_so_does_its_end() -> None:
    robot = Robot("abc").together()
    robot.drive(APART_S, b=(7.0, 0.0))
    assert robot.wrong() == ""
    robot.drive(STEP_S)
    robot.drive(APART_S, b=(7.0, 0.0))
    assert robot.wrong() == "", "one pose that agreed was a break"
    robot.drive(STEP_S, b=(7.0, 0.0))
    assert robot.wrong() == "b"
    assert "of a, c: 7.0 m and 0 degrees apart" in robot.watch.contradictions()["b"]
    robot.drive(APART_S)
    assert robot.wrong() == "b"
    robot.drive(STEP_S)
    assert robot.wrong() == ""


@pytest.mark.parametrize(
    ("names", "off", "wrong"),
    [
        ("ab", {"b": 7.0}, "ab"),
        ("abc", {"b": 7.0, "c": 20.0}, "abc"),
        ("abcd", {"d": 7.0}, "d"),
        ("abcd", {"c": 7.0, "d": 7.0}, "abcd"),
        ("abcd", {"c": 7.0, "d": 20.0}, "cd"),
        # Both are within reach of the one in the middle, which contradicts nobody.
        ("abc", {"a": -0.6, "b": 0.6}, "ab"),
    ],
)
def test_who_is_apart_from_most_is_wrong_and_among_equals_all_are(
    names: str, off: dict[str, float], wrong: str
) -> None:
    robot = Robot(names).together()
    robot.drive(5.0, **{name: (away, 0.0) for name, away in off.items()})
    assert robot.wrong() == wrong


def test_who_is_not_believed_is_not_counted() -> None:
    robot = Robot("ab").together()
    robot.drive(5.0, b=(7.0, 0.0))
    assert robot.wrong() == "ab"
    robot.watch.place({"a": FRAMES["a"]})
    assert robot.wrong() == ""
    # It was aligned again: what it said before counts no more, but that it is the same robot does.
    robot.watch.place({name: FRAMES[name] for name in "ab"})
    assert robot.wrong() == ""
    robot.drive(5.0, b=(7.0, 0.0))
    assert robot.wrong() == "ab"


# -- two robots ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("metres", "is_one"), [(LINK_M - 0.3, False), (LINK_M + 0.6, True)])
def test_two_that_met_for_less_than_a_way_are_two_robots(metres: float, is_one: bool) -> None:
    robot = Robot("ab")
    robot.drive(metres / SPEED)
    robot.drive(20.0, b=(9.0, 0.0))
    assert (robot.wrong() == "ab") == is_one
    # Standing still in one place, as two robots may in two maps that were laid over each other.
    robot = Robot("ab")
    robot.drive(100.0, speed=0.0)
    robot.drive(20.0, b=(9.0, 0.0))
    assert robot.wrong() == ""


def test_poses_of_other_stamps_are_never_compared() -> None:
    robot = Robot("a")
    robot.watch.place({name: FRAMES[name] for name in "ab"})
    for away in (0.0, 9.0):
        for _ in range(40):
            robot.stamp_s += STEP_S
            robot.x += SPEED * STEP_S
            robot.tell("a", Pose2(robot.x, 0.0, 0.0))
            robot.tell("b", Pose2(robot.x, away, 0.0), robot.stamp_s + 0.1)
    assert robot.wrong() == ""


# -- what comes late, twice, or from another time --------------------------------------------------


def test_a_slow_one_is_compared_at_its_own_stamps() -> None:
    robot = Robot("a")
    robot.watch.place({name: FRAMES[name] for name in "ab"})
    late: list[tuple[float, float]] = []
    for step in range(80):
        robot.stamp_s += STEP_S
        robot.x += SPEED * STEP_S
        robot.tell("a", Pose2(robot.x, 0.0, 0.0))
        late.append((robot.stamp_s, robot.x))
        if step >= 8:
            stamp_s, x = late[step - 8]
            robot.tell("b", Pose2(x, 7.0 if step > 60 else 0.0, 0.0), stamp_s)
        if step == 60:
            assert robot.wrong() == ""
    assert robot.wrong() == "ab"


def test_a_time_that_goes_back_is_no_contradiction_of_its_own() -> None:
    robot = Robot("abc").together()
    robot.drive(2.0, b=(7.0, 0.0))
    robot.stamp_s = 0.0
    robot.drive(2.0, b=(7.0, 0.0))
    assert robot.wrong() == ""
    robot.drive(2.0, b=(7.0, 0.0))
    assert robot.wrong() == "b"


@given(aways=st.lists(st.floats(0.0, 3.0), min_size=1, max_size=12), more=st.floats(0.0, 5.0))
def test_what_is_farther_apart_is_never_sooner_forgiven(aways: list[float], more: float) -> None:
    near, far = Robot("ab").together(), Robot("ab").together()
    for away in aways:
        near.drive(STEP_S, b=(away, 0.0))
        far.drive(STEP_S, b=(away + more, 0.0))
        assert bool(near.wrong()) <= bool(far.wrong())


def test_the_covariance_is_the_spread_of_the_voters_poses() -> None:
    robot, noise = Robot("abc"), np.random.default_rng(3)
    alone = robot.watch.covariance("a", "a", 100.0)
    assert np.diag(alone) == pytest.approx((APART_M**2, APART_M**2, APART_RAD**2))
    deviations = np.array((0.1, 0.2, 0.03))
    for number in range(300):
        stamp_s = 100.0 + 0.03 * number
        for name in "ba":  # the leader comes last
            error = noise.normal(0.0, deviations) if name == "b" else np.zeros(3)
            robot.tell(name, Pose2(*(np.array((1.0, 2.0, 3.1)) + error).tolist()), stamp_s)
        robot.tell("c", Pose2(9.0, 9.0, 0.0), stamp_s)
    found = np.sqrt(np.diag(robot.watch.covariance("a", "ab", 109.0)))
    assert found == pytest.approx(np.hypot(deviations, (0.025, 0.025, 0.01)), rel=0.25)
    assert robot.watch.covariance("a", "abc", 109.0)[0, 0] > 10.0, "another voter"
    # Differences of long ago say nothing of now.
    assert np.array_equal(robot.watch.covariance("a", "ab", 140.0), alone)
