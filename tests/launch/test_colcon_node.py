"""A node that colcon has installed, started as ``ros2 run`` would."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from ament_index_python.packages import get_package_prefix

from tests.ros.live import Observer, Processes

pytestmark = pytest.mark.ros


def test_an_installed_node_is_found_and_runs(
    workspace: Path, processes: Processes, observer: Observer
):
    prefix = workspace / "install" / "slamfusion"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AMENT_PREFIX_PATH", str(prefix))
        assert get_package_prefix("slamfusion") == str(prefix)

    share = prefix / "share" / "slamfusion"
    command = (
        f"source {workspace}/install/setup.bash && "
        f"exec python3 {prefix}/lib/slamfusion/fusion_node --ros-args -r __ns:=/robot1 "
        f"--params-file {share}/config/slamfusion.yaml"
    )
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    node = processes.start("fusion_node", ["bash", "-c", command], {"PATH": path})
    status = observer.wait_status("robot1/fusion: fusion", "nothing is fused", timeout_s=40.0)
    assert status.hardware_id == "fusion"
    assert node.interrupt() == 0
