"""The picture of a producer's own quantities over the time of its run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.palette import Rgb
from slamfusion.report.canvas import (
    DPI,
    INK,
    WIDTH_IN,
    plain_text,
    style_axes,
    to_png,
    unit_rgb,
    write_note,
)
from slamfusion.slam.common.mapper import Series

# Heights of one pair of axes, of the name above it, and of the lettering below the last.
_AXES_IN, _HEAD_IN, _FOOT_IN = 1.05, 0.25, 0.4
# Half the columns of a picture: each shows the least and the greatest of what falls on it.
_COLUMNS = 400
_SHADE = 0.25
_FEW = 50
# No line is drawn over a time so much longer than that between most values, and than this, seconds.
_PAUSE, _PAUSE_S = 5.0, 2.0


def drawable(series: Sequence[Series]) -> list[Series]:
    """Return the series that have a value to be drawn."""
    return [item for item in series if np.isfinite(item.values).any()]


def broken(
    stamps_s: npt.NDArray[np.float64], values: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return values over time, (N,), with NaN in each pause, where nothing is known."""
    steps_s = np.diff(stamps_s)
    if not len(steps_s):
        return stamps_s, values
    pauses = np.flatnonzero(steps_s > max(_PAUSE_S, _PAUSE * float(np.median(steps_s))))
    middle_s = stamps_s[pauses] + 0.5 * steps_s[pauses]
    return np.insert(stamps_s, pauses + 1, middle_s), np.insert(values, pauses + 1, np.nan)


def series_picture(
    series: Sequence[Series],
    *,
    colour: Rgb | None = None,
    start_s: float | None = None,
    shaded: Mapping[str, Sequence[tuple[float, float]]] | None = None,
) -> bytes:
    """Draw quantities over time, one pair of axes above the other on one axis of time.

    A limit is a dotted line, said in words beside the name. What is not finite leaves a gap.

    Args:
        series: at least one of them ``drawable``; the others are left out.
        colour: of the lines; default: that of a quantity of no one path.
        start_s: stamp that counts as 0 s, where the axis of time begins; default: the earliest of
            all series.
        shaded: times that are shaded behind the line of a series, by its name: two stamps each.

    Returns:
        The bytes of a PNG file.
    """
    shown = drawable(series)
    if not shown:
        message = "none of the series has a value to draw"
        raise ValueError(message)
    first_s = min(float(item.stamps_s[0]) for item in shown)
    begin = first_s if start_s is None else start_s
    end_s = max(float(item.stamps_s[-1]) for item in shown) - begin
    from_s = min(0.0, first_s - begin)
    room_s = 0.01 * (end_s - from_s) or 1.0
    row_in = _HEAD_IN + _AXES_IN
    tall_in = len(shown) * row_in + _FOOT_IN
    figure = Figure(figsize=(WIDTH_IN, tall_in), dpi=DPI)
    first = None
    drawn = INK if colour is None else unit_rgb(colour)
    for row, item in enumerate(shown):
        bottom_in = _FOOT_IN + row_in * (len(shown) - 1 - row)
        box = (0.155, bottom_in / tall_in, 0.825, _AXES_IN / tall_in)
        axes = figure.add_axes(box, sharex=first)
        first = first or axes
        since, values = thinned(item.stamps_s - begin, item.values)
        marker = "o" if len(values) <= _FEW else ""  # one value alone makes no line
        axes.plot(since, values, color=drawn, lw=0.9, marker=marker, ms=2.0)
        for one_s, other_s in (shaded or {}).get(item.name, ()):
            axes.axvspan(one_s - begin, other_s - begin, color=INK, alpha=_SHADE, lw=0)
        if item.limit is not None:
            axes.axhline(item.limit, color=INK, lw=0.8, ls=":")
            write_note(axes, f"limit {item.limit:.4g}")
        axes.set_title(plain_text(item.name), loc="left", color=INK, fontsize=7.5, pad=3)
        axes.set_ylabel(plain_text(item.unit), color=INK, fontsize=7.5)
        axes.set_ylim(*_span(item))
        axes.set_xlim(from_s - room_s, end_s + room_s)
        style_axes(axes)
        axes.tick_params(labelbottom=row == len(shown) - 1)
    axes.set_xlabel("seconds since the start", color=INK, fontsize=7.5)
    return to_png(figure)


def _span(item: Series) -> tuple[float, float]:
    """Return the limits of the y axis: from 0 where nothing is negative, the limit in sight."""
    values = item.values[np.isfinite(item.values)]
    low, high = float(values.min()), float(values.max())
    if item.limit is not None:
        low, high = min(low, item.limit), max(high, item.limit)
    low = min(low, 0.0)
    room = 0.06 * (high - low) or 1.0
    return low - (room if low < 0.0 else 0.0), high + room


def thinned(
    x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return few enough points for the picture; of each run of them the least and the greatest.

    Where a value of a run is not finite, the first such one is kept, too.
    """
    step = -(-len(x) // _COLUMNS)
    if step <= 2:
        return x, y
    count = len(x) // step * step
    rows = y[:count].reshape(-1, step)
    known = np.isfinite(rows)
    low = np.argmin(np.where(known, rows, np.inf), axis=1)
    high = np.argmax(np.where(known, rows, -np.inf), axis=1)
    gap = np.where(known.all(axis=1), low, np.argmin(known, axis=1))
    kept = np.stack((low, high, gap), axis=1) + step * np.arange(len(rows))[:, None]
    kept = np.append(np.unique(kept), np.arange(count, len(x)))
    return x[kept], y[kept]
