"""Tables of ``experiment`` and ``run`` are made of their documents, and kept by one command."""

from __future__ import annotations

import datetime as dt
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from docs.generate import tables
from docs.generate.benchmarks import measurements
from docs.generate.record import RECIPES, Recipe, main
from slamfusion.cli.program import cli
from slamfusion.config import RunConfig
from slamfusion.evaluation.measured import result_rows
from slamfusion.experiments.fusions import FUSIONS
from slamfusion.experiments.runs import RunResult
from slamfusion.experiments.trials import fusion_experiment
from slamfusion.jobs.records import Circumstances
from slamfusion.json_values import plain
from slamfusion.slam.registry import BUILT_IN
from tests.docs.test_pages import parse

pytestmark = pytest.mark.once

HERE = plain(Circumstances("a device", RunConfig()))
MADE = ("--commit", "0123abc", "--date", "2026-02-28")


def error_table(gains: Mapping[str, float], seeds: int, *cases: str) -> dict[str, Any]:
    """What an experiment prints: all errors 100 and 102, 96 and 98 for the graph, less by gains."""
    results = []
    for case in cases:
        for seed in range(seeds):
            errors = dict.fromkeys((*BUILT_IN, *FUSIONS), 100.0 + 2.0 * seed)
            errors["graph"] -= 4.0
            errors |= {name: errors["graph"] - gain for name, gain in gains.items()}
            rows = [
                row
                for name, error in errors.items()
                for row in result_rows(case, str(seed), name, {"error": error})
            ]
            results.append((case, RunResult(rows)))
    document = fusion_experiment("t", "t", results).document([], RunConfig(), "a device")
    printed: dict[str, Any] = json.loads(json.dumps(plain(document)))
    return printed


def saved(folder: Path, document: Mapping[str, Any], name: str = "document") -> str:
    path = folder / f"{name}.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    return str(path)


def test_a_document_becomes_a_dated_table(tmp_path: Path) -> None:
    document, kept_in = error_table({}, 2, "no obstacle"), tmp_path / "kept"
    main(
        [
            "ground-obstacle", "--document", saved(tmp_path, document), *MADE,
            "--record", str(kept_in),
        ]
    )  # fmt: skip
    kept = measurements(kept_in)["ground-obstacle"]
    assert (kept.commit, kept.date) == ("0123abc", "2026-02-28")
    assert kept.machine.startswith("a device, Python 3.")
    assert (kept.columns, kept.rows) == tables.ground_obstacle([document])


def test_every_recipe_is_of_a_table_that_stands_on_a_page() -> None:
    assert set(RECIPES) <= set(measurements())


@pytest.mark.parametrize("name", RECIPES)
def test_the_commands_of_a_table_are_there(name: str) -> None:
    for command in RECIPES[name].commands:
        words = [word.format(out="out", datasets="data") for word in command.split()]
        parse(cli, [*words, "--json"])


def test_a_command_is_run_and_its_table_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def tests(documents: Sequence[Mapping[str, Any]]) -> tables.TableText:
        (document,) = documents
        return ("test",), tuple((item["name"],) for item in document["self_test"])

    monkeypatch.setitem(RECIPES, "doctor", Recipe(("doctor",), tests))
    main(["doctor", "--record", str(tmp_path / "kept"), "--", "--device", "numpy"])
    kept = measurements(tmp_path / "kept")["doctor"]
    assert kept.date == dt.datetime.now(dt.timezone.utc).date().isoformat()
    assert kept.command == "python -m docs.generate.record doctor -- --device numpy"
    assert kept.note == "It runs `slamfusion doctor`."
    assert re.match(r"\d+ cores \(load [\d.]+\), NumPy twins", kept.machine)
    assert len(kept.rows) >= 3


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["failures", "--commit", "0123abc"], "--document, --commit and --date belong together"),
        (["real-logs"], "wanted --datasets DIR"),
        (["failures", "--document", "absent.json", *MADE], "absent.json"),
        (["ground-obstacle", "--document", "{made}", "--document", "{made}", *MADE], "found 2"),
        (["failures", "--document", "{made}", *MADE], "no key 'against_best_input'"),
    ],
)
def test_what_cannot_be_made_is_refused_in_a_line(
    words: list[str], told: str, tmp_path: Path
) -> None:
    made = saved(tmp_path, HERE)
    with pytest.raises(SystemExit, match=told) as ended:
        main([*(word.format(made=made) for word in words), "--record", str(tmp_path / "kept")])
    assert "\n" not in str(ended.value)
    assert not (tmp_path / "kept").exists()
