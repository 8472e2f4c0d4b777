"""What a scan's readings mean (REP-117), and what is no scan."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.errors import ScanError
from slamfusion.geometry import Pose2
from slamfusion.scan import LaserScan


def scan(ranges: list[float], **changes: object) -> LaserScan:
    settings: dict[str, object] = {
        "stamp_s": 0.0,
        "angle_min_rad": 0.0,
        "angle_increment_rad": 0.5 * math.pi,
        "range_min_m": 0.1,
        "range_max_m": 10.0,
    }
    return LaserScan(ranges=np.array(ranges), **(settings | changes))


def test_readings_by_rep_117():
    readings = scan([1.0, 0.05, 0.0, -1.0, 10.0, 12.0, math.inf, -math.inf, math.nan])
    assert readings.is_hit().tolist() == [True] + [False] * 8
    assert np.flatnonzero(readings.is_clear()).tolist() == [4, 5, 6]
    assert len(readings) == 9


def test_zero_is_no_hit_even_where_the_least_range_is_zero():
    assert scan([0.0, 1e-3], range_min_m=0.0).is_hit().tolist() == [False, True]


def test_usable_range_cuts_hits_but_clears_nothing():
    readings = scan([1.0, 5.0, 9.0, math.inf])
    assert readings.is_hit(5.0).tolist() == [True, False, False, False]
    assert readings.is_clear().tolist() == [False, False, False, True]


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_points_of_a_mounted_laser(direction: float):
    turned = scan([1.0, 2.0, math.inf, 3.0], angle_increment_rad=direction * 0.5 * math.pi)
    np.testing.assert_allclose(
        turned.points(), [(1.0, 0.0), (0.0, direction * 2.0), (0.0, -direction * 3.0)], atol=1e-12
    )
    mounted = scan([1.0, 2.0], mount=Pose2(0.3, -0.1, math.pi))
    np.testing.assert_allclose(mounted.points(), [(-0.7, -0.1), (0.3, -2.1)], atol=1e-12)


def test_a_laser_that_is_mounted_otherwise():
    given = LaserScan(0.0, [1.0, 2.0, 3.0], -0.5, 0.5, 0.1, 10.0, Pose2(0.2, 0.0, 0.0))
    x, y = given.points().T
    assert np.allclose(given.remounted("mirrored").points(), np.stack((x, -y), axis=-1))
    backward = given.remounted("backward").points()
    assert np.allclose(backward, np.stack((0.4 - x, -y), axis=-1), atol=1e-6)
    assert given.remounted("as-given") is given


def test_chosen_beams_only():
    chosen = np.array([False, True, False])
    np.testing.assert_allclose(scan([1.0, 2.0, 3.0]).points(chosen), [(0.0, 2.0)], atol=1e-12)


def test_readings_are_frozen_and_are_the_scan_s_own():
    given = np.array([1.0, 2.0], dtype=np.float32)
    kept = scan([1.0]).ranges
    own = LaserScan(0.0, given, 0.0, 0.1, 0.0, 5.0)
    given[0] = 7.0
    assert own.ranges[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        kept[0] = 2.0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ranges": np.zeros((0,))}, "at least one range"),
        ({"ranges": np.zeros((2, 2))}, "at least one range"),
        ({"stamp_s": math.nan}, "must be finite"),
        ({"angle_min_rad": math.inf}, "must be finite"),
        ({"angle_increment_rad": 0.0}, "must not be 0"),
        ({"angle_min_rad": -180.0, "angle_increment_rad": 1.0}, "-180 to -179 rad .degrees"),
        ({"angle_increment_rad": -13.0}, "within two turns"),
        ({"range_min_m": 10.0}, "0 <= min < max"),
        ({"range_min_m": -1.0}, "0 <= min < max"),
        ({"range_max_m": math.nan}, "0 <= min < max"),
    ],
)
def test_what_is_no_scan(changes: dict[str, object], words: str):
    settings = {
        "stamp_s": 0.0,
        "ranges": np.ones(2),
        "angle_min_rad": 0.0,
        "angle_increment_rad": 0.1,
        "range_min_m": 0.1,
        "range_max_m": 10.0,
    }
    with pytest.raises(ScanError, match=words):
        LaserScan(**(settings | changes))
