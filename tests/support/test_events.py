"""Drives are changed where they should be, and a false closure is told from a true one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from slamfusion.geometry import Pose2
from slamfusion.trajectory import Trajectory
from tests.support.events import (
    Drive,
    begun_later,
    closure_errors,
    is_false,
    loops,
    with_odometry_set_to_zero,
    with_pause,
)
from tests.support.producers import room_drive


@dataclass(frozen=True)
class Said:
    start_s: float
    end_s: float
    motion: Pose2
    weight: float = 1.0


def drive() -> Drive:
    scans = tuple(room_drive(10))
    poses = np.array([(p.x, p.y, p.yaw_rad) for item in scans if (p := item.odometry)])
    return scans, Trajectory(np.array([item.scan.stamp_s for item in scans]), poses, "truth")


def stamps(changed: Drive) -> list[float]:
    scans, truth = changed
    found = [item.scan.stamp_s for item in scans]
    assert truth.stamps_s.tolist() == found
    return found


def test_a_pause_lies_before_its_scan() -> None:
    before = stamps(drive())
    after = stamps(with_pause(drive(), 4, 3600.0))
    assert after[:4] == before[:4]
    assert after[4:] == [stamp + 3600.0 for stamp in before[4:]]


def test_a_drive_that_begins_later_is_the_rest_of_it() -> None:
    (scans, truth), (rest, end) = drive(), begun_later(drive(), 3)
    assert [item.scan.stamp_s for item in rest] == [item.scan.stamp_s for item in scans[3:]]
    assert [item.odometry for item in rest] == [item.odometry for item in scans[3:]]
    np.testing.assert_array_equal(end.poses, truth.poses[3:])


def test_odometry_that_is_set_to_zero_goes_on_from_there() -> None:
    scans, _ = drive()
    changed, _ = with_odometry_set_to_zero(drive(), 5)
    poses = [item.odometry for item in changed]
    assert poses[:5] == [item.odometry for item in scans[:5]]
    first, last = scans[5].odometry, scans[9].odometry
    assert first is not None
    assert last is not None
    for pose, wanted in ((poses[5], Pose2()), (poses[9], first.inverse().compose(last))):
        assert pose is not None
        found = (pose.x, pose.y, pose.yaw_rad)
        assert found == pytest.approx((wanted.x, wanted.y, wanted.yaw_rad), abs=1e-9)


def test_a_true_closure_has_no_error_and_a_false_one_its_own() -> None:
    poses = [(0.0, 0.0, 0.0), (3.0, 0.0, math.pi / 2), (3.0, 2.0, math.pi / 2)]
    truth = Trajectory(np.array([0.0, 10.0, 20.0]), np.array(poses))
    said = [
        Said(10.0, 20.0, Pose2(2.0, 0.0, 0.0)),
        Said(0.0, 20.0, Pose2(3.0, 2.4, math.pi / 2)),
        Said(0.0, 20.0, Pose2(3.0, 2.6, math.pi / 2)),
        Said(0.0, 10.0, Pose2(3.0, 0.0, math.pi / 2 + 0.2 - math.tau)),
    ]
    errors = closure_errors(said, truth)
    assert errors == pytest.approx(np.array([(0, 0), (0.4, 0), (0.6, 0), (0, 0.2)]), abs=1e-9)
    assert is_false(errors).tolist() == [False, False, True, True]
    assert closure_errors([], truth).shape == (0, 2)


def test_a_closure_at_a_time_without_a_true_pose_is_refused() -> None:
    truth = Trajectory(np.array([0.0, 10.0]), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="the truth has no pose"):
        closure_errors([Said(0.0, 9.9, Pose2())], truth)


def test_ties_of_neighbours_are_no_loops() -> None:
    near, far = Said(1.0, 2.0, Pose2()), Said(1.0, 60.0, Pose2())
    assert loops([near, far]) == [far]
