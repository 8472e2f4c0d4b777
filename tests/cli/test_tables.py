"""Tables on terminals of 80 and 200 columns, and in a pipe."""

from __future__ import annotations

import pytest
from rich.cells import cell_len

from slamfusion.cli.tables import Table
from tests.cli.shown_tables import FOLDER, SHOWN, WIDTHS, all_shown, shown

pytestmark = pytest.mark.once


@pytest.mark.parametrize("width", WIDTHS)
def test_tables_look_as_they_were_looked_at(width: int) -> None:
    """After a change: ``python -m tests.cli.shown_tables``, and look at the difference."""
    assert all_shown(width) == (FOLDER / f"tables_{width}.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize("width", [40, 60, *WIDTHS])
@pytest.mark.parametrize("name", SHOWN)
def test_no_table_is_wider_than_the_terminal(name: str, width: int) -> None:
    lines = shown(SHOWN[name], width).splitlines()
    assert max(map(len, lines)) <= max(width, 60)


@pytest.mark.parametrize("name", SHOWN)
def test_a_pipe_gets_plain_lines(name: str) -> None:
    text = shown(SHOWN[name], None)
    assert text.isprintable() or set(text) - {"\n", "\t"} == set(filter(str.isprintable, set(text)))
    assert "─" not in text
    assert "  " not in text, "padded"


def test_a_row_in_a_pipe_is_a_line_with_its_note() -> None:
    table = Table(("name ", "dx m"), (("a\tb", "1.0"),), ("it\nfits",), "A title")
    assert list(table.tabbed()) == ["A title", "name\tdx m\treason", "a b\t1.0\tit fits"]


def test_wide_characters_take_two_places() -> None:
    table = Table(("name ", "m"), (("機械の地図", "1"), ("abc", "22")))
    lines = table.fitted(80).splitlines()[2:]
    assert [cell_len(line) for line in lines] == [cell_len(lines[0])] * 2
    long = Table(("name ", "m"), (("機械の地図" * 4, "1"),))
    assert max(map(cell_len, long.fitted(30).splitlines())) <= 30


def test_columns_that_hold_nothing_are_left_out_on_a_terminal_alone() -> None:
    table = Table(("name ", "gap", "m"), (("a", "-", "1"), ("b", "-", "2")))
    assert table.fitted(80).split()[:2] == ["name", "m"]
    assert next(table.tabbed()).split() == ["name", "gap", "m"]
