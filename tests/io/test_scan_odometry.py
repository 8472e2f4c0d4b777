"""Claims about odometry that lies beside a log."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import LogConfig
from slamfusion.errors import LogError
from slamfusion.geometry import Pose2
from slamfusion.io import LogScan, open_log
from slamfusion.io.scan_odometry import read_scan_odometry
from tests.io.logs import flaser, write_lines
from tests.support.datasets import ABSENT, DATASETS

HEADER = "index,logger_timestamp,odom_x,odom_y,odom_theta,corrected_x,corrected_y,corrected_theta"
# Poses in the log, and the odometry beside them.
LOGGED = [(1.0 * k, 0.5, 0.25) for k in range(4)]
ODOMETRY = [(1.1 * k, 0.02 * k, -0.01 * k) for k in range(4)]
RECORDED = {
    "radish-corrected/fhw": (488, 398.3, True),
    "mit-killian/infinite-corridor": (1941, 1914.0, False),
}


def rows(logged: Sequence[tuple[float, float, float]] = LOGGED) -> list[str]:
    return [
        ",".join(map(str, (k, 0.0, *own, *pose)))
        for k, (own, pose) in enumerate(zip(ODOMETRY, logged, strict=True))
    ]


def log_lines(stamps: Sequence[float] = (1.0, 2.0, 3.0, 4.0)) -> list[str]:
    return [flaser(stamp, robot=pose) for stamp, pose in zip(stamps, LOGGED, strict=True)]


def read(folder: Path, table: Sequence[str], lines: Sequence[str] | None = None) -> list[LogScan]:
    csv = write_lines(folder / "a.odom.csv", *table)
    log = write_lines(folder / "a.log", *(log_lines() if lines is None else lines))
    return list(open_log(log, LogConfig(), csv))


def poses_of(scans: Sequence[LogScan]) -> list[Pose2 | None]:
    return [item.odometry for item in scans]


def test_scans_have_the_odometry_of_their_rows(tmp_path: Path) -> None:
    scans = read(tmp_path, [HEADER, *rows()])
    assert poses_of(scans) == [Pose2(*pose) for pose in ODOMETRY]
    assert [item.scan.stamp_s for item in scans] == [1.0, 2.0, 3.0, 4.0]


def test_the_user_is_told_whose_odometry_it_is(tmp_path: Path) -> None:
    csv = write_lines(tmp_path / "a.odom.csv", HEADER, *rows())
    log = open_log(write_lines(tmp_path / "a.log", *log_lines()), LogConfig(), csv)
    assert f"odometry is that of {csv}, not the poses in the log" in log.notes


def test_columns_may_stand_in_any_order_and_those_of_the_log_be_absent(tmp_path: Path) -> None:
    table = ["odom_theta,index,odom_y,odom_x"]
    table += [f"{yaw},{k},{y},{x}" for k, (x, y, yaw) in enumerate(ODOMETRY)]
    assert poses_of(read(tmp_path, table)) == [Pose2(*pose) for pose in ODOMETRY]


def test_a_packed_table_with_empty_lines_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress("\r\n".join([HEADER, "", *rows(), ""]).encode()))
    found = read_scan_odometry(path, tmp_path / "a.log", LOGGED)
    assert found == [Pose2(*pose) for pose in ODOMETRY]


def test_unreadable_laser_lines_have_a_row_too(tmp_path: Path) -> None:
    lines = log_lines()
    lines[1] = lines[1][:20]
    scans = read(tmp_path, [HEADER, *rows()], ["# a log", lines[0], "ODOM 1 2", *lines[1:]])
    assert poses_of(scans) == [Pose2(*ODOMETRY[k]) for k in (0, 2, 3)]


@pytest.mark.parametrize("stamps", [[0.0] * 4, [4294970000.0, -1.0, -2.0, -3.0]])
def test_times_rise_where_the_stamps_are_broken(tmp_path: Path, stamps: list[float]) -> None:
    scans = read(tmp_path, [HEADER, *rows()], log_lines(stamps))
    assert [item.scan.stamp_s for item in scans] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert poses_of(scans) == [Pose2(*pose) for pose in ODOMETRY]


OTHER = [LOGGED[0], LOGGED[1], (2.01, 0.5, 0.25), LOGGED[3]]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ([HEADER, *rows()[:3]], "wanted a row for each of the 4 laser lines of"),
        ([HEADER, *rows(), rows()[3].replace("3,", "4,", 1)], "found 5; give the odometry of this"),
        ([HEADER, *rows()[:1], *rows()[2:]], "line 3: wanted the row of index 1, found 2: a row"),
        ([HEADER, *rows()[:2], "2,1,soon,2,3,4,5,6"], "line 4, column 3 of 8: wanted a finite"),
        ([HEADER, "0,0,nan,2,3,4,5,6"], "line 2, column 3 of 8: wanted a finite number, found"),
        ([HEADER, "0,0,1"], "line 2: wanted 8 columns, found 3"),
        ([HEADER], "wanted a row for each scan, found none"),
        ([], "found none"),
        (["index,x,y,theta"], "found no odom_x, odom_y, odom_theta; give a CSV file with these"),
        ([HEADER, *rows(OTHER)], "row 2 belongs to a scan at (2.0100, 0.5000) m, 0.2500 rad, but"),
    ],
)
def test_a_table_that_does_not_fit_is_one_line(
    tmp_path: Path, table: list[str], words: str
) -> None:
    with pytest.raises(LogError) as caught:
        read(tmp_path, table)
    assert words in str(caught.value)
    assert str(tmp_path / "a.odom.csv") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_table_that_ends_early_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.csv.gz"
    packed = gzip.compress("\n".join([HEADER, *rows()]).encode())
    path.write_bytes(packed[:-12])
    with pytest.raises(LogError, match="ends early or is damaged; copy it again"):
        read_scan_odometry(path, tmp_path / "a.log", LOGGED)


def test_other_kinds_of_logs_take_none(tmp_path: Path) -> None:
    csv = write_lines(tmp_path / "a.odom.csv", HEADER, *rows())
    log = write_lines(tmp_path / "a.dat", " ".join(["1"] * 707))
    with pytest.raises(LogError, match="only a CARMEN log takes its odometry from"):
        open_log(log, LogConfig(), csv)


@pytest.mark.datasets
@pytest.mark.parametrize("name", RECORDED)
def test_recorded_logs_are_driven_by_their_reconstructed_odometry(name: str) -> None:
    path = DATASETS / f"{name}-corrected.log.gz"
    if not path.exists():
        pytest.skip(ABSENT)
    count, way_m, has_stamps = RECORDED[name]
    log = open_log(path, LogConfig(), DATASETS / f"{name}.odom.csv.gz")
    scans = list(log)
    assert len(scans) == count
    assert log.skips.total == 0
    assert log.has_stamps == has_stamps
    poses = np.array([(p.x, p.y) for item in scans if (p := item.odometry)])
    assert np.hypot(*np.diff(poses, axis=0).T).sum() == pytest.approx(way_m, abs=0.1)
    assert (np.diff([item.scan.stamp_s for item in scans]) > 0.0).all()
