"""The graph's map is drawn aside: scans go on meanwhile, and at the end it is that of ``grid``."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from slamfusion.compute import open_device
from slamfusion.config import GraphConfig, RunConfig
from slamfusion.grid import OccupancyGrid as Grid
from slamfusion.io import LogScan
from slamfusion.ros import messages, producer_node, qos
from slamfusion.slam.common.mapper import DrawsAside, MapJob
from slamfusion.slam.graph.node_map import NodeMap
from slamfusion.slam.graph.slam import GraphSlam
from slamfusion.slam.registry import make_producer
from tests.ros.drives import as_sent, offline, scans
from tests.ros.live import Observer
from tests.ros.test_producer_node import Robot

pytestmark = pytest.mark.ros


def there_and_back(count: int) -> list[LogScan]:
    """Return a drive that comes back the way it went, so that the graph finds closures."""
    there = scans(count)
    return [
        dataclasses.replace(item, scan=dataclasses.replace(item.scan, stamp_s=100.0 + 0.1 * index))
        for index, item in enumerate([*there, *there[-2::-1]])
    ]


def test_what_a_settled_map_is_drawn_from_gives_the_map():
    device = open_device()
    graph = make_producer("graph", RunConfig(), device)
    assert isinstance(graph, DrawsAside)
    aside = NodeMap(GraphConfig(), open_device())
    unsettled = 0
    for index, item in enumerate(there_and_back(60)):
        graph.feed(item.scan, item.odometry)
        if index % 8 == 7:
            job = graph.map_job(is_settled=True)
            unsettled += not np.array_equal(job.poses, graph.map_job().poses)
            drawn, wanted = aside.draw(job), graph.grid()
            assert drawn.origin == wanted.origin
            assert np.array_equal(drawn.cells, wanted.cells)
    assert unsettled > 0


class HeldMap(NodeMap):
    """A map that is as slow to draw as the test wants."""

    go_on = threading.Event()
    is_drawing = threading.Event()

    def draw(self, job: MapJob) -> Grid:
        self.is_drawing.set()
        assert self.go_on.wait(60.0)
        return super().draw(job)


def test_scans_go_on_while_a_slow_map_is_drawn(
    domain: int, observer: Observer, monkeypatch: pytest.MonkeyPatch
):
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    arguments = ["--ros-args", "-p", "map_update_interval_s:=0.05"]
    node = producer_node.ProducerNode("graph", context=context, arguments=arguments)
    monkeypatch.setattr(
        GraphSlam, "map_drawer", lambda _, device: HeldMap(GraphConfig(), device).draw
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node.node)
    spinning = threading.Thread(target=executor.spin)
    spinning.start()
    poses = observer.collect(PoseStamped, "graph/pose")
    maps = observer.collect(OccupancyGrid, "graph/map", qos.MAP)
    robot = Robot(observer)
    driven = there_and_back(30)
    try:
        robot.wait_for()
        robot.drive(driven, poses)
        # Every scan was answered, and the first map is still being drawn.
        assert HeldMap.is_drawing.is_set()
        assert not maps
        HeldMap.go_on.set()
        wanted = offline("graph", as_sent(driven))

        def is_same() -> bool:
            if not maps or abs(messages.stamp_s(maps[-1]) - driven[-1].scan.stamp_s) > 1e-6:
                return False
            found = messages.grid_from_message(maps[-1], "found")
            return found.origin == wanted.origin and np.array_equal(found.cells, wanted.cells)

        observer.wait(is_same, what="the map of all scans")
        assert (wanted.cells >= 65).sum() > 100
    finally:
        HeldMap.go_on.set()
        node.close()
        executor.shutdown()
        spinning.join()
        node.node.destroy_node()
        rclpy.shutdown(context=context)
