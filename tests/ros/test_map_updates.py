"""Parts of maps that changed, as costmaps and some SLAMs send them, make whole maps here."""

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
from slamfusion.ros.base import NodeBase
from slamfusion.ros.clocks import Clocks
from slamfusion.ros.map_source import MapSource
from slamfusion.ros.stamps import Stamps
from tests.ros import tf2
from tests.ros.live import Observer

pytestmark = [pytest.mark.ros, pytest.mark.once]


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
    clocks = Clocks(base.clock_s, base.diagnostics)
    heard: list[None] = []
    source = MapSource(
        base, "a", "a/map", 3.0, Stamps(base.clock_s), clocks, lambda: heard.append(None), print
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
        found = source.take()
        assert found is not None
        return messages.grid_from_message(found[0], "a").cells

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
    source.close()
    wait(lambda: not parts.get_subscription_count())
    executor.shutdown()
    base.node.destroy_node()
