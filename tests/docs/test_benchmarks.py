"""Benchmarks keep their tables as dated JSON, of which the pages' tables are made."""

from __future__ import annotations

import datetime as dt
import io
import json
import re
import sys
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from docs.generate.benchmarks import (
    FOLDER,
    Measurement,
    benchmark_table,
    benchmark_tables,
    measurements,
)
from docs.generate.marks import pages
from tests.benchmarks import record
from tests.cli.command import ROOT

MEASURED = Measurement(
    name="speed",
    date="2026-02-28",
    commit="0123abc",
    machine="two cores",
    command="bench | tee",
    columns=("what", "s"),
    rows=(("a|b", "1.5"), ("c", "2.5")),
)


def test_every_file_is_read_and_stands_on_a_page():
    text = "".join(page.read_text(encoding="utf-8") for page in pages())
    assert len(measurements()) >= 20
    for name in benchmark_tables():
        assert f"<!-- {name}: written by" in text, name
    assert all(Measurement.read(path).rows for path in FOLDER.glob("*.json"))


def test_every_table_of_the_pages_is_made_of_a_measurement():
    """No row of a table in docs/benchmarks is typed."""
    for page in sorted((ROOT / "docs" / "benchmarks").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        typed = re.sub(r"<!-- (benchmark [^:]+): .*?<!-- end of \1 -->", "", text, flags=re.DOTALL)
        assert not re.search(r"^\|", typed, flags=re.MULTILINE), page


def test_a_table_says_what_was_run_when_and_where():
    assert benchmark_table(MEASURED).splitlines() == [
        "| what | s |",
        "| --- | --- |",
        "| a\\|b | 1.5 |",
        "| c | 2.5 |",
        "",
        "*2026-02-28, commit 0123abc, two cores: `bench | tee`.*",
    ]


def test_a_measurement_comes_back_as_it_was_written(tmp_path: Path):
    path = tmp_path / MEASURED.file_name
    path.write_text(MEASURED.to_json(), encoding="utf-8")
    assert Measurement.read(path) == MEASURED


def test_of_several_the_newest_is_shown(tmp_path: Path):
    for date in ("2026-03-01", "2025-12-31", "2026-02-28"):
        told = json.loads(MEASURED.to_json()) | {"date": date}
        (tmp_path / f"speed-{date}.json").write_text(json.dumps(told), encoding="utf-8")
    assert measurements(tmp_path)["speed"].date == "2026-03-01"


def test_a_file_with_another_date_in_it_is_refused(tmp_path: Path):
    path = tmp_path / "speed-2026-03-01.json"
    path.write_text(MEASURED.to_json(), encoding="utf-8")
    with pytest.raises(ValueError, match=r"call it speed-2026-02-28\.json"):
        Measurement.read(path)


def test_a_row_that_is_too_short_is_refused(tmp_path: Path):
    told = json.loads(MEASURED.to_json()) | {"rows": [["alone"]]}
    path = tmp_path / MEASURED.file_name
    path.write_text(json.dumps(told), encoding="utf-8")
    with pytest.raises(ValueError, match="a row of 1 cells, 2 columns"):
        Measurement.read(path)


def test_a_console_keeps_every_table_that_it_prints(tmp_path: Path):
    printed = io.StringIO()
    console = record.console_for("drawn", tmp_path, file=printed, width=100)
    table = Table("map", "[bold]right[/bold]", title="drawn")
    table.add_row("a", "[green]3[/green] of 4")
    console.print("a word")
    console.print(table)
    console.print(table)
    today = dt.datetime.now(dt.timezone.utc).date().isoformat()
    names = {f"drawn-{today}.json", f"drawn-2-{today}.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    kept = measurements(tmp_path)["drawn"]
    assert (kept.columns, kept.rows) == (("map", "right"), (("a", "3 of 4"),))
    assert re.fullmatch(r"[0-9a-f]{7,}\+?", kept.commit)
    assert "cores" in kept.machine
    assert "a word" in printed.getvalue()


def test_without_a_folder_nothing_is_kept():
    assert type(record.console_for("drawn", None)) is Console


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (["--seeds", "5"], "--seeds 5"),
        (["--record"], "--record"),
        (["--record", "somewhere", "--seeds", "5"], "--record --seeds 5"),
        (["--record=somewhere", "one drive"], "--record 'one drive'"),
    ],
)
def test_a_command_is_kept_without_the_folder(
    words: list[str], kept: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys, "argv", ["/somewhere/bench.py", *words])
    assert record.command().endswith(f" {kept}")
    assert "somewhere" not in record.command()
