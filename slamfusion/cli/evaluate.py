"""``slamfusion evaluate``: how far maps are from the truth, or from measured distances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.help import Command
from slamfusion.cli.options import (
    case_option,
    check_picture,
    check_report,
    common_options,
    file_option,
    map_resolution_option,
    output_option,
    report_option,
    truth_scale_option,
    with_config,
)
from slamfusion.cli.output import is_verbose, notice, print_json, print_table, progress_bar
from slamfusion.cli.paths import CASE_MAP
from slamfusion.cli.results import (
    print_items,
    print_repetitions,
    results_option,
    save_results,
    table_option,
)
from slamfusion.cli.tables import print_evaluations, tell_left_out, tell_unaligned
from slamfusion.config import RunConfig
from slamfusion.jobs.cases import CaseFile, Placed, case_names, place_files
from slamfusion.jobs.documents import number
from slamfusion.jobs.inputs import (
    PixelSizes,
    device_for,
    distinct_names,
    load_maps,
    load_truth,
    map_file,
)

if TYPE_CHECKING:
    from slamfusion.evaluation import DistanceComparison
    from slamfusion.grid import OccupancyGrid
    from slamfusion.jobs.evaluate import CasesEvaluationDocument, EvaluateDocument
    from slamfusion.jobs.records import Evaluation


@dataclass(frozen=True)
class _Request:
    """The request, without the settings."""

    maps: tuple[CaseFile, ...]
    truths: tuple[CaseFile, ...]
    align: bool
    scale: PixelSizes | None
    distances_path: Path | None
    report_dir: Path | None
    image_path: Path | None
    resolution: float | None
    results_path: Path | None
    as_json: bool

    @property
    def paths(self) -> list[Path]:
        """The maps' files."""
        return [item.path for item in self.maps]

    @property
    def is_mutual(self) -> bool:
        """Whether the maps are compared with each other alone."""
        return not self.truths and self.distances_path is None

    def check(self) -> None:
        """Refuse what cannot be done before any work."""
        if self.is_mutual and len(self.maps) < 2:
            message = "give --truth MAP, --distances FILE, or more maps to compare with each other"
            raise click.UsageError(message)
        if self.is_mutual and self.results_path:
            message = "--save-results needs --truth MAP or --distances FILE"
            raise click.UsageError(message)
        if not self.truths and (self.report_dir or self.image_path):
            message = "--report and --image need --truth MAP"
            raise click.UsageError(message)
        if self.scale is not None and not self.align:
            message = "--scale searches where the maps lie on the plan; leave --no-align out"
            raise click.UsageError(message)
        check_picture("--image", self.image_path)
        check_report(self.report_dir)


def _report_folders(folder: Path, given: Mapping[str, Any]) -> list[Path]:
    truths = given["truths"]
    return [folder] if len(truths) < 2 else [folder / case for case in case_names(truths)]


def _image_files(image: Path, given: Mapping[str, Any]) -> list[Path]:
    """Return the difference images that may be written: of several maps with their names."""
    from slamfusion.jobs.evaluate import difference_images  # noqa: PLC0415

    maps, truths = given["maps"], given["truths"]
    if len(truths) < 2:
        names = distinct_names([map_file(item.path) for item in maps])
        return [image] if len(maps) == 1 else difference_images(image, names)
    placed = place_files(case_names(truths), maps)
    return difference_images(image, [f"{item.case}_{item.method}" for item in placed])


@click.command(
    "evaluate",
    cls=Command,
    examples=[
        "evaluate out/*.yaml --truth truth.yaml",
        "evaluate map.yaml --distances measured.csv",
        "evaluate a.yaml b.yaml c.yaml            (compares them with each other)",
    ],
)
@click.argument("maps", metavar="MAP...", nargs=-1, required=True, type=CASE_MAP)
@case_option("--truth", "truths", "MAP", "The true map.", CASE_MAP)
@truth_scale_option
@click.option(
    "--align/--no-align",
    default=True,
    help="Align each map with the truth first, or use both maps as they are. [default: align]",
)
@file_option(
    "--distances",
    "distances_path",
    "FILE",
    "Distances measured in the building (CSV or YAML), to compare with the map.",
)
@report_option("report_dir", _report_folders)
@output_option(
    "--image",
    "image_path",
    files=_image_files,
    metavar="FILE",
    help="Write an image of the differences. Several maps add their names.",
)
@map_resolution_option
@with_config("fusion.normalize", "fusion.align", "map_files", "evaluate", "report", "device", "")
@common_options
@results_option
@table_option
def command(config: RunConfig, **asked: Any) -> int:
    """Measure the errors of maps.

    Each MAP is compared with the true map, or with measured distances. Without both, the maps are
    compared with each other.

    With several truths, a map belongs to the truth whose name is a word of its file name or
    folder: graph/office.yaml and office_graph.yaml belong to office.yaml. CASE=MAP overrides that.
    One table then shows all maps and the mean of each method. Each truth gets its own report.
    """
    request = _Request(**asked)
    request.check()
    return (_compare if request.is_mutual else _evaluate)(request, config)


def _evaluate(request: _Request, config: RunConfig) -> int:
    """Measure maps, each against the truth of its case, or measured distances alone."""
    from slamfusion.jobs.evaluate import (  # noqa: PLC0415
        cases_document,
        distance_rows,
        evaluate_document,
        evaluation_rows,
        measure_distances,
    )

    cases = case_names(request.truths)
    files = {case: item.path for case, item in zip(cases, request.truths, strict=True)}
    placed = place_files(cases, request.maps) if cases else []
    grids = load_maps(request.paths, request.resolution, config.map_files, notice, measured=True)
    evaluations, device = _compare_with_truths(request, config, grids, placed, files)
    distances: Sequence[DistanceComparison] = ()
    if request.distances_path is not None:
        distances = measure_distances(grids, request.distances_path, config)
    _write_cases(request, placed, evaluations, config, device or "")
    tell_unaligned(evaluations)
    rows = evaluation_rows(placed, evaluations)
    document: EvaluateDocument | CasesEvaluationDocument
    if len(cases) > 1:
        document = cases_document(
            placed, evaluations, distances, config, truths=files, device=device or ""
        )
    else:
        truth = next(iter(files.values()), None)
        document = evaluate_document(evaluations, distances, config, truth=truth, device=device)
    save_results(
        request.results_path,
        document,
        [*rows, *distance_rows(request.maps, distances)],
        lambda: _inputs(request, files),
    )
    if request.as_json:
        print_json(document)
        return 0
    if len(cases) > 1:
        print_items(rows, "map", ("error", "wall_f1"))
    elif evaluations:
        print_evaluations(evaluations)
        print_repetitions(rows, "map")
    for comparison in distances:
        _print_distances(comparison)
    return 0


def _compare_with_truths(
    request: _Request,
    config: RunConfig,
    grids: Sequence[OccupancyGrid],
    placed: Sequence[Placed],
    files: Mapping[str, Path],
) -> tuple[list[Evaluation], str | None]:
    """Compare each map with the truth of its case; return the device, too, None without truths."""
    from slamfusion.jobs.evaluate import evaluate_maps  # noqa: PLC0415

    if not files:
        return [], None
    truths = {
        case: load_truth(
            path, config, resolution=request.resolution, scale=request.scale, warn=notice
        )
        for case, path in files.items()
    }
    if len(truths) > 1:
        truths = {case: grid.with_name(case) for case, grid in truths.items()}
        grids = [grid.with_name(own.name) for grid, own in zip(grids, placed, strict=True)]
    device = device_for(config)
    found: dict[int, Evaluation] = {}
    with progress_bar() as progress:
        for case, truth in truths.items():
            rows = [row for row, own in enumerate(placed) if own.case == case]
            evaluations = evaluate_maps(
                [grids[row] for row in rows], truth, config, device,
                align=request.align, scale=request.scale, progress=progress,
            )  # fmt: skip
            found.update(zip(rows, evaluations, strict=True))
    return [found[row] for row in range(len(grids))], device.name


def _write_cases(
    request: _Request,
    placed: Sequence[Placed],
    evaluations: Sequence[Evaluation],
    config: RunConfig,
    device: str,
) -> None:
    """Write the report and the pictures of each case, all or none."""
    from slamfusion.io import AtomicFiles  # noqa: PLC0415
    from slamfusion.jobs.evaluate import write_evaluation  # noqa: PLC0415

    several = len(request.truths) > 1
    with AtomicFiles() as files:
        for case in dict.fromkeys(item.case for item in placed):
            report, image = request.report_dir, request.image_path
            if several:
                report = report and report / case
                image = image and image.with_stem(f"{image.stem}_{case}")
            pairs = zip(placed, evaluations, strict=True)
            write_evaluation(
                [found for item, found in pairs if item.case == case],
                config,
                device=device,
                report=report,
                image=image,
                name_each=several,
                files=files,
            )


def _compare(request: _Request, config: RunConfig) -> int:
    """Compare maps with each other."""
    from slamfusion.jobs.evaluate import agreement_items, compare_maps, evaluate_document  # noqa: PLC0415

    grids = load_maps(request.paths, request.resolution, config.map_files, notice)
    device = device_for(config)
    with progress_bar() as progress:
        result = compare_maps(grids, config, device, progress=progress)
    tell_left_out(result)
    items = agreement_items(result)
    if request.as_json:
        document = evaluate_document(
            [], [], config, agreement=items, truth=None, device=device.name
        )
        print_json(document)
        return 0
    rows = [
        [
            item["name"],
            number(None if item["agreement"] is None else 100.0 * item["agreement"], 1),
            "-" if item["agreement"] is None else "no" if item["bent"] is None else "BENT",
            number(None if item["bent"] is None else item["bent"].x, 1),
            number(None if item["bent"] is None else item["bent"].y, 1),
        ]
        for item in items
    ]
    print_table(
        ("map ", "walls that agree [%]", "bent ", "worst at x [m]", "y [m]"),
        rows,
        notes=["" if item["accepted"] and not is_verbose() else item["reason"] for item in items],
        title=f"Agreement of the maps with each other, in the frame of {result.reference}",
    )
    return 0


def _inputs(request: _Request, truths: Mapping[str, Path]) -> list[tuple[str, str, Path]]:
    """Return role, case and path of the files that were read."""
    from slamfusion.jobs.results import map_inputs  # noqa: PLC0415

    found = map_inputs("map", "", request.paths)
    for case, path in truths.items():
        found += map_inputs("truth", case, [path])
    if request.distances_path is not None:
        found.append(("distances", "", request.distances_path))
    return found


def _print_distances(comparison: DistanceComparison) -> None:
    """Print each measured distance next to the map's."""
    rows = [
        [
            row.name,
            number(row.distance_m),
            number(row.map_m),
            number(row.error_m),
            number(row.error_percent, 1),
        ]
        for row in comparison.rows
    ]
    columns = ("distance ", "measured [m]", "map [m]", "error [m]", "error [%]")
    print_table(
        columns,
        rows,
        notes=[row.reason for row in comparison.rows],
        title=f"Measured distances in {comparison.name}",
    )
    print(f"mean absolute error: {number(comparison.mean_absolute_error_m)} m\n")
