"""Tables over drawn errors: means by hand, the best input, tests by pairs, and what is written."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from slamfusion.config import RunConfig
from slamfusion.experiments import ErrorTable, TrialRecord, write_error_table
from slamfusion.experiments.drive_paths import DRAWN, FUSED_PATH, drawn_at
from slamfusion.experiments.error_sheets import (
    harmed_sheet,
    intervals_sheet,
    notes_sheet,
    p_sheets,
)
from slamfusion.experiments.path_sheets import measure_pairs
from slamfusion.experiments.trials import alone
from slamfusion.experiments.voting import FUSIONS
from slamfusion.jobs.defaults import RUN_VOTE
from slamfusion.jobs.documents import circumstances, plain
from tests.support.documents import check_document

PRODUCERS = ("tinyslam", "gmapping", "graph")


def record(condition: str, seed: int, errors: dict[str, float], **notes: str) -> TrialRecord:
    full = {**dict.fromkeys(PRODUCERS, 100.0), **dict.fromkeys(FUSIONS, 100.0), **errors}
    return TrialRecord(condition, 1, seed, full, dict.fromkeys(full, 0.5), notes)


def drawn(gain: float, count: int = 12) -> ErrorTable:
    """The graph is the best input at 90 on the mean; the plain vote is better by ``gain``."""
    rng = np.random.default_rng(0)
    records = []
    for seed in range(count):
        hard = float(rng.normal(0.0, 8.0))
        fused = 90.0 + hard - gain + float(rng.normal(0.0, 0.5))
        records.append(record("hall", seed, {"graph": 90.0 + hard, "majority": fused}))
    return ErrorTable("drawn", tuple(records))


def test_the_best_input_has_the_smallest_mean_not_the_smallest_error() -> None:
    table = ErrorTable(
        "t",
        (
            record("hall", 0, {"tinyslam": 10.0, "gmapping": 50.0}),
            record("hall", 1, {"tinyslam": 99.0, "gmapping": 50.0}),
        ),
    )
    assert table.best_input("hall") == "gmapping"


def test_a_clear_gain_is_found_by_pairs_and_not_without() -> None:
    table = drawn(3.0)
    (pair,) = (item for item in table.pairs("hall") if item["methods"] == ["graph", "majority"])
    assert pair["p_pooled_t"] > 0.2
    assert pair["p_paired_t_holm"] < 1e-3
    assert pair["p_paired_t_holm"] >= pair["paired"]["t_test"]
    number = FUSIONS.index("majority")
    against = table.against_best("hall")[number]
    assert (against["best_input"], against["fusion"]) == ("graph", "majority")
    assert against["interval"] is not None
    low, high = against["interval"]
    assert low < against["ratio"] < high < 1.0
    assert against["ratio"] < 0.98
    sentence = table.sentences()[number]
    assert "below graph, the best input (95 % interval -" in sentence
    assert "chance" not in sentence


def test_no_gain_is_called_chance() -> None:
    assert "may be chance" in drawn(0.0).sentences()[FUSIONS.index("majority")]


def test_a_single_drive_proves_nothing() -> None:
    table = drawn(3.0, count=1)
    assert table.pairs("hall") == []
    assert p_sheets(table, "hall") == []
    assert "nothing can be tested" in table.sentences()[0]
    assert table.to_json()["summaries"][0]["interval"] is None


def test_overall_counts_each_condition_once_and_tells_the_worst() -> None:
    table = ErrorTable(
        "t",
        (
            record("a", 0, {"graph": 50.0, "majority": 60.0}),
            record("b", 0, {"graph": 90.0, "majority": 45.0}),
        ),
    )
    overall = table.overall()["majority"]
    assert overall["ratio"] == pytest.approx(0.5 * (1.2 + 0.5))
    assert overall["of_sums"] == pytest.approx(105.0 / 140.0)
    assert overall["worst"] == pytest.approx(1.2)
    assert table.sentences()[-1] == (
        "all conditions: majority -15.0 % against the best inputs on the mean of conditions "
        "(-25.0 % of the sums), +20.0 % where it stands worst."
    )


def test_a_harmed_producer_is_held_against_the_others_alone() -> None:
    others = {alone(fusion): 80.0 for fusion in FUSIONS}
    table = ErrorTable("t", (record("a", 0, {}), record("b", 0, {"consensus": 84.0, **others})))
    assert table.methods() == [*PRODUCERS, *FUSIONS]
    assert table.against_others("a") == {}
    assert table.against_others("b")["consensus"] == pytest.approx(1.05)
    (row,) = (row for row in harmed_sheet(table).rows if "consensus" in row)
    assert row == ("b", "consensus", "84.00", "80.00", "+5.0 %")
    assert "b: consensus +5.0 % against fusing the others alone." in table.sentences()
    assert list(table.to_json()["against_others_alone"]) == ["b"]
    told = {"sentences": table.sentences(), "files": [], **circumstances(RunConfig(), "numpy")}
    check_document(plain({**table.to_json(), **told}), "experiment failures")


def test_the_gain_is_told_for_each_world_and_for_all() -> None:
    records = drawn(3.0).records
    worlds = tuple(replace(item, world=1 + item.seed % 2) for item in records)
    table = ErrorTable("t", worlds)
    sheet = intervals_sheet(table)
    assert [row[:3] for row in sheet.rows] == [
        ("hall", "1", "6"), ("hall", "2", "6"), ("hall", "all", "12"),
    ]  # fmt: skip
    column = sheet.heading.index("majority")
    for row, part in zip(sheet.rows, (worlds[::2], worlds[1::2], worlds), strict=True):
        gains = [item.errors["majority"] - item.errors["graph"] for item in part]
        mean, low, high = (float(text.strip("()")) for text in row[column].split() if text != "to")
        assert mean == pytest.approx(np.mean(gains), abs=0.006)
        margin = stats.t.ppf(0.975, len(gains) - 1) * np.std(gains, ddof=1) / np.sqrt(len(gains))
        assert (low, high) == pytest.approx((mean - margin, mean + margin), abs=0.012)
        assert high < 0.0
    assert sheet in table.sheets(details=False)
    assert intervals_sheet(ErrorTable("t", worlds[:1])).rows[0][column].count(" ") == 0


def test_what_was_left_out_is_counted_with_its_reason() -> None:
    table = ErrorTable(
        "t", (record("a", 0, {}, majority="no two agree"), record("a", 1, {}), record("a", 2, {}))
    )
    assert notes_sheet(table).rows == (("a", "majority", "1 of 3", "no two agree"),)
    assert table.sheets(details=False)[-1].title == "What was left out"


def weighed(gain: float, count: int = 10) -> ErrorTable:
    """Paths of 0.06 m that the graph's beats in half of the drives; the fused one by ``gain``."""
    rng = np.random.default_rng(3)
    records = []
    for seed in range(count):
        hard = 0.06 + 0.02 * float(rng.random())
        ate = {"tinyslam": hard, "gmapping": hard + 0.01, "graph": hard + 0.01 * (-1) ** seed}
        ate[FUSED_PATH] = hard - gain + 0.001 * float(rng.normal())
        faces = {name: 1.0 - 2.0 * value for name, value in ate.items() if name in PRODUCERS}
        faces |= {drawn_at(name): value + 0.01 for name, value in faces.items()}
        faces |= {RUN_VOTE: 0.8, DRAWN: 1.0 - 2.0 * ate[FUSED_PATH]}
        kept = record("hall", seed, {DRAWN: 90.0})
        choice = "graph" if seed % 3 else ""
        records.append(replace(kept, faces_f1=faces, ate_m=ate, choice=choice))
    return ErrorTable("t", tuple(records))


def test_the_fused_path_and_the_drawn_map_are_held_against_each_and_the_best() -> None:
    table = weighed(0.03)
    pairs = {(pair["measure"], pair["against"]): pair for pair in measure_pairs(table)}
    paths = {name for measure, name in pairs if measure == "ate_m"}
    assert paths == {*PRODUCERS, "evidence choice", "best in hindsight"}
    best = pairs["ate_m", "best in hindsight"]
    ate = [item.ate_m for item in table.records]
    least = [min(item[name] for name in PRODUCERS) for item in ate]
    assert best["against_mean"] == pytest.approx(np.mean(least))
    assert best["mean"] == pytest.approx(np.mean([a[FUSED_PATH] for a in ate]))
    assert best["p_paired_t_holm"] is not None
    own = [value - item[FUSED_PATH] for value, item in zip(least, ate, strict=True)]
    # Five tests at once: Holm gives the surest at most five times its own.
    alone_p = stats.ttest_1samp(own, 0.0).pvalue
    assert alone_p <= best["p_paired_t_holm"] <= 5.0 * alone_p + 1e-15
    # Where the scans cannot tell there is no choice.
    assert pairs["ate_m", "evidence choice"]["drives"] == 6
    faces = {name: pair for (measure, name), pair in pairs.items() if measure == "faces_f1"}
    assert {pair["method"] for pair in faces.values()} == {DRAWN}
    assert "best in hindsight, drawn" in faces
    assert {RUN_VOTE, *map(drawn_at, PRODUCERS)} < set(faces)


def test_paths_and_faces_have_tables_of_their_own() -> None:
    sheets = {sheet.title: sheet for sheet in weighed(0.03).sheets(details=False)}
    paths = sheets["Paths"]
    means, tests = paths.rows
    assert paths.heading[-1] == FUSED_PATH
    assert means[:2] == ("hall", "10")
    assert tests[0] == "fused path against it"
    assert tests[paths.heading.index("gmapping")].startswith("p ")
    assert tests[-1] == ""
    # Records of another kind have none of these; a single drive has means alone.
    assert "Paths" not in {sheet.title for sheet in drawn(3.0).sheets(details=False)}
    assert measure_pairs(drawn(3.0)) == []
    (row,) = next(s for s in weighed(0.0, 1).sheets(details=False) if s.title == "Paths").rows
    assert row[0] == "hall"


def test_files_hold_every_error_and_the_tables(tmp_path: Path) -> None:
    table = drawn(3.0)
    files = write_error_table(tmp_path, "stem", table, {"device": "none"}, details=True)
    assert [path.name for path in files] == ["stem.csv", "stem.md", "stem.json"]
    with (tmp_path / "stem.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 * len(table.methods())
    read = [float(row["error"]) for row in rows if row["method"] == "majority"]
    assert read == table.errors("hall", "majority")
    document = json.loads((tmp_path / "stem.json").read_text(encoding="utf-8"))
    assert document["device"] == "none"
    assert len(document["pairs"]) == len(table.methods()) * (len(table.methods()) - 1) // 2
    text = (tmp_path / "stem.md").read_text(encoding="utf-8")
    for title in ("Errors of the maps", "p-values as in [F16], hall", "p-values of pairs, hall"):
        assert f"## {title}" in text
