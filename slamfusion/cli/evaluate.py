"""``slamfusion evaluate``: how far maps are from the truth, or from measured distances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion import jobs
from slamfusion.cli import options, output, results, tables
from slamfusion.cli.help import Command
from slamfusion.cli.paths import CASE_MAP, case_folders
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.jobs.cases import CaseFile
from slamfusion.jobs.inputs import PixelSizes
from slamfusion.jobs.records import number

if TYPE_CHECKING:
    from slamfusion.evaluation.distances import DistanceComparison


@click.command(
    "evaluate",
    cls=Command,
    examples=[
        "evaluate a.yaml b.yaml --truth truth.yaml",
        "evaluate map.yaml --distances measured.csv",
    ],
)
@click.argument("maps", metavar="MAP...", nargs=-1, required=True, type=CASE_MAP)
@options.case("--truth", "truths", "MAP", "The true map.", CASE_MAP)
@options.truth_scale
@click.option(
    "--align/--no-align",
    default=True,
    help="Align each map with the truth first, or use both maps as they are. [default: align]",
)
@options.file(
    "--distances",
    "distances_path",
    "FILE",
    "Distances measured in the building (CSV or YAML), to compare with the map.",
)
@options.report("report_dir", lambda folder, given: case_folders(folder, given["truths"]))
@options.resolution
@options.settings(
    "fusion.normalize", "fusion.align", "map_files", "evaluate", "report", "device", ""
)
@options.common
@results.results_option
@results.table_option
def command(
    config: RunConfig,
    maps: tuple[CaseFile, ...],
    truths: tuple[CaseFile, ...],
    align: bool,
    scale: PixelSizes | None,
    distances_path: Path | None,
    report_dir: Path | None,
    resolution: float | None,
) -> None:
    """Measure the errors of maps.

    Each MAP is compared with the true map, or with measured distances. Without both, `slamfusion
    fuse` compares maps with each other.

    With several truths, a map belongs to the truth whose name is a word of its file name or
    folder: graph/office.yaml and office_graph.yaml belong to office.yaml. CASE=MAP overrides that.
    One table then shows all maps and the mean of each method. Each truth gets its own report.
    """
    options.refuse(
        not truths and distances_path is None,
        "give --truth MAP or --distances FILE; without both, fuse compares maps with each other",
    )
    options.refuse(report_dir and not truths, "--report needs --truth MAP")
    message = "--scale searches where the maps lie on the plan; leave --no-align out"
    options.refuse(scale is not None and not align, message)
    paths = [item.path for item in maps]
    with output.progress_bar() as progress:
        found = jobs.evaluate.evaluate_cases(
            maps, truths, config, distances=distances_path,
            align=align, scale=scale, resolution=resolution, progress=progress, warn=output.notice,
        )  # fmt: skip
    pages = [] if report_dir is None else found.write(report_dir)
    evaluations = [item.evaluation for item in found.maps]
    output.notice(*jobs.fuse_documents.unaligned_sentences(evaluations))
    rows = found.rows()
    results.save_results(
        found, [*rows, *found.distance_rows()], lambda: _inputs(paths, found.truths, distances_path)
    )
    if not output.print_if_json(found):
        if len(truths) > 1:
            results.print_items(rows, "map", ("error", "wall_f1"))
        elif evaluations:
            tables.print_evaluations(evaluations)
            results.print_repetitions(rows, "map")
        for comparison in found.distances:
            _print_distances(comparison)
        output.print_facts(*(("report", page) for page in pages))
    if empty := [own.name for own in found.distances if own.mean_absolute_error_m is None]:
        why = "no wall near both points; are they in metres, in its map frame?"
        raise SlamFusionError(f"no distance could be measured in {', '.join(empty)}: {why}")


def _inputs(
    maps: Sequence[Path], truths: Mapping[str, Path], distances: Path | None
) -> list[tuple[str, str, Path]]:
    found = jobs.results.map_inputs("map", "", maps)
    for case, path in truths.items():
        found += jobs.results.map_inputs("truth", case, [path])
    return found if distances is None else [*found, ("distances", "", distances)]


def _print_distances(comparison: DistanceComparison) -> None:
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
    output.Table(
        columns,
        rows,
        notes=[row.reason for row in comparison.rows],
        title=f"Measured distances in {comparison.name}",
    ).print()
    print(f"mean absolute error: {number(comparison.mean_absolute_error_m)} m\n")
