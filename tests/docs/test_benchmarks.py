"""Benchmarks keep their tables as dated JSON, of which the pages' tables are made."""

from __future__ import annotations

import ast
import datetime as dt
import io
import itertools
import re
import sys
from pathlib import Path

import pytest
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
# Heads of the tables that a person writes, by page: settings, advice, links. None was measured.
WORDS = {
    "docs/concepts/alignment.md": {"| match | share of the common walls | what it means |"},
    "README.md": {"| question | page |", "| where | how |"},
    "CONTRIBUTING.md": {"| after a change of | run |", "| area | command | seconds |"},
    "SECURITY.md": {"| how far | what |", "| what | how far |"},
    "data/README.md": {"| map | faults |"},
    "docs/concepts/gmapping.md": {"| ours | published | why |"},
    "docs/concepts/graph_slam.md": {"| setting | open_karto | ours | difference |"},
    "docs/concepts/voting.md": {"| you have | take |"},
    "docs/guides/dds.md": {"| where | what |"},
    "docs/guides/fleet.md": {"| message | what to do |"},
    "docs/guides/live_page.md": {"| to | do |"},
    "docs/guides/nav2.md": {"| wanted | from pip alone | with ROS tools |"},
    "docs/guides/ros2.md": {"| you have | start everything with |"},
    "docs/guides/site.md": {"| step | work | on workers | memory |"},
    "docs/guides/troubleshooting.md": {"| what you see | why | what to do |"},
    "docs/guides/two_robots.md": {"| map_merge | fusion node | `slamfusion fuse` |"},
    "docs/guides/which_slam.md": {"| | tinySLAM | gmapping | graph |", "| | |"},
    "docs/index.md": {"| question | page |"},
    "docs/install.md": {"| for | install |", "| what | held | until |"},
    "docs/reference/command_line.md": {"| code | means |", "| command | does |"},
    "docs/reference/limits.md": {"| what | limit | why |"},
}


def test_every_file_is_read_and_stands_on_a_page():
    text = "".join(page.read_text(encoding="utf-8") for page in pages())
    assert len(measurements()) >= 20
    for name in benchmark_tables():
        assert f"<!-- {name}: written by" in text, name
    assert all(Measurement.read(path).rows for path in FOLDER.glob("*.json"))


def test_every_measured_table_is_made_of_a_measurement():
    """Outside of generated parts a page has no tables but those that are named here."""
    typed = {
        str(page.relative_to(ROOT)): typed_tables(page.read_text(encoding="utf-8"))
        for page in pages()
    }
    assert {page: heads for page, heads in typed.items() if heads} == WORDS


def typed_tables(text: str) -> set[str]:
    """Return the heads of the tables that nothing generates."""
    typed = re.sub(r"<!-- ([^:\n]+): written by .*?<!-- end of \1 -->", "", text, flags=re.DOTALL)
    lines = [line.strip() for line in typed.splitlines()]
    return {
        head
        for head, rule in itertools.pairwise(lines)
        if head.startswith("|") and re.fullmatch(r"\|[\s|:-]+\|", rule)
    }


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
    today = dt.datetime.now(dt.timezone.utc).date().isoformat()
    names = {f"drawn-{today}.json", f"drawn-2-{today}.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    kept = measurements(tmp_path)["drawn"]
    assert (kept.columns, kept.rows) == (("map", "right"), (("a", "3 of 4"),))
    assert re.fullmatch(r"[0-9a-f]{7,}\+?", kept.commit)
    assert "cores" in kept.machine
    assert "a word" in printed.getvalue()


@pytest.mark.parametrize("path", sorted(BENCHMARKS.glob("bench_*.py")), ids=lambda path: path.stem)
def test_every_benchmark_can_keep_its_table(path: Path):
    """Those of one producer have the option, and the console, from ``parts``."""
    module = ast.parse(path.read_text(encoding="utf-8"))
    called = {
        node.func.id
        for node in ast.walk(module)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert {"add_record_option", "console_for"} <= called or {"parser_of", "measure"} <= called


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
