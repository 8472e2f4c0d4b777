"""Tables as files: CSV that no spreadsheet runs, Markdown, LaTeX."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from slamfusion.cli import results
from slamfusion.cli.output import Table
from tests.cli.command import MAPS, TRUTH, run

pytestmark = pytest.mark.once

TABLE = Table(
    ("map ", "error m", "error m"),
    (("a|b", "-0.25", "-"), ("=1+1", "1e-3", "0.1"), ("c_d & 50% \\input{x} #$", "+2", "@x")),
    ("fits", "", "=no"),
    "Errors_1",
)


def written(path: Path, *tables: Table) -> list[str]:
    results._write(path, list(tables))
    return path.read_text(encoding="utf-8").splitlines()


def test_csv_has_no_formula_and_nothing_for_what_is_unknown(tmp_path: Path) -> None:
    lines = written(tmp_path / "out.csv", TABLE, TABLE, TABLE)
    assert list(csv.reader(lines)) == [
        ["map", "error m", "error m", "reason"],
        ["a|b", "-0.25", "", "fits"],
        ["'=1+1", "1e-3", "0.1", ""],
        ["c_d & 50% \\input{x} #$", "+2", "'@x", "'=no"],
    ]
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["out-2.csv", "out-3.csv", "out.csv"]


def test_markdown(tmp_path: Path) -> None:
    lines = written(tmp_path / "out.md", TABLE)
    assert lines[:4] == [
        "## Errors_1",
        "",
        "| map | error m | error m | reason |",
        "| --- | ---: | ---: | --- |",
    ]
    assert "| a\\|b | -0.25 | - | fits |" in lines


def test_latex_escapes_what_would_be_a_command(tmp_path: Path) -> None:
    lines = written(tmp_path / "out.tex", TABLE, TABLE)
    assert lines.count(r"\begin{tabular}{lrrl}") == 2
    assert r"c\_d \& 50\% \textbackslash input\{x\} \#\$ & +2 & @x & =no \\" in lines


def test_a_command_writes_what_it_prints(tmp_path: Path) -> None:
    words = ("evaluate", MAPS[0], MAPS[1], "--truth", TRUTH, "--device", "numpy", "--no-align")
    done = run(*words, "--table", tmp_path / "out.csv")
    assert done.returncode == 0, done.stderr
    (tmp_path / "out-2.csv").unlink()
    with (tmp_path / "out.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["map"] for row in rows] == ["map_a", "map_b"]
    assert all(float(row["error"]) > 0.0 for row in rows)
    for more in (("--table", "x.xlsx"), ("--table", "x.csv", "--json")):
        assert run(*words, *more, cwd=tmp_path).returncode == 2
