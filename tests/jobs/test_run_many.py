"""The main job on several logs: each alone, a folder for each, and one that fails is told."""

from __future__ import annotations

import json
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slamfusion.cli.program import run_program
from slamfusion.evidence.recommendation import Recommendation
from slamfusion.jobs import run_many
from slamfusion.jobs.inputs import RUN_DEFAULTS
from slamfusion.jobs.run_many import RunOfLog, log_tasks, run_logs
from tests.support.documents import check_document

pytestmark = pytest.mark.once


def test_folders_are_called_as_the_logs_are() -> None:
    def names(*logs: str) -> list[str]:
        tasks = log_tasks([Path(log) for log in logs], Path("/out"))
        assert all(task.folder.parent == Path("/out") for task in tasks)
        assert all(task.log.is_absolute() for task in tasks)
        shown.extend(task.name for task in tasks)
        return [task.folder.name for task in tasks]

    shown: list[str] = []
    assert names("/x/a.log", "/x/b.bag") == ["a", "b"]
    assert names("/x/a.log", "/x/a.bag") == ["a.log", "a.bag"]
    assert names("/x/a.log", "/y/a.log") == ["x-a", "y-a"]
    # Tables show the file's name, or what tells it from another of this name.
    assert shown == ["a.log", "b.bag", "a.log", "a.bag", "x-a", "y-a"]


def test_logs_that_fail_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.log").write_text("hello\n")
    logs = [str(tmp_path / name) for name in ("bad.log", "none.log")]
    assert run_program(["run", *logs, "-o", str(tmp_path / "out"), "--json"]) == 1
    printed = capsys.readouterr()
    assert "no fused map of 2 of 2 logs (bad.log: wanted FLASER, " in printed.err
    document: dict[str, Any] = json.loads(printed.out)
    check_document(document, "run", failed=True)
    bad, none = document["runs"]
    assert "there is no laser in it" in bad["error"]
    assert none["error"] == "no such file; check the path"
    assert run_program(["run", *logs, "-o", str(tmp_path / "out")]) == 1
    printed = capsys.readouterr()
    assert "bad.log\t-\t-\t-\t-\tNO FUSED MAP: wanted FLASER, " in printed.out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("producers", "code", "words"),
    [("graph", 1, "found that of graph alone; "), ("graph,grph", 2, "did you mean 'graph'?")],
)
def test_settings_that_no_log_could_be_run_with_are_refused_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], producers: str, code: int, words: str
) -> None:
    words_given = ["run", "a.log", "b.log", "-o", str(tmp_path / "out"), "--producers", producers]
    assert run_program(words_given) == code
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.count(words) == 1
    assert printed.out == ""


def test_an_error_of_another_machine_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = log_tasks([tmp_path / "a.log", tmp_path / "b.log"], tmp_path)
    monkeypatch.setattr(socket, "gethostname", lambda: "robot-7")
    told: list[tuple[str, float, int]] = []
    tasks = [replace(near, host="robot-7"), far]
    first, second = run_logs(tasks, RUN_DEFAULTS, progress=lambda *words: told.append(words))
    assert first.error == "no such file; check the path"
    assert second.error == "no such file; check the path (on robot-7)"
    assert (told[0], told[-1]) == (("logs", 0, 2), ("logs", 2, 2))


def test_what_could_not_be_measured_is_told_by_the_code_as_of_one_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def mapped(task: run_many.LogTask, *_: object) -> RunOfLog:
        troubles = ("the fused path: no pose in time",) if task.log.stem == "a" else ()
        answer = Recommendation("graph", "graph", "graph")
        return RunOfLog(
            log=task.log, recommendation=answer, not_measured=troubles, time_s=1.0, name=task.name
        )

    monkeypatch.setattr(run_many, "run_one", mapped)
    words = ["run", "a.log", "b.log", "-o", str(tmp_path), "--json"]
    assert run_program(words) == 1
    printed = capsys.readouterr()
    assert printed.err == (
        "slamfusion: error: of 1 of 2 logs not all could be measured "
        "(a.log: the fused path: no pose in time)\n"
    )
    document: dict[str, Any] = json.loads(printed.out)
    check_document(document, "run", failed=True)
    assert [run["not_measured"] for run in document["runs"]] == [
        ["the fused path: no pose in time"],
        [],
    ]
