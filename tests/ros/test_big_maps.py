"""Maps of 16 MB between processes, over each transport that the README names."""

from __future__ import annotations

import sys

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from nav_msgs.msg import OccupancyGrid

from slamfusion.ros import messages, qos
from tests.cli.command import ROOT
from tests.ros.big_map_writer import big_map
from tests.ros.live import Observer, Processes

pytestmark = pytest.mark.ros


@pytest.mark.parametrize("transport", ["DEFAULT", "UDPv4", "LARGE_DATA"])
def test_who_comes_late_gets_a_map_of_16_mb(
    transport: str, domain: int, processes: Processes, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", transport)
    monkeypatch.chdir(ROOT)
    processes.start("writer", [sys.executable, "-m", "tests.ros.big_map_writer"])
    with Observer(domain) as observer:
        observer.wait(
            lambda: qos.offered_durability(observer.node, "big/map") is not None, what="the writer"
        )
        maps = observer.collect(OccupancyGrid, "big/map", qos.MAP)
        observer.wait(lambda: maps, what="the map")
    found = messages.grid_from_message(maps[0], "big/map")
    assert np.array_equal(found.cells, big_map().cells)
