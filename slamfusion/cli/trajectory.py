"""``slamfusion trajectory``: how far a trajectory is from known relations, or from the truth."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import click

from slamfusion import jobs
from slamfusion.cli import options, results
from slamfusion.cli.help import Command
from slamfusion.cli.output import notice, print_facts, print_if_json
from slamfusion.cli.paths import CASE_FILE, MAP
from slamfusion.cli.tables import print_measures
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.jobs.cases import (
    CaseFile,
    known_files,
    measured_inputs,
    place_files,
    shared_case_names,
)
from slamfusion.jobs.inputs import load_maps
from slamfusion.jobs.records import Settings


def paths_in(item: CaseFile, named: Collection[Path]) -> list[CaseFile]:
    """Return the .tum files of a folder that are not named; of a file, a bag or a log, itself."""
    from slamfusion.io.logs import check_folder  # noqa: PLC0415  (OpenCV loads slowly)

    files = sorted(item.path.rglob("*.tum")) if item.path.is_dir() else []
    files = [path for path in files if path.resolve() not in named]
    if not files:
        check_folder(item.path, "a folder with .tum files that no option names, ")
    return [replace(item, path=path) for path in files] or [item]


@click.command(
    "trajectory",
    cls=Command,
    examples=[
        "trajectory out/*.tum --truth truth.tum",
        "trajectory out/graph.tum --relations drive.relations --report out/errors",
    ],
)
@click.argument("estimates", metavar="EST...", nargs=-1, required=True, type=CASE_FILE)
@options.case(
    "--relations",
    "relations",
    "FILE",
    "Known motions between pairs of times: lines of 't1 t2 x y z roll pitch yaw' [K09].",
)
@options.case(
    "--odometry",
    "odometry",
    "FILE",
    "Raw odometry of the whole run. It carries the nearest pose to the time of a relation.",
)
@options.case(
    "--log",
    "log",
    "LOG",
    "The log of EST. With --odometry, poses are matched by the odometry of their scan instead of "
    "their stamp.",
)
@options.case(
    "--truth", "truth", "FILE", "The true trajectory, for absolute and relative errors (ATE, RPE)."
)
@options.file(
    "--map",
    "map_path",
    "MAP",
    "A map in the frame of EST, drawn under the path in the report.",
    MAP,
)
@options.report("report_dir")
@options.settings("trajectory", "log", "map_files", "report")
@options.common
@results.results_option
@results.table_option
def command(
    config: RunConfig,
    estimates: tuple[CaseFile, ...],
    map_path: Path | None,
    report_dir: Path | None,
    **files: tuple[CaseFile, ...],
) -> None:
    """Measure the errors of paths.

    EST is a file of poses (TUM, 't x y theta' or CSV), a log, whose raw odometry is measured, or a
    folder, for all .tum files in it that no option names: out/seed-0/graph.tum is graph with
    seed 0.

    With several truths or relations, a path belongs to the one whose name is a word of its file
    name or folder: graph/intel.tum and intel_graph.tum belong to intel.tum. CASE=EST overrides
    that. The same holds for the files of other options. One table and one report then
    show all paths.
    """
    named = {item.path.resolve() for given in files.values() for item in given}
    paths = [found for item in estimates for found in paths_in(item, named)]
    relations, truths, odometry = (files[kind] for kind in ("relations", "truth", "odometry"))
    is_one = max(map(len, (paths, truths, relations))) == 1
    refuse = options.refuse
    refuse(not relations and not truths, "give --relations FILE, --truth FILE, or both")
    options.check_odometry(odometry, relations)
    message = "--log needs --odometry FILE, the raw odometry of the run"
    refuse(files["log"] and not odometry, message)
    refuse(map_path and not report_dir, "--map needs --report DIR, where it is drawn")
    refuse(map_path and not is_one, "--map is for one path; give one EST")
    cases = shared_case_names(truths, relations)
    known = known_files(cases, **files)
    placed = place_files(cases, paths)
    found, not_measured = jobs.trajectory.measure_trajectories(placed, known, config)
    if map_path is not None:
        (grid,) = load_maps([map_path], config, warn=notice)
        found = [replace(own, grid=grid) for own in found]
    page = None
    if report_dir is not None:
        page = jobs.trajectory.write_trajectories(found, report_dir, config)
    rows = [row for own in found for row in own.rows()]
    settings = Settings(config)
    document = (
        jobs.trajectory.TrajectoryDocument(found[0], settings)
        if is_one
        else jobs.trajectory.TrajectoriesDocument(
            found, jobs.results.summaries(rows), not_measured, settings
        )
    )
    inputs = [own.placed for own in found]
    results.save_results(document, rows, lambda: measured_inputs(inputs, known))
    if not print_if_json(document):
        if is_one:
            print_measures(found[0].trajectory, found[0].measures)
        else:
            results.print_items(rows, "path", ("ate_rmse_m", "relations_mean_m"))
        print_facts(("report", page))
    if not_measured:
        raise SlamFusionError("; ".join(not_measured))
