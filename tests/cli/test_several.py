"""Several maps or paths in several cases, saved and compared, as a user asks for them."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.cli import run
from slamfusion.cli.main import main
from slamfusion.io import load_map, save_map, write_tum
from slamfusion.io.carmen import write_carmen
from slamfusion.jobs.cases import CaseFile
from slamfusion.jobs.results import read_results
from slamfusion.trajectory import Trajectory
from tests.cli.command import MAPS, TRUTH
from tests.evidence.rooms import bent, circuit, recorded
from tests.support.documents import check_document
from tests.support.fresh import run_python

Ask = Callable[..., tuple[int, str, str]]


@pytest.fixture
def ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ask:
    """Run a command in a folder of its own; return exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(list(words))
        told = capsys.readouterr()
        return int(ended.value.code or 0), told.out, told.err

    return run


def document(done: tuple[int, str, str], command: str) -> dict[str, Any]:
    assert done[0] == 0, done[2]
    found: dict[str, Any] = json.loads(done[1])
    check_document(found, command)
    return found


def paths(folder: Path) -> None:
    """Write two drives' truths, and a good and a bad path of each."""
    stamps_s = np.arange(60.0)
    for number, case in enumerate(("intel", "office")):
        turn = np.linspace(0.0, 3.0 + number, 60)
        truth = np.stack((4.0 * np.cos(turn), 4.0 * np.sin(turn), turn), axis=1)
        write_tum(folder / f"{case}.tum", Trajectory(stamps_s, truth))
        for method, error_m in (("good", 0.02), ("bad", 0.1)):
            poses = truth.copy()
            poses[:, 0] += error_m * np.sin(stamps_s + number)
            (folder / method).mkdir(exist_ok=True)
            write_tum(folder / method / f"{case}.tum", Trajectory(stamps_s, poses))


TRUTHS = ("--truth", "intel.tum", "--truth", "office.tum")
ALL = ("good/intel.tum", "good/office.tum", "bad/office.tum", "bad/intel.tum")


def test_paths_of_several_truths_stand_in_one_table_with_means(ask: Ask, tmp_path: Path) -> None:
    paths(tmp_path)
    code, out, _ = ask("trajectory", *ALL, *TRUTHS, "--table", "out.csv")
    assert code == 0
    rows = [line.split("\t") for line in out.splitlines()]
    assert [row[:2] for row in rows[2:8]] == [
        *(["intel", "good"], ["office", "good"], ["office", "bad"], ["intel", "bad"]),
        *(["mean of 2", "good"], ["mean of 2", "bad"]),
    ]
    with (tmp_path / "out-2.csv").open(encoding="utf-8") as file:
        by_case = list(csv.DictReader(file))
    assert [row["path"] for row in by_case] == ["good", "bad"]
    for row in by_case:
        mean = (float(row["intel"]) + float(row["office"])) / 2.0
        assert float(row["mean"]) == pytest.approx(mean, abs=1e-4)

    found = document(ask("trajectory", *ALL, *TRUTHS, "--json"), "trajectory")
    cases = [item["case"] for item in found["trajectories"]]
    assert cases == ["intel", "office", "office", "intel"]
    ates = [item["ate"]["rmse"] for item in found["trajectories"] if item["method"] == "good"]
    mean = next(item for item in found["means"] if item["method"] == "good")
    assert mean["cases"] == 2
    assert mean["figures"]["ate_rmse_m"] == pytest.approx(np.mean(ates))


def test_one_path_is_as_it_was_and_one_that_fails_leaves_the_others(
    ask: Ask, tmp_path: Path
) -> None:
    paths(tmp_path)
    found = document(ask("trajectory", "good/intel.tum", *TRUTHS[:2], "--json"), "trajectory")
    assert found["name"] == "intel"
    assert "trajectories" not in found
    late = Trajectory(np.arange(3.0) + 1e6, np.zeros((3, 3)))
    write_tum(tmp_path / "late_intel.tum", late)
    code, out, err = ask("trajectory", "late_intel.tum", *ALL, *TRUTHS)
    assert code == 1
    assert "mean of 2\tgood" in out
    assert err.startswith("slamfusion: error: late_intel.tum: ")
    assert len(err.splitlines()) == 1
    named = ("--truth", "hall=intel.tum", "--truth", "office.tum", "--json")
    found = document(ask("trajectory", "hall=good/intel.tum", *ALL[1:3], *named), "trajectory")
    assert [item["case"] for item in found["trajectories"]] == ["hall", "office", "office"]
    code, _, err = ask("trajectory", ALL[0], "--truth", "..=intel.tum", "--report", "out/here")
    assert (code, list(tmp_path.glob("**/*.html"))) == (1, [])
    assert "'..' cannot name a case" in err
    for words in (("other.tum", *TRUTHS), ("x=good/intel.tum", *TRUTHS)):
        code, _, err = ask("trajectory", *words)
        assert code == 1
        assert "intel, office" in err


def test_results_are_saved_and_compared(ask: Ask, tmp_path: Path) -> None:
    paths(tmp_path)
    for method in ("good", "bad"):
        files = [f"{method}/{case}.tum" for case in ("intel", "office")]
        code, *_ = ask("trajectory", *files, *TRUTHS, "--save-results", f"{method}.zip")
        assert code == 0
    code, out, _ = ask("compare", "good.zip", "bad.zip", "--table", "out.md")
    assert code == 0
    assert "good (first) and bad (second)" in out
    assert "| ATE rmse [m] | " in (tmp_path / "out.md").read_text(encoding="utf-8")


def test_without_pandas_one_line_says_what_to_install(tmp_path: Path) -> None:
    words = ["compare", "a.zip", "b.zip"]
    script = (
        "import sys; sys.modules['pandas'] = None; from slamfusion.cli.main import main; "
        f"main({words})"
    )
    done = run_python(script, tmp_path)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "need pandas; pip install 'slamfusion[report]'" in done.stderr


def named_in(file: Path) -> set[tuple[str, str]]:
    """Return case and method of each item of saved results."""
    return set(read_results(file).table[["case", "method"]].itertuples(index=False, name=None))


def test_results_of_one_case_are_named_as_those_of_several(ask: Ask, tmp_path: Path) -> None:
    """So that ``compare`` pairs them, and sees where the truths are not the same."""
    paths(tmp_path)
    one, several = ("--save-results", "one.zip"), ("--save-results", "several.zip")
    assert ask("trajectory", "good/intel.tum", *TRUTHS[:2], *one)[0] == 0
    assert named_in(tmp_path / "one.zip") == {("intel", "good")}

    grid = load_map(TRUTH)
    for stem in ("hall", "yard", "map_a/hall", "map_b/hall", "map_a/yard"):
        save_map(grid, tmp_path / stem)
    maps = ("map_a/hall.yaml", "map_b/hall.yaml")
    options = ("--truth", "lab=hall.yaml", "--no-align")
    named = [f"lab={path}" for path in maps]
    assert ask("evaluate", *named, *options, *one)[0] == 0
    more = ("map_a/yard.yaml", "--truth", "yard.yaml")
    assert ask("evaluate", *named, *more, *options, *several)[0] == 0
    assert named_in(tmp_path / "one.zip") == {("lab", "map_a/hall"), ("lab", "map_b/hall")}
    assert named_in(tmp_path / "one.zip") < named_in(tmp_path / "several.zip")
    assert ("truth", "lab") in read_results(tmp_path / "one.zip").yardsticks


def test_maps_of_several_truths(ask: Ask, tmp_path: Path) -> None:
    """Both places are one here: what is measured is told by the tests of ``evaluate``."""
    truth = load_map(TRUTH)
    for case in ("hall", "yard"):
        save_map(truth, tmp_path / case)
        for name in MAPS[:2]:
            (tmp_path / Path(name).stem).mkdir(exist_ok=True)
            save_map(load_map(name), tmp_path / Path(name).stem / case)
    maps = [f"map_{letter}/{case}.yaml" for letter in "ab" for case in ("hall", "yard")]
    options = ("--truth", "hall.yaml", "--truth", "yard.yaml", "--no-align")
    found = document(
        ask("evaluate", *maps, *options, "--json", "--save-results", "a.zip"), "evaluate"
    )
    assert [(item["case"], item["method"]) for item in found["maps"]] == [
        (case, f"map_{letter}") for letter in "ab" for case in ("hall", "yard")
    ]
    errors = [item["error"] for item in found["maps"]]
    assert errors[0] == errors[1] != errors[2] == errors[3]
    assert [mean["figures"]["error"] for mean in found["means"]] == errors[::2]
    assert found["truths"] == {"hall": "hall.yaml", "yard": "yard.yaml"}
    assert (tmp_path / "a.zip").exists()


def test_paths_of_several_logs(ask: Ask, tmp_path: Path) -> None:
    truth = circuit()
    for case in ("north", "south"):
        write_carmen(tmp_path / f"{case}.log", recorded(truth))
        write_tum(tmp_path / f"{case}_good.tum", truth)
    write_tum(tmp_path / "south_bent.tum", bent(truth, 0.2, 70))
    files = ("north_good.tum", "south_good.tum", "south_bent.tum")
    words = ("north.log", *files, "--log", "south.log", "--truth", "south=south_good.tum")
    code, out, err = ask("judge", *words)
    assert code == 0, err
    assert "3 results in 2 cases" in out
    assert "south: Use the good path: no scan contradicts it" in out
    assert "north: Use the good path: no scan contradicts it" in out
    assert "means are of different cases" in err
    found = document(ask("judge", *words, "--json", "--save-results", "a.zip"), "judge")
    assert [log["case"] for log in found["logs"]] == ["north", "south"]
    assert [path["name"] for path in found["logs"][1]["paths"]] == ["good", "bent"]
    assert named_in(tmp_path / "a.zip") >= {("south", "bent"), ("north", "good")}


def test_maps_and_paths_may_follow_each_other() -> None:
    words = "drive.txt -o out --inputs a.yaml b.yaml --paths a.tum b=c.csv --seed 3"
    given = run.command.make_context("run", words.split()).params
    assert given["saved_maps"] == (Path("a.yaml"), Path("b.yaml"))
    assert given["saved_paths"] == (CaseFile(Path("a.tum")), CaseFile(Path("c.csv"), "b"))
    assert given["logs"] == (Path("drive.txt"),)
    behind = "--paths a.tum drive.log --inputs a.yaml -o out"
    assert run.command.make_context("run", behind.split()).params["logs"] == (Path("drive.log"),)
