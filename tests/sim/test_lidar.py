"""Lasers: true ranges where nothing errs, and each error as it is asked for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import LidarConfig, ObstacleConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, OccupancyGrid
from slamfusion.scan import LaserScan
from slamfusion.sim.world import LIDARS, World, beam_angles, mount_of, sweep_ranges
from tests.sim.places import room, world_of

EXACT = LidarConfig(
    beams=181,
    view_rad=math.pi,
    noise_m=0.0,
    noise_per_m=0.0,
    dropout_share=0.0,
    outlier_share=0.0,
    mixed_share=0.0,
    mount_x_m=0.0,
)


def ranges_at(
    world: World,
    lidar: LidarConfig,
    *poses: tuple[float, float, float],
    people: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None = None,
    seed: int = 0,
) -> npt.NDArray[np.float32]:
    table = np.array(poses)
    discs = (np.empty((len(table), 0, 2)), np.empty(0)) if people is None else people
    rng = np.random.default_rng(seed)
    return np.stack(list(sweep_ranges(world, lidar, table[:, None], discs, NumpyDevice(), rng)))


def many(pose: tuple[float, float, float], count: int = 200) -> list[tuple[float, float, float]]:
    return [pose] * count


def test_ranges_in_a_room_are_those_of_geometry() -> None:
    (ranges,) = ranges_at(world_of(room(8.0, 6.0)), EXACT, (1.0, 0.5, 0.0))
    first, step = beam_angles(EXACT)
    angles = first + step * np.arange(181)
    with np.errstate(divide="ignore"):
        to_x = 3.0 / np.abs(np.cos(angles))
        to_y = np.where(angles > 0, 2.5, 3.5) / np.abs(np.sin(angles))
    assert ranges == pytest.approx(np.minimum(to_x, to_y), abs=1e-4)


def test_a_turned_map_frame_changes_no_range() -> None:
    grid = room(8.0, 6.0)
    pose = Pose2(1.0, 0.5, 0.4)
    motion = Pose2(100.0, -20.0, 2.1)
    moved = OccupancyGrid(grid.cells, grid.resolution, motion.compose(grid.origin))
    there = motion.compose(pose)
    here = ranges_at(world_of(grid), EXACT, (pose.x, pose.y, pose.yaw_rad))
    found = ranges_at(world_of(moved), EXACT, (there.x, there.y, there.yaw_rad))
    assert found == pytest.approx(here, abs=2e-3)


def test_clockwise_laser_sees_the_mirrored_order() -> None:
    world = world_of(room(8.0, 6.0))
    left = ranges_at(world, EXACT, (1.0, 0.5, 0.2))
    right = ranges_at(world, replace(EXACT, clockwise=True), (1.0, 0.5, 0.2))
    assert right[0] == pytest.approx(left[0, ::-1], abs=1e-4)


def test_beyond_reach_is_inf_and_too_near_is_minus_inf() -> None:
    world = world_of(room(8.0, 6.0))
    (ranges,) = ranges_at(world, replace(EXACT, range_min_m=1.0, range_max_m=5.0), (3.5, 0.0, 0.0))
    assert ranges[90] == -math.inf
    (ranges,) = ranges_at(world, replace(EXACT, range_max_m=5.0), (-3.5, 0.0, 0.0))
    assert ranges[90] == math.inf
    assert math.isfinite(ranges[0])


def test_outliers_stop_short_and_never_reach_too_far() -> None:
    world = world_of(room(8.0, 6.0))
    ranges = ranges_at(world, replace(EXACT, outlier_share=0.2), *many((0.0, 0.0, 0.0)))
    true = ranges_at(world, EXACT, (0.0, 0.0, 0.0))[0]
    wrong = np.abs(ranges - true) > 1e-3
    assert wrong.mean() == pytest.approx(0.2, abs=0.02)
    assert (ranges <= true + 1e-3).all()


def test_glass_sends_back_what_meets_it_head_on_and_lets_the_rest_pass() -> None:
    grid = room(8.0, 6.0)
    cells = grid.cells.copy()
    cells[1:-1, 121] = OCCUPIED  # a pane at x = 2, the wall behind it at x = 4
    glass = np.zeros(cells.shape, dtype=np.bool_)
    glass[1:-1, 121] = True
    world = world_of(OccupancyGrid(cells, 0.05, grid.origin), glass=glass)
    ranges = ranges_at(world, EXACT, *many((0.0, 0.0, 0.0)))
    head_on = ranges[:, 90]
    back = np.abs(head_on - 2.0) < 1e-3
    assert back.mean() == pytest.approx(0.9, abs=0.06)
    assert head_on[~back] == pytest.approx(4.0, abs=1e-3)
    slanted = ranges[:, 90 + 30]
    assert slanted == pytest.approx(4.0 / math.cos(math.radians(30.0)), abs=1e-2)


def test_people_are_seen_as_circles() -> None:
    world = world_of(room(8.0, 6.0))
    people = (np.array([[[2.0, 0.0]]]), np.array([0.5]))
    (ranges,) = ranges_at(world, EXACT, (0.0, 0.0, 0.0), people=people)
    assert ranges[90] == pytest.approx(1.5)
    edge = math.degrees(math.asin(0.25))
    assert ranges[90 + int(edge)] < 2.0
    assert ranges[90 + int(edge) + 1] > 2.5
    behind = ranges_at(world, EXACT, (0.0, 0.0, math.pi), people=people)
    assert behind[0, 90] == pytest.approx(4.0, abs=1e-3)


CABLE = ObstacleConfig(x_m=0.0, y_m=0.0, across_m=0.8, pitch_rad=0.1)


def test_nose_down_reads_the_floor_and_nose_up_reads_long() -> None:
    world = world_of(room(16.0, 6.0), obstacles=(CABLE,))
    down, up, flat = ranges_at(world, EXACT, (0.2, 0.0, 0.0), (-0.2, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert down[90] == pytest.approx(EXACT.height_m / math.sin(0.1), abs=1e-3)
    assert up[90] == pytest.approx(8.2 / math.cos(0.1), abs=2e-3)
    assert flat[90] == pytest.approx(7.0, abs=1e-3)
    assert down[0] == pytest.approx(3.0, abs=1e-3), "sideways the plane stays level"


@pytest.mark.parametrize("name", LIDARS)
def test_every_laser_makes_a_scan_of_its_room(name: str) -> None:
    lidar = LIDARS[name]
    world = world_of(room(5.0, 4.0))
    first, step = beam_angles(lidar)
    for ranges in ranges_at(world, lidar, (0.3, 0.2, 0.5), (0.0, 0.0, 2.0)):
        scan = LaserScan(
            0.0, ranges, first, step, lidar.range_min_m, lidar.range_max_m, mount_of(lidar)
        )
        assert len(scan) == lidar.beams
        assert scan.is_hit().mean() > 0.7
        assert not np.isnan(ranges).any()
