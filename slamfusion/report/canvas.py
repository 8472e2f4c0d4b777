"""What the pictures of a report share: the sheet, its lettering, and cells that fit on it.

No name of a map is ever drawn: names stand in the page, where they are escaped, and a ``$`` or a
script of any alphabet in a name cannot upset a picture. Backgrounds are transparent and lettering
is mid-grey, so that a picture sits on a light and on a dark page.
"""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import rc_context  # noqa: TID251
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.backend_bases import FigureCanvasBase  # noqa: TID251
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox
from slamfusion.palette import FREE_RGB, INK_RGB, Rgb

Classes = npt.NDArray[np.int8]

INK = "#{:02x}{:02x}{:02x}".format(*INK_RGB)
# Four inches of lettering in 920 pixels: readable where three pictures stand side by side.
DPI = 230
WIDTH_IN = 4.0
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
        origin: its yaw says whether the cells lie along the picture's pixels.

    Returns:
        (h, w) int8, and the factor; rows and columns that fill the last block repeat its edge.
    """
    longest = _LONGEST_SIDE_TURNED if origin.yaw_rad else _LONGEST_SIDE_CELLS
    factor = max(1, math.ceil(max(codes.shape) / longest))
    if factor == 1:
        return codes, 1
    height, width = (math.ceil(side / factor) for side in codes.shape)
    padding = (
        (0, height * factor - codes.shape[0]),
        (0, width * factor - codes.shape[1]),
    )
    padded = np.pad(codes, padding, mode="edge")
    blocks = padded.reshape(height, factor, width, factor)
    return np.asarray(blocks.max(axis=(1, 3)), dtype=np.int8), factor


def style_axes(axes: Axes) -> None:
    """Give axes their quiet lettering and frame, and white ground also on a dark page."""
    axes.set_facecolor(unit_rgb(FREE_RGB))
    axes.tick_params(colors=INK, labelsize=7.5, width=0.7, length=3)
    axes.ticklabel_format(useOffset=False, style="plain")
    for spine in axes.spines.values():
        spine.set_color(INK)
        spine.set_linewidth(0.6)


class Drawing(bytes):
    """The bytes of a picture's PNG, which remember what was drawn: it is to be had as SVG, too."""

    figure: Figure

    @classmethod
    def of(cls, figure: Figure) -> Drawing:
        """Draw a figure."""
        drawn = cls(to_form(figure, "png"))
        # The pixels are in the bytes; the canvas would keep them a second time.
        FigureCanvasBase(figure)
        drawn.figure = figure
        return drawn


def to_png(figure: Figure) -> Drawing:
    """Return the figure as the bytes of a PNG with a transparent background."""
    figure.patch.set_alpha(0.0)
    return Drawing.of(figure)


def in_form(picture: bytes, form: str) -> bytes:
    """Return a picture as the bytes of another form.

    Args:
        picture: the PNG that ``to_png`` made.
        form: ``png``, ``svg`` or ``pdf``.

    Raises:
        TypeError: it is the PNG of no figure.
    """
    if form == "png":
        return picture
    if not isinstance(picture, Drawing):
        message = f"wanted a picture that was drawn here, found {type(picture).__name__}"
        raise TypeError(message)
    return to_form(picture.figure, form)


def to_form(figure: Figure, form: str) -> bytes:
    """Return the figure as the bytes of a file; the same figure always gives the same bytes.

    Args:
        figure: on its own background.
        form: ``png``, ``svg`` or ``pdf``; the text of the last two stays text.
    """
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    # Maps are large flat areas: a higher level takes four times as long for a few percent.
    more: dict[str, Any] = {"pil_kwargs": {"compress_level": 3}} if form == "png" else {}
    with rc_context(_SAME_BYTES):
        figure.savefig(buffer, format=form, metadata=_NO_METADATA[form], **more)
    return buffer.getvalue()


def write_note(axes: Axes, text: str) -> None:
    """Say in words what the dotted line of the axes is."""
    axes.set_title(text, loc="right", color=INK, fontsize=7, pad=2.5)


def plain_text(text: str) -> str:
    """Return text that matplotlib draws as it is written: a ``$`` starts no formula."""
    return text.replace("$", r"\$")


def unit_rgb(rgb: Rgb) -> tuple[float, float, float]:
    """Return a colour as matplotlib has it."""
    r, g, b = (value / 255.0 for value in rgb)
    return r, g, b
