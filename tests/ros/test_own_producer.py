"""A producer of another package as a node, by its name alone."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import OccupancyGrid

from slamfusion.ros import qos
from tests.ros.drives import write_log
from tests.ros.live import Observer, Processes
from tests.support.own_producer import NAME, with_own_producer

# That it is found by its name: tests/test_installed.py; a node's parameters: test_parameters.py.
pytestmark = [pytest.mark.ros, pytest.mark.full]


def test_it_is_a_node_with_its_own_parameters(
    processes: Processes, observer: Observer, tmp_path: Path
):
    python = with_own_producer(tmp_path / "venv")
    heard = observer.collect(OccupancyGrid, f"{NAME}/map", qos.MAP)
    log = write_log(tmp_path, 20)
    parameters = {
        f"{NAME}.resolution": 0.1,
        "map_update_interval_s": 0.2,
        "scans_stale_s": 600.0,  # the log may have ended long before the status is looked at
    }
    words = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
    command = [str(python), "-m", "slamfusion", "node", NAME, "--ros-args", *words]
    producer = processes.start(NAME, command)
    player = processes.node("player", file=str(log), lockstep=True, wait_for=[NAME])
    assert player.wait() == 0, producer.text()
    message = observer.wait(lambda: heard and heard[-1], what="its map")
    assert message.header.frame_id == f"{NAME}_map"
    assert message.info.resolution == pytest.approx(0.1)
    assert {-1, 0, 100} == set(message.data)
    status = observer.wait_status(f"{NAME}: slam", "mapping")
    assert status.hardware_id == NAME
    assert status.level == DiagnosticStatus.OK, status.message
    assert producer.interrupt() == 0
