"""What the pictures of a report share: the sheet, title and legend, and cells that fit on it.

A picture is complete without its page: title and legend stand in it, in dark letters on white, so
that it can be used elsewhere as it is.
"""

from __future__ import annotations

import io
import math
import textwrap
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import rc_context  # noqa: TID251
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.backend_bases import FigureCanvasBase  # noqa: TID251
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251
from matplotlib.patches import Patch  # noqa: TID251

from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox
from slamfusion.palette import INK_RGB, Rgb

Classes = npt.NDArray[np.int8]

INK = "#{:02x}{:02x}{:02x}".format(*INK_RGB)
DPI = 230
WIDTH_IN = 4.0
SMALL_PT, TITLE_PT = 7.5, 8.5
# Letters of these sizes are at most this wide on the average, and lines this high, inches.
_SMALL_IN, _TITLE_IN, _LINE_IN = 0.062, 0.076, 0.17
# No more cells than pixels along the longest side, or walls one cell wide would fall between them;
# a turned map needs a pixel in every cell whatever the angle.
_LONGEST_SIDE_CELLS = 760
_LONGEST_SIDE_TURNED = 450
_MARGIN_CELLS = 4
# No dates and no random names in a file; letters as letters (42: TrueType).
_SAME_BYTES: Any = {"svg.hashsalt": "slamfusion", "svg.fonttype": "none", "pdf.fonttype": 42}
_NO_METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}


@dataclass(frozen=True)
class LegendEntry:
    """One colour of a picture and its meaning."""

    text: str
    rgb: Rgb


def add_lettering(figure: Figure, title: str, legend: Sequence[LegendEntry] = ()) -> None:
    """Write a title above what was drawn and a legend below it; the figure grows for them."""
    wide, tall = (float(side) for side in figure.get_size_inches())
    lines = textwrap.wrap(title, int((wide - 0.16) / _TITLE_IN)) or [""]
    longest = max((len(entry.text) for entry in legend), default=1)
    columns = max(1, int(wide / (0.42 + _SMALL_IN * longest)))
    above, below = 0.1 + _LINE_IN * len(lines), _LINE_IN * -(-len(legend) // columns)
    below += 0.06 if legend else 0.0
    whole = tall + above + below
    figure.set_size_inches(wide, whole)
    for axes in figure.axes:
        left, bottom, width, height = axes.get_position().bounds
        axes.set_position((left, (bottom * tall + below) / whole, width, height * tall / whole))
    text = plain_text("\n".join(lines))
    look: dict[str, Any] = {"color": INK, "fontsize": TITLE_PT, "fontweight": "bold", "va": "top"}
    figure.text(0.08 / wide, 1.0 - 0.06 / whole, text, **look)
    add_legend(
        figure,
        [Patch(facecolor=unit_rgb(own.rgb), edgecolor=INK, lw=0.4) for own in legend],
        [own.text for own in legend],
        columns,
    )


def add_legend(figure: Figure, handles: Sequence[Any], texts: Sequence[str], columns: int) -> None:
    """Write a legend at the foot of a figure."""
    # The texts come after: of those given here matplotlib leaves out what starts with ``_``.
    legend = figure.legend(
        handles,
        [""] * len(handles),
        loc="lower left",
        ncols=columns,
        frameon=False,
        fontsize=SMALL_PT,
        labelcolor=INK,
        handlelength=1.3,
        borderaxespad=0.2,
        labelspacing=0.3,
    )
    for label, text in zip(legend.get_texts(), texts, strict=True):
        label.set_text(plain_text(text))


def crop_box(shown: npt.NDArray[np.bool_]) -> CellBox:
    """Return the box of the cells to show with a small margin; the whole map when none is."""
    rows, cols = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    if rows.size == 0:
        return CellBox(0, 0, shown.shape[0], shown.shape[1])
    margin = _MARGIN_CELLS
    return CellBox(
        int(rows[0]) - margin,
        int(cols[0]) - margin,
        int(rows[-1]) + 1 + margin,
        int(cols[-1]) + 1 + margin,
    )


def cut_cells(cells: Classes, box: CellBox) -> Classes:
    """Return the cells of a box; those beyond the array are -1."""
    cut = np.full((box.height, box.width), -1, dtype=np.int8)
    row0, col0 = max(box.row0, 0), max(box.col0, 0)
    row1, col1 = min(box.row1, cells.shape[0]), min(box.col1, cells.shape[1])
    cut[row0 - box.row0 : row1 - box.row0, col0 - box.col0 : col1 - box.col0] = cells[
        row0:row1, col0:col1
    ]
    return cut


def pool_cells(codes: Classes, origin: Pose2) -> tuple[Classes, int]:
    """Shrink by a whole factor to what a picture can show; the largest code of each block wins.

    Walls are one cell wide: any kind of averaging would lose them first.

    Args:
        codes: (H, W) int8.
        origin: its yaw decides whether cells and pixels are parallel.

    Returns:
        (h, w) int8, and the factor; rows and columns that fill the last block repeat its edge.
    """
    longest = _LONGEST_SIDE_TURNED if origin.yaw_rad else _LONGEST_SIDE_CELLS
    factor = max(1, math.ceil(max(codes.shape) / longest))
    if factor == 1:
        return codes, 1
    height, width = (math.ceil(side / factor) for side in codes.shape)
    padding = ((0, height * factor - codes.shape[0]), (0, width * factor - codes.shape[1]))
    padded = np.pad(codes, padding, mode="edge")
    blocks = padded.reshape(height, factor, width, factor)
    return np.asarray(blocks.max(axis=(1, 3)), dtype=np.int8), factor


def style_axes(axes: Axes) -> None:
    """Give axes their quiet lettering and frame."""
    axes.tick_params(colors=INK, labelsize=SMALL_PT, width=0.7, length=3)
    axes.ticklabel_format(useOffset=False, style="plain")
    for spine in axes.spines.values():
        spine.set_color(INK)
        spine.set_linewidth(0.6)


def to_form(figure: Figure, form: str) -> bytes:
    """Return the figure as the bytes of a file; the same figure always gives the same bytes.

    Args:
        form: ``png``, ``svg`` or ``pdf``; the text of the last two stays text.
    """
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    # Maps are large flat areas: a higher level takes four times as long for a few percent.
    more: dict[str, Any] = {"pil_kwargs": {"compress_level": 3}} if form == "png" else {}
    with rc_context(_SAME_BYTES), warnings.catch_warnings():
        # A letter that the font lacks is drawn as a box.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        figure.savefig(buffer, format=form, metadata=_NO_METADATA[form], **more)
    # The canvas would keep the pixels a second time.
    FigureCanvasBase(figure)
    return buffer.getvalue()


def stacked_axes(count: int, tall_in: float | Sequence[float]) -> tuple[Figure, list[Axes]]:
    """Return axes above each other that share their x axis, of these heights in inches."""
    heights = [tall_in] * count if isinstance(tall_in, (int, float)) else list(tall_in)
    head, foot = 0.24, 0.38
    whole = sum(heights) + head * count + foot
    figure, top = Figure(figsize=(WIDTH_IN, whole), dpi=DPI), whole
    axes: list[Axes] = []
    for height in heights:
        top -= head + height
        box = (0.155, top / whole, 0.815, height / whole)
        axes.append(figure.add_axes(box, sharex=axes[0] if axes else None))
        style_axes(axes[-1])
        axes[-1].tick_params(labelbottom=len(axes) == count)
    return figure, axes


def write_note(axes: Axes, text: str) -> None:
    """Say in words what the dotted line of the axes is."""
    axes.set_title(text, loc="right", color=INK, fontsize=7, pad=2.5)


def label_axes(axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Write the name of axes above them, on the left, and what is along their sides."""
    if title:
        axes.set_title(plain_text(title), loc="left", color=INK, fontsize=SMALL_PT, pad=3)
    for set_label, text in ((axes.set_xlabel, x), (axes.set_ylabel, y)):
        set_label(plain_text(text), color=INK, fontsize=SMALL_PT, labelpad=2)


def plain_text(text: str) -> str:
    """Return text that matplotlib draws as it is written: a ``$`` starts no formula."""
    return text.replace("$", r"\$")


def unit_rgb(rgb: Rgb) -> tuple[float, float, float]:
    """Return a colour as matplotlib has it."""
    r, g, b = (value / 255.0 for value in rgb)
    return r, g, b
