"""``slam gmapping`` as a user starts it: its settings, its report, and a map made in parts."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from slamfusion.io import write_carmen
from tests.cli.command import json_of, run
from tests.support.producers import room_drive

COUNT = 16
HALF = 9
# Few particles and short ways: the NumPy twins make a map in a second.
SETTINGS = ("--device", "numpy", "--particles", "3", "--linearUpdate", "0.2", "--seed", "4")


def gmapping(
    folder: Path, *arguments: str | Path, log: str = "room.log"
) -> subprocess.CompletedProcess[str]:
    return run("slam", "gmapping", log, *SETTINGS, *arguments, cwd=folder)


def write_log(path: Path, count: int = COUNT, first: int = 0) -> None:
    write_carmen(path, room_drive(count)[first:])


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a map made at once, and the state after its first half; to read only."""
    folder = tmp_path_factory.mktemp("gmapping")
    write_log(folder / "room.log")
    write_log(folder / "rest.log", COUNT, HALF)
    done = gmapping(folder, "-o", "whole")
    assert (done.returncode, done.stderr) == (0, "")
    arguments = ("-o", "half", "--stop-after", str(HALF), "--save-state", "states/half.state")
    done = gmapping(folder, *arguments)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert f"stopped after {HALF} scans, as asked for" in line
    return folder


@pytest.fixture
def state(parts: Path, tmp_path: Path) -> Path:
    """A folder of its own with the log and the state of its first half."""
    for name in ("room.log", "rest.log"):
        (tmp_path / name).write_bytes((parts / name).read_bytes())
    (tmp_path / "half.state").write_bytes((parts / "states" / "half.state").read_bytes())
    return tmp_path


@pytest.mark.parametrize(("log", "known"), [("room.log", HALF), ("rest.log", 0)])
def test_parts_give_the_bytes_of_one_run(parts: Path, state: Path, log: str, known: int) -> None:
    done = gmapping(
        state, "-o", "on", "--resume", "half.state", "--save-state", "all.state", "--report", "rep",
        "--json", log=log,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for suffix in (".pgm", ".yaml", ".tum"):
        whole = (parts / f"whole{suffix}").read_bytes().replace(b"whole.pgm", b"on.pgm")
        assert (state / f"on{suffix}").read_bytes() == whole
    (record,) = json_of(done)["producers"]
    assert (record["scans"], record["known_scans"]) == (COUNT, known)
    assert (record["resumed_from"], record["state_file"]) == ("half.state", "all.state")
    said = f"slamfusion: gmapping: passed over {HALF} scans of room.log that half.state knows\n"
    assert done.stderr == (said if known else "")
    # Raw odometry is drawn where its start is known.
    page = (state / "rep" / "report.html").read_text(encoding="utf-8")
    assert ("Raw odometry is aligned" in page) == bool(known)
