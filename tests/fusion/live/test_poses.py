"""Poses of inputs: who tracks one robot, who contradicts whom, on both sides of each threshold."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.config import LiveConfig
from slamfusion.fusion.live.poses import LINK_M, LINK_SHARE, RETURN_SHARE, PoseWatch
from slamfusion.geometry import Pose2, wrap_angle

LIVE = LiveConfig()
FRAMES = {
    "a": Pose2(),
    "b": Pose2(5.0, -3.0, 1.0),
    "c": Pose2(-20.0, 7.0, -2.2),
    "d": Pose2(1.0, 1.0, 0.1),
}
STEP_S, SPEED = 0.5, 0.5


class Robot:
    """Drives along x in the fused frame while some inputs tell where it is."""

    def __init__(self, names: str, live: LiveConfig = LIVE) -> None:
        self.watch = PoseWatch(live)
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


@pytest.mark.parametrize(("away", "is_wrong"), sides(LIVE.pose_apart_m))
def test_the_odd_one_of_three_contradicts_beyond_the_distance(away: float, is_wrong: bool) -> None:
    robot = Robot("abc").together()
    robot.drive(LIVE.pose_apart_s + 1.0, b=(away, 0.0))
    assert robot.wrong() == ("b" if is_wrong else "")


@pytest.mark.parametrize(("turn", "is_wrong"), sides(LIVE.pose_apart_rad))
def test_the_odd_one_of_three_contradicts_beyond_the_turn(turn: float, is_wrong: bool) -> None:
    robot = Robot("abc").together()
    robot.drive(LIVE.pose_apart_s + 1.0, c=(0.0, turn))
    assert robot.wrong() == ("c" if is_wrong else "")


def test_a_contradiction_takes_its_time_without_a_break_and_so_does_its_end() -> None:
    robot = Robot("abc").together()
    robot.drive(LIVE.pose_apart_s, b=(7.0, 0.0))
    assert robot.wrong() == ""
    robot.drive(STEP_S)
    robot.drive(LIVE.pose_apart_s, b=(7.0, 0.0))
    assert robot.wrong() == "", "one pose that agreed was a break"
    robot.drive(STEP_S, b=(7.0, 0.0))
    assert robot.wrong() == "b"
    assert "of a, c: 7.0 m and 0 degrees apart" in robot.watch.contradictions()["b"]
    robot.drive(LIVE.pose_apart_s)
    assert robot.wrong() == "b"
    robot.drive(STEP_S)
    assert robot.wrong() == ""


@pytest.mark.parametrize(("away", "stays"), sides(RETURN_SHARE * LIVE.pose_apart_m))
def test_who_contradicted_must_come_nearer_than_it_went(away: float, stays: bool) -> None:
    robot = Robot("abc").together()
    robot.drive(5.0, b=(2.0, 0.0))
    robot.drive(5.0, b=(away, 0.0))
    assert robot.wrong() == ("b" if stays else "")


def test_the_limits_are_settings() -> None:
    live = replace(LIVE, pose_apart_m=4.0, pose_apart_s=1.0)
    robot = Robot("abc", live).together()
    robot.drive(5.0, b=(3.9, 0.0))
    assert robot.wrong() == ""
    robot.drive(1.5, b=(4.1, 0.0))
    assert robot.wrong() == "b"


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


@pytest.mark.parametrize(("share", "restarts"), sides(LINK_SHARE))
def test_a_transform_that_moves_begins_again_and_one_that_creeps_does_not(
    share: float, restarts: bool
) -> None:
    robot = Robot("ab").together()
    robot.drive(5.0, b=(7.0, 0.0))
    moved = Pose2(share * LIVE.pose_apart_m, 0.0, 0.0).compose(FRAMES["b"])
    robot.watch.place({"a": FRAMES["a"], "b": moved})
    assert robot.wrong() == ("" if restarts else "ab")


# -- two robots ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("share", "is_one"), [(0.9, True), (1.1, False)])
def test_two_that_never_drove_together_are_two_robots(share: float, is_one: bool) -> None:
    robot = Robot("ab")
    # Side by side, as near as the robots' bodies allow, with equal stamps.
    robot.drive(60.0, b=(share * LINK_SHARE * LIVE.pose_apart_m, 0.0))
    robot.drive(60.0, b=(9.0, 0.0))
    assert (robot.wrong() == "ab") == is_one


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


def test_what_is_kept_of_poses_is_bounded() -> None:
    robot = Robot("ab").together()
    robot.drive(1000.0)
    assert all(len(poses) <= 512 for poses in robot.watch._poses.values())


@pytest.mark.parametrize("turn", [lambda yaw: yaw, lambda yaw: yaw + 2.0 * math.pi])
def test_turns_are_compared_round_the_circle(turn: Callable[[float], float]) -> None:
    robot = Robot("abc").together()
    robot.drive(5.0, b=(0.0, turn(0.0)))
    assert robot.wrong() == ""


# -- to the last digit -----------------------------------------------------------------------------

# Limits that are powers of two, and frames that are the fused one: nothing is rounded.
EXACT = replace(LIVE, pose_apart_m=1.0, pose_apart_rad=0.5, pose_apart_s=2.0)
STILL = Pose2()


class Two:
    """Two inputs, both in the fused frame, that tell their poses once a second."""

    def __init__(self, live: LiveConfig = EXACT, names: str = "ab") -> None:
        self.watch = PoseWatch(live)
        self.watch.place(dict.fromkeys(names, STILL))
        self.names = names
        self.stamp_s = 0.0
        self.x = 0.0

    def tell(self, *places: Pose2, step_s: float = 1.0) -> Two:
        self.stamp_s += step_s
        for name, pose in zip(self.names, places, strict=True):
            self.watch.hear(name, self.stamp_s, pose)
        return self

    def beside(self, away_m: float, count: int = 1, turn_rad: float = 0.0) -> Two:
        for _ in range(count):
            self.tell(Pose2(self.x), Pose2(self.x, away_m, turn_rad))
        return self

    def drive(self, metres: float, away_m: float = 0.0) -> Two:
        """Drive with the second input so far beside the first."""
        self.x += metres
        return self.beside(away_m)

    def linked(self) -> Two:
        self.beside(0.0).drive(2.0)
        return self

    @property
    def is_wrong(self) -> bool:
        return bool(self.watch.contradictions())


@pytest.mark.parametrize(
    ("metres", "is_one"), [(1.85, False), (1.99, False), (2.0, True), (2.15, True)]
)
def test_two_metres_together_make_one_robot(metres: float, is_one: bool) -> None:
    two = Two().beside(0.0).drive(metres / 2).drive(metres / 2).beside(9.0, 4)
    assert two.is_wrong is is_one


@pytest.mark.parametrize(("away", "is_one"), [(0.29, True), (0.3, True), (0.31, False)])
def test_together_is_within_three_tenths_of_the_limit(away: float, is_one: bool) -> None:
    assert Two().beside(away).drive(2.5, away).beside(9.0, 4).is_wrong is is_one
    # A single pose apart begins the way again, from nothing.
    two = Two().beside(0.0).drive(1.5).drive(0.0, 0.4).drive(0.0).drive(1.95).beside(9.0, 4)
    assert not two.is_wrong


@pytest.mark.parametrize(
    ("away", "turn", "is_wrong"),
    [
        (0.95, 0.0, False),
        (1.0, 0.0, False),
        (1.05, 0.0, True),
        (0.0, 0.48, False),
        (0.0, 0.52, True),
        (0.9, 0.4, False),
    ],
)
def test_apart_is_beyond_either_limit(away: float, turn: float, is_wrong: bool) -> None:
    assert Two().linked().beside(away, 4, turn).is_wrong is is_wrong


@pytest.mark.parametrize(("seconds", "is_wrong"), [(0, False), (1, False), (2, True), (3, True)])
def test_apart_for_its_time_and_no_less(seconds: int, is_wrong: bool) -> None:
    two = Two().linked().beside(9.0, 1 + seconds)
    assert two.is_wrong is is_wrong
    # And so long together again.
    if is_wrong:
        assert two.beside(0.0, seconds).is_wrong is (seconds < 3)
        assert not two.beside(0.0).is_wrong


@pytest.mark.parametrize(
    ("away", "stays"), [(0.65, False), (0.7, False), (0.71, True), (0.75, True)]
)
def test_back_is_within_seven_tenths(away: float, stays: bool) -> None:
    assert Two().linked().beside(9.0, 3).beside(away, 3).is_wrong is stays


@pytest.mark.parametrize(("back_s", "is_compared"), [(0.95, False), (1.0, False), (1.05, True)])
def test_stamps_that_go_back_by_more_than_a_second_are_another_time(
    back_s: float, is_compared: bool
) -> None:
    two = Two().linked().beside(9.0, 3)
    newest_s = two.stamp_s
    two.tell(STILL, STILL, step_s=-back_s)
    # Too old to be compared, or a time of its own.
    kept_s = two.watch._pairs["a", "b"].newest_s
    assert kept_s == (two.stamp_s if is_compared else newest_s)


def test_a_stamp_is_compared_once() -> None:
    two = Two().linked()
    two.beside(9.0)
    since_s = two.watch._pairs["a", "b"].changing_s
    # The same stamp again, now together: what was said of it stands.
    two.stamp_s -= 1.0
    two.beside(0.0)
    assert two.watch._pairs["a", "b"].changing_s == since_s is not None


@pytest.mark.parametrize(("apart_s", "is_one"), [(0.0004, True), (0.00055, False), (0.001, False)])
def test_stamps_of_one_millisecond_are_one(apart_s: float, is_one: bool) -> None:
    watch = PoseWatch(EXACT)
    watch.place({"a": STILL, "b": STILL})
    for second in range(50, 60):
        watch.hear("a", float(second), STILL)
        watch.hear("b", second + apart_s, STILL)
    assert bool(watch._pairs) is is_one


def test_poses_are_kept_for_slower_ones_until_there_are_many() -> None:
    for count, is_kept in ((512, True), (513, False)):
        watch = PoseWatch(EXACT)
        watch.place({"a": STILL, "b": STILL})
        for second in range(count):
            watch.hear("a", float(second), STILL)
        watch.hear("b", 0.0, STILL)
        assert bool(watch._pairs) is is_kept, "the oldest goes"
        watch.hear("b", float(count - 1), STILL)
        assert watch._pairs


def test_who_is_told_first_is_the_first_of_the_pair_by_name() -> None:
    for order in (("a", "b"), ("b", "a")):
        two = Two(names="".join(order))
        far = {"a": 0.0, "b": 0.25}
        for x in (0.0, 1.0):
            two.tell(*(Pose2(x, far[name]) for name in order))
        assert two.watch._pairs["a", "b"].last == Pose2(1.0, 0.0)


@pytest.mark.parametrize(
    ("moved", "restarts"),
    [
        (Pose2(0.3), False),
        (Pose2(0.301), True),
        (Pose2(0.0, 0.0, 0.149), False),
        (Pose2(0.0, 0.0, 0.151), True),
        (Pose2(0.2, 0.0, 0.1), False),
    ],
)
def test_an_input_laid_elsewhere_begins_again(moved: Pose2, restarts: bool) -> None:
    two = Two().linked()
    two.x = 0.0
    two.beside(9.0, 3)
    assert two.is_wrong
    # The newest pose of the first is at the origin: it moves as the frame does.
    two.watch.place({"a": moved, "b": STILL})
    assert two.is_wrong is not restarts
    if restarts:
        pair = two.watch._pairs["a", "b"]
        assert (pair.is_linked, pair.together_m, pair.changing_s) == (True, 0.0, None)
    # One that has not told a pose since was not moved anywhere.
    if restarts:
        two.watch.place({"a": Pose2(5.0), "b": STILL})
        assert "a" not in two.watch._poses


def test_the_limits_of_a_move_are_met_to_the_digit() -> None:
    for live, moved in (
        (replace(EXACT, pose_apart_m=2.5), Pose2(LINK_SHARE * 2.5)),
        (replace(EXACT, pose_apart_rad=0.5), Pose2(0.0, 0.0, 0.25)),
    ):
        two = Two(live).linked()
        two.x = 0.0
        two.beside(0.0)
        if moved.yaw_rad:
            turn = abs(wrap_angle(wrap_angle(moved.yaw_rad)))
            two.watch.live = replace(live, pose_apart_rad=turn / LINK_SHARE)
            assert LINK_SHARE * two.watch.live.pose_apart_rad == turn
        assert not two.watch._is_moved("a", STILL, moved)
        smaller = replace(two.watch.live, pose_apart_m=2.49 if moved.x else 9.0, pose_apart_rad=0.8)
        two.watch.live = smaller
        assert two.watch._is_moved("a", STILL, moved)


def test_a_limit_of_nothing_is_exceeded_by_anything() -> None:
    live = replace(EXACT, pose_apart_m=0.0)
    # Together to the last digit they are linked, and apart by the least.
    assert not Two(live).linked().beside(0.0, 4).is_wrong
    assert Two(live).linked().beside(1e-9, 4).is_wrong
    # A small limit is one all the same: half of it is within.
    live = replace(EXACT, pose_apart_m=0.0625)
    assert not Two(live).linked().beside(0.03125, 4).is_wrong
    assert Two(live).linked().beside(0.07, 4).is_wrong


def test_an_unlinked_pair_and_one_that_is_placed_no_more_say_nothing() -> None:
    assert not Two().beside(9.0, 9).is_wrong
    two = Two().linked().beside(9.0, 3)
    reason = two.watch.contradictions()["b"]
    assert reason == "its poses contradict those of a: 9.0 m and 0 degrees apart"


@given(
    aways=st.lists(st.floats(0.0, 3.0), min_size=1, max_size=12),
    more=st.floats(0.0, 5.0),
)
def test_what_is_farther_apart_is_never_sooner_forgiven(aways: list[float], more: float) -> None:
    near, far = Two().linked(), Two().linked()
    for away in aways:
        assert near.beside(away).is_wrong <= far.beside(away + more).is_wrong
