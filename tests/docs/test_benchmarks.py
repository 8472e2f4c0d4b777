"""Benchmarks keep their tables as JSON, of which the pages' tables are made."""

from __future__ import annotations

import ast
import io
import re
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from rich.table import Table

from docs.generate.benchmarks import Measurement, benchmark_table, benchmark_tables, measurements
from docs.generate.marks import pages
from tests.benchmarks import record
from tests.cli.command import ROOT

pytestmark = pytest.mark.once

MEASURED = Measurement(
    name="speed",
    date="2026-02-28",
    commit="0123abc",
    machine="two cores",
    command="bench | tee",
    columns=("what", "s"),
    rows=(("a|b", "1.5"), ("c", "2.5")),
)


BENCHMARKS = ROOT / "tests" / "benchmarks"
# Pages whose tables may have figures that nobody measured, or that are rounded to tens: codes,
# settings, seconds.
TYPED = {"CONTRIBUTING.md", "docs/concepts/graph_slam.md", "docs/reference/command_line.md"}
FIGURE = re.compile(r"[+-]?\d+(\.\d+)?( ?(m|cm|s|ms|%|MB))?")


def test_every_file_is_read_and_stands_on_a_page():
    text = "".join(page.read_text(encoding="utf-8") for page in pages())
    for name in benchmark_tables():
        assert f"<!-- {name}: written by" in text, name
    assert all(item.rows for item in measurements().values())


@pytest.mark.parametrize("name", measurements())
def test_the_command_of_a_table_is_there(name: str):
    program, *words = shlex.split(measurements()[name].command)
    if program == "python":
        assert words[0] == "-m"
        assert find_spec(words[1]) is not None
    else:
        assert program == "slamfusion"


def test_every_measured_table_is_made_of_a_measurement():
    """Outside of generated parts no table has a figure."""
    found = {
        str(page.relative_to(ROOT))
        for page in pages()
        for cell in typed_cells(page.read_text(encoding="utf-8"))
        if FIGURE.fullmatch(cell)
    }
    assert found == TYPED


def typed_cells(text: str) -> list[str]:
    """Return the cells of the tables that nothing generates."""
    typed = re.sub(r"<!-- ([^:\n]+): written by .*?<!-- end of \1 -->", "", text, flags=re.DOTALL)
    rows = re.findall(r"^ *\|(.*)\|$", typed, flags=re.MULTILINE)
    return [cell.strip(" *`") for row in rows for cell in row.split("|")]


def test_a_table_says_what_was_run_when_and_where():
    assert benchmark_table(MEASURED).splitlines() == [
        "| what | s |",
        "| --- | --- |",
        "| a\\|b | 1.5 |",
        "| c | 2.5 |",
        "",
        "*2026-02-28, commit 0123abc, two cores: `bench | tee`.*",
    ]


def test_a_console_keeps_every_table_that_it_prints(tmp_path: Path):
    printed = io.StringIO()
    console = record.console_for("drawn", tmp_path, file=printed, width=100)
    table = Table("map", "[bold]right[/bold]", title="drawn")
    table.add_row("a", "[green]3[/green] of 4")
    console.print("a word")
    console.print(table)
    console.print(table)
    assert {path.name for path in tmp_path.iterdir()} == {"drawn.json", "drawn-2.json"}
    kept = measurements(tmp_path)["drawn"]
    assert (kept.columns, kept.rows) == (("map", "right"), (("a", "3 of 4"),))
    assert re.fullmatch(r"[0-9a-f]{7,}\+?", kept.commit)
    assert "cores" in kept.machine
    assert "a word" in printed.getvalue()


@pytest.mark.parametrize("path", sorted(BENCHMARKS.glob("bench_*.py")), ids=lambda path: path.stem)
def test_every_benchmark_can_keep_its_table(path: Path):
    module = ast.parse(path.read_text(encoding="utf-8"))
    called = {
        node.func.id
        for node in ast.walk(module)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert {"bench_parser", "console_for"} <= called


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (["--seeds", "5"], "--seeds 5"),
        (["--record"], "--record"),
        (["--record", "somewhere", "--seeds", "5"], "--record --seeds 5"),
        (["--record=somewhere", "one drive"], "--record 'one drive'"),
        (["--drives", "/somewhere/drives", "--record"], "--drives DIR --record"),
    ],
)
def test_a_command_is_kept_without_the_folder(
    words: list[str], kept: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys, "argv", ["/somewhere/bench.py", *words])
    assert record.command().endswith(f" {kept}")
    assert "somewhere" not in record.command()
