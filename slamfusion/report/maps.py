"""Parts that several reports share: pictures and tables of maps, alignments and errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from slamfusion.align.records import Alignment
from slamfusion.config import NormalizeConfig
from slamfusion.evaluation import Figure, MapError, doubled_wall_share, face_figures, shown_figures
from slamfusion.evaluation.distances import sample_on_lattice
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid, known_box, trinary_cells
from slamfusion.palette import Rgb, colours_of
from slamfusion.report import plots
from slamfusion.report.canvas import LegendEntry
from slamfusion.report.page import Cell, Picture, Section, Table, number
from slamfusion.web.scene import layer_name

# An overlay of a wrong alignment may spread over far more cells than either map.
_OVERLAY_CELLS = 40_000_000
# Pairs that are drawn: with ten inputs there are 45.
_MOST_OVERLAYS = 12


def input_picture(
    grid: OccupancyGrid, normalize: NormalizeConfig, *, caption: str = "", accepted: bool = True
) -> Picture:
    """Return one input in its own frame, framed and marked if it was rejected."""
    classes = trinary_cells(grid.cells, normalize)
    size = f"{grid.width} x {grid.height} cells of {grid.resolution:g} m"
    return Picture(
        f"input-{grid.name}",
        plots.map_picture(classes, grid.resolution, grid.origin),
        grid.name,
        f"{size}. {caption}" if caption else size,
        tone="plain" if accepted else "bad",
        badge="" if accepted else "rejected",
        legend=plots.MAP_LEGEND,
    )


def input_colours(names: Sequence[str]) -> dict[str, Rgb]:
    """Return the colour of each input, as its layer has it: that of the fused map is not given.

    Args:
        names: of all inputs of the page, in their order.
    """
    layers = colours_of(layer_name(name) for name in names)
    return {name: layers[layer_name(name)] for name in names}


def pair_overlay(
    reference: OccupancyGrid,
    moving: OccupancyGrid,
    alignment: Alignment,
    normalize: NormalizeConfig,
    colours: Mapping[str, Rgb],
) -> Picture | None:
    """Return two maps over each other under an alignment, to see why it failed.

    None if they are too far apart to be drawn, or one of them is all unknown.
    """
    fixed, moved = trinary_cells(reference.cells, normalize), trinary_cells(moving.cells, normalize)
    box = _common_box(reference, fixed, moving, moved, alignment.transform)
    if box is None or box.area > _OVERLAY_CELLS:
        return None
    layers = [
        sample_on_lattice(fixed, reference, reference, box, Pose2()),
        sample_on_lattice(moved, moving, reference, box, alignment.transform),
    ]
    corner = reference.origin.transform(
        (box.col0 * reference.resolution, box.row0 * reference.resolution)
    )
    origin = Pose2(float(corner[0]), float(corner[1]), reference.origin.yaw_rad)
    return Picture(
        f"pair-{reference.name}-{moving.name}",
        plots.overlay_picture(
            layers,
            [colours[grid.name] for grid in (reference, moving)],
            reference.resolution,
            origin,
        ),
        f"{moving.name} on {reference.name}",
        f"The best alignment found. {alignment.reason}",
        tone="plain" if alignment.accepted else "bad",
        badge="" if alignment.accepted else "rejected",
        legend=tuple(LegendEntry(grid.name, colours[grid.name]) for grid in (reference, moving)),
    )


def pairs_section(
    grids: Sequence[OccupancyGrid], pairs: Sequence[Alignment], normalize: NormalizeConfig
) -> Section:
    """Return the pairs that were tried if nothing was fused: first overlays, a table of all."""
    by_name = {grid.name: grid for grid in grids}
    colours = input_colours(list(by_name))
    overlays = [
        pair_overlay(by_name[pair.reference], by_name[pair.moving], pair, normalize, colours)
        for pair in pairs[:_MOST_OVERLAYS]
        if pair.reference in by_name and pair.moving in by_name
    ]
    return Section(
        "Pairs",
        "Each pair under the best alignment found. Walls of both maps are black.",
        [overlay for overlay in overlays if overlay is not None],
        alignment_table("All pairs", pairs),
    )


def yaw_pictures(alignments: Sequence[Alignment]) -> list[Picture]:
    """Return the score over yaw of every alignment that kept it."""
    return [
        Picture(
            f"yaw-{alignment.moving}-{alignment.reference}",
            plots.yaw_picture(alignment),
            f"{alignment.moving} on {alignment.reference}",
            alignment.reason,
            tone="plain" if alignment.accepted else "bad",
            badge="" if alignment.accepted else "rejected",
        )
        for alignment in alignments
        if alignment.yaw_profile is not None and len(alignment.yaw_profile)
    ]


def alignment_table(
    title: str, alignments: Sequence[Alignment], *, folded: bool = False
) -> list[Table]:
    """Return a table of the transforms with their measures; none without alignments."""
    if not alignments:
        return []
    note = (
        "A transform maps a point of the moving map's frame into the reference's. Runner-up: score "
        "of the best distinct rival over the answer's; near 1, the place looks alike under both."
    )
    return [
        Table.of(
            title,
            alignments,
            {
                "moving": lambda own: own.moving,
                "reference": lambda own: own.reference,
                "": accepted_cell,
                "dx [m]": lambda own: number(own.transform.x),
                "dy [m]": lambda own: number(own.transform.y),
                "yaw [°]": lambda own: number(
                    math.degrees(math.remainder(own.transform.yaw_rad, 2 * math.pi)), 2
                ),
                "score": lambda own: number(own.score),
                "overlap": lambda own: number(own.overlap),
                "error [F16]": lambda own: number(own.error, 1),
                "runner-up ratio": lambda own: number(
                    own.runner_up.ratio if own.runner_up else None, 2
                ),
                "time [s]": lambda own: number(own.time_s, 2),
                "reason": lambda own: own.reason,
            },
            note,
            folded=folded,
        )
    ]


def accepted_cell(alignment: Alignment) -> Cell:
    """Return whether an alignment is accepted, and how good it is; a weak one is not green."""
    if not alignment.accepted:
        return Cell("rejected", "bad")
    strength = alignment.strength
    words = "accepted" if strength is None else f"accepted: {strength}"
    return Cell(words, "plain" if strength == "weak" else "good")


def statistics_table(
    grids: Sequence[OccupancyGrid],
    normalize: NormalizeConfig,
    doubled: Mapping[str, float] | None = None,
) -> Table:
    """Return size, known area and walls of maps, with their share of doubled walls.

    Args:
        doubled: the shares by name, where they are known already; others are found.
    """
    shares = doubled or {}

    def area_m2(grid: OccupancyGrid) -> float:
        known = np.count_nonzero(trinary_cells(grid.cells, normalize) != -1)
        return int(known) * grid.resolution**2

    def doubled_percent(grid: OccupancyGrid) -> float:
        known = shares.get(grid.name)
        found = doubled_wall_share(grid, normalize=normalize) if known is None else known
        return 100.0 * found

    return Table.of(
        "The maps in numbers",
        grids,
        {
            "map": lambda grid: grid.name,
            "cells": lambda grid: Cell(f"{grid.width} x {grid.height}", is_number=True),
            "cell [m]": lambda grid: number(grid.resolution),
            "known [m²]": lambda grid: number(area_m2(grid), 1),
            "wall cells": lambda grid: int((trinary_cells(grid.cells, normalize) == 1).sum()),
            "doubled walls [%]": lambda grid: number(doubled_percent(grid), 1),
        },
        "Doubled walls: wall cells with a parallel wall 2 to 8 cells away, the trace of a slip; "
        "thin furniture and double partitions count too, so compare maps of one place.",
    )


def error_section(
    evaluations: Sequence[MapError], alignments: Sequence[Alignment | None] = ()
) -> Section:
    """Return the errors against the truth, as a table and as pictures of the difference.

    Args:
        evaluations: one per map, all against one truth.
        alignments: the alignment with the truth that each rests on, in the same order; None for
            a map that was not moved. May be empty.
    """
    placed = list(alignments) or [None] * len(evaluations)
    pictures = [difference_picture(*pair) for pair in zip(evaluations, placed, strict=True)]
    return Section(
        "Error against the truth",
        "Each map on the lattice of the truth, over the truth's known box. The error is that of "
        "Fernandes and Alexandre 2016: the root of the summed squared differences with unknown -1, "
        "free 0 and wall 1.",
        pictures=pictures,
        tables=[
            _error_table(
                "Errors",
                evaluations,
                shown_figures,
                f"Walls count as right or found within {evaluations[0].tolerance_m:g} m. Distances "
                "are means from each wall cell to the nearest one of the other map.",
                placed,
            ),
            _error_table(
                "Faces of walls",
                evaluations,
                face_figures,
                "Faces are wall cells that share a side with a free cell. Outside is the area that "
                "the map knows beyond the truth's outline.",
                placed,
            ),
        ],
    )


def difference_picture(evaluation: MapError, alignment: Alignment | None) -> Picture:
    """Return where a map differs from the truth; an alignment that was rejected is marked."""
    is_placed = alignment is None or alignment.accepted
    caption = f"Error {evaluation.error:.2f}."
    if alignment is not None and not is_placed:
        caption = f"Error {evaluation.error:.2f} at best: not aligned. {alignment.reason}"
    colours = plots.DIFFERENCE_COLOURS.items()
    return Picture(
        f"difference-{evaluation.name}",
        plots.difference_picture(evaluation.difference, evaluation.resolution, evaluation.origin),
        f"{evaluation.name} against {evaluation.truth}",
        caption,
        tone="plain" if is_placed else "bad",
        badge="" if is_placed else "not aligned",
        legend=tuple(
            LegendEntry(*entry) for code, entry in colours if (evaluation.difference == code).any()
        ),
    )


def _error_table(
    title: str,
    evaluations: Sequence[MapError],
    figures_of: Callable[[MapError], Sequence[tuple[Figure, float | None]]],
    note: str,
    alignments: Sequence[Alignment | None],
) -> Table:
    """Return measures, a row for each map; the best of each column is marked."""
    heads, rows = ["map"], [[Cell(item.name)] for item in evaluations]
    for row, alignment in zip(rows, alignments, strict=True):
        if alignment is not None and not alignment.accepted:
            row[0] = Cell(f"{row[0].text} (not aligned)", "bad")
    for column in zip(*map(figures_of, evaluations), strict=True):
        figure, values = column[0][0], [value for _, value in column]
        defined = [value for value in values if value is not None]
        best = None
        if len(defined) > 1 and figure.larger_is_better is not None:
            best = (max if figure.larger_is_better else min)(defined)
        heads.append(figure.label)
        for row, value in zip(rows, values, strict=True):
            tone = "best" if value == best is not None else "plain"
            row.append(number(value, figure.digits, tone))
    return Table(title, heads, rows, f"{note} The best of each column is green.")


def _common_box(
    reference: OccupancyGrid,
    fixed: npt.NDArray[np.int8],
    moving: OccupancyGrid,
    moved: npt.NDArray[np.int8],
    transform: Pose2,
) -> CellBox | None:
    """Return the box of the reference's lattice that holds what both maps know."""
    own, other = known_box(fixed), known_box(moved)
    if own is None or other is None:
        return None
    corners = moving.resolution * np.array(
        [
            (other.col0, other.row0),
            (other.col1, other.row0),
            (other.col0, other.row1),
            (other.col1, other.row1),
        ],
        dtype=np.float64,
    )
    rows, cols = reference.cell_indices(transform.transform(moving.origin.transform(corners)))
    return CellBox(
        min(own.row0, int(rows.min())),
        min(own.col0, int(cols.min())),
        max(own.row1, int(rows.max()) + 1),
        max(own.col1, int(cols.max()) + 1),
    )
