"""Runs are kept: what is done is not run again, and other settings are."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import ExperimentConfig, FailuresConfig, RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evaluation.measured import result_rows
from slamfusion.experiments import runs as module
from slamfusion.experiments.runs import RunResult, Setup, Tell, run_all
from slamfusion.slam.registry import with_settings

TASKS = {"first": 1, "second": 2}


def double(task: int, config: RunConfig, tell: Tell) -> RunResult:
    tell(0.5)
    figures = {"error": 2.0 * task + config.seed, "ssim": None}
    rows = result_rows("hall", str(task), "graph", figures)
    return RunResult(rows, {"graph": "bent"}, b"maps" if task == 1 else None, "a remark")


def die(_: int, __: RunConfig, ___: Tell) -> RunResult:
    os._exit(1)


class Counted:
    """Does runs, and keeps their tasks."""

    def __init__(self) -> None:
        self.tasks: list[int] = []

    def __call__(self, task: int, config: RunConfig, tell: Tell) -> RunResult:
        self.tasks.append(task)
        return double(task, config, tell)


def test_what_is_done_is_not_run_again_and_the_rest_is(tmp_path: Path) -> None:
    told: list[tuple[float, int]] = []
    work, setup = Counted(), Setup(RunConfig(), NumpyDevice(), tmp_path)
    telling = replace(setup, progress=lambda _, n, of: told.append((n, of)))
    first = run_all(TASKS, work, telling)
    assert told == [(0, 2), (0.5, 2), (1, 2), (1.5, 2), (2, 2)]
    assert [own.rows[0][4] for own in first] == [2.0, 4.0]
    again = run_all(TASKS, work, setup)
    assert work.tasks == [1, 2]
    for a, b in zip(first, again, strict=True):
        assert (a.notes, a.example, a.remark) == (b.notes, b.example, b.remark)
        assert [row[:4] for row in a.rows] == [row[:4] for row in b.rows]
        assert a.rows[0][4] == b.rows[0][4]
        assert math.isnan(b.rows[1][4])
    # A lost picture, a missing file, a damaged one: only that run is done.
    (tmp_path / "trials" / "first.npz").unlink()
    run_all(TASKS, work, setup)
    (tmp_path / "trials" / "second.json").unlink()
    run_all(TASKS, work, setup)
    (tmp_path / "trials" / "first.json").write_text('{"half', encoding="utf-8")
    run_all(TASKS, work, setup)
    assert work.tasks == [1, 2, 1, 2, 1]


def test_other_settings_facts_and_programs_are_run_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, setup = Counted(), Setup(RunConfig(), NumpyDevice(), tmp_path)
    run_all(TASKS, work, setup)
    # The number of repetitions in all does not matter to one of them.
    few = ExperimentConfig(failures=FailuresConfig(repetitions=1))
    run_all(TASKS, work, replace(setup, config=RunConfig(experiment=few)))
    assert work.tasks == [1, 2]
    other = with_settings(setup.config, "gmapping", particles=7)
    run_all(TASKS, work, replace(setup, config=other))
    (tmp_path / "a.log").write_text("another log", encoding="utf-8")
    run_all(TASKS, work, setup, [("log", "", tmp_path / "a.log")])
    run_all({**TASKS, "second": 3}, work, setup)
    assert work.tasks == [1, 2] * 3 + [1, 3]
    monkeypatch.setattr(module, "program_digest", lambda: "another")
    run_all({"first": 1}, work, setup)
    assert work.tasks[-1] == 1
    assert len(work.tasks) == 9


def test_other_processes_give_the_same_bytes(tmp_path: Path) -> None:
    for processes, folder in ((1, "one"), (2, "two")):
        setup = Setup(RunConfig(), NumpyDevice(), tmp_path / folder, processes=processes)
        run_all(TASKS, double, setup)
    one, two = (
        {path.name: path.read_bytes() for path in (tmp_path / folder / "trials").iterdir()}
        for folder in ("one", "two")
    )
    assert one == two
    assert set(one) == {"first.json", "first.npz", "second.json"}
    assert json.loads(one["second.json"])["rows"][0] == ["hall", "2", "graph", "error", 4.0]


def test_where_processes_died_the_way_to_go_on_is_told(tmp_path: Path) -> None:
    setup = Setup(RunConfig(), NumpyDevice(), tmp_path, processes=2)
    with pytest.raises(SlamFusionError, match=r"a process died .* stays done: start .* again"):
        run_all(TASKS, die, setup)
