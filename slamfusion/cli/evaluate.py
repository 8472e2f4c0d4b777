"""``slamfusion evaluate``: how far maps are from the truth, or from measured distances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.inputs import check_writable, load_maps
from slamfusion.cli.options import common_options, map_resolution_option, with_config
from slamfusion.cli.output import (
    Progress,
    notice,
    number,
    path_text,
    print_json,
    print_table,
    progress_bar,
    versions,
)
from slamfusion.config import RunConfig, to_mapping
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid

if TYPE_CHECKING:
    from slamfusion.compute import ComputeDevice
    from slamfusion.evaluation import DistanceComparison, MapError
    from slamfusion.fusion.records import Alignment
    from slamfusion.jobs.records import EvaluateDocument, EvaluationJson

__all__ = ["Evaluation", "command", "evaluate_maps", "print_evaluations"]


@dataclass(frozen=True)
class Evaluation:
    """A map's errors, and the alignment with the truth that they rest on (None: as it lies)."""

    error: MapError
    alignment: Alignment | None

    @property
    def is_aligned(self) -> bool:
        """Whether the alignment may be believed; a map taken as it lies counts as aligned."""
        return self.alignment is None or self.alignment.accepted

    def to_json(self) -> EvaluationJson:
        """Return the errors with ``aligned`` and the alignment's record."""
        return {
            **self.error.to_json(),
            "aligned": self.is_aligned,
            "alignment": None if self.alignment is None else self.alignment.to_json(),
        }


def evaluate_maps(
    grids: Sequence[OccupancyGrid],
    truth: OccupancyGrid,
    config: RunConfig,
    device: ComputeDevice,
    *,
    align: bool = True,
    progress: Progress | None = None,
) -> list[Evaluation]:
    """Compare each map with the truth, aligned first.

    A map whose alignment is rejected is measured at the best transform found all the same; its
    error is then the least it can claim, and ``is_aligned`` says so.
    """
    from slamfusion.evaluation import compare_to_truth  # noqa: PLC0415
    from slamfusion.fusion import align_grids  # noqa: PLC0415

    evaluations = []
    for done, grid in enumerate(grids):
        if progress is not None:
            progress("evaluate", done, len(grids))
        alignment = align_grids(truth, grid, config.fusion, device) if align else None
        error = compare_to_truth(
            grid,
            truth,
            Pose2() if alignment is None else alignment.transform,
            normalize=config.fusion.normalize,
            tolerance_m=config.evaluate.tolerance_m,
        )
        evaluations.append(Evaluation(error, alignment))
    if progress is not None:
        progress("evaluate", len(grids), len(grids))
    return evaluations


@click.command("evaluate")
@click.argument("maps", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--truth",
    "truth_path",
    type=click.Path(path_type=Path),
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
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Compare distances measured in the building with the map's (CSV or YAML).",
)
@click.option(
    "--report",
    "report_dir",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Write a self-contained HTML report with its pictures here.",
)
@click.option(
    "--image",
    "image_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write the difference image of the map here; several maps add their names.",
)
@map_resolution_option
@with_config("fusion.normalize", "fusion.align", "map_files", "evaluate", "device", "")
@common_options
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
    _check_request(truth_path, distances_path, report_dir, image_path)
    grids = load_maps(maps, resolution, config.map_files)

    evaluations: list[Evaluation] = []
    device = None
    if truth_path is not None:
        from slamfusion.compute import open_device  # noqa: PLC0415

        truth = load_maps([truth_path], resolution, config.map_files)[0]
        backend = open_device(config.device.device)
        device = backend.name
        with progress_bar() as progress:
            evaluations = evaluate_maps(
                grids, truth, config, backend, align=align, progress=progress
            )
    comparisons = _compare_distances(grids, distances_path, config)
    _write_pictures(evaluations, report_dir, image_path, config, device or "")

    for evaluation in evaluations:
        if evaluation.alignment is not None and not evaluation.is_aligned:
            notice(f"not aligned: {evaluation.error.name}: {evaluation.alignment.reason}")
    if as_json:
        document: EvaluateDocument = {
            "maps": [evaluation.to_json() for evaluation in evaluations],
            "distances": [comparison.to_json() for comparison in comparisons],
            "truth": path_text(truth_path),
            "device": device,
            "seed": config.seed,
            "config": to_mapping(config),
            "versions": versions(),
        }
        print_json(document)
    else:
        if evaluations:
            print_evaluations(evaluations)
        for comparison in comparisons:
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


def _compare_distances(
    grids: Sequence[OccupancyGrid], path: Path | None, config: RunConfig
) -> list[DistanceComparison]:
    from slamfusion.evaluation import compare_distances  # noqa: PLC0415

    if path is None:
        return []
    normalize = config.fusion.normalize
    return [compare_distances(grid, path, normalize=normalize) for grid in grids]


def _write_pictures(
    evaluations: Sequence[Evaluation],
    report_dir: Path | None,
    image_path: Path | None,
    config: RunConfig,
    device: str,
) -> None:
    """Write the report and the difference images that were asked for."""
    errors = [evaluation.error for evaluation in evaluations]
    if report_dir is not None:
        from slamfusion.report import write_evaluation_report  # noqa: PLC0415

        alignments = [evaluation.alignment for evaluation in evaluations]
        write_evaluation_report(
            errors, report_dir, config=config, alignments=alignments, device=device
        )
    if image_path is not None:
        from slamfusion.report.evaluation_report import (  # noqa: PLC0415
            write_difference_image,
        )

        for error in errors:
            path = image_path
            if len(errors) > 1:
                name = f"{image_path.stem}_{error.name.replace('/', '_')}{image_path.suffix}"
                path = image_path.with_name(name)
            write_difference_image(error, path)


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


def _print_distances(comparison: DistanceComparison) -> None:
    """Print each measured distance beside the map's."""
    rows = [
        [
            row.measured.name,
            number(row.measured.distance_m),
            number(row.map_m),
            number(row.error_m),
            number(row.error_percent, 1),
            row.reason,
        ]
        for row in comparison.rows
    ]
    columns = ("distance ", "measured m", "map m", "error m", "error %", "note ")
    print_table(columns, rows, title=f"Measured distances in {comparison.name}")
    print(f"mean absolute error: {number(comparison.mean_absolute_error_m)} m")
