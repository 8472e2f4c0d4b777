"""Scans of ROS 1 and ROS 2 bags, without ROS; needs ``rosbags`` (the extra ``bags``)."""

from slamfusion.io.bags.log import BagLog

__all__ = ["BagLog"]
