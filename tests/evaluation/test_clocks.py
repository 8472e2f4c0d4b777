"""The offset of two clocks, found by the motion of two paths of one drive."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.config import TrajectoryConfig
from slamfusion.errors import ConfigError, TrajectoryError
from slamfusion.evaluation.trajectory_error import clock_offset_s, on_clock, trajectory_errors
from slamfusion.geometry import Pose2, moved_poses
from slamfusion.trajectory import Trajectory


def drive(seconds: float = 90.0, step_s: float = 0.05, first_s: float = 0.0) -> Trajectory:
    """A robot that drives and turns as it pleases, from a second of the drive on."""
    times_s = np.arange(0.0, 120.0, 0.01)
    speed = 0.5 + 0.3 * np.sin(0.31 * times_s) * np.sin(0.07 * times_s + 1.0)
    yaw = 1.5 * np.sin(0.4 * times_s) + np.sin(0.23 * times_s + 0.5)
    x, y = (np.cumsum(0.01 * speed * turn) for turn in (np.cos(yaw), np.sin(yaw)))
    stamps_s = np.arange(first_s, first_s + seconds, step_s)
    rows = [np.interp(stamps_s, times_s, column) for column in (x, y, yaw)]
    return Trajectory(stamps_s, np.stack(rows, axis=1))


@pytest.mark.parametrize("offset_s", [0.0, 0.35, -3.2, 1_700_000_000.0])
@pytest.mark.parametrize("first_s", [0.0, 20.0])
def test_the_offset_of_another_clock_is_found(offset_s: float, first_s: float) -> None:
    path = drive(first_s=first_s, step_s=0.07)
    noise = np.random.default_rng(1).normal(0.0, [0.005, 0.005, 0.003], (len(path), 3))
    poses = moved_poses(Pose2(3.0, -2.0, 1.0), path.poses) + noise
    path = Trajectory(path.stamps_s - offset_s, poses)
    assert clock_offset_s(path, drive()) == pytest.approx(offset_s, abs=0.01)


def test_stamps_of_the_same_scans_meet_exactly() -> None:
    path = drive()
    relative = path.later(-path.stamps_s[0] - 12.345)
    assert clock_offset_s(relative, path) == pytest.approx(12.345, abs=1e-6)


def test_paths_of_two_drives_are_refused() -> None:
    other = drive(seconds=60.0)
    steps = np.random.default_rng(2).normal(0.0, [0.01, 0.01, 0.02], (len(other), 3))
    with pytest.raises(TrajectoryError, match="do not move alike"):
        clock_offset_s(Trajectory(other.stamps_s, np.cumsum(steps, axis=0)), drive())
    with pytest.raises(TrajectoryError, match="--time-offset in seconds"):
        on_clock(other, None, "auto")


@pytest.mark.parametrize("offset", ["1700000000", "auto"])
def test_a_truth_on_another_clock_is_measured_with_its_offset(offset: str) -> None:
    estimate = drive().later(1.7e9)
    with pytest.raises(TrajectoryError, match=r"1700000000\.000 s apart\? use --time-offset 17000"):
        trajectory_errors(estimate, drive())
    found = trajectory_errors(estimate, drive(), TrajectoryConfig(time_offset=offset))
    assert found.ate.rmse < 1e-3
    assert found.time_offset_s == pytest.approx(1.7e9)


@pytest.mark.parametrize("offset", ["soon", "nan", ""])
def test_an_offset_that_is_no_number_is_refused(offset: str) -> None:
    with pytest.raises(ConfigError, match="wanted seconds or auto"):
        TrajectoryConfig(time_offset=offset)
