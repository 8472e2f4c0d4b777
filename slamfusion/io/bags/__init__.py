"""Scans of ROS 1 and ROS 2 bags, without ROS.

``reader`` opens a bag through ``rosbags``, which comes with the extra ``bags``; ``odometry`` is a
first pass for transforms and odometry; ``log`` yields the scans.
"""

from slamfusion.io.bags.log import BagLog

__all__ = ["BagLog"]
