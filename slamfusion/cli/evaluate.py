"""``slamfusion evaluate``: how far maps are from the truth, or from measured distances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.options import FILE, common_options, map_resolution_option, with_config
from slamfusion.cli.output import notice, number, print_json, print_table, progress_bar
from slamfusion.cli.table_files import table_option
from slamfusion.config import RunConfig
from slamfusion.jobs.inputs import check_writable, device_for, load_maps

if TYPE_CHECKING:
    from slamfusion.evaluation import DistanceComparison
    from slamfusion.jobs.evaluate import Evaluation

__all__ = ["command", "print_evaluations"]


@click.command("evaluate")
@click.argument("maps", nargs=-1, required=True, type=FILE)
@click.option(
    "--truth",
    "truth_path",
    type=FILE,
    metavar="MAP",
    help="The true map.",
)
@click.option(
    "--align/--no-align",
    default=True,
    help="Align each map with the truth first, or take both frames for the same. [default: align]",
)
@click.option(
    "--distances",
    "distances_path",
    type=FILE,
    metavar="FILE",
    help="Compare distances measured in the building with the map's (CSV or YAML).",
)
@click.option(
    "--report",
    "report_dir",
    type=FILE,
    metavar="DIR",
    help="Write a self-contained HTML report with its pictures here.",
)
@click.option(
    "--image",
    "image_path",
    type=FILE,
    metavar="FILE",
    help="Write the difference image of the map here; several maps add their names.",
)
@map_resolution_option
@with_config("fusion.normalize", "fusion.align", "map_files", "evaluate", "device", "")
@common_options
@table_option
def command(
    maps: tuple[Path, ...],
    truth_path: Path | None,
    align: bool,
    distances_path: Path | None,
    report_dir: Path | None,
    image_path: Path | None,
    resolution: float | None,
    config: RunConfig,
    as_json: bool,
) -> int:
    """Measure the error of MAPS against the truth, or against measured distances."""
    from slamfusion.jobs.evaluate import (  # noqa: PLC0415
        evaluate_document,
        evaluate_maps,
        measure_distances,
        write_evaluation,
    )

    _check_request(truth_path, distances_path, report_dir, image_path)
    grids = load_maps(maps, resolution, config.map_files, notice)
    evaluations: Sequence[Evaluation] = ()
    device = None
    if truth_path is not None:
        (truth,) = load_maps([truth_path], resolution, config.map_files, notice)
        computes = device_for(config)
        device = computes.name
        with progress_bar() as progress:
            evaluations = evaluate_maps(
                grids, truth, config, computes, align=align, progress=progress
            )
    distances = () if distances_path is None else measure_distances(grids, distances_path, config)
    write_evaluation(evaluations, config, device=device or "", report=report_dir, image=image_path)
    for evaluation in evaluations:
        if evaluation.alignment is not None and not evaluation.is_aligned:
            notice(f"not aligned: {evaluation.error.name}: {evaluation.alignment.reason}")
    if as_json:
        print_json(
            evaluate_document(evaluations, distances, config, truth=truth_path, device=device)
        )
    else:
        if evaluations:
            print_evaluations(evaluations)
        for comparison in distances:
            _print_distances(comparison)
    return 0


def _check_request(
    truth_path: Path | None,
    distances_path: Path | None,
    report_dir: Path | None,
    image_path: Path | None,
) -> None:
    """Refuse what cannot be done before any work."""
    if truth_path is None and distances_path is None:
        message = "give --truth MAP, --distances FILE, or both"
        raise click.UsageError(message)
    if truth_path is None and (report_dir or image_path):
        message = "--report and --image show the difference to a truth; give --truth MAP"
        raise click.UsageError(message)
    if image_path is not None and image_path.suffix.lower() != ".png":
        message = f"--image writes a PNG; call it {image_path.with_suffix('.png')}"
        raise click.UsageError(message)
    for folder in (report_dir, None if image_path is None else image_path.parent):
        if folder is not None:
            import slamfusion.report  # noqa: F401, PLC0415  (says early when its extra is missing)

            check_writable(folder)


def print_evaluations(evaluations: Sequence[Evaluation]) -> None:
    """Print one row of measures for each map."""
    rows = []
    for evaluation in evaluations:
        error = evaluation.error
        outward, back = error.map_to_truth, error.truth_to_map
        rows.append(
            [
                error.name,
                "yes" if evaluation.is_aligned else "NO",
                number(error.error, 2),
                number(error.wall_precision),
                number(error.wall_recall),
                number(error.wall_f1),
                number(error.iou_occupied),
                number(error.iou_free),
                number(None if outward is None else outward.mean_m),
                number(None if back is None else back.mean_m),
                number(error.ssim),
                number(error.coverage),
            ]
        )
    columns = (
        "map ",
        "aligned ",
        "error",
        "wall precision",
        "recall",
        "F1",
        "IoU wall",
        "IoU free",
        "to truth m",
        "from truth m",
        "SSIM",
        "coverage",
    )
    tolerance = evaluations[0].error.tolerance_m
    title = f"Error against {evaluations[0].error.truth} (walls within {tolerance:g} m)"
    print_table(columns, rows, title=title)
    _print_faces(evaluations)


def _print_faces(evaluations: Sequence[Evaluation]) -> None:
    """Print the measures that reward no thickness, one row for each map."""
    rows = []
    for evaluation in evaluations:
        error, faces, thickness = (
            evaluation.error,
            evaluation.error.faces,
            evaluation.error.wall_thickness,
        )
        outward, back = faces.map_to_truth, faces.truth_to_map
        rows.append(
            [
                error.name,
                *(number(agreement.f1) for agreement in faces.agreements),
                number(None if outward is None else outward.mean_m),
                number(None if back is None else back.mean_m),
                number(None if thickness is None else thickness.mean_m),
                number(error.doubled_wall_share),
                number(error.outside_m2, 1),
            ]
        )
    tolerances = [item.tolerance_m for item in evaluations[0].error.faces.agreements]
    columns = (
        "map ",
        *(f"faces F1 {tolerance_m:g} m" for tolerance_m in tolerances),
        "to truth m",
        "from truth m",
        "thickness m",
        "doubled",
        "outside m2",
    )
    title = "Faces of walls (wall cells beside free ones), which reward no thickness"
    print_table(columns, rows, title=title)


def _print_distances(comparison: DistanceComparison) -> None:
    """Print each measured distance beside the map's."""
    rows = [
        [
            row.measured.name,
            number(row.measured.distance_m),
            number(row.map_m),
            number(row.error_m),
            number(row.error_percent, 1),
        ]
        for row in comparison.rows
    ]
    columns = ("distance ", "measured m", "map m", "error m", "error %")
    print_table(
        columns,
        rows,
        notes=[row.reason for row in comparison.rows],
        title=f"Measured distances in {comparison.name}",
    )
    print(f"mean absolute error: {number(comparison.mean_absolute_error_m)} m")
