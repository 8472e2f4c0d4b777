"""Drawing shared by the pictures of a report: sheet, lettering, and maps with axes in metres.

Title and legend are part of a picture, dark on white, so that it can be used without its page.
"""

from __future__ import annotations

import io
import math
import textwrap
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context  # noqa: TID251
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.backend_bases import FigureCanvasBase  # noqa: TID251
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251
from matplotlib.patches import Patch  # noqa: TID251
from matplotlib.ticker import MaxNLocator  # noqa: TID251
from matplotlib.transforms import Affine2D, Bbox  # noqa: TID251

from slamfusion import palette
from slamfusion.config import PICTURE_FORMS
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import F64, I8, U8, Pose2
from slamfusion.grid import CellBox, ClassifiedGrid, box_origin, known_box

# Cells as -1 unknown, 0 free, 1 wall.
Classes = I8
# The colours of a picture by what they mean.
Legend = Mapping[str, palette.Rgb]

INK = "#{:02x}{:02x}{:02x}".format(*palette.INK_RGB)
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
# A box grows by this at least where its growth is limited to a share of its size.
_LEAST_GROWTH_M = 1.0
_LONGEST_IN = 1.25 * WIDTH_IN
# No dates and no random names in a file; letters as letters (42: TrueType).
_SAME_BYTES: Any = {"svg.hashsalt": "slamfusion", "svg.fonttype": "none", "pdf.fonttype": 42}
_NO_METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}
MARKS: Legend = {"start (circle)": palette.START_RGB, "end (square)": palette.END_RGB}


def unit_rgb(rgb: palette.Rgb) -> tuple[float, float, float]:
    """Return a colour as matplotlib has it."""
    r, g, b = (value / 255.0 for value in rgb)
    return r, g, b


# A number in a circle: a place to check.
PLACE_LOOK: dict[str, Any] = {
    "color": "white",
    "fontsize": SMALL_PT,
    "fontweight": "bold",
    "ha": "center",
    "va": "center",
    "bbox": {
        "boxstyle": "circle,pad=0.25",
        "facecolor": unit_rgb(palette.DISAGREEMENT_RGB),
        "lw": 0.0,
    },
    "zorder": 6.0,
}


# --- the sheet ------------------------------------------------------------------------------------


def add_lettering(figure: Figure, title: str, legend: Legend) -> None:
    """Write a title above what was drawn and a legend below it; the figure grows for them."""
    wide, tall = (float(side) for side in figure.get_size_inches())
    lines = textwrap.wrap(title, int((wide - 0.16) / _TITLE_IN)) or [""]
    columns = max(1, int(wide / (0.42 + _SMALL_IN * max(map(len, legend), default=1))))
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
    patches = [Patch(facecolor=unit_rgb(rgb), edgecolor=INK, lw=0.4) for rgb in legend.values()]
    add_legend(figure, patches, list(legend), columns)


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


def to_form(figure: Figure, form: str) -> bytes:
    """Return the bytes of a PNG, SVG or PDF file; the same figure always gives the same bytes.

    Raises:
        SlamFusionError: another form.
    """
    if form not in PICTURE_FORMS:
        raise SlamFusionError(f"a picture is one of {', '.join(PICTURE_FORMS)}, found {form!r}")
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


def style_axes(axes: Axes) -> None:
    """Give axes their quiet lettering and frame."""
    axes.tick_params(colors=INK, labelsize=SMALL_PT, width=0.7, length=3)
    axes.ticklabel_format(useOffset=False, style="plain")
    for spine in axes.spines.values():
        spine.set_color(INK)
        spine.set_linewidth(0.6)


def write_note(axes: Axes, text: str) -> None:
    """Say in words what the dotted line of the axes is."""
    axes.set_title(text, loc="right", color=INK, fontsize=7, pad=2.5)


def name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Let axes show rows 0, 1, ... downwards, each below its whole name, however long."""
    axes.set_ylim(len(names) - 0.6, -0.85)
    axes.set_yticks([])
    for row, name in enumerate(names):
        axes.annotate(
            plain_text(name), (0.0, row - 0.3), xycoords=("axes fraction", "data"),
            xytext=(1.5, 1.0), textcoords="offset points", color=INK, fontsize=SMALL_PT,
        )  # fmt: skip


def label_axes(axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Write the name of axes above them, on the left, and what is along their sides.

    A label that is not given stays.
    """
    if title:
        axes.set_title(plain_text(title), loc="left", color=INK, fontsize=SMALL_PT, pad=3)
    for set_label, text in ((axes.set_xlabel, x), (axes.set_ylabel, y)):
        if text:
            set_label(plain_text(text), color=INK, fontsize=SMALL_PT, labelpad=2)


def plain_text(text: str) -> str:
    """Return text that matplotlib draws as it is written: a ``$`` starts no formula."""
    return text.replace("$", r"\$")


# --- maps with axes in metres ---------------------------------------------------------------------


def box_of(points: F64) -> Bbox:
    """Return the box of points in the map frame, (N, 2) or more columns, x and y first, metres."""
    return Bbox([points[:, :2].min(axis=0), points[:, :2].max(axis=0)])


def grown(box: Bbox, other: Bbox, most: float | None = None) -> Bbox:
    """Return a box with another taken in, by at most ``most`` of its size a side."""
    whole = Bbox.union([box, other])
    if most is None:
        return whole
    room = box.padded(max(most * max(box.width, box.height), _LEAST_GROWTH_M))
    return Bbox([np.maximum(whole.min, room.min), np.minimum(whole.max, room.max)])


def map_axes(box: Bbox, *, bar: bool = False, margin_m: float | None = None) -> tuple[Figure, Axes]:
    """Return axes of the shape of a place, in metres; ``bar`` leaves room for a colour bar."""
    margin = 0.03 * max(box.width, box.height) + 0.2 if margin_m is None else margin_m
    low, high = np.subtract(box.min, margin), np.add(box.max, margin)
    wide, tall = (float(side) for side in high - low)
    left, right, bottom, top = 0.5, (0.72 if bar else 0.08), 0.4, 0.03
    width = WIDTH_IN - left - right
    height = width * tall / wide
    if height > _LONGEST_IN:
        width, height = max(_LONGEST_IN * wide / tall, 1.0), _LONGEST_IN
    height = max(height, 0.6)
    size = (width + left + right, height + bottom + top)
    figure = Figure(figsize=size, dpi=DPI)
    axes = figure.add_axes((left / size[0], bottom / size[1], width / size[0], height / size[1]))
    # Where a side was widened for the lettering, the place shows more around it.
    scale = max(wide / width, tall / height)
    middle = (low + high) / 2.0
    axes.set_xlim(middle[0] - scale * width / 2, middle[0] + scale * width / 2)
    axes.set_ylim(middle[1] - scale * height / 2, middle[1] + scale * height / 2)
    for axis, inches in ((axes.xaxis, width), (axes.yaxis, height)):
        axis.set_major_locator(MaxNLocator(nbins=max(2, round(1.8 * inches)), steps=[1, 2, 5, 10]))
    label_axes(axes, x="x [m]", y="y [m]")
    style_axes(axes)
    _draw_scale(axes)
    return figure, axes


def _draw_scale(axes: Axes) -> None:
    """Draw a bar of a round length, at most a quarter of the width, at the lower left."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    most = 0.25 * (right - left)
    unit = 10.0 ** math.floor(math.log10(most))
    length = max(step * unit for step in (1.0, 2.0, 5.0) if step * unit <= most)
    x, y = left + 0.04 * (right - left), bottom + 0.04 * (top - bottom)
    ends: dict[str, Any] = {"color": INK, "lw": 1.6, "marker": "|", "ms": 5.0, "zorder": 5.0}
    axes.plot([x, x + length], [y, y], scalex=False, scaley=False, **ends)
    ground = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.8}
    look: dict[str, Any] = {"color": INK, "fontsize": SMALL_PT, "bbox": ground, "zorder": 5.0}
    up = y + 0.02 * (top - bottom)
    axes.text(x + 0.5 * length, up, f"{length:g} m", ha="center", va="bottom", **look)


def crop_box(cells: I8) -> CellBox:
    """Return the box of the known cells with a small margin; the whole map when none is."""
    box = known_box(cells)
    return CellBox(0, 0, *cells.shape) if box is None else box.padded(_MARGIN_CELLS)


def shown_cells(
    codes: Classes, resolution: float, origin: Pose2, box: CellBox | None = None
) -> tuple[Classes, float, Pose2]:
    """Cut cells to a box, and shrink them by a whole factor to what a picture can show.

    The largest code of each block wins, so that walls of one cell are not averaged away.

    Args:
        codes: (H, W) int8.
        resolution: metres per cell.
        origin: its yaw decides whether cells and pixels are parallel.
        box: may reach beyond the cells, where the code is -1; default: what is not -1.

    Returns:
        (h, w) int8, metres per pixel, and the pose of the lower-left corner of pixel [0, 0].
    """
    box = box or crop_box(codes)
    longest = _LONGEST_SIDE_TURNED if origin.yaw_rad else _LONGEST_SIDE_CELLS
    factor = max(1, math.ceil(max(box.shape) / longest))
    cut = box.cut(codes, CellBox(0, 0, *codes.shape), -1)
    # Rows and columns that fill the last block repeat its edge.
    height, width = (math.ceil(side / factor) for side in cut.shape)
    padding = ((0, height * factor - cut.shape[0]), (0, width * factor - cut.shape[1]))
    blocks = np.pad(cut, padding, mode="edge").reshape(height, factor, width, factor)
    pooled = np.asarray(blocks.max(axis=(1, 3)), dtype=np.int8)
    return pooled, factor * resolution, box_origin(origin, resolution, box)


def draw_cells(axes: Axes, colours: U8, side_m: float, corner: Pose2) -> None:
    """Draw cells, (h, w, 3 or 4) uint8, at the pose of their lower-left corner; keep the limits."""
    height, width = colours.shape[:2]
    turned = Affine2D().rotate(corner.yaw_rad).translate(corner.x, corner.y)
    limits = axes.get_xlim(), axes.get_ylim()
    axes.imshow(
        colours,
        origin="lower",
        interpolation="nearest",
        extent=(0.0, width * side_m, 0.0, height * side_m),
        transform=turned + axes.transData,
        aspect="auto",
    )
    axes.set_facecolor(unit_rgb(palette.UNKNOWN_RGB))
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])


def cells_extent(shape: tuple[int, ...], side_m: float, corner: Pose2) -> Bbox:
    """Return the box of an image of cells; see ``draw_cells``."""
    tall, wide = side_m * shape[0], side_m * shape[1]
    return box_of(corner.transform([(0, 0), (wide, 0), (0, tall), (wide, tall)]))


def place_extent(poses: F64, grid: ClassifiedGrid | None) -> Bbox:
    """Return the box of poses, (N, 3) x, y, yaw, and of what the map knows, where there is one."""
    if grid is None:
        return box_of(poses)
    box = crop_box(grid.cells)
    corner = box_origin(grid.origin, grid.resolution, box)
    return grown(box_of(poses), cells_extent(box.shape, grid.resolution, corner))


def draw_grid(axes: Axes, grid: ClassifiedGrid | None) -> None:
    """Draw a classified map, if there is one, in its frame, coloured as by ``maps.map_picture``."""
    if grid is None:
        return
    pooled, side_m, corner = shown_cells(grid.cells, grid.resolution, grid.origin)
    colours = np.array((palette.UNKNOWN_RGB, palette.FREE_RGB, palette.WALL_RGB), dtype=np.uint8)
    # Unknown cells have no colour here: around the map there is nothing either.
    rgba = np.dstack((colours[pooled + 1], np.where(pooled == -1, 0, 255).astype(np.uint8)))
    draw_cells(axes, rgba, side_m, corner)


def draw_marks(axes: Axes, poses: F64) -> None:
    """Mark the first and the last pose; where they are one place both are seen."""
    for pose, colour, marker, size in (
        (poses[0], palette.START_RGB, "o", 8.5),
        (poses[-1], palette.END_RGB, "s", 4.0),
    ):
        axes.plot(
            [pose[0]],
            [pose[1]],
            marker=marker,
            ms=size,
            color=unit_rgb(colour),
            markeredgecolor="white",
            markeredgewidth=0.7,
            ls="none",
            scalex=False,
            scaley=False,
        )


def draw_places(figure: Figure, places: Iterable[tuple[float, float]]) -> None:
    """Number places on the map of a figure, x and y in metres; the first is 1."""
    for number, place in enumerate(places, start=1):
        figure.axes[0].annotate(str(number), place, annotation_clip=True, **PLACE_LOOK)
