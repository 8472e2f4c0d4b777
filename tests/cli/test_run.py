"""``run`` as a user starts it: three producers, one of them killed, saved maps, and the files."""

from __future__ import annotations

import gzip
import io
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.cli.program import run_program
from slamfusion.grid import UNKNOWN, OccupancyGrid
from slamfusion.io import load_map, read_trajectory, save_map, write_tum
from tests.cli.command import SAMPLE, assert_one_line_failure, json_of, run, tree
from tests.cli.run_folder import MAPS_OF_FUSION, files_of, outputs
from tests.slam.drives import write_flat
from tests.support.datasets import ABSENT, DATASETS

TWO = ("--producers", "tinyslam,graph")
MAP_OF_ANOTHER = SAMPLE / "map_a.yaml"
CSAIL = DATASETS / "mit-csail"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a drive through a flat, its true path, relations, and a saved map of it."""
    folder = tmp_path_factory.mktemp("place")
    write_flat(folder, 64)
    done = run("slam", "tinyslam", folder / "flat.log", "--seed", "9", "-o", folder / "saved")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def made(place: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A run with everything asked for: its folder and its JSON document."""
    out = tmp_path_factory.mktemp("run") / "out"
    done = run(
        "run", place / "flat.log", "-o", out, "--seed", "3", "--json",
        "--truth", place / "saved.yaml", "--truth-trajectory", place / "truth.tum",
        "--relations", place / "flat.relations", "--odometry", place / "flat.log",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert outputs(out) == files_of("tinyslam", "gmapping", "graph") | MAPS_OF_FUSION
    return out, json_of(done)


def test_a_producer_makes_the_map_that_slam_makes(
    made: tuple[Path, dict[str, Any]], place: Path, tmp_path: Path
) -> None:
    out, _ = made
    done = run("slam", "graph", place / "flat.log", "--seed", "3", "-o", tmp_path / "graph")
    assert done.returncode == 0, done.stderr
    for suffix in (".pgm", ".tum", ".yaml"):
        assert (tmp_path / f"graph{suffix}").read_bytes() == (out / f"graph{suffix}").read_bytes()


def test_the_tables_name_the_same_and_the_vote_is_that_of_fuse(
    made: tuple[Path, dict[str, Any]], place: Path, tmp_path: Path
) -> None:
    """It replaces all of an earlier run, what failed too; what is not of a run stays.

    Of the log a line and the end are damaged, which is named.
    """
    log, lines = tmp_path / "cut.log.gz", (place / "flat.log").read_bytes().splitlines()
    longest = max(range(len(lines) // 2), key=lambda number: len(lines[number]))
    lines[longest] = lines[longest][:100]
    log.write_bytes(gzip.compress(b"\n".join(lines))[:-2000])
    out = tmp_path / "out"
    shutil.copytree(made[0], out)
    (out / "failed" / "report").mkdir(parents=True)
    of_failed = ("failed/graph.yaml", "failed/report/report.html")
    for name in ("notes.txt", "graph_probability.yaml", *of_failed):
        (out / name).write_text("mine, or of an earlier run", encoding="utf-8")
    vote = ("--mode", "consensus")
    (tmp_path / "early.relations").write_text("0.2 3.0 1 0 0 0 0 0\n", encoding="utf-8")
    options = (*TWO, *vote, "--relations", tmp_path / "early.relations", "--truth", MAP_OF_ANOTHER)
    done = run("run", log, "-o", out, *options)
    assert done.returncode == 0, done.stderr
    assert "slamfusion: not aligned: graph: " in done.stderr
    left_out = "left out of the log: 1 x "
    assert f"{left_out}wrong number of fields (a cut-off line?) (line " in done.stderr
    cut = "the packed file ends early or is damaged; nothing after this was read (line "
    assert f"{left_out}{cut}" in done.stderr
    assert cut in (out / "report" / "report.html").read_text(encoding="utf-8")
    for word in ("tinyslam", "graph", "relations mean [m]", "votes",
                 "fused.yaml (consensus)", "report.html"):  # fmt: skip
        assert word in done.stdout
    assert "gmapping" not in done.stdout
    assert outputs(out) == files_of("tinyslam", "graph") | MAPS_OF_FUSION | {"notes.txt"}
    assert not (out / "failed").exists()
    assert not list(out.rglob(".slamfusion-*"))
    maps = [out / f"{name}.yaml" for name in ("tinyslam", "graph")]
    done = run("fuse", *maps, "--shared-frame", *vote, "-o", tmp_path / "fused")
    assert done.returncode == 0, done.stderr
    again, fused = load_map(tmp_path / "fused.yaml"), load_map(out / "fused.yaml")
    assert again.origin == fused.origin
    assert np.array_equal(again.cells, fused.cells)


def test_a_run_that_fuses_nothing_leaves_the_earlier_results(
    made: tuple[Path, dict[str, Any]], place: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(made[0], out)
    before = tree(out)
    other = ("--inputs", MAP_OF_ANOTHER)
    done = run("run", place / "flat.log", "-o", out, "--producers", "graph", *other)
    assert_one_line_failure(
        done, "no two of the inputs", f"so far are in {out}/failed", f"{out} keeps"
    )
    after = tree(out)
    failed = {name for name in after if name.split("/")[0] == "failed"}
    assert {name: data for name, data in after.items() if name not in failed} == before
    assert outputs(out / "failed") == files_of("graph")
    html = (out / "failed" / "report" / "report.html").read_text(encoding="utf-8")
    assert "Nothing was fused" in html
    shown = {path.name for path in (out / "failed" / "report").glob("*.png")}
    assert len(shown) == html.count("<img ")


@pytest.mark.full
def test_paths_that_cannot_be_measured_are_one_short_line(place: Path, tmp_path: Path) -> None:
    """Each path has the same trouble with a truth of another clock; the report names all."""
    truth = read_trajectory(place / "truth.tum")
    write_tum(tmp_path / "late.tum", replace(truth, stamps_s=truth.stamps_s + 1e6))
    given = ("--truth-trajectory", tmp_path / "late.tum")
    done = run("run", place / "flat.log", "-o", tmp_path / "out", *TWO, *given)
    assert_one_line_failure(done, "two clocks", "; 2 more in the report (the files so far")
    assert done.stderr.count("two clocks") == 1
    page = (tmp_path / "out" / "report" / "report.html").read_text(encoding="utf-8")
    assert page.count("two clocks") >= 3


@pytest.mark.full
def test_the_bar_of_the_whole_run_ends_at_100_percent(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", terminal)
    assert run_program(["run", str(place / "flat.log"), "-o", str(tmp_path), *TWO]) == 0
    shown = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", terminal.getvalue())
    assert re.findall(r"whole run\D*(\d+) %", shown)[-1] == "100"


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (("--producers", "tinyslam,grph"), 2, "did you mean 'graph'?"),
        (("-o", "flat.log"), 2, "is not a folder"),
        (("--inputs", "absent.yaml"), 1, "absent.yaml"),
        (("--truth", "absent.yaml"), 1, "absent.yaml"),
        (("--truth", "tiny.yaml"), 1, "tiny.yaml: resolution must lie in"),
        (("--truth", "mm.yaml"), 1, "mm: cells of 50 m are 1000 times coarser"),
        (("--truth", "blank.yaml"), 1, "blank: no cell is surely free or occupied"),
        (("--inputs", "tiny.yaml"), 1, "tiny.yaml: resolution must lie in"),
        (("--processes", "0"), 1, "must lie in"),
    ],
)
def test_what_cannot_end_well_is_refused_before_any_work(
    place: Path, tmp_path: Path, arguments: tuple[str, ...], code: int, word: str
) -> None:
    (tmp_path / "flat.log").write_bytes((place / "flat.log").read_bytes())
    text = (place / "saved.yaml").read_text(encoding="utf-8")
    (tmp_path / "saved.pgm").write_bytes((place / "saved.pgm").read_bytes())
    for name, size in (("tiny", "1.0e-09"), ("mm", "50.0")):
        (tmp_path / f"{name}.yaml").write_text(text.replace(": 0.05", f": {size}"), "utf-8")
    save_map(OccupancyGrid(np.full((2, 2), UNKNOWN, np.int8), 0.05), tmp_path / "blank")
    before = tree(tmp_path)
    done = run("run", "flat.log", "-o", "out", *TWO, *arguments, cwd=tmp_path)
    assert done.returncode in {code, 2}
    assert word in " ".join(done.stderr.split())
    assert done.stdout == ""
    assert tree(tmp_path) == before


@pytest.mark.full
@pytest.mark.datasets
@pytest.mark.skipif(not CSAIL.exists(), reason=ABSENT)
def test_a_recorded_drive_end_to_end(tmp_path: Path) -> None:
    done = run(
        "run", CSAIL / "mit-csail.clf.gz", "--relations", CSAIL / "mit-csail.relations",
        "-o", tmp_path / "out", "--json", timeout=600.0,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    document = json_of(done)
    errors = {record["name"]: record["translation"]["mean"] for record in document["producers"]}
    assert errors["tinyslam"] < 0.5
    assert errors["gmapping"] < 0.051
    assert errors["graph"] < 0.038
    assert document["fused_count"] == 3
    assert document["phantom_cells"] == 0
    assert max(gap["median_m"] for gap in document["path_gaps"]) < 0.3
    assert document["doubled_wall_share"]["added_by_fusion"] < 0.05
