"""The figure of quantities over the time of a drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.palette import INK_RGB, Rgb
from slamfusion.report.canvas import label_axes, stacked_axes, unit_rgb, write_note
from slamfusion.slam.common.mapper import Series

# Half the columns of a picture: each shows the least and the greatest of what falls on it.
_COLUMNS = 400
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
    series: Sequence[Series], *, colours: Sequence[Rgb] = (), start_s: float | None = None
) -> Figure:
    """Draw quantities over time, axes above each other; series of one name share axes.

    A limit is a dotted line. A value that is not finite leaves a gap.

    Args:
        series: at least one, each ``drawable``.
        colours: of the line of each series; default: the same for all.
        start_s: stamp that counts as 0 s; default: the earliest of all series.
    """
    first_s = min(float(item.stamps_s[0]) for item in series)
    begin = first_s if start_s is None else start_s
    end_s = max(float(item.stamps_s[-1]) for item in series) - begin
    from_s = min(0.0, first_s - begin)
    room_s = 0.01 * (end_s - from_s) or 1.0
    names = list(dict.fromkeys(item.name for item in series))
    figure, axes = stacked_axes(len(names), 1.05)
    for item, colour in zip(series, colours or [INK_RGB] * len(series), strict=True):
        place, drawn = axes[names.index(item.name)], unit_rgb(colour)
        since, values = thinned(item.stamps_s - begin, item.values)
        marker = "o" if len(values) <= _FEW else ""  # one value alone makes no line
        place.plot(since, values, color=drawn, lw=0.9, marker=marker, ms=2.0)
        if item.limit is not None:
            place.axhline(item.limit, color=drawn, lw=0.8, ls=":")
            write_note(place, f"limit {item.limit:.4g}" if len(series) == len(names) else "")
    for place, name in zip(axes, names, strict=True):
        own = [item for item in series if item.name == name]
        unit = own[0].unit
        label_axes(place, name, y=f"[{unit}]" if unit else "")
        place.set_ylim(*_span(own))
        place.set_xlim(from_s - room_s, end_s + room_s)
    label_axes(axes[-1], x="time since the start [s]")
    return figure


def _span(series: Sequence[Series]) -> tuple[float, float]:
    """Return the limits of the y axis: from 0 unless a value is negative, the limits in sight."""
    values = np.concatenate([item.values[np.isfinite(item.values)] for item in series])
    limits = [item.limit for item in series if item.limit is not None]
    low, high = min([0.0, *limits, float(values.min())]), max([*limits, float(values.max())])
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
