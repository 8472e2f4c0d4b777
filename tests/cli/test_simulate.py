"""``slamfusion simulate``, started as a user starts it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from slamfusion.io import load_map, open_log, read_trajectory
from tests.cli.command import assert_one_line_failure, json_of, run, tree

pytestmark = pytest.mark.once


@pytest.fixture(scope="module")
def f16(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the f16 course, seed 3."""
    folder = tmp_path_factory.mktemp("f16")
    done = run("simulate", "f16", "--seed", "3", "-o", folder, "--json")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    (folder / "made.json").write_text(done.stdout, encoding="utf-8")
    return folder


def test_it_says_what_was_made(f16: Path) -> None:
    done = run("simulate", f16 / "course.yaml", "-o", f16 / "again", "--json")
    made = json_of(done)
    assert (made["name"], made["scans"], made["seed"]) == ("f16", 181, 3)
    assert made["duration_s"] == pytest.approx(18.0)
    assert 4.0 < made["path_m"] < 5.0
    assert [Path(path).name for path in made["files"]] == [
        "f16.log.gz",
        "truth.yaml",
        "truth.pgm",
        "truth_thin.yaml",
        "truth_thin.pgm",
        "truth.tum",
        "course.yaml",
    ]
    assert all(Path(path).is_file() for path in made["files"])
    assert made["world"]["obstacles"] == 1
    assert made["device"]
    assert made["versions"]["numpy"]
    for path in made["files"]:
        assert Path(path).read_bytes() == (f16 / Path(path).name).read_bytes()


def test_log_truth_and_poses_fit_each_other(f16: Path) -> None:
    scans = list(open_log(f16 / "f16.log.gz"))
    truth = read_trajectory(f16 / "truth.tum")
    assert len(scans) == len(truth) == 181
    assert truth.stamps_s[-1] == pytest.approx(scans[-1].scan.stamp_s)
    first = scans[0].odometry
    assert (first.x, first.y) == pytest.approx(truth.poses[0, :2], abs=1e-6)
    grid = load_map(f16 / "truth.yaml")
    rows, cols = grid.cell_indices(truth.poses[:, :2])
    assert (grid.cells[rows, cols] == 0).all()


def test_options_change_the_course(tmp_path: Path) -> None:
    options = ("--lidar", "rplidar", "--no-obstacle", "--people", "1", "--resolution", "0.1")
    done = run("simulate", "f16", "-o", tmp_path, *options, "--json")
    made = json_of(done)
    assert (made["beams"], made["world"]["resolution"]) == (360, 0.1)
    assert (made["world"]["people"], made["world"]["obstacles"]) == (1, 0)
    written = yaml.safe_load((tmp_path / "course.yaml").read_text(encoding="utf-8"))
    assert written["lidar"]["model"] == "rplidar"
    assert written["obstacles"] == []
    assert len(written["people"]) == 1


def test_a_seed_on_the_command_line_beats_the_files(f16: Path, tmp_path: Path) -> None:
    course = f16 / "course.yaml"
    done = run("simulate", course, "-o", tmp_path / "given", "--seed", "4", "--json")
    assert json_of(done)["seed"] == 4
    log = tmp_path / "given" / "f16.log.gz"
    assert log.read_bytes() != (f16 / "f16.log.gz").read_bytes()


def test_the_truth_of_one_drive_is_the_world_of_another(f16: Path, tmp_path: Path) -> None:
    options = ("--world", f16 / "truth.yaml")
    made = json_of(run("simulate", "atrium", *options, "-o", tmp_path, "--json"))
    assert (made["name"], made["world"]["name"]) == ("truth", "map")
    assert (tmp_path / "truth.pgm").read_bytes() == (f16 / "truth.pgm").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere",), ("no course file", "'nowhere' is not one of office, ")),
        (("bad.yaml",), ("bad.yaml", "unknown key 'worlds'", "'world'")),
        (("hall", "--world", "absent.yaml", "--resolution", "0.1"), ("own cell size",)),
        (("f16", "--drive", "bicycle"), ("bicycle cannot",)),
        (("far.yaml",), ("drives into a wall after",)),
    ],
)
def test_failures_are_one_line_and_leave_nothing(
    tmp_path: Path, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    (tmp_path / "bad.yaml").write_text("worlds: hall\n", encoding="utf-8")
    far = "world: atrium\nscript: [forward_m: 20]\n"
    (tmp_path / "far.yaml").write_text(far, encoding="utf-8")
    before = tree(tmp_path)
    done = run("simulate", *arguments, "-o", "out", cwd=tmp_path)
    assert_one_line_failure(done, *words)
    assert tree(tmp_path) == before
