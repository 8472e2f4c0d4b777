"""Claims about reading tinySLAM's own recordings."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import LogConfig
from slamfusion.errors import LogError
from slamfusion.geometry import Pose2
from slamfusion.io import open_log
from slamfusion.io.tinyslam_dat import TinySlamDat, drive_arc
from tests.support.datasets import DATASETS

METRES_PER_TICK = 2.0 * math.pi * 0.077 / 2000.0
TICKS_PER_METRE = 1.0 / METRES_PER_TICK


def row(time_us: float, left: float = 0, right: float = 0, ranges: object = 1000) -> str:
    """One line: the ranges in millimetres, all the same or one each."""
    beams = [ranges] * 682 if isinstance(ranges, int) else list(ranges)
    fields = [time_us, 0, left, right, *[0] * 20, *beams, 255]
    return " ".join(map(str, fields))


def log_of(folder: Path, *lines: str, **config: float) -> TinySlamDat:
    path = folder / "a.dat"
    path.write_text("".join(f"{line}\n" for line in lines))
    return TinySlamDat(path, LogConfig(**config))


def poses_of(log: TinySlamDat) -> list[Pose2]:
    return [scan.odometry for scan in log if scan.odometry is not None]


def test_time_is_in_microseconds_and_ranges_in_millimetres(tmp_path: Path) -> None:
    (found,) = log_of(tmp_path, row(2_500_000, ranges=1234))
    assert found.scan.stamp_s == 2.5
    assert found.scan.ranges[341] == np.float32(1.234)
    assert found.scan.mount == Pose2(0.145, 0.0, 0.0)


def test_the_laser_looks_240_degrees_around_ahead(tmp_path: Path) -> None:
    angles = np.degrees(next(iter(log_of(tmp_path, row(1)))).scan.angles())
    assert angles[-1] - angles[0] == pytest.approx(240.0, abs=1.0)
    assert angles[340] == pytest.approx(0.0)


def test_0_saw_nothing_error_codes_and_hidden_beams_measured_nothing(tmp_path: Path) -> None:
    ranges = [1000] * 682
    ranges[300:303] = [0, 7, 4500]
    scan = next(iter(log_of(tmp_path, row(1, ranges=ranges)))).scan
    assert np.isnan(scan.ranges[:70]).all()
    assert np.isnan(scan.ranges[-70:]).all()
    assert scan.is_clear()[300:303].tolist() == [True, False, True]
    assert scan.is_hit()[300:303].tolist() == [False, False, False]
    assert scan.is_hit().sum() == 682 - 140 - 3


def test_the_user_may_trust_the_laser_farther(tmp_path: Path) -> None:
    scan = next(iter(log_of(tmp_path, row(1, ranges=4500), no_return_m=5.0))).scan
    assert scan.is_hit().any()


def test_equal_wheels_drive_straight_and_opposite_ones_turn(tmp_path: Path) -> None:
    quarter = 0.165 * math.pi / 2.0 * TICKS_PER_METRE
    log = log_of(
        tmp_path,
        row(1, 500, 700),
        row(2, 500 + TICKS_PER_METRE, 700 + TICKS_PER_METRE),
        row(3, 500 + TICKS_PER_METRE - quarter, 700 + TICKS_PER_METRE + quarter),
        row(4, 500 + 2 * TICKS_PER_METRE - quarter, 700 + 2 * TICKS_PER_METRE + quarter),
    )
    expected = [(0, 0, 0), (1, 0, 0), (1, 0, math.pi / 2), (1, 1, math.pi / 2)]
    for pose, wanted in zip(poses_of(log), expected, strict=True):
        assert (pose.x, pose.y, pose.yaw_rad) == pytest.approx(wanted, abs=1e-9)


def test_a_wheel_that_stands_still_is_the_centre_of_the_circle() -> None:
    # Half a turn about the left wheel, which stands 0.165 m to the left.
    pose = drive_arc(Pose2(), 0.0, math.pi * 0.33)
    assert (pose.x, pose.y) == pytest.approx((0.0, 0.33), abs=1e-12)
    assert abs(pose.yaw_rad) == pytest.approx(math.pi)


def test_bad_lines_are_counted_skips(tmp_path: Path) -> None:
    whole = row(1)
    log = log_of(
        tmp_path,
        whole,
        whole[:900],
        row(2).replace("1000", "one", 1),
        row(math.nan),
        row(3, math.inf),
        row(3, 1e300),
        row(1),
        row(0.5),
        row(4),
    )
    assert [scan.line for scan in log] == [1, 9]
    assert log.skips.counts == {
        "not 707 fields (a cut-off line?)": 1,
        "not numbers": 1,
        "ticks or time not finite": 3,
        "two scans of one stamp": 1,
        "time goes back": 1,
    }
    assert log.skips.lines["ticks or time not finite"] == [4, 5, 6]


def test_a_file_without_such_lines_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"a\.dat: wanted lines of 707 numbers.* 2 x not 707"):
        log_of(tmp_path, "1 2 3", "4 5 6")


@pytest.mark.datasets
@pytest.mark.parametrize(
    ("name", "scans", "skipped", "time_s"),
    [("exp1", 756, 0, 74.6), ("exp2", 641, 0, 63.2), ("test_lab2", 404, 1, 39.4)],
)
def test_recorded_drives(name: str, scans: int, skipped: int, time_s: float) -> None:
    log = open_log(DATASETS / "tinyslam" / f"{name}.dat.gz")
    found = list(log)
    assert len(found) == scans
    assert log.skips.total == skipped
    assert found[-1].scan.stamp_s - found[0].scan.stamp_s == pytest.approx(time_s, abs=0.06)
    assert found[0].odometry == Pose2()
    steps = np.diff([(s.odometry.x, s.odometry.y) for s in found if s.odometry], axis=0)
    assert 20.0 < np.hypot(*steps.T).sum() < 60.0
    assert np.hypot(*steps.T).max() < 0.5
