"""``experiment`` as a user starts it."""

from __future__ import annotations

import csv
import gzip
import json
from pathlib import Path

import pytest

from slamfusion.experiments.drive_paths import DRAWN, drawn_at
from slamfusion.experiments.examples import example_maps
from slamfusion.experiments.voting import FUSIONS
from slamfusion.io import write_carmen, write_tum
from slamfusion.slam.registry import BUILT_IN
from tests.cli.command import assert_one_line_failure, json_of, run, tree
from tests.experiments.drives import room
from tests.support.documents import check_document

pytestmark = pytest.mark.once

NUMPY = ("--device", "numpy")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short log, its relations and its truth."""
    folder = tmp_path_factory.mktemp("drive")
    made = room(drift=0.3)
    assert made.relations is not None
    assert made.reference is not None
    write_carmen(folder / "room.log", made.scans)
    write_tum(folder / "truth.tum", made.reference)
    ((first, second),), ((x, y, yaw),) = made.relations.stamps_s, made.relations.motions
    line = f"{first} {second} {x} {y} 0 0 0 {yaw}\n"
    (folder / "room.relations").write_text(line, encoding="utf-8")
    return folder


def test_cell_models_prints_table_two(tmp_path: Path) -> None:
    done = run("experiment", "cell-models", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    for wanted in (
        "base forward 0.105 0.225 0.460 0.105 0.225 0.460 yes",
        "base backward 0.502 0.737 0.858 0.502 0.737 0.858 yes",
        "mean forward 0.245 0.480 0.715 0.245 0.480 0.715 yes",
        "mean backward 0.245 0.480 0.715 0.245 0.480 0.715 yes",
    ):
        assert wanted.split() in lines


def test_cell_models_writes_table_and_picture(tmp_path: Path) -> None:
    done = run("experiment", "cell-models", "-o", tmp_path, "--json")
    document = json_of(done)
    assert document["equal"] is True
    assert len(document["rows"]) == 12
    assert set(tree(tmp_path)) == {f"cell-models.{kind}" for kind in ("csv", "md", "json", "png")}
    with (tmp_path / "cell-models.csv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert table[1]["9 occupied"] == "0.858"
    assert (tmp_path / "cell-models.png").read_bytes().startswith(b"\x89PNG")
    assert "cell-models.png" in (tmp_path / "cell-models.md").read_text(encoding="utf-8")


def test_occupancy_estimator_on_a_log_alone(drive: Path, tmp_path: Path) -> None:
    done = run(
        "experiment", "occupancy-estimator", "-o", tmp_path, *NUMPY,
        "--log", drive / "room.log", "--relations", drive / "room.relations",
        "--reference", drive / "truth.tum",
        "--floors", "0", "--seeds", "2", "--resolutions", "0.1,0.4", "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    document = json_of(done)
    assert document["complete"] is True
    assert document["runs_made"] == 8
    assert {item["measure"] for item in document["verdicts"]} == {
        "relations_mean_m",
        "ate_rmse_m",
    }
    assert document["config"]["experiment"]["occupancy_estimator"]["seeds"] == 2
    names = {
        *(f"occupancy-estimator.{kind}" for kind in ("csv", "md", "json")),
        "occupancy-estimator-relations-mean.png",
        "occupancy-estimator-ate-rmse.png",
    }
    assert set(tree(tmp_path)) == names
    saved = json.loads((tmp_path / "occupancy-estimator.json").read_text(encoding="utf-8"))
    assert saved["runs"] == document["runs"]
    text = (tmp_path / "occupancy-estimator.md").read_text(encoding="utf-8")
    assert "## In words" in text
    assert "Unfinished" not in text


def test_cell_models_trajectories_on_logs(drive: Path, tmp_path: Path) -> None:
    log = f"{drive / 'room.log'}:{drive / 'room.relations'}"
    done = run(
        "experiment", "cell-models-trajectories", "-o", tmp_path,
        "--log", log, "--log", f"{log}:{drive / 'room.log'}",
        "--floors", "0", "--seeds", "2",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "tinyslam base" in done.stdout
    assert "room#2, relations mean in m: " in done.stdout
    with (tmp_path / "cell-models-trajectories.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["drive"] for row in rows] == ["room"] * 6 + ["room#2"] * 6
    assert "gmapping" in {row["method"] for row in rows}
    saved = json.loads((tmp_path / "cell-models-trajectories.json").read_text(encoding="utf-8"))
    check_document({**saved, "files": []}, "experiment cell-models-trajectories")


def test_ground_obstacle_small(tmp_path: Path) -> None:
    arguments = (
        "experiment", "ground-obstacle", "-o", tmp_path,
        "--repetitions", "2", "--worlds", "1", "--particles", "2", "--json",
    )  # fmt: skip
    done = run(*arguments)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    document = json_of(done)
    methods = [*BUILT_IN, *FUSIONS]
    assert len(document["trials"]) == 4
    assert [item["method"] for item in document["summaries"]] == methods * 2
    assert {item["condition"] for item in document["pairs"]} == {"no obstacle", "obstacle"}
    assert document["config"]["experiment"]["ground_obstacle"]["repetitions"] == 2
    files = tree(tmp_path)
    assert {f"ground-obstacle.{kind}" for kind in ("csv", "md", "json")} < set(files)
    shown = methods
    assert len([name for name in files if name.endswith(".png")]) == 2 * len(shown)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "p-values as in [F16], obstacle" in page
    assert "Fused minus best input" in page
    assert page.count("data:image/png;base64") == 2 * len(shown)
    assert "Faces of the walls" in page
    # All of it is there: nothing is driven again, and everything is the same.
    again = json_of(run(*arguments, timeout=20.0))
    assert again["trials"] == document["trials"]
    unchanged = {name: data for name, data in files.items() if name.startswith("trials")}
    assert len(unchanged) > 4
    assert unchanged.items() <= tree(tmp_path).items()


def test_real_logs_skips_what_is_not_there(tmp_path: Path) -> None:
    made = room()
    folder = tmp_path / "datasets" / "mit-csail"
    folder.mkdir(parents=True)
    assert made.reference is not None
    write_carmen(folder / "mit-csail.clf.gz", made.scans)
    write_tum(tmp_path / "truth.tum", made.reference)
    text = (tmp_path / "truth.tum").read_bytes()
    (folder / "mit-csail-reference-graph.log.gz").write_bytes(gzip.compress(text))
    out = tmp_path / "out"
    done = run(
        "experiment", "real-logs", "--datasets", tmp_path / "datasets", "-o", out, "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (skipped,) = done.stderr.splitlines()
    assert "skipped: intel: " in skipped
    assert skipped.endswith("intel-910-raw.log.gz is not there")
    document = json_of(done)
    methods = [*BUILT_IN, *FUSIONS]
    drawn = [*map(drawn_at, BUILT_IN), DRAWN]
    assert [item["map"] for item in document["maps"]] == [*methods, *drawn, "reference"]
    assert all(item["wall_distance_mean_m"] < 0.2 for item in document["maps"][:-1])
    assert set(document["overall"]) == set(FUSIONS)
    files = tree(out)
    assert {f"real-logs.{kind}" for kind in ("csv", "md", "json")} < set(files)
    assert len([name for name in files if name.endswith(".png")]) == len([*methods, *drawn])
    assert "12 of 12 scans" in (out / "report.html").read_text(encoding="utf-8")
    truth, maps = example_maps(out, "mit-csail")
    assert [grid.name for grid in maps] == [*methods, *drawn]
    assert all(grid.cells.shape == truth.cells.shape for grid in maps)


def test_real_logs_without_any_is_one_line(tmp_path: Path) -> None:
    done = run("experiment", "real-logs", "--datasets", tmp_path, "-o", tmp_path / "out")
    assert done.returncode == 1
    assert "no recorded drive in" in done.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()


@pytest.mark.full
def test_simulated_floor_is_the_default(tmp_path: Path) -> None:
    done = run(
        "experiment", "occupancy-estimator", "-o", tmp_path,
        "--seeds", "2", "--resolutions", "0.5", "--json", timeout=600.0,
    )  # fmt: skip
    document = json_of(done)
    assert [item["drive"] for item in document["verdicts"]] == ["office-1"]
    constant = document["conditions"][0]["ate_rmse_m"]
    assert constant["worst"] < 1.0


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("occupancy-estimator", "--relations", "x"), "give --log"),
        (("occupancy-estimator", "--floors", "0"), "nothing to run on"),
        (("cell-models-trajectories", "--floors", "0"), "nothing to run on"),
        (("cell-models-trajectories", "--log", "only.log"), "wanted LOG:RELATIONS"),
        (("cell-models-trajectories", "--log", "a:b:c:d"), "wanted LOG:RELATIONS"),
        (("occupancy-estimator", "--resolutions", "0.6..0.1"), "must be like 0.1..0.6"),
        (("failures", "--courses", "glas"), "wanted some of corridor loop, glass"),
        (("failures", "--lidars", "sonar"), "must be one of kinect, hokuyo"),
        (("ground-obstacle", "--repetitions", "0"), "must lie in [1, 10000]"),
        (("no-such",), "No such command"),
    ],
)
def test_wrong_usage(tmp_path: Path, arguments: tuple[str, ...], word: str) -> None:
    out = () if arguments == ("no-such",) else ("-o", str(tmp_path / "out"))
    done = run("experiment", *arguments, *out)
    assert done.returncode == 2
    assert word in " ".join(done.stderr.split())
    assert not (tmp_path / "out").exists()


def test_a_log_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    done = run(
        "experiment", "cell-models-trajectories", "-o", tmp_path / "out", *NUMPY,
        "--log", "gone.log:gone.relations",
    )  # fmt: skip
    assert_one_line_failure(done, "gone.log")
    assert not (tmp_path / "out").exists()
