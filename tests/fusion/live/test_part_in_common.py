"""Two robots' maps that share only a part of their ground, and grow away from each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from tests.fusion.drawings import building, degraded, off_by
from tests.fusion.live.maps import Drive, live_fusion, shifted
from tests.support.cuts import along, kept

# About searches, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

LENGTH_M, CELL_M = 28.0, 0.1
MIDDLE_M = LENGTH_M / 2.0
# Off by less than two cells, and by half a degree.
CELLS, DEGREES = 2.0, 0.5


@cache
def wings(seed: int = 1) -> tuple[Callable[[float, float], tuple[OccupancyGrid, ...]], Pose2]:
    """Return what draws two robots' maps of one building, and b's frame in a's.

    The maps are drawn for the half width of the strip about the middle that both have, and for how
    far each has gone beyond the middle on its own side; metres.
    """
    place = building(seed, LENGTH_M, 11.0, CELL_M)
    other, motion = degraded(place, seed, "b", yaw_rad=2.0, flip_share=0.005)
    of_a, of_b = along(place, place, Pose2(), "x"), along(other, place, motion, "x")

    def drawn(half_m: float, gone_m: float) -> tuple[OccupancyGrid, ...]:
        low, high = MIDDLE_M - gone_m, MIDDLE_M + half_m
        a = kept(place, of_a, (round(low / CELL_M), round(high / CELL_M)))
        low, high = MIDDLE_M - half_m, MIDDLE_M + gone_m
        b = kept(other, of_b, (round(low / CELL_M), round(high / CELL_M)))
        return replace(a, name="a"), replace(b, name="b")

    return drawn, motion


def assert_right(drive: Drive, b: OccupancyGrid, motion: Pose2) -> None:
    """Assert that both vote, and that b lies right in a's frame."""
    a_in_fused, b_in_fused = drive.input("a").transform, drive.input("b").transform
    cells, degrees = off_by(b, a_in_fused.inverse().compose(b_in_fused), motion)
    assert drive.accepted() == "ab", drive.input("b").reason
    assert cells <= CELLS
    assert degrees <= DEGREES


def test_two_robots_that_begin_together_and_part_stay_fused(device: ComputeDevice) -> None:
    drawn, motion = wings()
    drive = Drive(live_fusion(device))
    searches = 0
    for gone_m in (3.0, 5.0, 7.0, 9.0, 11.0, 14.0):
        a, b = drawn(3.0, gone_m)
        searches += drive.step(a, b).is_full_search
        assert_right(drive, b, motion)
    assert drive.input("b").fit.score < 0.7 * 0.6, "a third in common: far below the first score"
    assert drive.input("b").fit.is_tracked
    assert searches == 1, "nothing has moved, so nothing is searched again"


def test_two_robots_that_met_begin_to_be_fused_and_go_on(device: ComputeDevice) -> None:
    """From two wings without common ground on, each a little farther into the other's."""
    drawn, motion = wings()
    drive = Drive(live_fusion(device))
    for half_m in (-2.0, 1.0, 3.0, 5.0):
        a, b = drawn(half_m, MIDDLE_M)
        drive.maybe(a, b)
        if drive.accepted():
            assert_right(drive, b, motion)
        else:
            assert half_m <= 1.0, drive.input("b").reason
    assert_right(drive, b, motion)


def test_walls_that_moved_are_still_noticed_where_little_is_shared(device: ComputeDevice) -> None:
    """What the common ground says counts: a map whose walls slid by 1.5 m keeps no vote there."""
    drawn, _ = wings()
    drive = Drive(live_fusion(device))
    for gone_m in (3.0, 7.0, 11.0):
        a, b = drawn(3.0, gone_m)
        drive.step(a, b)
    assert drive.accepted() == "ab"
    before = drive.input("b").transform
    drive.step(a, shifted(b, 15))
    now = drive.input("b")
    is_moved = before.inverse().compose(now.transform)
    assert not now.accepted or abs(is_moved.x) + abs(is_moved.y) > 1.0


@pytest.mark.parametrize("seed", [11])
def test_wings_of_two_buildings_never_fuse(device: ComputeDevice, seed: int) -> None:
    drive = Drive(live_fusion(device))
    for gone_m in (3.0, 9.0, 14.0):
        a, b = wings(1)[0](3.0, gone_m)[0], wings(seed)[0](3.0, gone_m)[1]
        drive.maybe(a, b)
        assert drive.accepted() == "", drive.input("b").reason
