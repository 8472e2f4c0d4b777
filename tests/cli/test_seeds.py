"""``--seeds``: files of each seed, one table with means and deviations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from slamfusion.cli.program import run_program
from slamfusion.jobs.run_many import log_tasks
from tests.cli.command import MAPS
from tests.slam.drives import write_flat
from tests.support.documents import check_document


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with a short drive and its true path."""
    write_flat(tmp_path, 24, "flat.log.gz")
    return tmp_path


def test_slam_runs_each_seed_and_prints_their_mean_and_deviation(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["slam", "tinyslam", str(place / "flat.log.gz"), "-o", str(place / "t")]
    words += ["--seeds", "3-4", "--truth", str(place / "truth.tum")]
    other = ["--truth-map", str(MAPS[0])]
    assert run_program([*words, *other, "--table", str(place / "table.tex")]) == 0
    printed, notices = capsys.readouterr()
    assert [line.split(": ")[1:3] for line in notices.splitlines() if "not aligned" in line] == [
        [f"tinyslam seed {seed}", "not aligned"] for seed in (3, 4)
    ]
    rows = [line.split("\t") for line in printed.splitlines()]
    assert [row[1] for row in rows if row[0] == "flat"] == ["3", "4", "mean of 2", "std of 2"]
    assert "ATE rmse [m]" in printed
    assert r"\begin{tabular}" in (place / "table.tex").read_text(encoding="utf-8")
    assert (place / "t_seed-3.tum").read_bytes() != (place / "t_seed-4.tum").read_bytes()
    assert run_program([*words, "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    check_document(document, "slam")
    assert len(document["producers"]) == 2
    # The names say what belongs together.
    assert run_program(["trajectory", str(place), "--truth", str(place / "truth.tum")]) == 0
    rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert ["truth", "mean of 2", "t"] in [row[:3] for row in rows]


def test_a_run_has_a_folder_for_each_log_and_seed() -> None:
    tasks = log_tasks([Path("/x/a.log"), Path("/x/b.log")], Path("/out"), seeds=(0, 1))
    assert [str(task.folder) for task in tasks] == [
        f"/out/{log}/seed-{seed}" for log in "ab" for seed in (0, 1)
    ]
    assert [task.seed for task in tasks] == [0, 1, 0, 1]


@pytest.mark.full
def test_a_run_of_two_seeds_prints_one_table(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    words = ["run", "flat.log.gz", "-o", "out", "--seeds", "0,1"]
    words += ["--truth-trajectory", str(place / "truth.tum"), "--producers", "tinyslam,graph"]
    words += ["--truth", str(MAPS[0])]
    assert run_program([*words, "--save-results", str(place / "all.zip")]) == 0
    printed, notices = capsys.readouterr()
    assert "slamfusion: flat.log.gz seed 0: not aligned: graph: " in notices
    rows = [line.split("\t") for line in printed.splitlines()]
    assert ["flat", "mean of 2", "fused"] in [row[:3] for row in rows]
    folders = [row[4] for row in rows if row[0].startswith("flat.log.gz seed")]
    assert folders == ["out/flat/seed-0", "out/flat/seed-1"]
    for seed in (0, 1):
        assert (place / "out" / "flat" / f"seed-{seed}" / "fused.yaml").is_file()
    assert run_program(["compare", str(place / "all.zip")]) == 0
