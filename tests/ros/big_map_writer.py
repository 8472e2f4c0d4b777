"""Writes one map of 4000 x 4000 cells, 16 MB, and stays: ``python -m tests.ros.big_map_writer``."""

from __future__ import annotations

import numpy as np
import rclpy
from nav_msgs.msg import OccupancyGrid

from slamfusion import grid as grids
from slamfusion.ros import messages, qos

CELLS = 4000


def big_map() -> grids.OccupancyGrid:
    """Every value a cell can have, in no order."""
    rng = np.random.default_rng(5)
    return grids.OccupancyGrid(rng.integers(-1, 101, (CELLS, CELLS)).astype(np.int8), 0.05)


def main() -> None:
    """Write the map and spin until the process is ended."""
    rclpy.init()
    node = rclpy.create_node("big_map_writer")
    writer = node.create_publisher(OccupancyGrid, "big/map", qos.MAP)
    writer.publish(messages.grid_to_message(big_map(), "big_map", messages.to_stamp(1.0)))
    rclpy.spin(node)


if __name__ == "__main__":
    main()
