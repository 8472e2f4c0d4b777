"""Robots whose clocks are off are named, and nothing more."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from slamfusion.ros.base import Diagnostics
from slamfusion.ros.clocks import KEPT, Clocks


class Log:
    """Says nothing."""

    def warning(self, text: str) -> None:
        del text

    info = error = warning


class Robots:
    """Inputs that tell poses ten times a second by clocks of their own."""

    def __init__(self, **ahead_s: float) -> None:
        self.ahead_s = ahead_s
        self.now_s = 1e9
        self.diagnostics = Diagnostics(Log())
        self.clocks = Clocks(lambda: self.now_s, self.diagnostics)

    def drive(self, count: int = 20, late_s: float = 0.0) -> None:
        for _ in range(count):
            self.now_s += 0.1
            for name, ahead_s in self.ahead_s.items():
                self.clocks.hear(name, "pose", self.now_s + ahead_s - late_s)

    def told(self) -> str:
        self.clocks.look(self.ahead_s)
        return self.diagnostics.worst("all is well")[1]


def test_a_clock_that_is_off_is_named_by_how_much_until_it_is_set() -> None:
    robots = Robots(a=-0.05, b=30.0, c=-0.1)
    robots.drive()
    assert robots.told().startswith("the clock of 'b' is 30.0 s ahead of the others';")
    assert robots.told().count("clock of") == 2, "its own, and the one to be set"
    robots.ahead_s["b"] = -12.0
    robots.drive(KEPT)
    assert robots.told().startswith(
        "the clock of 'b' is 12.0 s behind the others', or its messages come that late;"
    )
    robots.ahead_s["b"] = 0.0
    robots.drive(KEPT)
    assert robots.told() == "all is well"
    robots.ahead_s["b"] = 30.0
    robots.drive()
    robots.told()
    del robots.ahead_s["b"]
    assert robots.told() == "all is well", "it is no input any more"


def test_near_enough_is_not_named() -> None:
    robots = Robots(a=0.0, b=1.9, c=-1.9)
    robots.drive()
    assert robots.told() == "all is well"


def test_messages_that_come_late_now_and_then_tell_nothing() -> None:
    robots = Robots(a=0.0, b=0.0)
    robots.drive()
    for late_s in (5.0, 0.1, 7.0):
        robots.drive(5, late_s)
        assert robots.told() == "all is well"


def test_a_stray_stamp_is_no_clock() -> None:
    robots = Robots(a=0.0, b=0.0)
    robots.drive()
    robots.clocks.hear("b", "pose", robots.now_s + 86400.0)
    assert robots.told() == "all is well"
    robots.drive(2)
    assert robots.told() == "all is well"


def test_a_kept_map_of_long_ago_is_no_clock() -> None:
    robots = Robots(a=0.0, b=0.0)
    del robots.ahead_s["b"]
    robots.drive()
    for _ in range(20):  # sent again and again, and another one as old
        robots.clocks.hear("b", "map", robots.now_s - 600.0)
        robots.clocks.hear("b", "map", 1e9 - 600.0)
    robots.ahead_s["b"] = 0.0
    robots.clocks.look("ab")
    robots.drive(3)
    assert robots.told() == "all is well"


def test_what_most_have_is_right() -> None:
    # A log that is played without simulated time, with and without a robot that lives.
    robots = Robots(a=-1e8, b=-1e8)
    robots.drive()
    assert robots.told() == "all is well"
    robots = Robots(a=-1e8, b=0.0)
    robots.drive()
    assert "the clock of 'a' is 100000000.0 s behind" in robots.told()
    # Two and two: those that this machine agrees with.
    robots = Robots(a=30.0, b=30.0, c=0.0)
    robots.drive()
    assert "'a'" in robots.told()
    assert "'b'" in robots.told()
    assert "'c'" not in robots.told()


def test_one_alone_and_time_that_is_not_known_tell_nothing() -> None:
    robots = Robots(a=500.0)
    robots.drive()
    assert robots.told() == "all is well"
    robots = Robots(a=0.0, b=500.0)
    robots.now_s = -100.0
    robots.drive()
    assert robots.told() == "all is well"
    robots = Robots(a=0.0, b=500.0)
    robots.drive()
    robots.clocks.forget()
    assert robots.told() == "all is well"


def test_who_is_not_to_be_compared_any_more_is_not_named() -> None:
    robots = Robots(a=0.0, b=500.0)
    robots.drive()
    assert "the clock of 'b' is 500.0 s ahead" in robots.told()
    del robots.ahead_s["a"]
    assert robots.told() == "all is well", "b is alone"
    robots = Robots(a=0.0, b=500.0)
    robots.drive()
    robots.told()
    robots.clocks.forget()
    assert robots.told() == "all is well", "time jumped back"
