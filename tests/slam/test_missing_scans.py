"""Scans that never came, and no odometry that tells how far the robot went meanwhile."""

from __future__ import annotations

import math

import pytest

from slamfusion.config import RunConfig
from slamfusion.slam.registry import BUILT_IN, make_producer, open_producer_device, with_settings
from tests.slam.drives import drive

# Scans of the drive that are missing, of ten a second: the robot goes on for a metre.
MISSING = range(40, 56)


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_robot_without_odometry_is_found_where_it_went_on_to(name: str) -> None:
    scans, truth = drive(64, turn_bias=0.0)
    config = RunConfig()
    if name == "gmapping":
        config = with_settings(config, name, particles=6)
    made = make_producer(name, config, open_producer_device(name, config))
    for number, (item, pose) in enumerate(zip(scans, truth, strict=True)):
        if number not in MISSING:
            found = made.feed(item.scan, item.odometry if number < 30 else None).pose_map_base
            away = math.hypot(found.x - pose.x, found.y - pose.y)
            assert away < 0.3, f"scan {number}"
