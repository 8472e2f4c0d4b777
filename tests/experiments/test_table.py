"""The frame of repeated experiments: every run kept, figures by hand, files whole."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from slamfusion.experiments.table import (
    Level,
    Results,
    markdown_table,
    measure_label,
    repeat,
    write_results,
)
from slamfusion.jobs.documents import p_text

FACTORS = ("drive", "size m", "method")
CONDITIONS: Sequence[tuple[Level, ...]] = [
    (drive, size, method)
    for drive in ("hall", "yard")
    for size in (0.1, 0.2)
    for method in ("old", "new")
]


def once(levels: tuple[Level, ...], seed: int) -> dict[str, float]:
    """An error that the new method halves; the yard has no relations."""
    drive, size, method = levels
    error = (1.0 if method == "old" else 0.5) * float(size) * 10.0 + 0.01 * seed
    return {"ate_m": error} | ({"relations_m": 2.0 * error} if drive == "hall" else {})


@pytest.fixture(scope="module")
def results() -> Results:
    return repeat("A title", FACTORS, CONDITIONS, (1, 2, 3), once)


def test_every_condition_is_run_with_every_seed(results: Results) -> None:
    assert len(results.runs) == results.planned == 24
    assert results.is_complete
    made = results.runs[[*FACTORS, "seed"]].itertuples(index=False, name=None)
    assert list(made) == [(*levels, seed) for levels in CONDITIONS for seed in (1, 2, 3)]


def test_summaries_by_hand(results: Results) -> None:
    summary = results.summary(("hall", 0.1, "old"), "ate_m")
    assert summary is not None
    assert summary.count == 3
    assert summary.mean == pytest.approx(1.02)
    assert summary.std == pytest.approx(0.01)
    assert summary.worst == pytest.approx(1.03)
    assert results.summary(("yard", 0.1, "old"), "relations_m") is None


def test_methods_are_compared_within_their_group(results: Results) -> None:
    found = results.comparisons("ate_m")
    assert [item["levels"] for item in found] == [
        ["hall", 0.1], ["hall", 0.2], ["yard", 0.1], ["yard", 0.2]
    ]  # fmt: skip
    first = found[0]
    assert first["methods"] == ["old", "new"]
    assert first["means"] == pytest.approx([1.02, 0.52])
    assert first["p_values"] is not None
    assert first["p_values"]["welch"] < 1e-6
    assert len(results.comparisons("relations_m")) == 2


def test_table_has_a_row_a_group_and_columns_a_method(results: Results) -> None:
    heading, rows = results.rows("ate_m")
    assert heading == ["drive", "size m", "runs", "old", "worst", "new", "worst", "p"]
    assert rows[0] == [
        "hall", "0.1", "3", "1.0200 ± 0.0100", "1.0300", "0.5200 ± 0.0100", "0.5300", "<0.001"
    ]  # fmt: skip
    assert len(rows) == 4
    assert [row[0] for row in results.rows("relations_m")[1]] == ["hall", "hall"]


def test_one_seed_has_no_deviation_and_no_p() -> None:
    results = repeat("A title", FACTORS, CONDITIONS[:2], (5,), once)
    (row,) = results.rows("ate_m")[1]
    assert row[2:] == ["1", "1.0500", "1.0500", "0.5500", "0.5500", "-"]


def test_errors_come_before_times() -> None:
    def timed(levels: tuple[Level, ...], seed: int) -> dict[str, float]:
        return {"ate_m": 1.0, "time_ms": 2.0} | once(levels, seed)

    assert repeat("A title", FACTORS, CONDITIONS, (1, 2), timed).measures() == [
        "ate_m",
        "relations_m",
        "time_ms",
    ]


def test_three_methods_have_a_p_value_for_every_two() -> None:
    conditions = [("hall", 0.1, method) for method in ("a", "b", "c")]
    results = repeat("A title", FACTORS, conditions, (1, 2), once)
    heading, _ = results.rows("ate_m")
    assert heading[-3:] == ["p a / b", "p a / c", "p b / c"]


def test_csv_holds_every_run(results: Results, tmp_path: Path) -> None:
    write_results(tmp_path, "try", results)
    text = (tmp_path / "try.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    assert len(rows) == 24
    assert rows[0]["drive"] == "hall"
    assert float(rows[0]["ate_m"]) == results.runs["ate_m"][0]
    assert rows[-1]["relations_m"] == ""


def test_json_holds_summaries_comparisons_and_runs(results: Results) -> None:
    document = json.loads(json.dumps(results.to_json(), allow_nan=False))
    assert document["complete"] is True
    assert document["conditions"][0]["ate_m"]["mean"] == pytest.approx(1.02)
    assert "relations_m" not in document["conditions"][-1]
    assert document["comparisons"][0]["means"] == pytest.approx([1.02, 0.52])
    assert document["runs"][0] == {
        "drive": "hall", "size m": 0.1, "method": "old", "seed": 1,
        "ate_m": 1.01, "relations_m": 2.02,
    }  # fmt: skip


def test_an_interruption_leaves_the_finished_conditions(tmp_path: Path) -> None:
    def interrupted(levels: tuple[Level, ...], seed: int) -> dict[str, float]:
        if levels == CONDITIONS[2] and seed == 2:
            raise KeyboardInterrupt
        return once(levels, seed)

    with pytest.raises(KeyboardInterrupt):
        repeat(
            "A title",
            FACTORS,
            CONDITIONS,
            (1, 2),
            interrupted,
            keep=lambda results: write_results(tmp_path, "try", results) and None,
        )
    document = json.loads((tmp_path / "try.json").read_text(encoding="utf-8"))
    assert document["complete"] is False
    assert (document["runs_made"], document["runs_planned"]) == (4, 16)
    assert "**Unfinished**: 4 of 16 runs." in (tmp_path / "try.md").read_text(encoding="utf-8")
    assert len((tmp_path / "try.csv").read_text(encoding="utf-8").splitlines()) == 5


def test_progress_counts_runs() -> None:
    told: list[tuple[str, int, int]] = []
    repeat(
        "A title", FACTORS, CONDITIONS[:1], (1, 2), once, progress=lambda *args: told.append(args)
    )
    assert told == [("runs", 0, 2), ("runs", 1, 2), ("runs", 2, 2)]


def test_files_carry_words_pictures_and_document(results: Results, tmp_path: Path) -> None:
    files = write_results(
        tmp_path / "new",
        "try",
        results,
        text="It helps.",
        document={"device": "none"},
        pictures={"try-ate.png": b"PNG"},
    )
    assert [path.name for path in files] == ["try.csv", "try.md", "try.json", "try-ate.png"]
    assert {path.name for path in (tmp_path / "new").iterdir()} == {path.name for path in files}
    markdown = (tmp_path / "new" / "try.md").read_text(encoding="utf-8")
    assert "## ate in m" in markdown
    assert "It helps." in markdown
    assert "![try-ate.png](try-ate.png)" in markdown
    assert json.loads((tmp_path / "new" / "try.json").read_text())["device"] == "none"


def test_markdown_puts_numbers_to_the_right_and_keeps_bars() -> None:
    assert markdown_table(["name", "n"], [["a|b", "1.0"], ["c", "-"]]) == [
        "| name | n |",
        "| --- | ---: |",
        "| a\\|b | 1.0 |",
        "| c | - |",
    ]


def test_labels_and_p_values_in_words() -> None:
    assert measure_label("time_per_scan_ms") == "time per scan in ms"
    assert p_text(0.0004) == "<0.001"
    assert p_text(0.0404) == "0.040"
