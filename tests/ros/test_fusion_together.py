"""Player, three producers and the fusion as processes, against the same log without ROS."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid

from slamfusion.compute import open_device
from slamfusion.config import AlignConfig, FusionConfig, VoteConfig
from slamfusion.fusion import FusionResult, fuse_grids
from slamfusion.ros import messages, qos
from tests.ros.drives import FIRST_S, offline_log, write_log
from tests.ros.fused import share_equal
from tests.ros.live import Observer, Processes, values

pytestmark = pytest.mark.ros

COUNT = 60
LAST_S = FIRST_S + 0.1 * (COUNT - 1)
SETTINGS = {"tinyslam": {}, "gmapping": {"particles": 6}, "graph": {}}


@pytest.fixture(scope="module")
def offline(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FusionResult]:
    """The log, and the fusion of what each producer makes of it without ROS."""
    log = write_log(tmp_path_factory.mktemp("drive"), COUNT)
    maps = [offline_log(kind, log, **given) for kind, given in SETTINGS.items()]
    config = FusionConfig(align=AlignConfig(), vote=VoteConfig(extent="union"), reference="graph")
    return log, fuse_grids(maps, config, open_device())


@pytest.mark.full
def test_the_fused_map_of_a_log_is_that_of_the_offline_run(
    processes: Processes, observer: Observer, offline: tuple[Path, FusionResult]
):
    """In a namespace, by other names and by the log's time."""
    log, wanted = offline
    space, prefix = "/robot1", "robot1/"
    fused = observer.collect(OccupancyGrid, f"{space}/fused/map", qos.MAP)
    poses = observer.collect(PoseWithCovarianceStamped, f"{space}/fused/pose")
    names = ("-r", f"__ns:={space}")
    renamed = ("-r", "scan:=front/scan", "-r", "odom:=wheels")
    processes.node(
        "fusion",
        *names,
        *renamed[2:],
        fusion__reference="graph",
        live__search_pause_s=0.0,
        use_sim_time=True,
        publish_tf=True,
    )
    for kind, given in SETTINGS.items():
        settings = {f"{kind}__{name}": value for name, value in given.items()}
        processes.node(
            kind, *names, *renamed, map_update_interval_s=0.3, use_sim_time=True, **settings
        )
    observer.wait_status(f"{prefix}fusion: fusion", "nothing is fused", timeout_s=60.0)
    player = processes.node(
        "player", *names, *renamed, file=str(log), lockstep=True, wait_for=list(SETTINGS)
    )
    assert player.wait(120.0) == 0

    maps = {}
    for kind in SETTINGS:
        maps[kind] = observer.collect(OccupancyGrid, f"{space}/{kind}/map", qos.MAP)
    observer.wait(
        lambda: all(m and abs(messages.stamp_s(m[-1]) - LAST_S) < 1e-6 for m in maps.values()),
        what="the last map of every producer",
    )
    observer.wait_status(f"{prefix}fusion: fusion", "all 3 inputs vote")
    observer.wait(lambda: fused and abs(messages.stamp_s(fused[-1]) - LAST_S) < 1e-6)
    observer.listen(1.5)

    assert len(wanted.accepted) == 3
    cell_m = wanted.fused.resolution
    for record in wanted.inputs:
        assert record.alignment is not None
        figures = values(observer.statuses()[f"{prefix}fusion: input {record.name}"])
        place = record.alignment.transform
        off_m = math.hypot(float(figures["x [m]"]) - place.x, float(figures["y [m]"]) - place.y)
        assert off_m < cell_m, record.name
    assert share_equal(fused[-1], wanted.fused) >= 0.9

    # The robot's pose in the fused frame, up to the last scan.
    assert poses
    observer.wait(lambda: abs(messages.stamp_s(poses[-1]) - LAST_S) < 1e-6, what="the last pose")
    for process in processes.running:
        assert "Traceback" not in process.text(), process.name
