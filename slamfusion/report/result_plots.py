"""Pictures of results that stand alone, in a paper: on white, with the names in their legends.

Saved results side by side, and the means of an experiment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist  # noqa: TID251
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.evaluation import figure_of
from slamfusion.palette import colours_of
from slamfusion.report.canvas import plain_text, to_form, unit_rgb

# The most paths and figures that a readable picture holds, and points of a line.
MOST_PATHS, MOST_FIGURES, POINTS = 6, 6, 2000
WIDTH_IN, ROW_IN, FOOT_IN = 7.0, 2.0, 0.45
MARKERS, STYLES = "osD^vP", ("-", "--", "-.", ":")
# Of an experiment: the height of a case, of a method and at least; and what is around the cases.
METHOD_IN, LEAST_CASE_IN = 0.05, 0.3
FRAME_IN, LEGEND_IN, LEGEND_COLUMNS = 0.75, 0.2, 4
# An error that is this many times the median one is drawn on a logarithmic axis.
LARGE = 50.0


def comparison_plot(tables: Mapping[str, pd.DataFrame], form: str) -> bytes:
    """Draw saved results side by side.

    The first rows show single errors, a row for each case: along the path on the left, and the
    share of the errors below each value on the right. The rows below show the figures, a point for
    each map or path, those of one case, seed and method joined by a line. If each table has a
    single path, only its errors are drawn.

    Args:
        tables: the rows of each file of results, by its name; see ``slamfusion.evaluation.Row``.
        form: ``png``, ``svg`` or ``pdf``.

    Returns:
        The bytes of the file; the same for the same results.
    """
    names = list(tables)
    colours = {name: unit_rgb(colour) for name, colour in colours_of(names).items()}
    table = pd.concat([own.assign(set=name) for name, own in tables.items()], ignore_index=True)
    figures, errors = table[table["at"].isna()], table.dropna(subset="at")
    # Of each case the kind of error that most results have.
    counts = errors.groupby(["case", "figure"], sort=False)["set"].nunique().reset_index()
    leading = counts.sort_values("set", ascending=False, kind="stable").drop_duplicates("case")
    paths = [
        errors[(errors["case"] == case) & (errors["figure"] == figure)]
        for case, figure, _ in leading.sort_index().head(MOST_PATHS).itertuples(index=False)
    ]
    items = figures.drop_duplicates(["set", "case", "seed", "method"])
    drawn = []
    if items["set"].duplicated().any() or not paths:
        sets = figures.dropna(subset="value").groupby("figure", sort=False)["set"].nunique()
        drawn = list(sets[sets == len(names)].index[:MOST_FIGURES])
    rows = len(paths) + -(-len(drawn) // 2)
    sheet = Figure(figsize=(WIDTH_IN, rows * ROW_IN + FOOT_IN), dpi=200, layout="constrained")
    grid = sheet.add_gridspec(rows + 1, 2, height_ratios=[*[ROW_IN] * rows, FOOT_IN])
    handles: dict[str, Artist] = {}
    for row, own in enumerate(paths):
        axes = [sheet.add_subplot(grid[row, column]) for column in (0, 1)]
        _draw_errors(axes, own, colours, handles)
    for number, name in enumerate(drawn):
        place = sheet.add_subplot(grid[len(paths) + number // 2, number % 2])
        own = figures[figures["figure"] == name].dropna(subset="value")
        _draw_figure(place, own, colours, handles)
    foot = sheet.add_subplot(grid[rows, :])
    foot.set_axis_off()
    # The names come after: of those given here matplotlib leaves out what begins with ``_``.
    legend = foot.legend(
        list(handles.values()),
        [""] * len(handles),
        loc="center",
        ncols=min(3, max(len(handles), 1)),
        fontsize=7,
        frameon=False,
    )
    for text, label in zip(legend.get_texts(), handles, strict=True):
        text.set_text(plain_text(label))
    return to_form(sheet, form)


def _draw_errors(
    axes: list[Axes], errors: pd.DataFrame, colours: Mapping[str, Any], handles: dict[str, Artist]
) -> None:
    """Draw single errors along the path, and the share of them below each value.

    What is drawn is added to ``handles``, of each name the first.
    """
    along, below = axes
    start = errors["at"].min()
    values = errors["value"]
    # Where the worst errors would hide all others on a linear axis.
    is_wide = values.min() >= 0.0 and values.max() > LARGE * values.median() > 0.0
    for name, own in errors.groupby("set", sort=False):
        methods = list(own["method"].unique())
        for (_, method), path in own.groupby(["seed", "method"], sort=False):
            nth = methods.index(method)
            step = -(-len(path) // POINTS)
            look: dict[str, Any] = {"color": colours[name], "ls": STYLES[nth % 4], "lw": 0.9}
            ranked = np.sort(path["value"])[::step]
            below.plot(ranked, np.linspace(0.0, 1.0, len(ranked)), **look)
            if path["to"].notna().any():  # relations are no line
                look |= {"ls": "", "marker": MARKERS[nth % 6], "ms": 1.5}
            kept = path.sort_values("at", kind="stable")[::step]
            (drawn,) = along.plot(kept["at"] - start, kept["value"], **look)
            handles.setdefault(name if len(methods) == 1 else f"{name}: {method}", drawn)
    figure = errors["figure"].iloc[0]
    error = figure_of(figure).label
    travelled = "metres travelled" if figure.startswith("rpe") else "seconds"
    _finish(along, errors["case"].iloc[0], travelled, error)
    _finish(below, errors["case"].iloc[0], error, "share of errors below")
    along.set_yscale("log" if is_wide else "linear")
    below.set_xscale("log" if is_wide else "linear")
    below.set_ylim(0.0, 1.02)


def _draw_figure(
    axes: Axes, figures: pd.DataFrame, colours: Mapping[str, Any], handles: dict[str, Artist]
) -> None:
    """Draw one figure of every map or path: a place for each set, lines for the same items.

    What is drawn is added to ``handles``, of each name the first.
    """
    for place, (name, colour) in enumerate(colours.items()):
        own = figures[figures["set"] == name]["value"]
        look = {"color": colour, "marker": MARKERS[place % 6], "ls": "", "ms": 4, "zorder": 3}
        (drawn,) = axes.plot(np.full(len(own), float(place)), own, **look)
        handles.setdefault(name, drawn)
        axes.plot([place - 0.18, place + 0.18], [own.mean()] * 2, color=colour, lw=2.0)
    keys = ["case", "seed"]
    if figures.duplicated(["set", *keys]).any():
        keys.append("method")
    places = figures["set"].map({name: place for place, name in enumerate(colours)})
    for _, own in figures.assign(place=places).groupby(keys, sort=False):
        axes.plot(own["place"], own["value"], color="0.6", lw=0.7, zorder=1)
    axes.set_xlim(-0.5, len(colours) - 0.5)
    axes.set_xticks([])
    figure = figure_of(figures["figure"].iloc[0])
    _finish(axes, "", "", figure.label)
    if figure.larger_is_better is not None:
        title = "larger is better" if figure.larger_is_better else "smaller is better"
        axes.set_title(title, fontsize=6.5, loc="right")


def _finish(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    """Write what the axes show."""
    axes.set_title(plain_text(title), fontsize=7.5, loc="left")
    axes.set_xlabel(plain_text(x_label), fontsize=7)
    axes.set_ylabel(plain_text(y_label), fontsize=7)
    axes.tick_params(labelsize=6.5, width=0.6, length=2.5)
    axes.grid(visible=True, lw=0.3, color="0.85")
    axes.spines[["top", "right"]].set_visible(False)


def experiment_plot(summaries: pd.DataFrame, figures: Sequence[str], form: str) -> bytes:
    """Draw the figures of an experiment, a panel each.

    Args:
        summaries: ``mean`` and ``std`` by case, figure and method.
        figures: those that are drawn, in order; others are left out.
        form: ``png``, ``svg`` or ``pdf``.

    Returns:
        The bytes of the file; the same for the same numbers.
    """
    shown = [name for name in figures if name in summaries.index.unique("figure")]
    drawn = summaries.index[summaries.index.isin(shown, level="figure")]
    methods = list(drawn.unique("method"))
    cases = list(summaries.index.unique("case"))
    colours = colours_of(methods)
    case_in = max(LEAST_CASE_IN, METHOD_IN * len(methods))
    heights = [case_in * len(cases) + FRAME_IN] * len(shown)
    heights.append(LEGEND_IN * -(-len(methods) // LEGEND_COLUMNS))
    sheet = Figure(figsize=(WIDTH_IN, sum(heights)), dpi=200, layout="constrained")
    panels = sheet.subplots(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    handles = {}
    for axes, name in zip(panels, shown, strict=False):
        own = summaries.xs(name, level="figure")
        for number, method in enumerate(own.index.unique("method")):
            values = own.xs(method, level="method")
            # Methods of one case are drawn below each other.
            shift = 0.6 * (number / max(len(methods) - 1, 1) - 0.5)
            handles[method] = axes.errorbar(
                values["mean"],
                [cases.index(case) + shift for case in values.index],
                xerr=values["std"].fillna(0.0),
                color=unit_rgb(colours[method]),
                marker=MARKERS[methods.index(method) % len(MARKERS)],
                ls="",
                ms=3.5,
                elinewidth=0.8,
                capsize=2.0,
            )
        axes.set_yticks(np.arange(len(cases)), [plain_text(case) for case in cases], fontsize=7)
        axes.set_ylim(len(cases) - 0.5, -0.5)
        _finish(axes, "", figure_of(name).label, "")
        axes.grid(visible=False, axis="y")
    panels[-1].set_axis_off()
    panels[-1].legend(
        list(handles.values()),
        list(map(plain_text, handles)),
        loc="center",
        ncols=LEGEND_COLUMNS,
        fontsize=7,
        frameon=False,
    )
    return to_form(sheet, form)
