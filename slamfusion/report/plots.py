"""The pictures of maps, each as the bytes of a PNG file; see ``canvas`` for their look."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251
from matplotlib.ticker import MaxNLocator  # noqa: TID251
from matplotlib.transforms import Affine2D  # noqa: TID251

from slamfusion.align.records import Alignment
from slamfusion.evaluation import (
    AGREE_FREE,
    AGREE_UNKNOWN,
    AGREE_WALL,
    EXTRA_FREE,
    EXTRA_WALL,
    MISSING_FREE,
    MISSING_WALL,
)
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, box_origin
from slamfusion.palette import (
    AGREED_WALL_RGB,
    DISAGREEMENT_RGB,
    EXTRA_FREE_RGB,
    EXTRA_WALL_RGB,
    FREE_RGB,
    MISSING_FREE_RGB,
    MISSING_WALL_RGB,
    UNKNOWN_RGB,
    WALL_RGB,
    Rgb,
)
from slamfusion.report.canvas import (
    DPI,
    INK,
    WIDTH_IN,
    Classes,
    crop_box,
    cut_cells,
    pool_cells,
    style_axes,
    to_png,
    unit_rgb,
)

# In the order of visibility when cells are pooled: the last wins.
DIFFERENCE_COLOURS: dict[int, tuple[str, Rgb]] = {
    AGREE_UNKNOWN: ("both unknown", UNKNOWN_RGB),
    AGREE_FREE: ("both free", FREE_RGB),
    EXTRA_FREE: ("free, unknown in the truth", EXTRA_FREE_RGB),
    MISSING_FREE: ("unknown, free in the truth", MISSING_FREE_RGB),
    AGREE_WALL: ("true wall", WALL_RGB),
    EXTRA_WALL: ("extra wall", EXTRA_WALL_RGB),
    MISSING_WALL: ("missing wall", MISSING_WALL_RGB),
}

# Share of votes for the winner: white for all, through yellow to red for hardly any.
_AGREEMENT_MAP = "YlOrRd"


def map_picture(
    cells: Classes, resolution: float, origin: Pose2, box: CellBox | None = None
) -> bytes:
    """Draw one map: walls dark, free white, unknown grey; cropped to what is known.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
        resolution: metres per cell.
        origin: pose of the lower-left corner of cell [0, 0]; its yaw turns the picture.
        box: cells to show; default: what is known, with a small margin.
    """
    box = box or crop_box(cells != -1)
    pooled, factor = pool_cells(cut_cells(cells, box), origin)
    palette = np.array((UNKNOWN_RGB, FREE_RGB, WALL_RGB), dtype=np.uint8)
    return _map_png(palette[pooled + 1], factor * resolution, box_origin(origin, resolution, box))


def overlay_picture(
    layers: Sequence[Classes],
    colours: Sequence[Rgb],
    resolution: float,
    origin: Pose2,
    box: CellBox | None = None,
) -> bytes:
    """Lay the walls of several maps over each other; see ``overlay_rgb``.

    Args:
        layers: (H, W) int8 each, in {-1, 0, 1}, one lattice.
        colours: of each layer's walls.
        resolution: metres per cell.
        origin: pose of the lower-left corner of cell [0, 0].
        box: cells to show; default: what is known, with a small margin.
    """
    stack = [np.asarray(layer) for layer in layers]
    box = box or crop_box(np.any([layer != -1 for layer in stack], axis=0))
    pooled = [pool_cells(cut_cells(layer, box), origin) for layer in stack]
    rgb = overlay_rgb([classes for classes, _ in pooled], colours)
    return _map_png(rgb, pooled[0][1] * resolution, box_origin(origin, resolution, box))


def overlay_rgb(layers: Sequence[Classes], colours: Sequence[Rgb]) -> npt.NDArray[np.uint8]:
    """Mix maps: a wall of one map in its colour, darker where more have one, of all that of a wall.

    Args:
        layers: (H, W) int8 each, in {-1, 0, 1}.
        colours: of each layer's walls.

    Returns:
        (H, W, 3) uint8; other cells are the whiter, the more of the maps know them.
    """
    walls = np.array([layer == 1 for layer in layers])[..., None]
    count = walls.sum(axis=0)
    own = (walls * np.array(colours, dtype=np.float64)[:, None, None]).sum(axis=0)
    dark = np.clip((count - 1) / max(len(layers) - 1, 1), 0.0, 1.0)
    wall = own / np.maximum(count, 1) * (1.0 - dark) + np.array(WALL_RGB) * dark
    known = np.mean([layer != -1 for layer in layers], axis=0)[..., None]
    ground = np.array(UNKNOWN_RGB) * (1.0 - known) + np.array(FREE_RGB) * known
    return np.asarray(np.rint(np.where(count > 0, wall, ground)), dtype=np.uint8)


def agreement_picture(
    agreement: Classes, resolution: float, origin: Pose2, box: CellBox | None = None
) -> bytes:
    """Draw the share of votes for the winner of each cell, light where all agree.

    Args:
        agreement: (H, W) int8, 0..100 percent, -1 without votes.
        resolution: metres per cell.
        origin: pose of the lower-left corner of cell [0, 0].
        box: cells to show; default: what is known, with a small margin.
    """
    box = box or crop_box(agreement != -1)
    cut = cut_cells(agreement, box)
    # Pooled by the worst cell: disagreement must not vanish in a small picture.
    disagreement = np.where(cut < 0, -1, 100 - cut.astype(np.int16)).astype(np.int8)
    pooled, factor = pool_cells(disagreement, origin)
    colours = [UNKNOWN_RGB, *(agreement_colour(100 - step) for step in range(101))]
    palette = np.array(colours, dtype=np.uint8)
    return _map_png(
        palette[pooled.astype(np.int16) + 1],
        factor * resolution,
        box_origin(origin, resolution, box),
    )


def dissent_picture(
    fused: Classes,
    dissent: npt.NDArray[np.bool_],
    resolution: float,
    origin: Pose2,
    *,
    box: CellBox | None = None,
) -> bytes:
    """Draw where one input was outvoted, over a faint fused map.

    Args:
        fused: (H, W) int8 in {-1, 0, 1}.
        dissent: (H, W) bool.
        resolution: metres per cell.
        origin: pose of the lower-left corner of cell [0, 0].
        box: cells to show; default: what is known, with a small margin.
    """
    box = box or crop_box((fused != -1) | dissent)
    codes = cut_cells(fused, box).copy()
    codes[cut_cells(dissent.astype(np.int8), box, outside=0) == 1] = 2
    pooled, factor = pool_cells(codes, origin)
    palette = np.array((UNKNOWN_RGB, FREE_RGB, AGREED_WALL_RGB, DISAGREEMENT_RGB), dtype=np.uint8)
    return _map_png(palette[pooled + 1], factor * resolution, box_origin(origin, resolution, box))


def difference_picture(difference: Classes, resolution: float, origin: Pose2) -> bytes:
    """Draw the difference to the truth in the colours of ``DIFFERENCE_COLOURS``.

    Args:
        difference: (H, W) int8 codes of ``slamfusion.evaluation``.
        resolution: metres per cell.
        origin: pose of the lower-left corner of cell [0, 0].
    """
    order = list(DIFFERENCE_COLOURS)
    rank = np.zeros(len(order), dtype=np.int8)
    rank[order] = np.arange(len(order), dtype=np.int8)
    pooled, factor = pool_cells(rank[difference], origin)
    palette = np.array([DIFFERENCE_COLOURS[code][1] for code in order], dtype=np.uint8)
    return _map_png(palette[pooled], factor * resolution, origin)


def yaw_picture(alignment: Alignment) -> bytes:
    """Draw the best coarse score over yaw, with the answer and its rival marked.

    A single sharp peak is a place that looks like itself under one yaw only.
    """
    profile = alignment.yaw_profile
    if profile is None or len(profile) == 0:
        message = f"the alignment of {alignment.moving!r} has no scores over yaw to draw"
        raise ValueError(message)
    order = np.argsort(profile[:, 0])
    yaw_deg, score = np.rad2deg(profile[order, 0]), profile[order, 1]

    figure = Figure(figsize=(WIDTH_IN, 2.1), dpi=DPI)
    axes = figure.add_axes((0.125, 0.21, 0.85, 0.65))
    axes.fill_between(yaw_deg, score, min(0.0, float(score.min())), color=INK, alpha=0.16, lw=0)
    axes.plot(yaw_deg, score, color=INK, lw=1.1)
    marks = [(alignment.transform, "answer", unit_rgb(WALL_RGB), "o")]
    if alignment.runner_up is not None:
        ratio = f"runner-up, {alignment.runner_up.ratio:.2f} of it"
        marks.append((alignment.runner_up.transform, ratio, unit_rgb(DISAGREEMENT_RGB), "D"))
    for pose, label, colour, marker in marks:
        angle = math.degrees(math.remainder(pose.yaw_rad, 2 * math.pi))
        height = float(np.interp(angle, yaw_deg, score))
        axes.axvline(angle, color=colour, lw=1.0, ls=":")
        axes.plot(
            [angle],
            [height],
            marker=marker,
            color=colour,
            ms=5,
            ls="none",
            label=f"{label} ({angle:.1f}°)",
        )
    axes.set_xlabel("yaw in degrees", color=INK, fontsize=7.5)
    axes.set_ylabel("coarse score", color=INK, fontsize=7.5)
    axes.margins(x=0)
    axes.set_ylim(top=float(score.max()) * 1.08 + 1e-9)
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=2,
        frameon=False,
        fontsize=7.5,
        labelcolor=INK,
        borderaxespad=0.2,
        handletextpad=0.3,
    )
    if yaw_deg[-1] - yaw_deg[0] > 300:
        axes.set_xticks(range(-180, 181, 45))
    style_axes(axes)
    return to_png(figure)


def agreement_colour(percent: int) -> Rgb:
    """Return the colour of a share of votes: white for all, then yellow to dark red."""
    if percent >= 100:
        return FREE_RGB
    r, g, b, _ = colormaps[_AGREEMENT_MAP](0.15 + 0.85 * (100 - percent) / 100.0)
    return round(255 * r), round(255 * g), round(255 * b)


def _map_png(rgb: npt.NDArray[np.uint8], resolution: float, corner: Pose2) -> bytes:
    """Draw an image of cells in map-frame metres, row 0 at the bottom.

    Args:
        rgb: (h, w, 3) uint8.
        resolution: metres per pixel of ``rgb``.
        corner: pose of the lower-left corner of pixel [0, 0] in the map frame.
    """
    height_m, width_m = rgb.shape[0] * resolution, rgb.shape[1] * resolution
    corners = corner.transform([(0, 0), (width_m, 0), (0, height_m), (width_m, height_m)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    wide, tall = (float(side) for side in high - low)

    # The axes take the shape of the map; margins are fixed in inches for the lettering.
    left, right, bottom, top = 0.5, 0.08, 0.4, 0.08
    plot_width = WIDTH_IN - left - right
    plot_height = plot_width * tall / wide
    longest = 1.25 * WIDTH_IN
    if plot_height > longest:
        plot_height = longest
        plot_width = max(plot_height * wide / tall, 0.6)
        plot_height = min(longest, plot_width * tall / wide)
    plot_height = max(plot_height, 0.35)
    size = (plot_width + left + right, plot_height + bottom + top)
    figure = Figure(figsize=size, dpi=DPI)
    axes = figure.add_axes(
        (left / size[0], bottom / size[1], plot_width / size[0], plot_height / size[1])
    )
    turned = Affine2D().rotate(corner.yaw_rad).translate(corner.x, corner.y)
    axes.imshow(
        rgb,
        origin="lower",
        interpolation="nearest",
        extent=(0.0, width_m, 0.0, height_m),
        transform=turned + axes.transData,
        aspect="auto",
    )
    axes.set_xlim(float(low[0]), float(high[0]))
    axes.set_ylim(float(low[1]), float(high[1]))
    axes.set_aspect("equal", adjustable="box")
    for axis, inches in ((axes.xaxis, plot_width), (axes.yaxis, plot_height)):
        axis.set_major_locator(MaxNLocator(nbins=max(2, round(1.8 * inches)), steps=[1, 2, 5, 10]))
    axes.set_xlabel("x in m", color=INK, fontsize=7.5, labelpad=2)
    axes.set_ylabel("y in m", color=INK, fontsize=7.5, labelpad=2)
    style_axes(axes)
    axes.set_facecolor(unit_rgb(UNKNOWN_RGB))
    return to_png(figure)
