"""Parts that several reports share: pictures and tables of maps, alignments and errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from slamfusion.align.records import Alignment
from slamfusion.config import NormalizeConfig
from slamfusion.evaluation import MapError, doubled_wall_share
from slamfusion.evaluation.cells import sample_on_lattice
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid, known_box, trinary_cells
from slamfusion.palette import Rgb, colours_of
from slamfusion.report import plots
from slamfusion.report.page import Cell, LegendEntry, Picture, Section, Table, number
from slamfusion.viewer.scene import layer_name

# An overlay of a wrong alignment may spread over far more cells than either map.
_OVERLAY_CELLS = 40_000_000


def input_picture(
    grid: OccupancyGrid, normalize: NormalizeConfig, *, caption: str = "", accepted: bool = True
) -> Picture:
    """Return one input as it was given, framed and marked when it was rejected."""
    classes = trinary_cells(grid.cells, normalize)
    size = f"{grid.width} x {grid.height} cells of {grid.resolution:g} m"
    return Picture(
        f"input-{grid.name}",
        plots.map_picture(classes, grid.resolution, grid.origin),
        grid.name,
        f"{size}. {caption}" if caption else size,
        tone="plain" if accepted else "bad",
        badge="" if accepted else "rejected",
    )


def input_colours(names: Sequence[str]) -> dict[str, Rgb]:
    """Return the colour of each input, as its layer has it: that of the fused map is not given.

    Args:
        names: of all inputs of the page, in their order.
    """
    layers = colours_of(layer_name(name) for name in names)
    return {name: layers[layer_name(name)] for name in names}


def layer_legend(names: Sequence[str], colours: Mapping[str, Rgb]) -> tuple[LegendEntry, ...]:
    """Return the colours of an overlay's layers with their names."""
    return tuple(LegendEntry(name, colours[name]) for name in names)


def pair_overlay(
    reference: OccupancyGrid,
    moving: OccupancyGrid,
    alignment: Alignment,
    normalize: NormalizeConfig,
    colours: Mapping[str, Rgb],
) -> Picture | None:
    """Return two maps laid over each other as one alignment would have it, to see why it failed.

    None when they would lie too far apart to be drawn, or one of them is all unknown.
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
        legend=layer_legend((reference.name, moving.name), colours),
    )


def pairs_section(
    grids: Sequence[OccupancyGrid],
    pairs: Sequence[Alignment],
    normalize: NormalizeConfig,
    *,
    most_overlays: int,
) -> Section:
    """Return the pairs that were tried where nothing was fused: overlays of the first, and all.

    Args:
        grids: the inputs.
        pairs: every pair that was aligned.
        normalize: what counts as wall and as free.
        most_overlays: with ten inputs there are 45 pairs.
    """
    by_name = {grid.name: grid for grid in grids}
    colours = input_colours(list(by_name))
    overlays = [
        pair_overlay(by_name[pair.reference], by_name[pair.moving], pair, normalize, colours)
        for pair in pairs[:most_overlays]
        if pair.reference in by_name and pair.moving in by_name
    ]
    return Section(
        "Pairs",
        "pairs",
        "Each pair laid over each other under the best alignment that was found. Where both maps "
        "have a wall it is black.",
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
    """Return the transforms with their measures, and the decision's own numbers, folded."""
    if not alignments:
        return []
    columns = (
        "moving",
        "reference",
        "",
        "dx m",
        "dy m",
        "yaw °",
        "score",
        "overlap",
        "error [F16]",
        "runner-up ratio",
        "time s",
        "reason",
    )
    rows = []
    for alignment in alignments:
        transform, rival = alignment.transform, alignment.runner_up
        rows.append(
            [
                Cell(alignment.moving),
                Cell(alignment.reference),
                accepted_cell(alignment),
                number(transform.x),
                number(transform.y),
                number(math.degrees(math.remainder(transform.yaw_rad, 2 * math.pi)), 2),
                number(alignment.score),
                number(alignment.overlap),
                number(alignment.error, 1),
                number(rival.ratio if rival else None, 2),
                number(alignment.time_s, 2),
                Cell(alignment.reason),
            ]
        )
    note = (
        "A transform maps a point of the moving map's frame into the reference's. Runner-up: score "
        "of the best distinct rival over the answer's; near 1, the place looks alike under both."
    )
    tables = [Table(title, columns, rows, note, folded=folded)]
    with_numbers = [item for item in alignments if item.statistics]
    if with_numbers:
        keys = sorted({key for item in with_numbers for key in item.statistics})
        tables.append(
            Table(
                f"{title}: the numbers of the decision",
                ("number", *(f"{item.moving} on {item.reference}" for item in with_numbers)),
                [
                    [Cell(key), *(_statistic(item.statistics.get(key)) for item in with_numbers)]
                    for key in keys
                ],
                folded=True,
            )
        )
    return tables


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
        grids: the maps.
        normalize: what counts as wall and as free.
        doubled: the shares by name, where they are known already; others are found.
    """
    shares = doubled or {}
    rows = []
    for grid in grids:
        classes = trinary_cells(grid.cells, normalize)
        known = int(np.count_nonzero(classes != -1))
        share = shares[grid.name] if grid.name in shares else doubled_wall_share(classes == 1)
        rows.append(
            [
                Cell(grid.name),
                Cell(f"{grid.width} x {grid.height}", is_number=True),
                number(grid.resolution),
                number(known * grid.resolution**2, 1),
                Cell(f"{int(np.count_nonzero(classes == 1)):d}", is_number=True),
                number(100 * share, 1),
            ]
        )
    return Table(
        "The maps in numbers",
        ("map", "cells", "cell m", "known m²", "wall cells", "doubled walls %"),
        rows,
        "Doubled walls: wall cells with a parallel wall 2 to 8 cells away, the trace of a map laid "
        "over itself with a slip; thin furniture and double partitions count too, so compare maps "
        "of one place.",
    )


def error_section(
    evaluations: Sequence[MapError], alignments: Sequence[Alignment | None] = ()
) -> Section:
    """Return the errors against the truth, as a table and as pictures of the difference.

    Args:
        evaluations: one per map, all against one truth.
        alignments: the alignment with the truth that each rests on, in the same order; None for
            a map that was taken as it lies. May be empty.
    """
    placed = list(alignments) or [None] * len(evaluations)
    legend = tuple(
        LegendEntry(text, rgb)
        for code, (text, rgb) in plots.DIFFERENCE_COLOURS.items()
        if any((evaluation.difference == code).any() for evaluation in evaluations)
    )
    pictures = []
    for evaluation, alignment in zip(evaluations, placed, strict=True):
        is_placed = alignment is None or alignment.accepted
        pictures.append(
            Picture(
                f"difference-{evaluation.name}",
                plots.difference_picture(
                    evaluation.difference, evaluation.resolution, evaluation.origin
                ),
                f"{evaluation.name} against {evaluation.truth}",
                f"Error {evaluation.error:.2f}."
                if is_placed or alignment is None
                else f"Error {evaluation.error:.2f} at best: not aligned. {alignment.reason}",
                tone="plain" if is_placed else "bad",
                badge="" if is_placed else "not aligned",
                legend=legend,
            )
        )
    return Section(
        "Error against the truth",
        "errors",
        "Each map on the lattice of the truth, over the truth's known box. The error is that of "
        "Fernandes and Alexandre 2016: the root of the summed squared differences with unknown -1, "
        "free 0 and wall 1.",
        pictures=pictures,
        tables=[_error_table(evaluations, placed), _face_table(evaluations)],
    )


# Heading, digits, whether larger is better, and the value of each map.
_Measure = tuple[str, int, bool, list[float | None]]


def _error_table(evaluations: Sequence[MapError], alignments: Sequence[Alignment | None]) -> Table:
    """Return all measures with the best of each column marked."""
    measures: list[_Measure] = [
        ("error [F16]", 2, False, [item.error for item in evaluations]),
        ("wall precision", 3, True, [item.wall_precision for item in evaluations]),
        ("wall recall", 3, True, [item.wall_recall for item in evaluations]),
        ("wall F1", 3, True, [item.wall_f1 for item in evaluations]),
        ("IoU walls", 3, True, [item.iou_occupied for item in evaluations]),
        ("IoU free", 3, True, [item.iou_free for item in evaluations]),
        (
            "map wall to true m",
            3,
            False,
            [item.map_to_truth_m.mean if item.map_to_truth_m else None for item in evaluations],
        ),
        (
            "true wall to map m",
            3,
            False,
            [item.truth_to_map_m.mean if item.truth_to_map_m else None for item in evaluations],
        ),
        ("SSIM", 3, True, [item.ssim for item in evaluations]),
        ("coverage", 3, True, [item.coverage for item in evaluations]),
    ]
    rows = _measure_rows(evaluations, measures)
    for row, alignment in zip(rows, alignments, strict=True):
        if alignment is not None and not alignment.accepted:
            row[0] = Cell(f"{row[0].text} (not aligned)", "bad")
    tolerance = evaluations[0].tolerance_m if evaluations else 0.0
    return Table(
        "Errors",
        ("map", *(heading for heading, *_ in measures)),
        rows,
        f"Walls count as right or found within {tolerance:g} m. Distances are means from each wall "
        "cell to the nearest one of the other map. The best of each column is green.",
    )


def _face_table(evaluations: Sequence[MapError]) -> Table:
    """Return the measures that reward no thickness with the best of each column marked."""
    agreements = evaluations[0].faces.agreements if evaluations else ()
    measures: list[_Measure] = [
        (
            f"faces F1 {agreement.tolerance_m:g} m",
            3,
            True,
            [item.faces.agreements[index].f1 for item in evaluations],
        )
        for index, agreement in enumerate(agreements)
    ]
    outward = [item.faces.map_to_truth_m for item in evaluations]
    back = [item.faces.truth_to_map_m for item in evaluations]
    measures += [
        ("face to true m", 3, False, [item.mean if item else None for item in outward]),
        ("true face to map m", 3, False, [item.mean if item else None for item in back]),
        ("doubled walls", 3, False, [item.doubled_wall_share for item in evaluations]),
        ("outside m\N{SUPERSCRIPT TWO}", 1, False, [item.outside_m2 for item in evaluations]),
    ]
    rows = _measure_rows(evaluations, measures)
    # No thickness is the best one: it is told, and none is marked.
    for row, item in zip(rows, evaluations, strict=True):
        row.append(number(item.wall_thickness_m.mean if item.wall_thickness_m else None, 3))
    return Table(
        "Faces of walls",
        ("map", *(heading for heading, *_ in measures), "wall thickness m"),
        rows,
        "Faces are the wall cells that share a side with a free cell, so what is filled behind a "
        "wall counts for nothing. Outside is the area that the map knows beyond the truth's "
        "outline. The best of each column is green.",
    )


def _measure_rows(
    evaluations: Sequence[MapError], measures: Sequence[_Measure]
) -> list[list[Cell]]:
    """Return a row of measures for each map, with the best of each column marked."""
    rows = [[Cell(item.name)] for item in evaluations]
    for _, digits, larger_is_better, values in measures:
        defined = [value for value in values if value is not None]
        best = (max if larger_is_better else min)(defined) if len(defined) > 1 else None
        for row, value in zip(rows, values, strict=True):
            row.append(number(value, digits, "best" if value == best is not None else "plain"))
    return rows


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


def _statistic(value: float | None) -> Cell:
    """Return a number of unknown scale."""
    return Cell("-" if value is None else f"{value:.4g}", is_number=True)
