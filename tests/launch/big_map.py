"""Send or hear one map of 4000 x 4000 cells: ``python -m tests.launch.big_map send|hear``.

What was heard is printed as one JSON document, with how it came.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import OccupancyGrid as Message
from rclpy.executors import SingleThreadedExecutor

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.ros import messages, qos

CELLS = 4000
TOPIC = "big/map"


def big_grid() -> OccupancyGrid:
    """A map of 16 MB that does not compress into nothing."""
    cells = np.random.default_rng(3).integers(-1, 101, (CELLS, CELLS), dtype=np.int8)
    return OccupancyGrid(cells, 0.05, Pose2(-100.0, -100.0, 0.0), "big")


def digest(grid: OccupancyGrid) -> str:
    return hashlib.sha256(grid.cells.tobytes()).hexdigest()


def shared_memory_bytes() -> int:
    """The largest piece of shared memory of Fast DDS that this process has mapped."""
    sizes = [0]
    for line in Path("/proc/self/maps").read_text(encoding="utf-8").splitlines():
        found = re.match(r"([0-9a-f]+)-([0-9a-f]+) .*/dev/shm/fastrtps_[0-9a-f]+", line)
        if found:
            sizes.append(int(found[2], 16) - int(found[1], 16))
    return max(sizes)


def send(node: Any, spin: Any) -> None:
    """Publish the map once, and stay until it was taken."""
    topic = node.create_publisher(Message, TOPIC, qos.MAP)
    topic.publish(messages.grid_to_message(big_grid(), "map", messages.to_stamp(1.0)))
    while not topic.get_subscription_count():
        spin(0.1)
    while topic.get_subscription_count():
        spin(0.1)


def hear(node: Any, spin: Any) -> None:
    """Wait for the map, and tell what came."""
    heard: list[Any] = []
    node.create_subscription(Message, TOPIC, heard.append, qos.MAP)
    begun_s = time.monotonic()
    while not heard:
        spin(0.1)
    after_s = time.monotonic() - begun_s
    grid = messages.grid_from_message(heard[0], "big")
    told = {"shape": grid.cells.shape, "digest": digest(grid), "after_s": after_s}
    print(json.dumps({**told, "shared_memory": shared_memory_bytes()}))


def main(what: str) -> None:
    """Run one side."""
    rclpy.init()
    node = rclpy.create_node(f"{what}s_big_map")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    {"send": send, "hear": hear}[what](node, lambda wait_s: executor.spin_once(timeout_sec=wait_s))
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(sys.argv[1])
