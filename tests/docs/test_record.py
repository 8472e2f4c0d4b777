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
from slamfusion.evaluation import result_rows
from slamfusion.experiments.runs import RunResult
from slamfusion.experiments.trials import fusion_experiment
from slamfusion.experiments.voting import FUSIONS
from slamfusion.io import write_carmen, write_tum
from slamfusion.jobs.documents import circumstances
from slamfusion.json_values import plain
from slamfusion.slam.registry import BUILT_IN
from tests.docs.test_pages import parse
from tests.experiments.drives import room
from tests.support.documents import check_document

pytestmark = pytest.mark.once

HERE = circumstances(RunConfig(), "a device")
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


def test_methods_stand_beside_each_other_and_votes_against_the_best_input() -> None:
    document = error_table({"consensus": 9.7}, 2, "no obstacle")
    check_document(document, "experiment ground-obstacle")
    columns, (means, against) = tables.ground_obstacle([document])
    assert columns == ("", "tinySLAM", "gmapping", "graph", *FUSIONS)
    found = dict(zip(columns, means, strict=True))
    assert found[""] == "no obstacle"
    assert found["tinySLAM"] == "101.0 ± 1.4"
    assert found["graph"] == "97.0 ± 1.4"
    assert found["consensus"] == "**87.3 ± 1.4**"
    found = dict(zip(columns, against, strict=True))
    assert found[""] == "against graph, 95 %"
    assert found["tinySLAM"] == ""
    assert found["consensus"] == "-10.0 to -10.0 %"


def test_what_was_drawn_stands_beside_what_it_is_held_against() -> None:
    rows = [
        row
        for seed in ("0", "1")
        for method, figures in {
            "fused path": {"ate_rmse_m": 0.1},
            "drawn": {"faces_f1": 0.61 + 0.01 * int(seed)},
            "graph": {"ate_rmse_m": 0.57, "faces_f1": 0.5, "error": 1.0},
            "tinyslam": {"faces_f1": 0.57, "error": 1.0},
            **{name: {"error": 1.0} for name in FUSIONS},
        }.items()
        for row in result_rows("obstacle", seed, method, figures)
    ]
    experiment = fusion_experiment("t", "t", [("obstacle", RunResult(rows))], draws=True)
    document = plain(experiment.document([], RunConfig(), "a device"))
    assert tables.paths_and_faces([document]) == (
        ("mean of", "", "graph", "tinySLAM"),
        (
            ("obstacle, ATE m, fused path", "0.100", "0.570 (p 0.500)", "-"),
            ("obstacle, faces F1 at 0.1 m, drawn", "0.615", "0.500 (p 0.500)", "0.570 (p 0.500)"),
        ),
    )
    with pytest.raises(ValueError, match="give --draw"):
        tables.paths_and_faces([error_table({}, 2, "obstacle")])


def test_worlds_stand_beside_each_other() -> None:
    documents = [
        error_table({"consensus": gain}, 1, "glass, kinect", "slip, kinect") for gain in (9.6, 19.2)
    ]
    columns, rows = tables.failures(documents)
    column = columns.index("consensus")
    assert [(row[0], row[column]) for row in rows] == [
        ("glass, kinect", "-10 / -20"),
        ("slip, kinect", "-10 / -20"),
        ("**mean of the 2**", "**-10.0 / -20.0**"),
        ("worst", "-10.0 / -20.0"),
        ("of the sums", "-10.0 / -20.0"),
    ]
    with pytest.raises(ValueError, match="of the same conditions"):
        tables.failures([*documents, error_table({}, 1, "glass, kinect")])


def test_of_each_recorded_map_three_figures_are_shown() -> None:
    maps = {"graph": (299.4, 0.934, 0.059), "consensus": (372.0, 0.934, None)}
    maps["reference"] = (None, None, 0.01)
    summaries = [
        {"case": "mit", "figure": figure, "method": name, "mean": value}
        for name, values in maps.items()
        for figure, value in zip(("error", "wall_f1", "doubled_wall_share"), values, strict=True)
        if value is not None
    ]
    assert tables.real_logs([{"summaries": summaries}]) == (
        ("log", "", "graph", "consensus"),
        (
            ("mit", "error [F16]", "**299**", "372"),
            ("", "wall F1", "0.934", "0.934"),
            ("", "doubled walls %", "5.9", "-"),
        ),
    )


def test_each_run_s_paths_stand_beside_the_fused_one() -> None:
    def run(log: str, fused: float, **means: float) -> dict[str, Any]:
        producers = [
            {"name": name, "failed": None, "translation": {"mean": mean}}
            for name, mean in means.items()
        ]
        producers.append({"name": "gmapping", "failed": "it ended with exit code 1"})
        return {"log": log, "producers": producers, "fused_path": {"translation": {"mean": fused}}}

    runs = [run("data/a.clf.gz", 0.0282, tinyslam=0.0293), run("b.log", 0.0445, graph=0.0441)]
    assert tables.fused_path(runs) == (
        ("log", "tinySLAM", "graph", "fused path"),
        (("a", "0.0293", "-", "**0.0282**"), ("b", "-", "**0.0441**", "0.0445")),
    )


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


@pytest.mark.full
def test_an_experiment_is_run_and_its_table_kept(tmp_path: Path) -> None:
    drive, folder = room(drift=0.3), tmp_path / "mit-csail"
    folder.mkdir()
    assert drive.relations is not None
    assert drive.reference is not None
    write_carmen(folder / "mit-csail.clf.gz", drive.scans)
    ((first, second),), ((x, y, yaw),) = drive.relations.stamps_s, drive.relations.motions
    (folder / "mit-csail.relations").write_text(f"{first} {second} {x} {y} 0 0 0 {yaw}\n")
    write_tum(folder / "mit-csail-reference-graph.log.gz", drive.reference)
    small = ("--floors", "0", "--seeds", "1", "--resolutions", "0.1", "--device", "numpy")
    main(
        [
            "occupancy-estimator", "--datasets", str(tmp_path), "--out", str(tmp_path / "out"),
            "--record", str(tmp_path / "kept"), "--", *small,
        ]
    )  # fmt: skip
    kept = measurements(tmp_path / "kept")["occupancy-estimator"]
    assert kept.columns == ("drive", "measure", "constant", "area", "p")
    assert [row[:2] for row in kept.rows] == [
        ("mit-csail, 0.1 m", "relations"),
        ("mit-csail, 0.1 m", "ATE"),
    ]
    assert all(0.0 < float(row[2].split()[0]) < 1.0 for row in kept.rows)
    assert "cores" in kept.machine
    assert kept.command.endswith("record occupancy-estimator -- " + " ".join(small))
    assert str(tmp_path) not in kept.to_json()


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


def test_a_command_that_fails_leaves_no_table(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="ended with exit code"):
        main(["failures", "--record", str(tmp_path / "kept"), "--", "--no-such-option"])
    assert not (tmp_path / "kept").exists()
