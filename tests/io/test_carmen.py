"""Claims about reading and writing CARMEN logs."""

from __future__ import annotations

import gzip
import math
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.config import LogConfig
from slamfusion.errors import LogError
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.io import LogScan, open_log, write_carmen
from slamfusion.io.carmen import CarmenLog
from slamfusion.io.log import LogRecord, Skips
from slamfusion.scan import LaserScan
from tests.io.logs import flaser, robotlaser, write_lines
from tests.support.datasets import DATASETS
from tests.support.examples import examples


def log_of(folder: Path, *lines: str, **config: float) -> CarmenLog:
    return CarmenLog(write_lines(folder / "a.log", *lines), LogConfig(**config))


def read(log: CarmenLog) -> tuple[list[LogScan], Skips]:
    return list(log), log.skips


@pytest.mark.parametrize(
    ("beams", "step_deg", "last_deg"),
    [(180, 1.0, 89.0), (181, 1.0, 90.0), (360, 0.5, 89.5), (361, 0.5, 90.0)],
)
def test_usual_beam_counts_start_at_the_right_in_their_usual_steps(
    tmp_path: Path, beams: int, step_deg: float, last_deg: float
) -> None:
    log = log_of(tmp_path, flaser(1, [2.0] * beams))
    scan = next(iter(log)).scan
    angles = np.degrees(scan.angles())
    assert angles[0] == pytest.approx(-90.0)
    assert angles[1] - angles[0] == pytest.approx(step_deg)
    assert angles[-1] == pytest.approx(last_deg)
    assert not any("angles" in note for note in log.notes)


def test_an_odd_beam_count_is_spread_over_180_degrees_and_said(tmp_path: Path) -> None:
    log = log_of(tmp_path, flaser(1, [2.0] * 5))
    angles = np.degrees(next(iter(log)).scan.angles())
    assert angles.tolist() == pytest.approx([-90.0, -45.0, 0.0, 45.0, 90.0])
    assert any("5 beams" in note and "45 degrees" in note for note in log.notes)


def test_robotlaser_says_its_own_geometry(tmp_path: Path) -> None:
    line = robotlaser(7.5, [1.0, 2.0, 8.0, 0.0], (1.0, 2.0, 0.5), angles=(0.3, -0.6, -0.2))
    (found,) = log_of(tmp_path, line)
    assert found.scan.angle_min_rad == 0.3
    assert found.scan.angle_increment_rad == -0.2
    assert found.scan.range_max_m == 8.0
    assert found.scan.stamp_s == 7.5
    assert found.odometry == Pose2(1.0, 2.0, 0.5)
    np.testing.assert_array_equal(found.scan.ranges, np.float32([1.0, 2.0, np.inf, np.nan]))


def laser_at(robot: tuple[float, float, float], mount: Pose2) -> tuple[float, float, float]:
    pose = Pose2(*robot).compose(mount)
    return round(pose.x, 6), round(pose.y, 6), round(pose.yaw_rad, 6)


@pytest.mark.parametrize("make", [flaser, robotlaser])
def test_a_laser_off_the_centre_gives_the_mount(tmp_path: Path, make: object) -> None:
    mount = Pose2(-0.04, 0.1, math.pi)
    robots = [(0.5 * k, -0.2 * k, 0.7 * k) for k in range(6)]
    lines = [make(k, robot=r, laser=laser_at(r, mount)) for k, r in enumerate(robots, start=1)]
    scans = list(log_of(tmp_path, *lines))
    assert [scan.odometry for scan in scans] == [Pose2(*robot) for robot in robots]
    for scan in scans:
        found = scan.scan.mount
        assert (found.x, found.y) == pytest.approx((mount.x, mount.y), abs=1e-5)
        assert wrap_angle(found.yaw_rad - mount.yaw_rad) == pytest.approx(0.0, abs=1e-5)


def test_a_laser_pose_that_wanders_is_no_mount(tmp_path: Path) -> None:
    setting = "PARAM robot_frontlaser_offset 0.25 host 0"
    lines = [flaser(k, robot=(k, 0.0, 0.0), laser=(1.1 * k, 0.0, 0.0)) for k in range(1, 5)]
    log = log_of(tmp_path, setting, *lines)
    assert {scan.scan.mount for scan in log} == {Pose2(0.25, 0.0, 0.0)}
    assert [scan.odometry.x for scan in log if scan.odometry] == [1.0, 2.0, 3.0, 4.0]
    assert any("robot_frontlaser_offset 0.25" in note for note in log.notes)


def test_an_offset_setting_that_the_poses_deny_is_not_used_and_said(tmp_path: Path) -> None:
    log = log_of(tmp_path, "PARAM robot_frontlaser_offset -0.04 host 0", flaser(1))
    assert next(iter(log)).scan.mount == Pose2()
    assert any("not used" in note for note in log.notes)


def test_comments_odometry_settings_and_other_lasers_are_no_scans(tmp_path: Path) -> None:
    rear = flaser(2).replace("FLASER", "RLASER")
    log = log_of(tmp_path, "# said", "", "ODOM 0 0 0 0 0 0 1 h 0", "PARAM a b c 0", flaser(1), rear)
    scans, skips = read(log)
    assert [scan.line for scan in scans] == [5]
    assert skips.total == 0
    assert any("1 RLASER" in note for note in log.notes)


def test_the_stamp_is_the_third_field_from_the_end(tmp_path: Path) -> None:
    line = flaser(123.25).replace("host 0", "host 999.5")
    assert next(iter(log_of(tmp_path, line))).scan.stamp_s == 123.25


def test_scans_that_a_log_holds_in_two_forms_are_read_once(tmp_path: Path) -> None:
    lines = [make(k) for k in range(1, 9) for make in (flaser, robotlaser)]
    log = log_of(tmp_path, *lines)
    scans, skips = read(log)
    assert len(scans) == 8
    assert skips.total == 0
    assert log.has_stamps
    assert {scan.scan.angle_increment_rad for scan in scans} == {0.5}
    assert any("repeat ROBOTLASER1" in note for note in log.notes)


def test_a_laser_before_any_odometry_is_a_counted_skip(tmp_path: Path) -> None:
    log = log_of(tmp_path, "Laser 2 1.0 2.0", "Odometry 1 2 0.5", "Laser 2 1.0 2.0")
    scans, skips = read(log)
    assert [scan.odometry for scan in scans] == [Pose2(1.0, 2.0, 0.5)]
    assert skips.sentences() == ("1 x laser before odometry (line 1)",)
    assert not log.has_stamps


def test_gmappings_laser_readings_are_read(tmp_path: Path) -> None:
    (found,) = log_of(tmp_path, "ODOM 9 9 9 5", "LASER_READING 3 1 2 3 0.5 0.25 0.1 17.5")
    assert found.odometry == Pose2(0.5, 0.25, 0.1)
    assert found.scan.stamp_s == 17.5
    assert found.scan.ranges.tolist() == [1.0, 2.0, 3.0]


def varied(count: int, top: float, seed: int = 1) -> list[float]:
    return np.random.default_rng(seed).uniform(0.5, top, count).round(2).tolist()


@pytest.mark.parametrize("code", [81.91, 81.83, 51.2, 32.767, 30.0])
def test_the_repeated_top_value_saw_nothing(tmp_path: Path, code: float) -> None:
    ranges = [*varied(170, 20.0), *[code] * 10]
    lines = [flaser(k, ranges) for k in range(1, 5)]
    log = log_of(tmp_path, *lines)
    scan = next(iter(log)).scan
    assert scan.is_clear().sum() == 10
    assert np.isposinf(scan.ranges[-10:]).all()
    assert scan.is_hit().sum() == 170
    assert 0.99 * code < scan.range_max_m < code
    assert any(f"repeats {code:g} m" in note for note in log.notes)


def test_two_codes_of_one_laser_both_saw_nothing(tmp_path: Path) -> None:
    ranges = [*varied(350, 20.0), *[81.91] * 8, *[81.83] * 2]
    scan = next(iter(log_of(tmp_path, *(flaser(k, ranges) for k in range(9))))).scan
    assert scan.is_clear().sum() == 10


def test_a_largest_reading_that_occurs_once_is_a_hit(tmp_path: Path) -> None:
    ranges = [*varied(179, 20.0), 79.5]
    log = log_of(tmp_path, flaser(1, ranges), *(flaser(k, varied(180, 20, k)) for k in range(2, 9)))
    scan = next(iter(log)).scan
    assert scan.is_hit().all()
    assert scan.ranges[-1] == np.float32(79.5)
    assert any(note.endswith("all above 0 and below 1000 m count as hits") for note in log.notes)


def test_readings_in_millimetres_are_named(tmp_path: Path) -> None:
    lines = [flaser(k, [1000.0 * r for r in varied(180, 20, k)]) for k in range(8)]
    assert any("millimetres? wanted metres" in note for note in log_of(tmp_path, *lines).notes)


def test_the_user_says_what_saw_nothing(tmp_path: Path) -> None:
    log = log_of(tmp_path, flaser(1, [1.0, 7.0, 9.0]), no_return_m=7.0)
    scan = next(iter(log)).scan
    assert scan.range_max_m == 7.0
    np.testing.assert_array_equal(scan.ranges, np.float32([1.0, np.inf, np.inf]))


def test_the_range_limit_of_a_robotlaser_line_is_said(tmp_path: Path) -> None:
    log = log_of(tmp_path, robotlaser(1, [1.0, 8.5, 81.91], range_max=8.0))
    assert next(iter(log)).scan.is_clear().tolist() == [False, True, True]
    assert log.notes == ["readings from 8 m on are no return, as the lines say"]


def test_zero_and_negative_readings_measured_nothing(tmp_path: Path) -> None:
    scan = next(iter(log_of(tmp_path, flaser(1, [0.0, -1.0, 2.0])))).scan
    assert np.isnan(scan.ranges).tolist() == [True, True, False]
    assert scan.is_hit().tolist() == [False, False, True]


@pytest.mark.parametrize(
    "stamps",
    [[0] * 12, ["1.13486e+09"] * 12, [4294970000.0] * 12, [*range(90), *([5] * 10)]],
    ids=["zero", "rounded", "overflowed", "a tenth not increasing"],
)
def test_broken_stamps_give_index_time_and_say_so(tmp_path: Path, stamps: list[object]) -> None:
    log = log_of(tmp_path, *map(flaser, stamps), index_period_s=0.25)
    scans, skips = read(log)
    expected = [0.25 * k for k in range(len(stamps))]
    assert [scan.scan.stamp_s for scan in scans] == pytest.approx(expected)
    assert skips.total == 0
    assert not log.has_stamps
    faults = LogRecord.of(log).faults()
    assert any("index times 0.25 s (--index-period-s)" in note for _, note in faults)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (flaser(2)[:30], "wrong number of fields"),
        ("FLASER", "wrong number of fields"),
        (flaser(2).replace("FLASER 3", "FLASER 4"), "wrong number of fields"),
        (flaser(2).replace("FLASER 3", "FLASER 99999999999999999999"), "wrong number of fields"),
        (flaser(2).replace("FLASER 3", "FLASER x"), "not numbers"),
        (flaser(2).replace("2.0", "two"), "not numbers"),
        (flaser("soon"), "not numbers"),
        (flaser(2, robot=(math.nan, 0.0, 0.0)), "pose or time not finite"),
        (flaser(2, robot=(0.0, math.inf, 0.0)), "pose or time not finite"),
        (flaser(math.nan), "pose or time not finite"),
        (flaser(2, robot=(1e300, 0.0, 0.0)), "pose more than 1e+09 m away"),
        (robotlaser(2, angles=(1e300, 1.0, 0.1)), "angles or ranges that cannot be a scan"),
        (flaser(2, []), "scan without beams"),
        (robotlaser(2)[:40], "wrong number of fields"),
        (robotlaser(2, angles=(math.nan, 1.0, 0.1)), "pose or time not finite"),
        (robotlaser(2, angles=(0.0, 0.0, 0.0)), "angles or ranges that cannot be a scan"),
        ("LASER_READING 3 1 2", "wrong number of fields"),
        ("Odometry 1 2", "wrong number of fields"),
    ],
)
def test_a_damaged_line_is_a_counted_skip(tmp_path: Path, bad: str, reason: str) -> None:
    scans, skips = read(log_of(tmp_path, flaser(1), bad, flaser(3)))
    assert [scan.line for scan in scans] == [1, 3]
    (sentence,) = skips.sentences()
    assert sentence.startswith(f"1 x {reason}")
    assert sentence.endswith("(line 2)")


@pytest.mark.parametrize("parts", [2, 20])
def test_a_cut_off_packed_file_gives_what_is_whole_and_says_so(tmp_path: Path, parts: int) -> None:
    lines = "\n".join(flaser(k, varied(180, 20.0, k)) for k in range(1, 200))
    packed = gzip.compress(lines.encode())
    path = tmp_path / "a.log.gz"
    path.write_bytes(cut := packed[: len(packed) // parts])
    scans, skips = read(CarmenLog(path))
    assert len(scans) == zlib.decompressobj(31).decompress(cut).count(b"\n") > 0
    assert any("ends early" in reason for reason in skips.counts)


poses = st.builds(Pose2, st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-math.pi, math.pi))
readings = st.one_of(
    st.floats(0.0625, 40.0, width=32), st.just(math.inf), st.just(math.nan), st.just(0.0)
)


@st.composite
def logged_scans(draw: st.DrawFn) -> list[LogScan]:
    """Scans of one laser: FLASER's geometry, or any other."""
    forward = draw(st.booleans())
    count = draw(st.sampled_from([180, 181, 360, 361]) if forward else st.integers(1, 12))
    step = math.pi / (180 if count < 200 else 360)
    first, step, mount = (
        (-math.pi / 2.0, step, Pose2())
        if forward
        else (
            draw(st.floats(-3.0, 3.0)),
            draw(st.floats(0.001, 0.5)) * draw(st.sampled_from([1.0, -1.0])),
            draw(st.builds(Pose2, st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.1, 3.1))),
        )
    )
    range_max = draw(st.floats(1.0, 40.0))
    stamps = draw(st.lists(st.integers(0, 10**9), min_size=1, max_size=4, unique=True).map(sorted))
    start = draw(st.sampled_from([0.0, 1.2e9]))
    return [
        LogScan(
            LaserScan(
                stamp_s=start + 1.0 + 1e-3 * stamp,
                ranges=np.resize(np.array(draw(st.lists(readings, min_size=1)), np.float32), count),
                angle_min_rad=first,
                angle_increment_rad=step,
                range_min_m=0.0,
                range_max_m=range_max,
                mount=mount,
            ),
            draw(poses),
            line,
        )
        for line, stamp in enumerate(stamps, start=1)
    ]


def assert_same_pose(found: Pose2 | None, wanted: Pose2 | None) -> None:
    assert (found.x, found.y) == pytest.approx((wanted.x, wanted.y), abs=1e-6)
    assert wrap_angle(found.yaw_rad - wanted.yaw_rad) == pytest.approx(0.0, abs=1e-6)


@settings(deadline=None, max_examples=examples(60))
@given(scans=logged_scans(), packed=st.booleans())
def test_what_is_written_reads_back(
    scans: list[LogScan], packed: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("round") / ("a.log.gz" if packed else "a.clf")
    assert write_carmen(path, scans) == len(scans)
    log = open_log(path)
    found = list(log)
    assert len(found) == len(scans)
    assert log.skips.total == 0
    for back, wanted in zip(found, scans, strict=True):
        assert back.scan.stamp_s == pytest.approx(wanted.scan.stamp_s, abs=1e-6, rel=0)
        assert_same_pose(back.odometry, wanted.odometry)
        assert_same_pose(back.scan.mount, wanted.scan.mount)
        assert back.scan.range_max_m == wanted.scan.range_max_m
        assert back.scan.angles() == pytest.approx(wanted.scan.angles(), abs=1e-9)
        hits = wanted.scan.is_hit()
        np.testing.assert_array_equal(back.scan.is_hit(), hits)
        np.testing.assert_array_equal(back.scan.is_clear(), wanted.scan.is_clear())
        np.testing.assert_allclose(back.scan.ranges[hits], wanted.scan.ranges[hits], atol=2e-4)


def test_a_scan_without_odometry_cannot_be_written(tmp_path: Path) -> None:
    path = tmp_path / "b.log"
    first, second = log_of(tmp_path, flaser(1), flaser(2))
    with pytest.raises(LogError, match="scan 2 has no odometry"):
        write_carmen(path, [first, replace(second, odometry=None)])
    assert not path.exists()


def test_no_scan_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no scan to write"):
        write_carmen(tmp_path / "a.log", [])


RECORDED = [
    ("mit-csail/mit-csail.clf.gz", 1988, 0, 361, 424.0, 373.6, True),
    ("mit-csail/csail.corrected.gfs.gz", 406, 0, 361, 395.8, 371.1, True),
    ("mit-csail/csail-corrected.log.gz", 406, 0, 361, 40.5, 379.6, False),
    ("mit-csail/mit-csail-reference-graph.log.gz", 1051, 0, 361, 410.3, 382.9, True),
    ("intel/intel-910-raw.log.gz", 910, 0, 180, 2650.9, 501.1, True),
    ("intel/intel-2726-raw.log.gz", 2726, 0, 180, 2667.2, 506.0, True),
    ("intel/intel-corrected.log.gz", 906, 4, 180, 2650.9, 499.4, True),
    ("mit-killian/infinite-corridor-corrected.log.gz", 1941, 0, 180, 194.0, 1919.7, False),
    ("radish-corrected/acapulco-corrected.log.gz", 861, 0, 181, 1363.9, 812.2, True),
    ("radish-corrected/fhw-corrected.log.gz", 488, 0, 180, 2007.2, 405.5, True),
    ("radish-corrected/freiburg-campus-corrected.log.gz", 2008, 0, 360, 200.7, 1754.4, False),
    ("radish-corrected/orebro-corrected.log.gz", 237, 0, 181, 23.6, 221.4, False),
    ("dpslam/loop5.log.gz", 551, 0, 181, 55.0, 56.1, False),
]


# The longest real reading and how often the log writes what stands for nothing; README, section 2.
NOTHING_SEEN = {
    "mit-csail/mit-csail.clf.gz": (42.4, 23711),
    "intel/intel-910-raw.log.gz": (25.38, 4172),
    "radish-corrected/orebro-corrected.log.gz": (32.63, 968),
    "radish-corrected/freiburg-campus-corrected.log.gz": (81.74, 184330 + 2704),
    "mit-killian/infinite-corridor-corrected.log.gz": (50.86, 4660),
}


@pytest.mark.datasets
@pytest.mark.parametrize(
    ("name", "scans", "skipped", "beams", "time_s", "path_m", "has_stamps"), RECORDED
)
def test_recorded_logs_give_the_scans_they_are_known_for(
    name: str, scans: int, skipped: int, beams: int, time_s: float, path_m: float, has_stamps: bool
) -> None:
    log = open_log(DATASETS / name)
    found = list(log)
    assert len(found) == scans
    assert log.skips.total == skipped
    assert {len(scan.scan) for scan in found} == {beams}
    assert log.has_stamps == has_stamps
    assert found[-1].scan.stamp_s - found[0].scan.stamp_s == pytest.approx(time_s, abs=0.06)
    xy = np.array([(scan.odometry.x, scan.odometry.y) for scan in found if scan.odometry])
    assert np.hypot(*np.diff(xy, axis=0).T).sum() == pytest.approx(path_m, abs=0.06)
    if name in NOTHING_SEEN:
        longest_m, clear = NOTHING_SEEN[name]
        seen = [item.scan for item in found]
        assert sum(int(scan.is_clear().sum()) for scan in seen) == pytest.approx(clear, rel=2e-4)
        longest = max(float(scan.ranges[scan.is_hit()].max()) for scan in seen)
        assert longest == pytest.approx(longest_m, abs=0.01)
