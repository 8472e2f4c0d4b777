"""The picture of quantities over time: what is high is high, nothing of note is thinned away."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.palette import Rgb
from slamfusion.report.errors import broken, drawable, series_picture
from slamfusion.slam.common.mapper import Series
from tests.report.drawn import near, pixels

pytestmark = pytest.mark.once

COLOUR: Rgb = (28, 126, 214)


def series(values: list[float] | npt.NDArray[np.float64], **more: Any) -> Series:
    """One value a second."""
    numbers = np.asarray(values, dtype=np.float64)
    stamps = np.arange(len(numbers), dtype=np.float64)
    return Series("particles", "", stamps, numbers, **more)


def line(figure: Any) -> npt.NDArray[np.bool_]:
    """Where the line is."""
    return near(pixels(figure), COLOUR, 40)


def test_a_rising_quantity_rises_to_the_right() -> None:
    rows, cols = np.nonzero(line(series_picture([series(list(range(100)))], colours=[COLOUR])))
    assert rows[cols < np.quantile(cols, 0.1)].mean() > rows[cols > np.quantile(cols, 0.9)].mean()
    assert np.corrcoef(rows, cols)[0, 1] < -0.99


@pytest.mark.parametrize("value", [0.0, 2.0])
def test_one_moment_in_a_long_run_stays_in_the_picture(value: float) -> None:
    values = np.full(50_000, 1.0)
    values[31_337] = value
    drawn = line(series_picture([series(values)], colours=[COLOUR]))
    rows, cols = np.nonzero(drawn)
    lonely = [row for row in np.unique(rows) if np.ptp(cols[rows == row]) < 10]
    assert len(lonely) > 50
    away = np.array(lonely).mean() - np.median(rows)
    assert (away > 0) == (value < 1.0)


def test_every_quantity_has_its_unit_also_the_lowest() -> None:
    times = np.arange(3.0)
    drawn = [Series("speed", "m/s", times, times), Series("turn", "rad/s", times, times)]
    labels = [axes.get_ylabel() for axes in series_picture(drawn).axes]
    assert labels == ["[m/s]", "[rad/s]"]


def test_what_is_not_known_leaves_a_gap() -> None:
    values = np.full(1000, 4.0)
    values[400:600] = np.nan
    _, cols = np.nonzero(line(series_picture([series(values)], colours=[COLOUR])))
    gap = np.diff(np.unique(cols)).max()
    assert gap / np.ptp(cols) == pytest.approx(0.2, abs=0.01)


def test_a_line_is_broken_over_a_pause_also_where_it_is_thinned() -> None:
    stamps_s = np.r_[0.0:400.0:0.2, 500.0:900.0:0.2]
    values = np.full(len(stamps_s), 3.0)
    times_s, shown = broken(stamps_s, values)
    assert np.isnan(shown).sum() == 1
    assert times_s[np.isnan(shown)] == pytest.approx(449.9, abs=0.2)
    _, cols = np.nonzero(
        line(series_picture([Series("gap", "m", times_s, shown)], colours=[COLOUR]))
    )
    pause = np.diff(np.unique(cols)).max()
    assert pause / np.ptp(cols) == pytest.approx(100.0 / 900.0, abs=0.01)


@pytest.mark.parametrize(
    "values",
    [
        [7.0],
        [0.0, 0.0],
        [-5.0, -1.0],
        [1e12, 3e12],
        [1e-9, 2e-9],
        [float("nan"), 3.0, float("nan")],
        [float("inf"), 1.0],
    ],
)
def test_odd_values_can_be_drawn(values: list[float]) -> None:
    assert line(series_picture([series(values)], colours=[COLOUR])).any()


def test_what_has_no_value_is_left_out() -> None:
    kept = series([1.0, 2.0])
    nothing = [series([]), series([float("nan")] * 3)]
    assert drawable([*nothing, kept]) == [kept]
