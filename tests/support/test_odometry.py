"""Odometry is made wrong where it should be, and nowhere else."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slamfusion.compute import open_device
from slamfusion.config import ActionConfig
from slamfusion.geometry import compose_poses, invert_poses
from slamfusion.io.log import LogScan
from slamfusion.sim import Recording, named_course, simulate
from tests.support.odometry import (
    in_wrong_direction,
    joined,
    moments_under_way,
    without_odometry,
)


@cache
def driven(*actions: ActionConfig) -> Recording:
    """A script in the atrium, read with few beams."""
    course = named_course("f16", 2)
    lidar = replace(course.lidar, beams=11)
    return simulate(
        replace(course, script=actions, obstacles=False, lidar=lidar), open_device("auto")
    )


TURN, FORWARD = ActionConfig(turn_deg=90.0, speed_deg_s=45.0), ActionConfig(forward_m=1.5)
BACK, WAIT = ActionConfig(forward_m=-1.5), ActionConfig(wait_s=4.0)


def steps(scans: tuple[LogScan, ...]) -> np.ndarray:
    """(N - 1, 3) motion of the odometry between scans, seen by the robot."""
    poses = np.array([(p.x, p.y, p.yaw_rad) for item in scans if (p := item.odometry)])
    return compose_poses(invert_poses(poses[:-1]), poses[1:])


def test_steps_are_undone_in_the_window_and_kept_outside() -> None:
    scans = driven(FORWARD, TURN, TURN, WAIT).scans
    wrong = in_wrong_direction(scans, [2.0], 2.0)
    ends_s = np.array([item.scan.stamp_s for item in scans[1:]])
    inside = (ends_s > 2.0) & (ends_s <= 4.0)
    right, found = steps(scans), steps(wrong)
    assert inside.sum() == 20
    assert found[~inside] == pytest.approx(right[~inside], abs=1e-9)
    assert found[inside] == pytest.approx(invert_poses(right[inside]), abs=1e-9)
    assert right[inside, 0].sum() > 0.4
    assert found[inside, 0].sum() < -0.4
    assert right[inside, 2].sum() > 0.6
    assert found[inside, 2].sum() < -0.6
    assert all(a.scan is b.scan for a, b in zip(scans, wrong, strict=True))


def test_moments_are_under_way_and_apart() -> None:
    scans = driven(WAIT, FORWARD, WAIT, BACK, WAIT, FORWARD, WAIT).scans
    stamps_s = np.array([item.scan.stamp_s for item in scans])
    moved = np.concatenate(([0.0], np.cumsum(np.hypot(*steps(scans)[:, :2].T))))
    for seed in range(20):
        moments = moments_under_way(scans, 3, 1.0, np.random.default_rng(seed))
        assert (np.diff(moments) > 1.0).all()
        for moment in moments:
            begin, end = np.searchsorted(stamps_s, [moment, moment + 1.0 + 1e-6])
            assert moved[min(end, len(moved) - 1)] - moved[begin] > 0.2


def test_a_robot_that_stands_in_a_whole_part_is_never_under_way() -> None:
    scans = driven(FORWARD, WAIT, WAIT, WAIT, WAIT).scans
    with pytest.raises(ValueError, match="empty"):
        moments_under_way(scans, 3, 1.0, np.random.default_rng(0))


def test_drives_are_joined_without_a_jump() -> None:
    first = driven(FORWARD, TURN)
    second = replace(first.course, seed=7, start=first.truth.pose(-1), script=(WAIT,))
    stand = simulate(second, open_device("auto"))
    scans, truth = joined((first, stand, stand))
    count, more = len(first.scans), len(stand.scans)
    assert len(scans) == len(truth) == count + 2 * more
    assert np.diff(truth.stamps_s) == pytest.approx(0.1)
    assert [item.scan.stamp_s for item in scans] == pytest.approx(truth.stamps_s)
    assert (np.diff([item.line for item in scans]) == 1).all()
    made = steps(scans)
    assert made[: count - 1] == pytest.approx(steps(first.scans), abs=1e-9)
    assert made[count - 1 :] == pytest.approx(0.0, abs=1e-9)
    assert truth.poses[count:] == pytest.approx(np.tile(truth.poses[count - 1], (2 * more, 1)))


def test_scans_without_odometry_keep_their_readings() -> None:
    scans = driven(FORWARD, TURN).scans
    bare = without_odometry(scans)
    assert all(item.odometry is None for item in bare)
    assert all(a.scan is b.scan for a, b in zip(scans, bare, strict=True))
