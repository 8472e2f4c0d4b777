"""What a machine without ROS is told; runs where rclpy is absent."""

from __future__ import annotations

import importlib.util

import pytest

from tests.cli.command import assert_one_line_failure, run


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="rclpy is here")
def test_without_ros_the_command_says_what_to_install():
    assert_one_line_failure(
        run("node", "tinyslam"), "rclpy cannot be imported", "pip install 'slamfusion[ros]'"
    )
