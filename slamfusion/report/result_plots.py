"""Figures of saved results next to each other and of the means of an experiment, for a paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251
from matplotlib.layout_engine import ConstrainedLayoutEngine  # noqa: TID251

from slamfusion.evaluation.measured import figure_of
from slamfusion.geometry import F64
from slamfusion.palette import Rgb, colours_of
from slamfusion.report import canvas
from slamfusion.report.errors import draw_shares

# The most cases with single errors, and the most figures, that a readable picture holds.
MOST_PATHS, MOST_FIGURES = 6, 6
WIDTH_IN, PATH_IN, LEGEND_IN, LEGEND_COLUMNS = 7.0, 2.1, 0.2, 4
# Of a figure by case: the height of a method, of a case at least, and of what is around the cases.
METHOD_IN, LEAST_CASE_IN, FRAME_IN = 0.07, 0.25, 0.65
MARKERS = "osD^vP"
# Windows of a running median, each with at least this many errors; the band has these quantiles.
WINDOWS, WINDOW_ERRORS, BAND = 60, 5, (0.1, 0.9)


def comparison_plot(tables: Mapping[str, pd.DataFrame], form: str) -> bytes:
    """Draw saved results next to each other; return a ``png``, ``svg`` or ``pdf`` file.

    The first rows show the single errors of each case: on the left their running median with a
    band from the 10 % to the 90 % quantile, on the right the share of the errors below each value.
    The rows below show the figures by case, mean and standard deviation over seeds.

    Args:
        tables: the rows of each file of results, by its name; see ``slamfusion.evaluation.Row``.
    """
    named = []
    for name, own in tables.items():
        methods = f"{name}: " + own["method"]
        named.append(own.assign(set=name, series=methods if len(set(methods)) > 1 else name))
    table = pd.concat(named, ignore_index=True)
    figures, errors = table[table["at"].isna()].dropna(subset="value"), table.dropna(subset="at")
    # Of each case the kind of error that most results have.
    counts = errors.groupby(["case", "figure"], sort=False)["set"].nunique().reset_index()
    leading = counts.sort_values("set", ascending=False, kind="stable").drop_duplicates("case")
    paths = [
        errors[(errors["case"] == case) & (errors["figure"] == figure)]
        for case, figure, _ in leading.sort_index().head(MOST_PATHS).itertuples(index=False)
    ]
    sets = figures.groupby("figure", sort=False)["set"].nunique()
    values = figures.groupby(["case", "figure", "series"], sort=False)["value"]
    common = list(sets[sets == len(tables)].index[:MOST_FIGURES])
    return _plot(paths, values.agg(["mean", "std"]), common, form)


def experiment_plot(summaries: pd.DataFrame, figures: Sequence[str], form: str) -> bytes:
    """Draw the named figures of an experiment by case; return a ``png``, ``svg`` or ``pdf`` file.

    Args:
        summaries: ``mean`` and ``std`` by case, figure and method.
    """
    known = summaries.index.unique("figure")
    return _plot([], summaries, [name for name in figures if name in known], form)


def _plot(
    paths: Sequence[pd.DataFrame], summaries: pd.DataFrame, figures: Sequence[str], form: str
) -> bytes:
    """Draw a row for each table of single errors, then a panel for each figure."""
    drawn = summaries[summaries.index.isin(figures, level=1)]
    names = list(
        dict.fromkeys([*(n for own in paths for n in own["series"]), *drawn.index.unique(2)])
    )
    colours = colours_of(names)
    cases = list(drawn.index.unique(0))
    panel_in = max(LEAST_CASE_IN, METHOD_IN * len(names)) * len(cases) + FRAME_IN
    legend_in = LEGEND_IN * -(-len(names) // LEGEND_COLUMNS)
    heights = [PATH_IN] * len(paths) + [panel_in] * len(figures)
    bottom = legend_in / (sum(heights) + legend_in)
    layout = ConstrainedLayoutEngine(rect=(0.0, bottom, 1.0, 1.0 - bottom))
    sheet = Figure(figsize=(WIDTH_IN, sum(heights) + legend_in), dpi=canvas.DPI, layout=layout)
    grid = sheet.add_gridspec(len(heights), 2, height_ratios=heights)
    handles: dict[str, Any] = {}
    for row, own in enumerate(paths):
        _draw_path(
            sheet.add_subplot(grid[row, 0]), sheet.add_subplot(grid[row, 1]), own, colours, handles
        )
    for row, name in enumerate(figures, start=len(paths)):
        _draw_cases(sheet.add_subplot(grid[row, :]), summaries, name, cases, colours, handles)
    shown = [name for name in names if name in handles]
    canvas.add_legend(sheet, [handles[name] for name in shown], shown, LEGEND_COLUMNS)
    return canvas.to_form(sheet, form)


def running(at: F64, values: F64) -> tuple[F64, F64]:
    """Return the middles of windows along (N,) places, and (3, W) low, median and high in them."""
    order = np.argsort(at, kind="stable")
    windows = np.array_split(order, max(1, min(WINDOWS, len(at) // WINDOW_ERRORS)))
    quantiles = [np.quantile(values[own], (BAND[0], 0.5, BAND[1])) for own in windows]
    return np.array([at[own].mean() for own in windows]), np.array(quantiles).T


def _draw_path(
    along: Axes,
    below: Axes,
    errors: pd.DataFrame,
    colours: Mapping[str, Rgb],
    handles: dict[str, Any],
) -> None:
    """Draw the single errors of a case along the path, and the share of them below each value."""
    start, most = errors["at"].min(), 0.0
    found = [(str(name), own) for name, own in errors.groupby("series", sort=False)]
    for name, own in found:
        middles, (low, median, high) = running(own["at"].to_numpy(), own["value"].to_numpy())
        colour = canvas.unit_rgb(colours[name])
        along.fill_between(middles - start, low, high, color=colour, alpha=0.18, lw=0)
        (handles[name],) = along.plot(middles - start, median, color=colour, lw=1.1, label="")
        most = max(most, float(high.max()))
    draw_shares(below, [(name, own["value"].to_numpy()) for name, own in found], colours)
    for axes in (along, below):
        canvas.style_axes(axes)
        axes.grid(visible=True, lw=0.3, color="0.85")
    figure, case = errors["figure"].iloc[0], errors["case"].iloc[0]
    error = figure_of(figure).label
    travelled = "distance travelled [m]" if figure.startswith("rpe") else "time since the start [s]"
    along.set_ylim(min(0.0, float(errors["value"].min())), 1.05 * most or 1.0)
    canvas.label_axes(along, f"{case}: running median, band 10 to 90 %", travelled, error)
    canvas.label_axes(below, "", error, "share of errors below")


def _draw_cases(
    axes: Axes,
    summaries: pd.DataFrame,
    figure: str,
    cases: Sequence[str],
    colours: Mapping[str, Rgb],
    handles: dict[str, Any],
) -> None:
    """Draw one figure: a row for each case, a mark with its deviation for each method."""
    own = summaries.xs(figure, level=1)
    names = [name for name in colours if name in own.index.unique(1)]
    for nth, name in enumerate(names):
        values = own.xs(name, level=1)
        # The methods of one case are drawn below each other.
        shift = 0.6 * (nth / max(len(names) - 1, 1) - 0.5)
        handles[name] = axes.errorbar(
            values["mean"],
            [cases.index(case) + shift for case in values.index],
            xerr=values["std"].fillna(0.0),
            color=canvas.unit_rgb(colours[name]),
            marker=MARKERS[nth % len(MARKERS)],
            ls="",
            ms=3.5,
            elinewidth=0.8,
            capsize=2.0,
        )
    canvas.style_axes(axes)
    axes.set_yticks(
        np.arange(len(cases)), [canvas.plain_text(case) for case in cases], fontsize=canvas.SMALL_PT
    )
    axes.set_ylim(len(cases) - 0.5, -0.5)
    axes.grid(visible=True, axis="x", lw=0.3, color="0.85")
    shown = figure_of(figure)
    way = {True: " (larger is better)", False: " (smaller is better)", None: ""}
    canvas.label_axes(axes, x=shown.label + way[shown.larger_is_better])
