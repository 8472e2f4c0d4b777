"""What experiments show: errors against cell size, a cell's value as it is told, fused maps.

Colours and line styles tell the lines apart; their meaning stands in a legend, because these
pictures are looked at without a page around them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251
from matplotlib.ticker import MaxNLocator  # noqa: TID251

from slamfusion.config import RunConfig
from slamfusion.geometry import Pose2
from slamfusion.palette import colours_of
from slamfusion.report import plots
from slamfusion.report.canvas import DPI, INK, WIDTH_IN, plain_text, style_axes, to_png, unit_rgb
from slamfusion.report.page import (
    Banner,
    Fact,
    LegendEntry,
    Page,
    Picture,
    Section,
    Table,
    circumstances,
    write_page,
)

__all__ = [
    "Difference",
    "Line",
    "Panel",
    "cell_values_picture",
    "sweep_picture",
    "write_fusion_experiment",
]

# Tables of a fusion experiment that stand above its pictures.
TOP = 2

_MARKERS = ("o", "D", "s", "^")
_STYLES = ("-", "--", ":", "-.")
# Bars at one place on the x axis stand this share of its step apart.
_BESIDE = 0.06
_LEGEND_COLUMNS = 2
# Heights of a row of the legend, and of the name of the x axis below the last panel.
_LEGEND_IN = 0.155
_LABEL_IN = 0.12


@dataclass(frozen=True)
class Line:
    """One line of a panel.

    Attributes:
        label: its name in the legend; plain text.
        x: where its points lie.
        y: their values, as many.
        spread: half length of each point's bar; empty: no bars.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    spread: Sequence[float] = ()


@dataclass(frozen=True)
class Panel:
    """One pair of axes with its lines.

    Attributes:
        title: above it; plain text.
        lines: at least one.
    """

    title: str
    lines: Sequence[Line]


def sweep_picture(panels: Sequence[Panel], *, x_label: str, y_label: str) -> bytes:
    """Draw means with deviation bars against a setting, a panel above the other.

    Args:
        panels: at least one.
        x_label: what the setting is, with its unit.
        y_label: what the values are, with their unit.

    Returns:
        The bytes of a PNG file.
    """
    figure, all_axes = _figure(panels, 2.0)
    colours = colours_of(line.label for panel in panels for line in panel.lines)
    for panel, axes in zip(panels, all_axes, strict=True):
        places = sorted({float(x) for line in panel.lines for x in line.x})
        step = min(np.diff(places), default=1.0)
        for number, line in enumerate(panel.lines):
            beside = _BESIDE * step * (number - (len(panel.lines) - 1) / 2.0)
            axes.errorbar(
                np.asarray(line.x) + beside,
                line.y,
                yerr=line.spread or None,
                color=unit_rgb(colours[line.label]),
                marker=_MARKERS[number % len(_MARKERS)],
                ls=_STYLES[number % len(_STYLES)],
                label=plain_text(line.label),
                ms=3.5,
                lw=1.1,
                elinewidth=0.8,
                capsize=2.5,
            )
        top = max(float(np.max(np.asarray(line.y) + (line.spread or 0.0))) for line in panel.lines)
        # Bars that reach below zero are cut: no error is negative.
        axes.set_ylim(0.0, 1.06 * top + 1e-9)
        axes.set_xticks(places)
        _finish(axes, panel, y_label)
    all_axes[-1].set_xlabel(x_label, color=INK, fontsize=7.5)
    return to_png(figure)


def cell_values_picture(panels: Sequence[Panel]) -> bytes:
    """Draw what a cell says, 0 free to 1 occupied, after each of its observations.

    Args:
        panels: at least one; ``x`` counts observations from 0.

    Returns:
        The bytes of a PNG file.
    """
    figure, all_axes = _figure(panels, 1.6)
    colours = colours_of(line.label for panel in panels for line in panel.lines)
    for panel, axes in zip(panels, all_axes, strict=True):
        axes.axhline(0.5, color=INK, lw=0.7, ls=":")
        for number, line in enumerate(panel.lines):
            axes.plot(
                line.x,
                line.y,
                color=unit_rgb(colours[line.label]),
                marker=_MARKERS[number % len(_MARKERS)],
                ls=_STYLES[number % len(_STYLES)],
                label=plain_text(line.label),
                ms=3.0,
                lw=1.1,
                clip_on=False,
            )
        axes.set_ylim(0.0, 1.0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.margins(x=0.02)
        _finish(axes, panel, "value of the cell")
    all_axes[-1].set_xlabel("observations", color=INK, fontsize=7.5)
    return to_png(figure)


@dataclass(frozen=True, eq=False)
class Difference:
    """A map against the truth, to be drawn.

    Attributes:
        title: what is seen; plain text.
        caption: which drive it is of.
        codes: (H, W) int8, codes of ``slamfusion.evaluation``.
        resolution: metres per cell.
    """

    title: str
    caption: str
    codes: npt.NDArray[np.int8]
    resolution: float


def write_fusion_experiment(
    title: str,
    ratios: Mapping[str, float],
    borne_out: Collection[str],
    sentences: Sequence[str],
    tables: Sequence[Table],
    examples: Mapping[str, Sequence[Difference]],
    directory: str | Path,
    *,
    config: RunConfig,
    device: str,
) -> Path:
    """Write an experiment on fusion as one self-contained page with its pictures beside it.

    Args:
        title: of the page.
        ratios: error of every way to vote over that of the best inputs, by name; at least one.
        borne_out: of these, the ones whose smaller error is hardly chance.
        sentences: what was found, in words.
        tables: the first two are shown at the top, the others after the pictures.
        examples: the maps of a drive, by the name of its section.
        directory: for ``report.html`` and the PNG files; made when missing.
        config: the effective configuration, written out in full.
        device: the device that computed, in words.

    Returns:
        The path of ``report.html``.

    Raises:
        SlamFusionError: the directory cannot be written.
    """
    best = min(ratios, key=ratios.__getitem__)
    is_better = ratios[best] < 1.0 and best in borne_out
    if ratios[best] >= 1.0:
        headline = f"{best} is not better than the best inputs"
    elif is_better:
        headline = f"{best} is better than the best inputs"
    else:
        headline = f"{best} has a smaller error than the best inputs, which may be chance"
    lines = [(f"{head}:", rest) for head, _, rest in (text.partition(": ") for text in sentences)]
    banner = Banner("good" if is_better else "warn", headline, lines)
    facts = [
        Fact(
            f"{100.0 * (ratio - 1.0):+.1f} %",
            f"{name} against the best inputs",
            "bad" if ratio >= 1.0 else "good" if name in borne_out else "plain",
        )
        for name, ratio in ratios.items()
    ]
    sections = [Section("Errors", "errors", tables=tables[:TOP])]
    for number, (name, maps) in enumerate(examples.items(), start=1):
        pictures = [_difference(item) for item in maps]
        sections.append(Section(name, f"example-{number}", pictures=pictures))
    if len(tables) > TOP:
        sections.append(Section("In detail", "detail", tables=tables[TOP:]))
    sections.append(circumstances(config, device))
    page = Page(title, banner, facts, sections)
    return write_page(page, directory, forms=config.report.pictures)


def _difference(item: Difference) -> Picture:
    """Draw a map against the truth, with the colours that are used in it."""
    legend = tuple(
        LegendEntry(text, rgb)
        for code, (text, rgb) in plots.DIFFERENCE_COLOURS.items()
        if (item.codes == code).any()
    )
    png = plots.difference_picture(item.codes, item.resolution, Pose2())
    return Picture(item.title, png, item.title, item.caption, legend=legend)


def _figure(panels: Sequence[Panel], height_in: float) -> tuple[Figure, list[Axes]]:
    """Return axes above each other with room for a title and a legend above each."""
    lines = max(len(panel.lines) for panel in panels)
    head_in, foot_in = 0.3 + _LEGEND_IN * -(-lines // _LEGEND_COLUMNS), 0.3
    row_in = head_in + height_in + foot_in
    figure = Figure(figsize=(WIDTH_IN, len(panels) * row_in + _LABEL_IN), dpi=DPI)
    tall_in = figure.get_size_inches()[1]
    bottoms_in = [_LABEL_IN + foot_in + row_in * row for row in reversed(range(len(panels)))]
    boxes = [(0.13, bottom_in / tall_in, 0.85, height_in / tall_in) for bottom_in in bottoms_in]
    return figure, [figure.add_axes(box) for box in boxes]


def _finish(axes: Axes, panel: Panel, y_label: str) -> None:
    """Give a panel its lettering."""
    legend_rows = -(-len(panel.lines) // _LEGEND_COLUMNS)
    axes.set_ylabel(y_label, color=INK, fontsize=7.5)
    axes.set_title(
        plain_text(panel.title),
        loc="left",
        color=INK,
        fontsize=8,
        pad=5 + 72 * _LEGEND_IN * legend_rows,
    )
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=_LEGEND_COLUMNS,
        frameon=False,
        fontsize=7,
        labelcolor=INK,
        borderaxespad=0.1,
        handlelength=2.6,
    )
    style_axes(axes)
