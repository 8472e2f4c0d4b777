"""Maps that the jobs are tested on."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import RunConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, degraded, fusion_config

CONFIG = replace(RunConfig(), fusion=fusion_config())


@cache
def device() -> ComputeDevice:
    """The device that a user gets: PoCL where there is no other."""
    return open_device()


def moved(seed: int = 3) -> tuple[OccupancyGrid, OccupancyGrid, Pose2]:
    """A building, a map of it in another frame, and where that lies."""
    truth = building(seed)
    grid, pose = degraded(truth, 1, shift_share=(0.1, -0.05), yaw_rad=0.2)
    return truth, grid, pose
