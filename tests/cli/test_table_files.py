"""Tables as files: CSV that no spreadsheet runs, Markdown, LaTeX."""

from __future__ import annotations

import csv
from pathlib import Path

from slamfusion.cli.output import Table
from slamfusion.cli.results import write_tables

TABLE = Table(
    ("map ", "error m", "error m"),
    (("a|b", "-0.25", "-"), ("=1+1", "1e-3", "0.1"), ("c_d & 50% \\input{x} #$", "+2", "@x")),
    ("fits", "", "=no"),
    "Errors_1",
)


def written(path: Path, *tables: Table) -> list[str]:
    write_tables(path, list(tables))
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
