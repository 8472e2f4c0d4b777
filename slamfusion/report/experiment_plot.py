"""The plot of an experiment: means with their deviations, a row a case."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.evaluation import figure_of
from slamfusion.palette import colours_of
from slamfusion.report.canvas import plain_text, to_form, unit_rgb

MARKERS = "osD^vP"
WIDTH_IN, FRAME_IN, LEGEND_IN = 7.0, 0.75, 0.2
# The height of a case: of a method, and at least.
METHOD_IN, LEAST_CASE_IN = 0.05, 0.3
LEGEND_COLUMNS = 4


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
        axes.set_xlabel(figure_of(name).label, fontsize=7.5)
        axes.tick_params(labelsize=7, width=0.6, length=2.5)
        axes.grid(visible=True, axis="x", lw=0.3, color="0.85")
        axes.spines[["top", "right"]].set_visible(False)
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
