"""The figures of maps; see ``canvas`` for their look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251

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
    INK,
    SMALL_PT,
    Classes,
    LegendEntry,
    crop_box,
    cut_cells,
    label_axes,
    pool_cells,
    stacked_axes,
    unit_rgb,
)
from slamfusion.report.map_axes import cells_extent, draw_cells, map_axes

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

MAP_LEGEND = (
    LegendEntry("wall", WALL_RGB),
    LegendEntry("free", FREE_RGB),
    LegendEntry("unknown", UNKNOWN_RGB),
)

# Share of votes for the winner: white for all, through yellow to red for hardly any.
_AGREEMENT_MAP = "YlOrRd"


def map_picture(
    cells: Classes,
    resolution: float,
    origin: Pose2,
    box: CellBox | None = None,
    outvoted: npt.NDArray[np.bool_] | None = None,
) -> Figure:
    """Draw one map: walls dark, free white, unknown grey; cropped to what is known.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
        resolution: metres per cell.
        origin: pose of the lower-left corner of cell [0, 0]; its yaw turns the picture.
        box: cells to show; default: what is known, with a small margin.
        outvoted: (H, W) bool, cells that are marked; default: none.
    """
    codes = cells if outvoted is None else np.where(outvoted, np.int8(2), cells)
    colours = (UNKNOWN_RGB, FREE_RGB, WALL_RGB, DISAGREEMENT_RGB)
    return _codes_figure(codes, colours, resolution, origin, box)


def overlay_picture(
    layers: Sequence[Classes],
    colours: Sequence[Rgb],
    resolution: float,
    origin: Pose2,
    box: CellBox | None = None,
) -> Figure:
    """Lay the walls of several maps over each other; see ``overlay_rgb``.

    Args:
        layers: (H, W) int8 each, in {-1, 0, 1}, one lattice.
        resolution, origin, box: see ``map_picture``.
    """
    stack = [np.asarray(layer) for layer in layers]
    box = box or crop_box(np.any([layer != -1 for layer in stack], axis=0))
    pooled = [pool_cells(cut_cells(layer, box), origin) for layer in stack]
    rgb = overlay_rgb([classes for classes, _ in pooled], colours)
    return _map_figure(rgb, pooled[0][1] * resolution, box_origin(origin, resolution, box))


def overlay_rgb(layers: Sequence[Classes], colours: Sequence[Rgb]) -> npt.NDArray[np.uint8]:
    """Mix maps: a wall of one map in its colour, darker where more have one, of all that of a wall.

    Args:
        layers: (H, W) int8 each, in {-1, 0, 1}.

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
) -> Figure:
    """Draw the share of votes for the winner of each cell, light where all agree.

    Args:
        agreement: (H, W) int8, 0..100 percent, -1 without votes.
        resolution, origin, box: see ``map_picture``.
    """
    # The worst cell of a block counts: disagreement must not vanish in a small picture.
    disagreement = np.where(agreement < 0, -1, 100 - agreement.astype(np.int16)).astype(np.int8)
    colours = [UNKNOWN_RGB, *(agreement_colour(100 - step) for step in range(101))]
    return _codes_figure(disagreement, colours, resolution, origin, box)


def difference_picture(difference: Classes, resolution: float, origin: Pose2) -> Figure:
    """Draw the difference to the truth in the colours of ``DIFFERENCE_COLOURS``.

    Args:
        difference: (H, W) int8 codes of ``slamfusion.evaluation``.
        resolution, origin: see ``map_picture``.
    """
    order = list(DIFFERENCE_COLOURS)
    rank = np.zeros(len(order), dtype=np.int8)
    rank[order] = np.arange(len(order), dtype=np.int8)
    colours = [colour for _, colour in DIFFERENCE_COLOURS.values()]
    whole = CellBox(0, 0, *difference.shape)
    return _codes_figure(rank[difference] - np.int8(1), colours, resolution, origin, whole)


def yaw_picture(alignment: Alignment) -> Figure:
    """Draw the best coarse score over yaw, with the answer and its rival marked.

    A single sharp peak is a place that looks like itself under one yaw only.
    """
    profile = alignment.yaw_profile
    if profile is None or len(profile) == 0:
        raise ValueError(f"the alignment of {alignment.moving!r} has no scores over yaw to draw")
    order = np.argsort(profile[:, 0])
    yaw_deg, score = np.rad2deg(profile[order, 0]), profile[order, 1]

    figure, (axes,) = stacked_axes(1, 1.5)
    axes.fill_between(yaw_deg, score, min(0.0, float(score.min())), color=INK, alpha=0.16, lw=0)
    axes.plot(yaw_deg, score, color=INK, lw=1.1)
    marks = [(alignment.transform, "answer", WALL_RGB, "o")]
    if alignment.runner_up is not None:
        ratio = f"runner-up, {alignment.runner_up.ratio:.2f} of it"
        marks.append((alignment.runner_up.transform, ratio, DISAGREEMENT_RGB, "D"))
    for pose, label, rgb, marker in marks:
        angle = math.degrees(math.remainder(pose.yaw_rad, 2 * math.pi))
        look: dict[str, Any] = {"color": unit_rgb(rgb), "marker": marker, "ms": 5, "ls": "none"}
        axes.axvline(angle, color=unit_rgb(rgb), lw=1.0, ls=":")
        height = float(np.interp(angle, yaw_deg, score))
        axes.plot([angle], [height], label=f"{label} ({angle:.1f}°)", **look)
    label_axes(axes, x="yaw [°]", y="coarse score")
    axes.margins(x=0)
    axes.set_ylim(top=float(score.max()) * 1.35 + 1e-9)
    axes.legend(loc="upper left", ncols=2, frameon=False, fontsize=SMALL_PT, labelcolor=INK)
    if yaw_deg[-1] - yaw_deg[0] > 300:
        axes.set_xticks(range(-180, 181, 45))
    return figure


def agreement_legend() -> tuple[LegendEntry, ...]:
    """Return the colours of some shares of votes."""
    return tuple(LegendEntry(f"{share} %", agreement_colour(share)) for share in (100, 75, 50, 25))


def agreement_colour(percent: int) -> Rgb:
    """Return the colour of a share of votes: white for all, then yellow to dark red."""
    if percent >= 100:
        return FREE_RGB
    r, g, b, _ = colormaps[_AGREEMENT_MAP](0.15 + 0.85 * (100 - percent) / 100.0)
    return round(255 * r), round(255 * g), round(255 * b)


def _codes_figure(
    codes: Classes, colours: Sequence[Rgb], resolution: float, origin: Pose2, box: CellBox | None
) -> Figure:
    """Draw cells by their codes, from -1 on; of a block of cells the largest code shows."""
    box = box or crop_box(codes != -1)
    pooled, factor = pool_cells(cut_cells(codes, box), origin)
    rgb = np.array(colours, dtype=np.uint8)[pooled.astype(np.int16) + 1]
    return _map_figure(rgb, factor * resolution, box_origin(origin, resolution, box))


def _map_figure(rgb: npt.NDArray[np.uint8], resolution: float, corner: Pose2) -> Figure:
    """Return the picture of an image of cells; see ``draw_cells``."""
    figure, axes = map_axes(cells_extent(rgb.shape, resolution, corner), margin_m=0.0)
    draw_cells(axes, rgb, resolution, corner)
    return figure
