"""Table II of [H16], digit by digit."""

from __future__ import annotations

import pytest

from slamfusion.experiments import tinyslam
from slamfusion.experiments.tinyslam import table_two

TABLE_TWO = {
    ("base", "forward"): ["0.105", "0.225", "0.460"],
    ("base", "backward"): ["0.502", "0.737", "0.858"],
    ("mean", "forward"): ["0.245", "0.480", "0.715"],
    ("mean", "backward"): ["0.245", "0.480", "0.715"],
}


def test_table_two_in_three_decimals() -> None:
    means = table_two().summaries["mean"]
    for (model, order), wanted in TABLE_TWO.items():
        cases = [f"{order}, {count} occupied" for count in (3, 6, 9)]
        assert [f"{means[case, 'value', model]:.3f}" for case in cases] == wanted
    assert table_two().failure == ""


def test_a_last_digit_off_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(tinyslam.PAPER, ("base", "forward"), (0.104, 0.225, 0.460))
    failure = table_two().failure
    assert failure.startswith("1 values differ from Table II of [H16]: base, forward, 3 occupied: ")
    assert failure.endswith("found 0.105, wanted 0.104")
