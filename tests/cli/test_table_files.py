"""Tables as files: CSV that no spreadsheet runs, Markdown, LaTeX."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from slamfusion.cli.table_files import as_csv, as_latex, as_markdown
from slamfusion.cli.tables import Table
from tests.cli.command import MAPS, TRUTH, run

pytestmark = pytest.mark.once

PATH = Path("out.csv")
TABLE = Table(
    ("map ", "error m", "gap"),
    (("a|b", "-0.25", "-"), ("=1+1", "1e-3", "0.1"), ("c_d & 50%", "+2", "@x")),
    ("fits", "", "=no"),
    "Errors_1",
)


def test_csv_has_no_formula_and_nothing_for_what_is_unknown() -> None:
    ((_, text),) = as_csv(PATH, [TABLE]).items()
    assert list(csv.reader(text.splitlines())) == [
        ["map", "error m", "gap", "reason"],
        ["a|b", "-0.25", "", "fits"],
        ["'=1+1", "1e-3", "0.1", ""],
        ["c_d & 50%", "+2", "'@x", "'=no"],
    ]


def test_each_table_is_a_csv_file_of_its_own() -> None:
    names = list(as_csv(Path("x/out.csv"), [TABLE, TABLE, TABLE]))
    assert names == [Path("x/out.csv"), Path("x/out-2.csv"), Path("x/out-3.csv")]


def test_markdown() -> None:
    text = as_markdown(PATH, [TABLE])[PATH]
    assert text.splitlines()[:4] == [
        "## Errors_1",
        "",
        "| map | error m | gap | reason |",
        "| --- | ---: | ---: | --- |",
    ]
    assert "| a\\|b | -0.25 | - | fits |" in text


def test_latex_escapes_what_would_be_a_command() -> None:
    text = as_latex(PATH, [TABLE])[PATH]
    assert r"\begin{tabular}{lrrl}" in text
    assert r"c\_d \& 50\% & +2 & @x & =no \\" in text
    odd = as_latex(PATH, [Table(("a ",), (("\\input{x} ~^#$",),))])[PATH]
    assert r"\textbackslash{}input\{x\} \textasciitilde{}\textasciicircum{}\#\$" in odd


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
