"""Figures of saved results next to each other and of the means of an experiment, for a paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251
from matplotlib.layout_engine import ConstrainedLayoutEngine  # noqa: TID251

from slamfusion.evaluation import figure_of
from slamfusion.palette import Rgb, colours_of
from slamfusion.report.canvas import (
    DPI,
    SMALL_PT,
    add_legend,
    label_axes,
    plain_text,
    style_axes,
    to_form,
    unit_rgb,
)

# The most figures that a readable picture holds.
MOST_FIGURES = 6
WIDTH_IN, LEGEND_IN, LEGEND_COLUMNS = 7.0, 0.2, 4
# Of a figure by case: the height of a method, of a case at least, and of what is around the cases.
METHOD_IN, LEAST_CASE_IN, FRAME_IN = 0.07, 0.25, 0.65
MARKERS = "osD^vP"


def comparison_plot(tables: Mapping[str, pd.DataFrame], form: str) -> bytes:
    """Draw saved results next to each other.

    A panel shows each of the first common figures by case, mean and standard deviation over seeds.

    Args:
        tables: the rows of each file of results, by its name; see ``slamfusion.evaluation.Row``.
        form: ``png``, ``svg`` or ``pdf``.

    Returns:
        The bytes of the file; the same for the same results.
    """
    named = []
    for name, own in tables.items():
        methods = f"{name}: " + own["method"]
        named.append(own.assign(set=name, series=methods if len(set(methods)) > 1 else name))
    table = pd.concat(named, ignore_index=True)
    figures = table.dropna(subset="value")
    sets = figures.groupby("figure", sort=False)["set"].nunique()
    values = figures.groupby(["case", "figure", "series"], sort=False)["value"]
    common = list(sets[sets == len(tables)].index[:MOST_FIGURES])
    return _plot(values.agg(["mean", "std"]), common, form)


def experiment_plot(summaries: pd.DataFrame, figures: Sequence[str], form: str) -> bytes:
    """Draw the figures of an experiment by case.

    Args:
        summaries: ``mean`` and ``std`` by case, figure and method.
        figures: those that are drawn, in order; others are left out.

    Returns:
        The bytes of the file; the same for the same numbers.
    """
    known = summaries.index.unique("figure")
    return _plot(summaries, [name for name in figures if name in known], form)


def _plot(summaries: pd.DataFrame, figures: Sequence[str], form: str) -> bytes:
    """Draw a panel for each figure."""
    drawn = summaries[summaries.index.isin(figures, level=1)]
    names, cases = list(drawn.index.unique(2)), list(drawn.index.unique(0))
    colours = colours_of(names)
    panel_in = max(LEAST_CASE_IN, METHOD_IN * len(names)) * len(cases) + FRAME_IN
    legend_in = LEGEND_IN * -(-len(names) // LEGEND_COLUMNS)
    height_in = panel_in * max(len(figures), 1) + legend_in
    bottom = legend_in / height_in
    layout = ConstrainedLayoutEngine(rect=(0.0, bottom, 1.0, 1.0 - bottom))
    sheet = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout=layout)
    handles: dict[str, Any] = {}
    for nth, name in enumerate(figures, start=1):
        axes = sheet.add_subplot(len(figures), 1, nth)
        _draw_cases(axes, summaries, name, cases, colours, handles)
    shown = [name for name in names if name in handles]
    add_legend(sheet, [handles[name] for name in shown], shown, LEGEND_COLUMNS)
    return to_form(sheet, form)


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
            color=unit_rgb(colours[name]),
            marker=MARKERS[nth % len(MARKERS)],
            ls="",
            ms=3.5,
            elinewidth=0.8,
            capsize=2.0,
        )
    style_axes(axes)
    axes.set_yticks(np.arange(len(cases)), [plain_text(case) for case in cases], fontsize=SMALL_PT)
    axes.set_ylim(len(cases) - 0.5, -0.5)
    axes.grid(visible=True, axis="x", lw=0.3, color="0.85")
    shown = figure_of(figure)
    way = {True: " (larger is better)", False: " (smaller is better)", None: ""}
    label_axes(axes, x=shown.label + way[shown.larger_is_better])
