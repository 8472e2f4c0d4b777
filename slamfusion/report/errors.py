"""What happened over a drive: the errors of paths, their distributions, and other quantities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.evaluation.measured import FIGURES, MeasuredPath
from slamfusion.evaluation.relations import REVISIT_S, RelationErrors
from slamfusion.evaluation.statistics import ErrorStatistics
from slamfusion.evaluation.trajectory_error import TrajectoryErrors
from slamfusion.geometry import F64
from slamfusion.palette import INK_RGB, Rgb
from slamfusion.report.canvas import INK, label_axes, name_rows, stacked_axes, unit_rgb, write_note
from slamfusion.report.page import Fact, Picture, Section, tables
from slamfusion.slam.common.mapper import Series

# Distributions are drawn up to this share of the errors: the few beyond would hide the others.
_BULK = 0.99
# Errors below this are drawn here: a logarithmic axis has no zero.
_LEAST = 1e-4
_FEW = 50
# No line is drawn over a time so much longer than that between most values, and than this, seconds.
_PAUSE, _PAUSE_S = 5.0, 2.0


def errors_section(
    measured: Sequence[MeasuredPath], colours: Mapping[str, Rgb], case: str = ""
) -> list[Section]:
    """Return the errors of paths of one drive; its name is empty where a page has no other."""
    rows, pictures = [], []
    for item in measured:
        kinds, relations = item.measures.kinds(), item.measures.relations
        if relations is not None and (revisits := relations.is_revisit()).any():
            own = ErrorStatistics.of(relations.translation_m[revisits])
            kinds.append(("revisits, translation m", own, 4))
        for kind, statistics, digits in kinds:
            values = [getattr(statistics, name, None) for name in FIGURES]
            rows.append((item.name, kind, values, digits))
    if not rows:
        return []
    of, stem = (f"{case}: ", f"{case}-") if case else ("", "")
    errors = {item.name: item.measures for item in measured}
    truth = {name: own.truth for name, own in errors.items() if own.truth is not None}
    if truth:
        title = f"{of}Error against the truth"
        pictures += _error_pictures(f"{stem}error", title, "", truth, colours)
    known = {name: own.relations for name, own in errors.items() if own.relations is not None}
    if known:
        title = f"{of}Error on known relations"
        caption = f"Large dots: revisits, where the two times are over {REVISIT_S:g} s apart."
        pictures += _error_pictures(f"{stem}relations", title, caption, known, colours)
    text = (
        "ATE: error of each pose after one rigid alignment of the whole path (if asked for). RPE: "
        "error of the motion between two poses. Relations [K09]: error of the motion between two "
        "times against the known one; no common frame is needed."
    )
    table = tables().path_errors([f"#{name}" for name in FIGURES], rows)
    title = f"{of}errors of the paths" if of else "Errors of the paths"
    return [Section(title, text, pictures, table)]


def _error_pictures(
    stem: str,
    title: str,
    caption: str,
    errors: Mapping[str, TrajectoryErrors | RelationErrors],
    colours: Mapping[str, Rgb],
) -> list[Picture]:
    """Return errors over the drive, with this caption, and their distribution."""
    legend = {name: colours[name] for name in errors}
    values = {name: own.translation_m for name, own in errors.items()}
    return [
        Picture(
            stem, _over_time(errors, colours), f"{title} over the drive", caption, legend=legend
        ),
        Picture(
            f"{stem}-distribution",
            distribution_figure(values, colours),
            f"{title}, distribution",
            "Box: quartiles and median; whiskers: 5 % and 95 %.",
            legend=legend,
        ),
    ]


def error_facts(item: MeasuredPath) -> list[Fact]:
    """Return the leading errors of a path as numbers of the headline."""
    facts, truth, relations = [], item.measures.truth, item.measures.relations
    if truth is not None:
        facts.append(Fact(f"{truth.ate.rmse:.4f} m", f"ATE rmse, {item.name}"))
        if truth.rpe is not None:
            pair = f"{truth.rpe_delta:g} {truth.rpe_unit}"
            facts.append(Fact(f"{truth.rpe.rmse:.4f} m", f"RPE rmse, {pair}, {item.name}"))
    if relations is not None:
        mean = relations.translation.mean
        facts.append(Fact(f"{mean:.4f} m", f"error of relations, mean, {item.name}"))
    return facts


def _over_time(
    errors: Mapping[str, TrajectoryErrors | RelationErrors], colours: Mapping[str, Rgb]
) -> Figure:
    """Draw the errors of place and of heading over time; those of relations as dots."""
    figure, axes = stacked_axes(2, 1.45)
    start_s = min(float(own.stamps_s.min()) for own in errors.values())
    for name, own in errors.items():
        since_s = own.stamps_s.reshape(len(own.stamps_s), -1).min(axis=1) - start_s
        colour = unit_rgb(colours[name])
        for place, values in zip(
            axes, (own.translation_m, np.rad2deg(own.rotation_rad)), strict=True
        ):
            if isinstance(own, TrajectoryErrors):
                place.plot(since_s, values, color=colour, lw=0.9)
                rmse = float(np.sqrt(np.mean(values**2)))
                place.axhline(rmse, color=colour, lw=0.7, ls=":")
                continue
            sizes = np.where(own.is_revisit(), 9.0, 1.5)
            shown = np.maximum(values, _LEAST)
            place.scatter(since_s, shown, s=sizes, color=colour, alpha=0.7, linewidths=0)
            place.axhline(max(float(values.mean()), _LEAST), color=colour, lw=0.7, ls=":")
            place.set_yscale("log")
    is_truth = isinstance(next(iter(errors.values())), TrajectoryErrors)
    for place, unit in zip(axes, ("m", "°"), strict=True):
        label_axes(place, y=f"error [{unit}]")
        write_note(place, f"dotted: {'rmse' if is_truth else 'mean'}")
        place.margins(x=0.01)
        if is_truth:
            place.set_ylim(bottom=0.0)
    label_axes(axes[-1], x="time since the start [s]")
    return figure


def distribution_figure(values: Mapping[str, F64], colours: Mapping[str, Rgb]) -> Figure:
    """Draw the share of errors (N,) in metres below each value, with a box plot of each path."""
    figure, (above, below) = stacked_axes(2, (1.5, 0.2 + 0.32 * len(values)))
    draw_shares(above, list(values.items()), colours)
    drawn = below.boxplot(
        list(values.values()),
        positions=range(len(values)),
        orientation="horizontal",
        whis=(5.0, 95.0),
        showfliers=False,
        widths=0.4,
        patch_artist=True,
        medianprops={"color": "white", "lw": 1.2},
        whiskerprops={"color": INK, "lw": 0.8},
        capprops={"color": INK, "lw": 0.8},
    )
    for box, name in zip(drawn["boxes"], values, strict=True):
        box.set(facecolor=unit_rgb(colours[name]), edgecolor=INK, linewidth=0.6)
    name_rows(below, list(values))
    label_axes(above, y="share of errors below")
    label_axes(below, x="error [m]")
    return figure


def draw_shares(axes: Axes, values: Sequence[tuple[str, F64]], colours: Mapping[str, Rgb]) -> None:
    """Draw the share of errors below each value, up to the bulk of them; the names may repeat."""
    for name, own in values:
        share = np.arange(1, len(own) + 1) / len(own)
        axes.step(np.sort(own), share, where="post", color=unit_rgb(colours[name]), lw=1.0)
    most = max(float(np.quantile(own, _BULK)) for _, own in values)
    least = min(0.0, *(float(own.min()) for _, own in values))
    axes.set_xlim(least, most + 0.05 * (most - least) or 1.0)
    axes.set_ylim(0.0, 1.02)
    write_note(axes, f"shown up to the {_BULK:.0%} quantile")


def drawable(series: Sequence[Series]) -> list[Series]:
    """Return the series that have a value to be drawn."""
    return [item for item in series if np.isfinite(item.values).any()]


def broken(stamps_s: F64, values: F64) -> tuple[F64, F64]:
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
    """Draw quantities over time on stacked axes; series of one name share axes.

    A limit is a dotted line. A value that is not finite leaves a gap.

    Args:
        series: each ``drawable``.
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
        marker = "o" if len(item.values) <= _FEW else ""  # one value alone makes no line
        look: dict[str, Any] = {"color": drawn, "lw": 0.9, "marker": marker, "ms": 2.0}
        place.plot(
            item.stamps_s - begin, np.where(np.isfinite(item.values), item.values, np.nan), **look
        )
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
