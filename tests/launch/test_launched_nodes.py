"""The nodes of the launch files, started with the words that these give them, over real DDS."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from geometry_msgs.msg import PoseStamped

from tests.launch.launch_reader import started
from tests.ros.drives import write_log
from tests.ros.live import Observer, Processes, values

pytestmark = pytest.mark.ros

COUNT = 40


@pytest.mark.full
def test_a_log_waits_for_the_slowest_producer_and_no_scan_is_lost(
    processes: Processes, observer: Observer, tmp_path: Path
):
    log = write_log(tmp_path, COUNT)
    robot = {"namespace": "robot1", "frame_prefix": "robot1/", "tf": "tf", "tf_static": "tf_static"}
    nodes = started("slamfusion.launch.py", log=str(log), rate="2.0", **robot)
    statuses = observer.statuses()
    poses = observer.collect(PoseStamped, "/robot1/tinyslam/pose")

    def start(name: str, *more: str) -> None:
        processes.node(name, *nodes[name].words(), *more)
        observer.wait(
            lambda: any(key.startswith(f"robot1/{name}: ") for key in statuses), what=name
        )

    # Two of the three, for the time that this takes.
    start("player", "-p", "wait_for:=tinyslam,graph")
    start("tinyslam")
    start("graph")

    def fed(name: str) -> str | None:
        return values(statuses[f"robot1/{name}: slam"]).get("scans fed")

    for name in ("tinyslam", "graph"):
        observer.wait(lambda name=name: fed(name) == str(COUNT), what=f"every scan in {name}")
    assert {item.header.frame_id for item in poses} == {"robot1/tinyslam_map"}
    for name in ("tinyslam", "graph"):
        figures = values(statuses[f"robot1/{name}: slam"])
        assert figures["scans dropped"] == "0"
        assert figures["scans without odometry"] == "0"
    # The laser's place in robot1/base_link was found, so the frames are those of the player.
    assert "cannot be used" not in statuses["robot1/tinyslam: slam"].message
