"""Whether an input is well: its process lives, its clock is right, its maps can be followed."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.msg import OccupancyGrid
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Header

from slamfusion.errors import GridError
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid as Grid
from slamfusion.ros import messages, qos
from slamfusion.ros.base import TIME_JUMP, Diagnostics, NodeBase
from slamfusion.ros.input_health import AHEAD_S, DOUBT_S, KEPT, Clocks, Liveliness, MapSource
from tests.ros import tf2
from tests.ros.live import Observer

pytestmark = [pytest.mark.ros, pytest.mark.once]
DAY_S = 86400.0


class Robots:
    """Inputs that send poses ten times a second by clocks of their own."""

    def __init__(self, **ahead_s: float) -> None:
        self.ahead_s = ahead_s
        self.now_s = 1e9
        quiet = SimpleNamespace(warning=str, info=str, error=str)
        self.diagnostics = Diagnostics(quiet)
        self.clocks = Clocks(lambda: self.now_s, self.diagnostics)

    def drive(self, count: int = 20, late_s: float = 0.0) -> None:
        for _ in range(count):
            self.now_s += 0.1
            for name, ahead_s in self.ahead_s.items():
                stamp_s = self.now_s + ahead_s - late_s
                self.clocks.hear(name, "pose", stamp_s)
                self.clocks.is_too_far_ahead(name, stamp_s)

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
    robots.clocks.remove("b")
    assert robots.told() == "all is well", "it is no input any more"


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


def test_who_maps_the_same_scans_later_has_a_queue_and_no_wrong_clock() -> None:
    robots = Robots(a=0.0, c=0.0)
    stamps_s = [robots.now_s + 0.1 * count for count in range(60)]
    for robots.now_s, earlier_s in zip(stamps_s[30:], stamps_s, strict=False):
        for name, stamp_s in (("a", robots.now_s), ("b", earlier_s), ("c", robots.now_s)):
            robots.clocks.hear(name, "pose", stamp_s)
        robots.clocks.hear("a", "map", earlier_s)
    robots.ahead_s["b"] = 0.0
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
    assert robots.told() == (
        "the clock of 'b' is 500.0 s ahead of the others'; such poses are left out, and the fused "
        "map is stamped by other inputs; set the clock of its machine"
    )
    robots.clocks.forget()
    assert robots.told() == "all is well", "time jumped back"


def test_a_stamp_is_ahead_of_the_clock_and_of_all_others_or_it_is_not():
    now_s = 1e9
    tomorrow_s = now_s + DAY_S
    stamps = Robots().clocks
    # Alone it has nobody to contradict it, and within a minute nobody does.
    assert not stamps.is_too_far_ahead("a", tomorrow_s)
    assert not stamps.is_too_far_ahead("a", now_s + AHEAD_S)
    assert not stamps.is_too_far_ahead("b", now_s + AHEAD_S)
    # Two that agree are as wrong as one, where the clock is with the third.
    assert stamps.is_too_far_ahead("b", tomorrow_s)
    assert stamps.is_too_far_ahead("c", tomorrow_s)
    assert not stamps.is_too_far_ahead("a", now_s + 1.0)
    # All say the same: it is the node's clock that is behind.
    stamps.forget()
    assert not any(stamps.is_too_far_ahead(name, tomorrow_s) for name in "abcabc")
    # A clock that has not begun says nothing; a log lies behind it.
    for clock_s in (0.0, 1e9):
        stamps = Clocks(lambda clock_s=clock_s: clock_s, Diagnostics(None))
        assert not stamps.is_too_far_ahead("a", 5.0)
        assert not stamps.is_too_far_ahead("b", 5000.0)


# Writers that live, how many more do than with the last event, and how many more do not.
LIVES, SILENT, RENEWED = (1, 1, 0), (0, -1, 1), (1, 1, -1)
GIVEN_UP, ANOTHER = (0, 0, -1), (1, 1, 0)
# The lease ran out once more and was renewed, both in one event.
AGAIN = (1, 0, 0)
# The same where a writer that never gave a sign of life was taken from the living.
FEWER, FEWER_LIVES, FEWER_SILENT, FEWER_RENEWED = (-1, -1, 0), (0, 1, 0), (-1, -1, 1), (0, 1, -1)


def after(*events: tuple[int, int, int]) -> Liveliness:
    """Return what is known after events, of which one comes each tenth of a second."""
    found = Liveliness()
    for number, event in enumerate(events):
        found.take(*event, 0.1 * number)
    return found


def test_a_writer_that_falls_silent_is_dead_after_a_moment_of_doubt() -> None:
    found = after(LIVES, SILENT)
    assert not found.is_dead(0.1 + 0.9 * DOUBT_S)
    assert found.is_dead(0.1 + 1.1 * DOUBT_S)


def test_before_any_writer_nobody_is_dead() -> None:
    assert not Liveliness().is_dead(1e9)


@pytest.mark.parametrize(
    ("events", "is_back"),
    [
        ((LIVES,), False),
        ((LIVES, SILENT, RENEWED), True),
        ((LIVES, SILENT, RENEWED, AGAIN), True),
        ((LIVES, SILENT, RENEWED, SILENT, RENEWED), True),
        # The old one was given up, another one has come.
        ((LIVES, SILENT, GIVEN_UP, ANOTHER), False),
        ((LIVES, SILENT, RENEWED, SILENT, GIVEN_UP, ANOTHER), False),
        # Of one that was given up too early the count is too small from then on.
        ((FEWER, FEWER_LIVES, FEWER_SILENT, FEWER_RENEWED), True),
        ((LIVES, SILENT, FEWER, FEWER_LIVES), False),
    ],
)
def test_the_writer_that_had_fallen_silent_is_told_from_another_one(
    events: tuple[tuple[int, int, int], ...], is_back: bool
) -> None:
    found = after(*events)
    assert found.is_back == is_back
    assert not found.is_dead(1e9)


def drawn() -> OccupancyGrid:
    """A map of 5 x 4 cells, all free."""
    grid = Grid(np.zeros((4, 5), dtype=np.int8), 0.1, Pose2(1.0, 2.0, 0.3), "a")
    return messages.grid_to_message(grid, "a_map", messages.to_stamp(5.0))


def fields(x: int, y: int, cells: list[list[int]], frame: str = "a_map") -> dict[str, Any]:
    """What an update says, row by row from the lowest."""
    flat = np.array(cells, dtype=np.int8)
    return {
        "header": Header(frame_id=frame, stamp=messages.to_stamp(7.0)),
        "x": x,
        "y": y,
        "width": flat.shape[1],
        "height": flat.shape[0],
        "data": array("b", flat.tobytes()),
    }


def updated(x: int, y: int, cells: list[list[int]], **changes: Any) -> OccupancyGrid:
    said = {**fields(x, y, cells), **changes}
    return messages.updated_map(drawn(), SimpleNamespace(**said))


def test_an_update_is_put_where_it_says() -> None:
    before = drawn()
    after = messages.updated_map(before, SimpleNamespace(**fields(3, 1, [[100, -1], [7, 8]])))
    cells = np.zeros((4, 5), dtype=np.int8)
    cells[1, 3:], cells[2, 3:] = (100, -1), (7, 8)
    assert np.array_equal(messages.grid_from_message(after, "a").cells, cells)
    assert after.info == before.info
    assert messages.stamp_s(after) == 7.0
    assert not any(before.data), "the one before is somebody else's"
    corners = updated(0, 0, [[100]]), updated(4, 3, [[100]])
    assert [list(item.data).index(100) for item in corners] == [0, 19]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: updated(-1, 0, [[1]]), "column -1 and row 0 lie outside of a map of 5 x 4"),
        (lambda: updated(0, -1, [[1]]), "lie outside"),
        (lambda: updated(4, 0, [[1, 1]]), "lie outside"),
        (lambda: updated(0, 3, [[1], [1]]), "lie outside"),
        (lambda: updated(0, 0, [[1]], width=0, data=array("b")), "0 cells sent for 0 x 1 cells"),
        (lambda: updated(0, 0, [[1, 2]], width=3), "2 cells sent for 3 x 1 cells"),
        (
            lambda: updated(0, 0, [[1]], header=Header(frame_id="odom")),
            "it is in 'odom', and the map in 'a_map'",
        ),
    ],
)
def test_what_is_no_part_of_the_map_is_refused(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(GridError, match=words):
        make()


def test_a_source_follows_what_is_sent_beside_its_map(observer: Observer) -> None:
    tf2.skip_without("map_msgs")
    from map_msgs.msg import OccupancyGridUpdate  # noqa: PLC0415 - only where it was built

    context = observer.node.context
    base = NodeBase("reader", context=context)
    now_s = base.clock_s()
    clocks = Clocks(lambda: now_s, base.diagnostics)
    heard: list[OccupancyGrid] = []
    source = MapSource(
        base, "a", "a/map", 3.0, clocks, lambda _, message: heard.append(message), print
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(base.node)
    whole = observer.publisher(OccupancyGrid, "a/map", qos.MAP)
    parts = observer.publisher(OccupancyGridUpdate, "a/map_updates")

    def wait(is_done: Callable[[], Any]) -> None:
        until_s = time.monotonic() + 20.0
        while not is_done():
            assert time.monotonic() < until_s, base.diagnostics.worst()
            executor.spin_once(timeout_sec=0.1)

    def taken() -> np.ndarray:
        return source.read(heard[-1]).cells

    wait(parts.get_subscription_count)
    parts.publish(OccupancyGridUpdate(**fields(0, 0, [[100]])))
    said = "an update of the map of 'a' is left out (1 so far): it came before the first map"
    wait(lambda: said in base.diagnostics.worst()[1])
    assert not heard
    whole.publish(drawn())
    wait(lambda: heard)
    assert not taken().any()
    # One after the other, each on what the last one made.
    for column in range(3):
        parts.publish(OccupancyGridUpdate(**fields(column, 2, [[100]])))
        wait(lambda column=column: len(heard) == 2 + column)
    cells = taken()
    assert (cells == 100).sum() == 3
    assert (cells[2, :3] == 100).all()
    parts.publish(OccupancyGridUpdate(**fields(5, 0, [[100]])))
    wait(lambda: "(2 so far)" in base.diagnostics.worst()[1])
    assert len(heard) == 4
    # The whole map begins anew, and who is removed hears nothing more.
    whole.publish(drawn())
    wait(lambda: len(heard) == 5)
    assert not taken().any()
    # A map of before the clock jumped back has no wrong clock, one still ahead later has.
    late = drawn()
    base.diagnostics.note(TIME_JUMP, "time jumped back")
    assert not clocks.is_too_far_ahead("b", now_s)
    late.header.stamp = messages.to_stamp(now_s + 500.0)
    for is_named in (False, True):
        source.read(late)
        assert source.stamp_s < now_s
        clocks.look("ab")
        assert ("ahead of the clock" in base.diagnostics.worst()[1]) == is_named
        base.diagnostics.clear(TIME_JUMP)
    source.close()
    wait(lambda: not parts.get_subscription_count())
    executor.shutdown()
    base.node.destroy_node()
