"""``slam`` as a user starts it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from slamfusion.io import read_trajectory, write_carmen
from slamfusion.io.log import LogScan
from tests.cli.command import assert_one_line_failure, json_of, run, tree
from tests.cli.run_folder import SUFFIXES
from tests.support.producers import room_drive, unseeing


def write_log(path: Path, scans: Sequence[LogScan]) -> Path:
    write_carmen(path, scans)
    return path


def test_a_truth_of_another_time_loses_no_map(tmp_path: Path) -> None:
    log = write_log(tmp_path / "room.log", room_drive(4))
    (tmp_path / "late.tum").write_text("9e9 0 0 0 0 0 0 1\n9.1e9 1 0 0 0 0 0 1\n", encoding="utf-8")
    done = run("slam", "tinyslam", log, "-o", tmp_path / "m", "--truth", tmp_path / "late.tum")
    assert_one_line_failure(done, "the map and the path were written all the same")
    for suffix in SUFFIXES:
        assert (tmp_path / f"m{suffix}").stat().st_size > 0


def test_odometry_of_scans_replaces_the_poses_of_the_log(tmp_path: Path) -> None:
    log = write_log(tmp_path / "room-corrected.log", room_drive(12))
    rows = [f"{k},{0.06 * k},1.5,0.0" for k in range(12)]
    table = tmp_path / "room.odom.csv"
    table.write_text("\n".join(["index,odom_x,odom_y,odom_theta", *rows]), encoding="ascii")
    arguments = ("slam", "tinyslam", log, "-o", tmp_path / "map", "--scan-odometry")
    document = json_of(run(*arguments, table, "--json"))
    assert document["scan_odometry"] == str(table)
    (record,) = document["producers"]
    assert record["odometry_path_length_m"] == pytest.approx(0.06 * 11)
    assert any(str(table) in note for note in record["log"]["notes"])
    # The map frame begins where the odometry does.
    assert read_trajectory(tmp_path / "map.tum").poses[0, 1] == pytest.approx(1.5)

    table.write_text("\n".join(["index,odom_x,odom_y,odom_theta", *rows[:-1]]), encoding="ascii")
    before = tree(tmp_path)
    assert_one_line_failure(run(*arguments, table), "each of the 12 laser lines", "found 11")
    assert tree(tmp_path) == before


def test_a_doubtful_run_is_said_everywhere(tmp_path: Path) -> None:
    scans = room_drive(12)
    log = write_log(tmp_path / "room.log", scans[:6] + unseeing(scans[6:]))
    done = run(
        "slam", "tinyslam", log, "-o", tmp_path / "map",
        "--report", tmp_path / "report", "--json",
    )  # fmt: skip
    assert done.returncode == 0
    (notice,) = done.stderr.splitlines()
    assert "tracking may be lost: 6 of 12 scans could not be used" in notice
    (warning,) = json_of(done)["producers"][0]["warnings"]
    assert warning in notice
    html = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "tracking may be lost" in html


def test_scans_that_see_nothing_make_no_map_and_no_file(tmp_path: Path) -> None:
    log = write_log(tmp_path / "blind.log", unseeing(room_drive(3)))
    done = run("slam", "tinyslam", log, "-o", tmp_path / "map")
    assert_one_line_failure(done, "blind.log", "none of 3 scans", "3 x no reading")
    assert set(tree(tmp_path)) == {"blind.log"}


@pytest.mark.parametrize(("first", "known"), [(0, 9), (9, 0)])
def test_a_map_that_is_made_in_parts_is_that_of_one_run(
    tmp_path: Path, first: int, known: int
) -> None:
    """The second part is of the same log, or of one that starts where the state ends."""
    logs = [write_log(tmp_path / f"{n}.log", room_drive(16)[n:]) for n in (0, first)]
    settings = ("--device", "numpy", "--particles", "3", "--linearUpdate", "0.2", "--seed", "4")
    slam, state = ("slam", "gmapping", *settings), tmp_path / "half.state"
    assert run(*slam, logs[0], "-o", tmp_path / "whole").stderr == ""
    half = run(*slam, logs[0], "-o", tmp_path / "on", "--stop-after", "9", "--save-state", state)
    assert "stopped after 9 scans, as asked for" in half.stderr
    done = run(
        *slam, logs[1], "-o", tmp_path / "on", "--resume", state, "--report", tmp_path, "--json"
    )
    for suffix in (".pgm", ".tum"):
        assert (tmp_path / f"on{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()
    (record,) = json_of(done)["producers"]
    assert (record["scans"], record["known_scans"]) == (16, known)
    assert record["resumed_from"] == str(state)
    said = f"slamfusion: gmapping: passed over 9 scans of {logs[0]} that {state} knows\n"
    assert done.stderr == (said if known else "")
    # Raw odometry is drawn where its start is known.
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert ("Raw odometry is aligned" in page) == bool(known)
