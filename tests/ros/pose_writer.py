"""Offers poses with a lease, sends none, and stays: ``python -m tests.ros.pose_writer TOPIC``."""

from __future__ import annotations

import sys

import rclpy
from geometry_msgs.msg import PoseStamped

from slamfusion.ros import qos


def main() -> None:
    """Spin until the process is ended."""
    rclpy.init()
    node = rclpy.create_node("pose_writer")
    node.create_publisher(PoseStamped, sys.argv[1], qos.POSE)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
