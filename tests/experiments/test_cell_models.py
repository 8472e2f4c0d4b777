"""Table II of [H16], digit by digit."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slamfusion.experiments import table_two

TABLE_TWO = {
    ("base", "forward"): ["0.105", "0.225", "0.460"],
    ("base", "backward"): ["0.502", "0.737", "0.858"],
    ("mean", "forward"): ["0.245", "0.480", "0.715"],
    ("mean", "backward"): ["0.245", "0.480", "0.715"],
}


def test_table_two_in_three_decimals() -> None:
    found: dict[tuple[str, str], list[str]] = {}
    for row in table_two():
        found.setdefault((row.model, row.order), []).append(f"{row.value:.3f}")
    assert found == TABLE_TWO
    assert all(row.is_equal for row in table_two())


def test_each_row_keeps_the_way_there() -> None:
    for row in table_two():
        assert len(row.values) == 13
        assert row.values[0] == 0.5
        starts_up = row.values[1] > 0.5
        assert starts_up == (row.order == "forward")
        assert row.to_json()["value"] == row.values[-1]


def test_a_last_digit_off_is_not_equal() -> None:
    row = table_two()[0]
    assert row.value == pytest.approx(0.105, abs=0.0005)
    assert not replace(row, paper=0.104).is_equal
