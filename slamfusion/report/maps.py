"""Pictures and tables of maps, alignments and errors, which several reports share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib import colormaps  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion import palette
from slamfusion.align.records import Alignment
from slamfusion.evaluation import map_error
from slamfusion.evaluation.distances import sample_on_lattice
from slamfusion.evaluation.doubled_walls import doubled_wall_share
from slamfusion.evaluation.measured import Figure as Measure
from slamfusion.evaluation.measured import face_figures, shown_figures
from slamfusion.geometry import B8, F64, U8, Pose2
from slamfusion.grid import CellBox, ClassifiedGrid, OccupancyGrid, box_origin
from slamfusion.report import canvas
from slamfusion.report.page import Picture, Section, tables
from slamfusion.vote.lattice import Lattice
from slamfusion.web.scene import layer_name

# In the order of visibility when cells are pooled: the last wins.
DIFFERENCES: dict[int, tuple[str, palette.Rgb]] = {
    map_error.AGREE_UNKNOWN: ("both unknown", palette.UNKNOWN_RGB),
    map_error.AGREE_FREE: ("both free", palette.FREE_RGB),
    map_error.EXTRA_FREE: ("free, unknown in the truth", palette.EXTRA_FREE_RGB),
    map_error.MISSING_FREE: ("unknown, free in the truth", palette.MISSING_FREE_RGB),
    map_error.AGREE_WALL: ("true wall", palette.WALL_RGB),
    map_error.EXTRA_WALL: ("extra wall", palette.EXTRA_WALL_RGB),
    map_error.MISSING_WALL: ("missing wall", palette.MISSING_WALL_RGB),
}

MAP_LEGEND: canvas.Legend = {
    "wall": palette.WALL_RGB,
    "free": palette.FREE_RGB,
    "unknown": palette.UNKNOWN_RGB,
}

# Share of votes for the winner: white for all, through yellow to red for hardly any.
_AGREEMENT_MAP = "YlOrRd"
# An overlay of a wrong alignment may spread over far more cells than either map.
_OVERLAY_CELLS = 40_000_000
# Pairs that are drawn: with ten inputs there are 45.
_MOST_OVERLAYS = 12
YAW_TEXT = (
    "The best coarse score at each yaw of the moving map. One sharp peak: the place fits in one "
    "way only. A second peak of nearly the same height: the place is symmetric."
)


# --- figures --------------------------------------------------------------------------------------


def map_picture(
    cells: canvas.Classes,
    resolution: float,
    origin: Pose2,
    box: CellBox | None = None,
    outvoted: B8 | None = None,
) -> Figure:
    """Draw a map of cells in {-1, 0, 1}, (H, W) int8; its origin's yaw turns the picture.

    Args:
        box: cells to show; default: what is known, with a small margin.
        outvoted: (H, W) bool, cells that are marked. In a block of cells that is one pixel a wall
            that was not outvoted shows: one cell of its edge would mark the whole wall.
    """
    codes = np.where(cells == 1, np.int8(2), cells)
    if outvoted is not None:
        codes[outvoted] = 1
    colours = (palette.UNKNOWN_RGB, palette.FREE_RGB, palette.DISAGREEMENT_RGB, palette.WALL_RGB)
    return _codes_figure(codes, colours, resolution, origin, box)


def overlay_picture(
    layers: Sequence[canvas.Classes],
    colours: Sequence[palette.Rgb],
    resolution: float,
    origin: Pose2,
    box: CellBox | None = None,
) -> Figure:
    """Draw the walls of several maps on one lattice over each other.

    A wall in one map has that map's colour, in several a darker one, in all the colour of walls.
    The more maps know another cell, the whiter it is. See ``map_picture``.
    """
    box = box or canvas.crop_box(np.max(layers, axis=0))
    shown = [canvas.shown_cells(layer, resolution, origin, box) for layer in layers]
    return _cells_figure(overlay_rgb([cells for cells, _, _ in shown], colours), *shown[0][1:])


def overlay_rgb(layers: Sequence[canvas.Classes], colours: Sequence[palette.Rgb]) -> U8:
    """Return the colours of ``overlay_picture``, (H, W, 3)."""
    pooled = np.array(layers)
    walls = (pooled == 1)[..., None]
    count = walls.sum(axis=0)
    own = (walls * np.array(colours, dtype=np.float64)[:, None, None]).sum(axis=0)
    dark = np.clip((count - 1) / max(len(layers) - 1, 1), 0.0, 1.0)
    wall = own / np.maximum(count, 1) * (1.0 - dark) + np.array(palette.WALL_RGB) * dark
    known = np.mean(pooled != -1, axis=0)[..., None]
    ground = np.array(palette.UNKNOWN_RGB) * (1.0 - known) + np.array(palette.FREE_RGB) * known
    return np.asarray(np.rint(np.where(count > 0, wall, ground)), dtype=np.uint8)


def agreement_picture(agreement: OccupancyGrid, box: CellBox | None = None) -> Figure:
    """Draw the share of votes for the winner of each cell, in percent, light where all agree."""
    # The worst cell of a block counts: disagreement must not vanish in a small picture.
    cells = agreement.cells
    disagreement = np.where(cells < 0, -1, 100 - cells.astype(np.int16)).astype(np.int8)
    colours = [palette.UNKNOWN_RGB, *(agreement_colour(100 - step) for step in range(101))]
    return _codes_figure(disagreement, colours, agreement.resolution, agreement.origin, box)


def agreement_colour(percent: int) -> palette.Rgb:
    """Return the colour of a share of votes: white for all, then yellow to dark red."""
    if percent >= 100:
        return palette.FREE_RGB
    r, g, b, _ = colormaps[_AGREEMENT_MAP](0.15 + 0.85 * (100 - percent) / 100.0)
    return round(255 * r), round(255 * g), round(255 * b)


def yaw_picture(alignment: Alignment, profile: F64) -> Figure:
    """Draw the best coarse score over yaw, (N, 2), with the answer and its rival marked."""
    order = np.argsort(profile[:, 0])
    yaw_deg, score = np.rad2deg(profile[order, 0]), profile[order, 1]

    figure, (axes,) = canvas.stacked_axes(1, 1.5)
    axes.fill_between(
        yaw_deg, score, min(0.0, float(score.min())), color=canvas.INK, alpha=0.16, lw=0
    )
    axes.plot(yaw_deg, score, color=canvas.INK, lw=1.1)
    marks = [(alignment.transform, "answer", palette.WALL_RGB, "o")]
    if alignment.runner_up is not None:
        ratio = f"runner-up, {alignment.runner_up.ratio:.2f} of it"
        marks.append((alignment.runner_up.transform, ratio, palette.DISAGREEMENT_RGB, "D"))
    for pose, label, rgb, marker in marks:
        angle = math.degrees(math.remainder(pose.yaw_rad, 2 * math.pi))
        look: dict[str, Any] = {
            "color": canvas.unit_rgb(rgb),
            "marker": marker,
            "ms": 5,
            "ls": "none",
        }
        axes.axvline(angle, color=canvas.unit_rgb(rgb), lw=1.0, ls=":")
        height = float(np.interp(angle, yaw_deg, score))
        axes.plot([angle], [height], label=f"{label} ({angle:.1f}°)", **look)
    canvas.label_axes(axes, x="yaw [°]", y="coarse score")
    axes.margins(x=0)
    axes.set_ylim(top=float(score.max()) * 1.35 + 1e-9)
    axes.legend(
        loc="upper left", ncols=2, frameon=False, fontsize=canvas.SMALL_PT, labelcolor=canvas.INK
    )
    if yaw_deg[-1] - yaw_deg[0] > 300:
        axes.set_xticks(range(-180, 181, 45))
    return figure


def _codes_figure(
    codes: canvas.Classes,
    colours: Sequence[palette.Rgb],
    resolution: float,
    origin: Pose2,
    box: CellBox | None,
) -> Figure:
    """Draw cells by their codes, from -1 on; of a block of cells the largest code shows."""
    pooled, side_m, corner = canvas.shown_cells(codes, resolution, origin, box)
    rgb = np.array(colours, dtype=np.uint8)[pooled.astype(np.int16) + 1]
    return _cells_figure(rgb, side_m, corner)


def _cells_figure(rgb: U8, side_m: float, corner: Pose2) -> Figure:
    """Return the picture of an image of cells; see ``draw_cells``."""
    figure, axes = canvas.map_axes(canvas.cells_extent(rgb.shape, side_m, corner), margin_m=0.0)
    canvas.draw_cells(axes, rgb, side_m, corner)
    return figure


# --- pictures -------------------------------------------------------------------------------------


def input_picture(grid: ClassifiedGrid, rejected: str | None = None) -> Picture:
    """Return a classified input in its frame, framed and marked if it was rejected for a reason."""
    size = f"{grid.width} x {grid.height} cells of {grid.resolution:g} m"
    figure = map_picture(grid.cells, grid.resolution, grid.origin)
    caption, badge = (
        (size, "") if rejected is None else (f"{size}. Rejected: {rejected}", "rejected")
    )
    stem = f"input-{grid.name}"
    return Picture(stem, figure, grid.name, caption, badge=badge, legend=MAP_LEGEND)


def input_colours(names: Sequence[str]) -> dict[str, palette.Rgb]:
    """Return the colours of all inputs of a page, as their layers have them."""
    layers = palette.colours_of(layer_name(name) for name in names)
    return {name: layers[layer_name(name)] for name in names}


def pair_overlay(
    reference: ClassifiedGrid,
    moving: ClassifiedGrid,
    alignment: Alignment,
    colours: Mapping[str, palette.Rgb],
) -> Picture | None:
    """Overlay two classified maps; None if they are too far apart or one is all unknown."""
    own, other = reference.known_box, moving.known_box
    if own is None or other is None:
        return None
    lattice, moved = (Lattice(grid.resolution, grid.origin) for grid in (reference, moving))
    box = own.hull(lattice.box_of(other, moved, alignment.transform))
    if box.area > _OVERLAY_CELLS:
        return None
    layers = [
        sample_on_lattice(reference, reference, box, Pose2()),
        sample_on_lattice(moving, reference, box, alignment.transform),
    ]
    legend = {name: colours[name] for name in (reference.name, moving.name)}
    figure = overlay_picture(
        layers,
        list(legend.values()),
        reference.resolution,
        box_origin(reference.origin, reference.resolution, box),
    )
    return Picture(
        f"pair-{reference.name}-{moving.name}",
        figure,
        f"{moving.name} on {reference.name}",
        f"The best alignment found. {alignment.reason}",
        badge="" if alignment.accepted else "rejected",
        legend=legend,
    )


def pairs_section(grids: Sequence[ClassifiedGrid], pairs: Sequence[Alignment]) -> Section:
    """Return the pairs of classified maps that were tried: first overlays, then a table of all."""
    by_name = {grid.name: grid for grid in grids}
    colours = input_colours(list(by_name))
    overlays = [
        pair_overlay(by_name[pair.reference], by_name[pair.moving], pair, colours)
        for pair in pairs[:_MOST_OVERLAYS]
        if pair.reference in by_name and pair.moving in by_name
    ]
    return Section(
        "Pairs",
        "Each pair under the best alignment found. Walls of both maps are black.",
        [overlay for overlay in overlays if overlay is not None],
        tables().alignments("All pairs", pairs),
    )


def yaw_pictures(alignments: Sequence[Alignment]) -> list[Picture]:
    """Return the score over yaw of every alignment that kept it."""
    return [
        Picture(
            f"yaw-{own.moving}-{own.reference}",
            yaw_picture(own, own.yaw_profile),
            f"{own.moving} on {own.reference}",
            own.reason,
            badge="" if own.accepted else "rejected",
        )
        for own in alignments
        if own.yaw_profile is not None and len(own.yaw_profile)
    ]


# --- tables ---------------------------------------------------------------------------------------


def map_statistics(
    grids: Sequence[ClassifiedGrid], doubled: Mapping[str, float] = MappingProxyType({})
) -> Markup:
    """Return classified maps in numbers; ``doubled``: known shares of doubled walls."""
    rows: list[Mapping[str, Any]] = []
    for grid in grids:
        walls, share = grid.cells == 1, doubled.get(grid.name)
        share = doubled_wall_share(walls) if share is None else share
        known_m2 = int(np.count_nonzero(grid.cells != -1)) * grid.resolution**2
        row = {"grid": grid, "known_m2": known_m2, "wall_cells": int(np.count_nonzero(walls))}
        rows.append({**row, "doubled_percent": 100.0 * share})
    return Markup(tables().statistics(rows))  # noqa: S704 - made by the template


def error_section(
    evaluations: Sequence[map_error.MapError], alignments: Sequence[Alignment | None]
) -> Section:
    """Return the errors against one truth as a table and pictures of the difference.

    Args:
        alignments: of each map with the truth, None if it was not moved.
    """
    lost = [own is not None and not own.accepted for own in alignments]
    measured = [_best_marked(evaluations, lost, own) for own in (shown_figures, face_figures)]
    return Section(
        "Error against the truth",
        "Each map on the lattice of the truth, over the truth's known box. The error is that of "
        "Fernandes and Alexandre 2016: the root of the summed squared differences with unknown -1, "
        "free 0 and wall 1.",
        [difference_picture(*pair) for pair in zip(evaluations, alignments, strict=True)],
        tables().map_errors(*measured, evaluations[0].tolerance_m),
    )


def _best_marked(
    evaluations: Sequence[map_error.MapError],
    lost: Sequence[bool],
    figures_of: Callable[[map_error.MapError], Sequence[tuple[Measure, float | None]]],
) -> tuple[list[str], list[Mapping[str, Any]]]:
    """Return the names of measures, and a row for each map; of each measure the best is marked."""
    heads, columns = [], []
    for column in zip(*map(figures_of, evaluations), strict=True):
        figure, values = column[0][0], [value for _, value in column]
        defined = [value for value in values if value is not None]
        best = None
        if len(defined) > 1 and figure.larger_is_better is not None:
            best = (max if figure.larger_is_better else min)(defined)
        heads.append(f"#{figure.label}")
        columns.append([(value, figure.digits, value == best is not None) for value in values])
    rows = zip(evaluations, lost, zip(*columns, strict=True), strict=True)
    return heads, [{"name": own.name, "is_lost": bad, "values": row} for own, bad, row in rows]


def difference_picture(evaluation: map_error.MapError, alignment: Alignment | None) -> Picture:
    """Return where a map differs from the truth; an alignment that was rejected is marked."""
    difference, caption, badge = evaluation.difference, ".", ""
    if alignment is not None and not alignment.accepted:
        caption, badge = f" at best: not aligned. {alignment.reason}", "not aligned"
    order = list(DIFFERENCES)
    rank = np.zeros(len(order), dtype=np.int8)
    rank[order] = np.arange(len(order), dtype=np.int8)
    figure = _codes_figure(
        rank[difference] - np.int8(1),
        [colour for _, colour in DIFFERENCES.values()],
        evaluation.resolution,
        evaluation.origin,
        CellBox(0, 0, *difference.shape),
    )
    title = f"{evaluation.name} against {evaluation.truth}"
    caption = f"Error {evaluation.error:.2f}{caption}"
    legend = dict(own for code, own in DIFFERENCES.items() if (difference == code).any())
    stem = f"difference-{evaluation.name}"
    return Picture(stem, figure, title, caption, badge=badge, legend=legend)
