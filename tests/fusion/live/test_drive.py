"""Live fusion of three SLAMs that map one simulated drive: the fused frame never moves."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.slam.registry import make_producer
from tests.fusion.live.maps import (
    Drive,
    assert_same_lattice,
    live_fusion,
    moved_frame,
    share_standing,
)
from tests.slam.drives import drive

pytestmark = pytest.mark.once

SCANS, EVERY = 140, 20
# The frames of the three maps are as foreign to each other as those of any three programs.
FRAMES = {"tinyslam": Pose2(), "gmapping": Pose2(5.0, -3.0, 1.0), "graph": Pose2(-20.0, 7.0, -2.2)}


@pytest.fixture(scope="module")
def rounds(device: ComputeDevice) -> list[dict[str, OccupancyGrid]]:
    """The maps of the three producers as they grow, every 20 scans."""
    scans, _ = drive(SCANS, turn_bias=0.003)
    producers = {name: make_producer(name, RunConfig(), device) for name in FRAMES}
    out = []
    for number, item in enumerate(scans, start=1):
        for producer in producers.values():
            producer.feed(item.scan, item.odometry)
        if number % EVERY == 0:
            maps = {name: producer.grid() for name, producer in producers.items()}
            out.append(
                {
                    name: moved_frame(grid.with_name(name), FRAMES[name])
                    for name, grid in maps.items()
                }
            )
    return out


def test_maps_grow_and_no_wall_moves(
    device: ComputeDevice, rounds: list[dict[str, OccupancyGrid]]
) -> None:
    fusion = Drive(live_fusion(device))
    first = None
    for maps in rounds:
        fusion.step(*maps.values())
        assert fusion.accepted() == "tinyslamgmappinggraph"
        first = first or fusion.fused
        assert_same_lattice(first, fusion.fused)
        assert share_standing(first, fusion.fused) > 0.95
    for record in fusion.live.inputs():
        # The producers share the true frame of the drive, so that their transforms are known.
        found = record.transform.compose(FRAMES[record.name])
        reference = fusion.live.inputs()
        base = next(r for r in reference if r.fit.score == 1.0)
        wanted = base.transform.compose(FRAMES[base.name])
        assert np.hypot(found.x - wanted.x, found.y - wanted.y) < 0.15
        assert abs(np.angle(np.exp(1j * (found.yaw_rad - wanted.yaw_rad)))) < 0.03
