"""``--start`` on ``fuse``, ``run`` and ``align``."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from slamfusion.geometry import Pose2
from tests.cli.command import MAPS, SAMPLE, TRUTH, json_of, run, run_here, tree

pytestmark = pytest.mark.usefixtures("remembered_searches")

POSES = {
    name: Pose2(record["dx_m"], record["dy_m"], record["yaw_rad"])
    for name, record in yaml.safe_load((SAMPLE / "transforms.yaml").read_text("utf-8")).items()
}
WANTED = "wanted x,y,yaw or x,y,yaw,metres,radians, all finite, tolerances from 0"
# What is given, and the end of the line that refuses it.
BAD = {
    "map_a=1,2,nan": f"map_a: {WANTED}; found 1,2,nan",
    "map_a=1,2": f"map_a: {WANTED}; found 1,2",
    "map_a=1deg,2,3": f"map_a: {WANTED}; found 1deg,2,3",
    "map_a=1,2,-90": "found -90; if these are degrees, write -90deg",
    "map_a=1,2,3,1,20": "found 20; if these are degrees, write 20deg",
    "map_a=1,2,3,-0.1,1": f"map_a: {WANTED}; found 1,2,3,-0.1,1",
    "=1,2,3": "wanted NAME=x,y,yaw or NAME=x,y,yaw,metres,radians, found '=1,2,3'",
}
COMMANDS = {
    "fuse": ("fuse", *MAPS[:2], "-o", "x"),
    "run": ("run", "absent.log", "-o", "x"),
    "align": ("align", *MAPS[:2]),
}


def start(name: str, pose: Pose2, *tolerances: float) -> tuple[str, str]:
    numbers = (pose.x, pose.y, pose.yaw_rad, *tolerances)
    return "--start", f"{name}=" + ",".join(map(repr, numbers))


def assert_refused(folder: Path, words: str, *arguments: str | Path) -> None:
    """Exit code 2 and one line; nothing is written."""
    done = run(*arguments, cwd=folder)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("slamfusion: error: '--start': ")
    assert line.endswith(words), line
    assert done.stdout == ""
    assert not tree(folder)


@pytest.mark.parametrize(
    ("command", "given"),
    [*(("fuse", given) for given in BAD), *((command, "map_a=1,2") for command in COMMANDS)],
)
def test_a_start_that_is_none_is_refused_in_one_line(
    tmp_path: Path, command: str, given: str
) -> None:
    assert_refused(tmp_path, BAD[given], *COMMANDS[command], "--start", given)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_start_that_names_no_input_or_is_given_twice_is_refused(
    tmp_path: Path, command: str
) -> None:
    known = "tinyslam, gmapping, graph" if command == "run" else "map_a, map_b"
    words = f"a start names 'lab', which is no input; the inputs are {known}"
    assert_refused(tmp_path, words, *COMMANDS[command], "--start", "lab=1,2,3")
    twice = ("--start", "map_a=1,2,3", "--start", "map_a=1,2,3.5")
    assert_refused(tmp_path, "map_a is given twice; keep one", *COMMANDS[command], *twice)


def test_a_single_start_of_three_maps_is_refused(tmp_path: Path) -> None:
    words = "give one of theirs too, or name the reference"
    asked = ("fuse", *MAPS, "-o", "x", "--start", "map_a=1,2,3")
    assert_refused(tmp_path, words, *asked)


@pytest.mark.parametrize("command", ["fuse", "run"])
def test_only_align_takes_a_start_without_a_name(tmp_path: Path, command: str) -> None:
    words = "wanted NAME=x,y,yaw or NAME=x,y,yaw,metres,radians, found '1,2,3'"
    assert_refused(tmp_path, words, *COMMANDS[command], "--start", "1,2,3")
    words = "map_b is given twice, once without its name; keep one"
    both = ("--start", "1,2,3", "--start", "map_b=1,2,3")
    assert_refused(tmp_path, words, *COMMANDS["align"], *both)


def test_starts_of_the_file_hold_unless_the_option_says_otherwise(tmp_path: Path) -> None:
    right, wrong = POSES["map_b"], Pose2(8.0, 8.0, 1.0)
    path = tmp_path / "starts.yaml"
    path.write_text(yaml.safe_dump({"start": {"map_b": [wrong.x, wrong.y, wrong.yaw_rad]}}))
    asked = ("align", TRUTH, MAPS[1], "--config", path, "--json")
    assert run_here(*asked).returncode == 1
    assert json_of(run_here(*asked, *start("map_b", right)))["accepted"] is True
    path.write_text("start: {lab: [1, 2, 3]}\n")
    done = run_here(*asked)
    assert done.returncode == 1
    assert "a start names 'lab', which is no input" in done.stderr
    path.write_text("start: {map_b: [1, 2, .inf]}\n")
    done = run_here(*asked)
    assert done.returncode == 1
    assert done.stderr.startswith(f"slamfusion: error: {path}: start: map_b: {WANTED}")


def test_angles_may_be_in_degrees() -> None:
    asked = ("align", TRUTH, MAPS[1], "--start", "-0.2,-0.2,-126.05deg,2,20deg", "--json")
    found = json_of(run_here(*asked))["config"]["start"]["map_b"]
    assert found == pytest.approx([-0.2, -0.2, -2.2, 2.0, 0.34907], abs=1e-4)
