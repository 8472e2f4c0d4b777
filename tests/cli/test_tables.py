"""Tables on terminals of 80 and 200 columns, in a pipe, and as files."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from rich.cells import cell_len

from slamfusion.cli.output import Table
from slamfusion.cli.results import write_tables


def errors(cells: int) -> Table:
    """Return a table like those of paths: a row for each of three SLAMs, with a reason."""
    head = ("path ", *(f"RPE over {number} frames, deg" for number in range(cells)))
    names = ("tinyslam", "gmapping", "a map with a very long name indeed")
    rows = tuple((name, *("1234.5678",) * cells) for name in names)
    return Table(head, rows, ("", "the process was killed (SIGKILL) at scan 400", ""), "Errors")


@pytest.mark.parametrize("cells", [1, 4, 12])
@pytest.mark.parametrize("width", [60, 80, 200])
def test_no_table_is_wider_than_the_terminal_and_no_value_is_lost(width: int, cells: int) -> None:
    text = errors(cells).fitted(width, is_whole=True)
    assert max(map(cell_len, text.splitlines())) <= width
    assert text.count("1234.5678") == 3 * cells
    for name in ("tinyslam", "SIGKILL", "indeed"):
        assert name in text


def test_columns_that_do_not_fit_are_named_and_left_out_from_the_last_one() -> None:
    text = errors(12).fitted(80)
    assert max(map(cell_len, text.splitlines())) <= 80
    shown = text.count("1234.5678") // 3
    assert 0 < shown < 12
    said = " ".join(text.split())
    assert f"--verbose also shows: RPE over {shown} frames, deg, " in said
    assert said.endswith("RPE over 11 frames, deg")


def test_a_unit_in_brackets_is_no_markup_and_heads_stay_whole_where_they_fit() -> None:
    table = Table(("path ", "ATE rmse [m]"), (("graph", "0.1"),))
    assert table.fitted(80).splitlines()[0] == " path   ATE rmse [m]"


def test_a_row_in_a_pipe_is_a_line_with_its_note() -> None:
    table = Table(("name ", "dx m"), (("a\tb", "1.0"),), ("it\nfits",), "A title")
    assert list(table.tabbed()) == ["A title", "name\tdx m\treason", "a b\t1.0\tit fits"]


def test_columns_that_hold_nothing_are_left_out_on_a_terminal_alone() -> None:
    table = Table(("name ", "gap", "m"), (("a", "-", "1"), ("b", "-", "2")))
    assert table.fitted(80).split()[:2] == ["name", "m"]
    assert next(table.tabbed()).split() == ["name", "gap", "m"]


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
