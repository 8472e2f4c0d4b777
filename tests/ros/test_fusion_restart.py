"""A fusion that is killed goes on in its frame; a state that cannot be used is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.msg import OccupancyGrid
from std_srvs.srv import Trigger

from slamfusion.fusion.live.state import LiveState
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid as Grid
from slamfusion.ros import messages, qos
from slamfusion.vote.lattice import Lattice
from tests.fusion.live.maps import assert_same_lattice, share_standing, three, touched
from tests.ros.fused import Makers, start_fusion
from tests.ros.live import Observer, Processes, values

pytestmark = pytest.mark.ros

FUSION = "fusion: fusion"


def test_a_killed_fusion_goes_on_in_its_frame(
    processes: Processes, observer: Observer, tmp_path: Path
):
    path = tmp_path / "fusion.state"
    makers = Makers(observer)
    first = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    node = start_fusion(processes, state_path=str(path))
    makers.send_all()
    observer.wait_status(FUSION, "all 3 inputs vote")
    makers.send(touched(three()["b"], 1))
    observer.wait(lambda: first and abs(messages.stamp_s(first[-1]) - makers.stamp_s) < 1e-6)
    before = first[-1]

    def is_kept() -> bool:
        stamp_s = makers.stamp_s
        return path.exists() and LiveState.from_bytes(path.read_bytes()).stamp_s == stamp_s

    observer.wait(is_kept, what="the state of the last map")
    node.kill()
    assert [item.name for item in tmp_path.iterdir() if "fusion.state" in item.name] == [path.name]

    # No input is there: the last map comes at once, and says that nobody has confirmed it.
    for name in "abc":
        makers.stop(name)
    observer.statuses().clear()
    heard = observer.collect(OccupancyGrid, "fused/map", qos.MAP)
    node = start_fusion(processes, state_path=str(path))
    observer.wait(lambda: heard, what="the kept map")
    assert heard[0] == before
    status = observer.wait_status(FUSION, f"restored from '{path}' of", "no input confirmed yet")
    assert status.level == b"\x01"
    observer.wait_status("fusion: input a", "no map on '/a/map' yet")

    # The inputs come: tried where they lay, so nothing is searched and no cell moves.
    for name in "abc":
        makers.start(name)
    grids = {**three(), "b": touched(three()["b"], 1)}
    for grid in grids.values():
        makers.send(grid)
    observer.wait_status(FUSION, "all 3 inputs vote")
    # Maps of the first two that came may go out before.
    observer.wait(lambda: heard[-1].data == before.data, what="the same map")
    observer.wait(lambda: abs(messages.stamp_s(heard[-1]) - makers.stamp_s) < 1e-6)
    assert values(observer.statuses()[FUSION])["full searches"] == "0"
    assert heard[-1].info.origin == before.info.origin
    assert heard[-1].data == before.data
    for message in heard:
        grid = messages.grid_from_message(message, "fused")
        assert_same_lattice(messages.grid_from_message(before, "fused"), grid)
        assert share_standing(messages.grid_from_message(before, "fused"), grid) > 0.99

    # A new frame is begun when asked for; the log says so and the file follows.
    answer = observer.call(Trigger, "reset", Trigger.Request())
    assert answer.success
    observer.wait(lambda: "reset was called" in node.text(), what="the word of it in the log")
    observer.wait(lambda: values(observer.statuses()[FUSION])["resets"] == "1")
    observer.wait_status(FUSION, "all 3 inputs vote")
    assert node.interrupt() == 0
    kept = LiveState.from_bytes(path.read_bytes())
    assert {*kept.transforms} == {*"abc"}
    assert "Traceback" not in node.text()


def test_a_state_that_cannot_be_used_is_named_and_never_written_over(
    processes: Processes, observer: Observer, tmp_path: Path
):
    makers = Makers(observer)
    makers.send_all()
    damaged, absent = tmp_path / "damaged", tmp_path / "absent"
    whole = bytearray(a_state().to_bytes())
    whole[-1] ^= 1
    damaged.write_bytes(whole)
    start_fusion(processes, state_path=str(damaged))
    nowhere = start_fusion(processes, "-r", "__node:=third", state_path=str(absent / "state"))
    observer.wait_status(FUSION, "all 3 inputs vote", "digest", "a new fused frame starts")
    observer.wait(damaged.exists, what="the new state")
    assert (tmp_path / "damaged.unusable").read_bytes() == whole
    assert nowhere.wait() == 1
    assert f"there is no folder {absent}" in nowhere.text()
    assert "Traceback" not in nowhere.text()
    assert not absent.exists()


def a_state() -> LiveState:
    """A frame with a map of two walls that nothing else looks like."""
    cells = np.zeros((50, 50), dtype=np.int8)
    cells[5:45, 7] = cells[40, 3:49] = 100
    place = Pose2(1.0, 2.0, 0.3)
    fused, agreement = (Grid(own, 0.05, place) for own in (cells, np.full_like(cells, 100)))
    return LiveState(Lattice(0.05, place), fused, agreement, dict.fromkeys("abc", place), "a")
