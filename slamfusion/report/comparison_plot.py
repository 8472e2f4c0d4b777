"""The picture of several saved results: errors along the paths, and figures case by case.

Unlike those of a page it stands alone, in a paper: on white, with the names in its legend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist  # noqa: TID251
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.evaluation import ErrorSeries, MeasuredItem, figure_of
from slamfusion.palette import colours_of
from slamfusion.report.canvas import plain_text, to_form, unit_rgb

__all__ = ["comparison_plot"]

# What is drawn at most: a picture of more is none that one reads.
MOST_PATHS, MOST_FIGURES = 6, 6
WIDTH_IN, ROW_IN, FOOT_IN = 7.0, 2.0, 0.45
MARKERS, STYLES = "osD^vP", ("-", "--", "-.", ":")
# Points of a line: more than a page shows.
POINTS = 2000
# An error that is so many times the median one is drawn on a logarithmic axis.
LARGE = 50.0

Sets = Mapping[str, Sequence[MeasuredItem]]


def comparison_plot(sets: Sets, form: str) -> bytes:
    """Draw saved results beside each other.

    The first rows show single errors, a row for each kind of error of each case: along the path on
    the left, and the share of the errors below each value on the right. The rows below show the
    figures, a point for each map or path, those of one case, seed and method joined by a line;
    where each file has a single path, its errors say more.

    Args:
        sets: the maps or paths of each file of results, by its name.
        form: ``png``, ``svg`` or ``pdf``.

    Returns:
        The bytes of the file; the same for the same results.
    """
    series = _drawn_series(sets)
    has_several = any(len(items) > 1 for items in sets.values())
    figures = _drawn_figures(sets) if has_several or not series else []
    rows = len(series) + -(-len(figures) // 2)
    figure = Figure(figsize=(WIDTH_IN, rows * ROW_IN + FOOT_IN), dpi=200, layout="constrained")
    grid = figure.add_gridspec(rows + 1, 2, height_ratios=[*[ROW_IN] * rows, FOOT_IN])
    handles: dict[str, Artist] = {}
    for row, (case, name) in enumerate(series):
        along, below = figure.add_subplot(grid[row, 0]), figure.add_subplot(grid[row, 1])
        _draw_series(along, below, sets, case, name, handles)
    for number, name in enumerate(figures):
        place = grid[len(series) + number // 2, number % 2]
        _draw_figure(figure.add_subplot(place), sets, name, handles)
    _draw_legend(figure.add_subplot(grid[rows, :]), handles)
    return to_form(figure, form)


def _draw_legend(axes: Axes, handles: Mapping[str, Artist]) -> None:
    """Draw what the lines and points of all axes are, by their names."""
    axes.set_axis_off()
    # The names come after: of those given here matplotlib leaves out what begins with ``_``.
    legend = axes.legend(
        list(handles.values()),
        [""] * len(handles),
        loc="center",
        ncols=min(3, max(len(handles), 1)),
        fontsize=7,
        frameon=False,
    )
    for text, label in zip(legend.get_texts(), handles, strict=True):
        text.set_text(plain_text(label))


def _drawn_series(sets: Sets) -> list[tuple[str, str]]:
    """Return the (case, series) that most sets have; the leading kind of error of each case."""
    counts: dict[tuple[str, str], int] = {}
    for items in sets.values():
        for key in {(item.case, name): None for item in items for name in item.series}:
            counts[key] = counts.get(key, 0) + 1
    leading: dict[str, str] = {}
    for (case, name), count in counts.items():
        known = leading.get(case)
        if known is None or count > counts[case, known]:
            leading[case] = name
    return list(leading.items())[:MOST_PATHS]


def _drawn_figures(sets: Sets) -> list[str]:
    """Return the figures that every set has."""
    known = [
        dict.fromkeys(name for item in items for name in item.figures) for items in sets.values()
    ]
    return [name for name in known[0] if all(name in other for other in known)][:MOST_FIGURES]


def _draw_series(
    along: Axes, below: Axes, sets: Sets, case: str, name: str, handles: dict[str, Artist]
) -> None:
    """Draw single errors along the path, and the share of them below each value.

    What is drawn is added to ``handles``, of each name the first.
    """
    shown = {
        label: [item for item in items if item.case == case and name in item.series]
        for label, items in sets.items()
    }
    every = [item.series[name] for items in shown.values() for item in items]
    start = min(float(series.at[:, 0].min()) for series in every)
    scale = _scale(every)
    for label, items in shown.items():
        methods = list(dict.fromkeys(item.method for item in items))
        for item in items:
            nth, series = methods.index(item.method), item.series[name]
            order = np.argsort(series.at[:, 0], kind="stable")
            step = -(-len(order) // POINTS)
            look: dict[str, Any] = {
                "color": unit_rgb(colours_of(sets)[label]),
                "ls": STYLES[nth % len(STYLES)],
                "lw": 0.9,
            }
            ranked = np.sort(series.errors)[::step]
            below.plot(ranked, np.linspace(0.0, 1.0, len(ranked)), **look)
            if series.at.shape[1] > 1:  # relations are no line
                look |= {"ls": "", "marker": MARKERS[nth % len(MARKERS)], "ms": 1.5}
            kept = order[::step]
            (drawn,) = along.plot(series.at[kept, 0] - start, series.errors[kept], **look)
            handles.setdefault(label if len(methods) == 1 else f"{label}: {item.method}", drawn)
    error = figure_of(name).label
    travelled = name.startswith("rpe")
    _finish(along, case, "metres travelled" if travelled else "seconds", error)
    _finish(below, case, error, "share of errors below")
    along.set_yscale(scale)
    below.set_xscale(scale)
    below.set_ylim(0.0, 1.02)


def _scale(series: Sequence[ErrorSeries]) -> str:
    """Return ``log`` where the worst errors would hide all others on a linear axis."""
    values = np.concatenate([item.errors for item in series])
    usual = float(np.median(values))
    return "log" if values.min() >= 0.0 and float(values.max()) > LARGE * usual > 0.0 else "linear"


def _draw_figure(axes: Axes, sets: Sets, name: str, handles: dict[str, Artist]) -> None:
    """Draw one figure of every map or path: a place for each set, lines for the same items.

    What is drawn is added to ``handles``, of each name the first.
    """
    joined: dict[tuple[str, str, str], list[tuple[int, float]]] = {}
    for number, (label, items) in enumerate(sets.items()):
        known = [item for item in items if name in item.figures]
        values = [item.figures[name] for item in known]
        colour = unit_rgb(colours_of(sets)[label])
        marker = MARKERS[number % len(MARKERS)]
        places = np.full(len(values), float(number))
        (drawn,) = axes.plot(places, values, color=colour, marker=marker, ls="", ms=4, zorder=3)
        handles.setdefault(label, drawn)
        mean = float(np.mean(values))
        axes.plot([number - 0.18, number + 0.18], [mean, mean], color=colour, lw=2.0)
        cases = {(item.case, item.seed) for item in known}
        for item in known:
            key = (item.case, item.seed, "" if len(cases) == len(known) else item.method)
            joined.setdefault(key, []).append((number, item.figures[name]))
    for points in joined.values():
        axes.plot(*zip(*points, strict=True), color="0.6", lw=0.7, zorder=1)
    axes.set_xlim(-0.5, len(sets) - 0.5)
    axes.set_xticks([])
    _finish(axes, "", "", figure_of(name).label)
    better = figure_of(name).larger_is_better
    if better is not None:
        axes.set_title(
            "larger is better" if better else "smaller is better", fontsize=6.5, loc="right"
        )


def _finish(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    """Write what the axes show."""
    axes.set_title(plain_text(title), fontsize=7.5, loc="left")
    axes.set_xlabel(plain_text(x_label), fontsize=7)
    axes.set_ylabel(plain_text(y_label), fontsize=7)
    axes.tick_params(labelsize=6.5, width=0.6, length=2.5)
    axes.grid(visible=True, lw=0.3, color="0.85")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
