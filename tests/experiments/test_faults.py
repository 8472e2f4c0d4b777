"""What is done to scans: where odometry goes afterwards, and that no range changes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.experiments.trials import FAULTS, break_odometry, kidnap, lose
from slamfusion.geometry import Pose2
from slamfusion.io import LogScan
from slamfusion.scan import LaserScan


def straight(count: int = 60) -> list[LogScan]:
    """A drive along x, 0.1 m and 0.1 s a scan, turning a little; ranges tell the scans apart."""
    return [
        LogScan(
            LaserScan(
                0.1 * index,
                np.full(4, 1.0 + index, dtype=np.float32),
                -1.0,
                0.5,
                0.1,
                100.0,
                Pose2(),
            ),
            Pose2(0.1 * index, 0.0, 0.01 * index),
            index + 1,
        )
        for index in range(count)
    ]


def odometry(scans: tuple[LogScan, ...] | list[LogScan]) -> list[Pose2]:
    return [pose for item in scans if (pose := item.odometry) is not None]


def told(scans: tuple[LogScan, ...] | list[LogScan]) -> list[tuple[float, Pose2 | None, float]]:
    """What tells scans apart: time, odometry and first bearing."""
    return [(item.scan.stamp_s, item.odometry, item.scan.angle_min_rad) for item in scans]


def step(a: Pose2, b: Pose2) -> tuple[float, float]:
    motion = a.inverse().compose(b)
    return math.hypot(motion.x, motion.y), motion.yaw_rad


def test_a_kidnapped_robot_sees_another_place_and_feels_nothing() -> None:
    before, after = straight(), kidnap(straight())
    assert len(after) == 54
    assert told(after[:27]) == told(before[:27])
    # What it sees jumps over the part, what it feels and the clock do not.
    assert [item.scan.ranges[0] for item in after[26:28]] == [27.0, 34.0]
    poses = odometry(after)
    assert step(poses[26], poses[27]) == pytest.approx((0.0, 0.0), abs=1e-12)
    stamps = np.array([item.scan.stamp_s for item in after])
    np.testing.assert_allclose(np.diff(stamps), 0.1)
    for index in (28, 40, 53):
        expected = step(*odometry(before[index + 5 : index + 7]))
        assert step(poses[index - 1], poses[index]) == pytest.approx(expected)


def test_broken_odometry_reads_ways_long_and_turns_small() -> None:
    before, after = straight(), break_odometry(straight())
    assert told(after[:21]) == told(before[:21])
    old, new = odometry(before), odometry(after)
    for index in (21, 40, 59):
        way, turn = step(old[index - 1], old[index])
        assert step(new[index - 1], new[index]) == pytest.approx((1.4 * way, 0.4 * turn))


def test_a_lost_producer_sees_left_and_right_in_each_others_place() -> None:
    before, after = straight(), lose(straight())
    assert told(after[:30]) == told(before[:30])
    assert odometry(after) == odometry(before)
    for old, new in zip(before[30:], after[30:], strict=True):
        np.testing.assert_allclose(new.scan.points() * (1.0, -1.0), old.scan.points(), atol=1e-9)


@pytest.mark.parametrize("name", FAULTS)
def test_ranges_and_missing_odometry_stay(name: str) -> None:
    before = straight()
    after = FAULTS[name](before)
    ranges = {item.line: item.scan.ranges for item in before}
    assert all((item.scan.ranges == ranges[item.line]).all() for item in after)
    blind = [replace(item, odometry=None) for item in before]
    assert all(item.odometry is None for item in FAULTS[name](blind))


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_shortest_drives_survive(name: str, count: int) -> None:
    assert FAULTS[name](straight(count))
