"""``experiment`` as a user starts it."""

from __future__ import annotations

import csv
import gzip
from pathlib import Path

import pytest

from slamfusion.experiments.fusions import FUSIONS, drawn_at
from slamfusion.experiments.runs import kept_maps
from slamfusion.io import write_carmen, write_tum
from slamfusion.jobs.inputs import LogFiles
from slamfusion.jobs.outputs import DRAWN
from slamfusion.slam.registry import BUILT_IN
from tests.cli.command import assert_one_line_failure, json_of, run, run_here, tree
from tests.experiments.drives import room, room_files
from tests.support.documents import check_document


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> LogFiles:
    """A short log, its relations and its truth."""
    return room_files(tmp_path_factory.mktemp("drive"))


def test_cell_models_prints_and_writes_table_two(tmp_path: Path) -> None:
    done = run("experiment", "cell-models", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    for wanted in (
        "forward, 9 occupied\t1\t0.460\t0.460\t0.715\t0.715",
        "backward, 9 occupied\t1\t0.858\t0.858\t0.715\t0.715",
    ):
        assert wanted in done.stdout.splitlines()
    assert set(tree(tmp_path / "out")) == {f"cell-models.{kind}" for kind in ("csv", "md", "png")}
    with (tmp_path / "out" / "cell-models.csv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 24
    assert {row["method"] for row in table} == {"base", "base [H16]", "mean", "mean [H16]"}


def test_occupancy_estimator_on_a_log_alone(drive: LogFiles, tmp_path: Path) -> None:
    arguments = (
        "experiment", "occupancy-estimator", "-o", tmp_path, "--log", drive.log,
        "--relations", drive.relations, "--reference", drive.truth,
        "--floors", "0", "--seeds", "2", "--resolutions", "0.1,0.4", "--json",
    )  # fmt: skip
    done = run(*arguments)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    document = json_of(done)
    check_document(document, "experiment occupancy-estimator")
    assert {item["figure"] for item in document["comparisons"]} == {
        "relations_mean_m", "ate_rmse_m", "time_per_scan_ms"
    }  # fmt: skip
    assert len(document["sentences"]) == 4  # both errors, in two cell sizes
    assert document["config"]["experiment"]["occupancy_estimator"]["seeds"] == 2
    files = tree(tmp_path)
    names = {f"occupancy-estimator.{kind}" for kind in ("csv", "md", "png")}
    assert {name for name in files if not name.startswith("trials")} == names
    assert len(files) == 3 + 1 + 8  # and their folder
    assert "## In words" in (tmp_path / "occupancy-estimator.md").read_text(encoding="utf-8")
    # All of it is there: nothing is run again, times included.
    assert json_of(run(*arguments))["summaries"] == document["summaries"]


@pytest.mark.full
def test_real_logs_skips_what_is_not_there(tmp_path: Path) -> None:
    made = room()
    folder = tmp_path / "datasets" / "mit-csail"
    folder.mkdir(parents=True)
    write_carmen(folder / "mit-csail.clf.gz", made.scans)
    write_tum(tmp_path / "truth.tum", made.ground_truth.truth)
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
    check_document(document, "experiment real-logs")
    methods = [*BUILT_IN, *FUSIONS]
    drawn = [*map(drawn_at, BUILT_IN), DRAWN]
    distances = [item for item in document["summaries"] if item["figure"] == "map_to_truth_mean_m"]
    assert [item["method"] for item in distances] == [*methods, *drawn]
    assert all(item["mean"] < 0.2 for item in distances)
    assert set(document["overall"]) == set(FUSIONS)
    assert {f"real-logs.{kind}" for kind in ("csv", "md", "png")} < set(tree(out))
    assert "12 of 12 scans" in (out / "real-logs.md").read_text(encoding="utf-8")
    truth, maps = kept_maps(out, "mit-csail")
    assert [grid.name for grid in maps] == [*methods, *drawn]
    assert all(grid.cells.shape == truth.cells.shape for grid in maps)


def test_real_logs_without_any_is_one_line(tmp_path: Path) -> None:
    done = run("experiment", "real-logs", "--datasets", tmp_path, "-o", tmp_path / "out")
    assert done.returncode == 1
    assert "no recorded drive in" in done.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_a_log_that_is_not_there_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/robot")
    log = "~/gone.log:gone.relations"
    done = run_here("experiment", "cell-models-trajectories", "-o", tmp_path / "out", "--log", log)
    assert_one_line_failure(done, "/home/robot/gone.log")
    assert not (tmp_path / "out").exists()
