"""``slamfusion trajectory``: how far a trajectory is from known relations, or from the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.help import Command
from slamfusion.cli.options import (
    case_option,
    check_odometry,
    check_report,
    common_options,
    file_option,
    report_option,
    with_config,
)
from slamfusion.cli.output import notice, print_json
from slamfusion.cli.paths import CASE_FILE, MAP
from slamfusion.cli.results import print_items, results_option, save_results, table_option
from slamfusion.cli.tables import print_measures
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.jobs.cases import CaseFile, Placed, files_by_case, place_files, shared_case_names
from slamfusion.jobs.inputs import load_maps

if TYPE_CHECKING:
    from slamfusion.jobs.trajectory import CaseFiles, TrajectoriesDocument, TrajectoryDocument


@dataclass(frozen=True)
class _Request:
    """The request, without the settings."""

    estimates: tuple[CaseFile, ...]
    relations: tuple[CaseFile, ...]
    odometry: tuple[CaseFile, ...]
    logs: tuple[CaseFile, ...]
    truths: tuple[CaseFile, ...]
    map_path: Path | None
    report_dir: Path | None
    results_path: Path | None
    as_json: bool

    @property
    def is_one(self) -> bool:
        """Whether it is one path, held against one truth or relations."""
        return max(map(len, (self.estimates, self.truths, self.relations))) == 1

    def check(self) -> None:
        """Refuse what cannot be measured before any work."""
        if not self.relations and not self.truths:
            raise click.UsageError("give --relations FILE, --truth FILE, or both")
        check_odometry(self.odometry, self.relations)
        if self.logs and not self.odometry:
            message = "--log needs --odometry FILE, the raw odometry of the run"
            raise click.UsageError(message)
        if self.map_path is not None and self.report_dir is None:
            raise click.UsageError("--map needs --report DIR, where it is drawn")
        if self.map_path is not None and not self.is_one:
            raise click.UsageError("--map is for one path; give one EST")
        check_report(self.report_dir)

    def placed(self) -> tuple[list[Placed], CaseFiles]:
        """Return the paths in their cases, and what they are held against there."""
        from slamfusion.jobs.trajectory import CaseFiles  # noqa: PLC0415  (loads slowly)

        cases = shared_case_names(self.truths, self.relations)
        held = CaseFiles(
            relations=files_by_case(cases, self.relations, "--relations"),
            odometry=files_by_case(cases, self.odometry, "--odometry"),
            logs=files_by_case(cases, self.logs, "--log"),
            truths=files_by_case(cases, self.truths, "--truth"),
        )
        return place_files(cases, self.estimates), held


def paths_in(item: CaseFile) -> list[CaseFile]:
    """Return the .tum files of a folder; of a file itself."""
    files = sorted(item.path.rglob("*.tum")) if item.path.is_dir() else []
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
@case_option(
    "--relations",
    "relations",
    "FILE",
    "Known motions between pairs of times: lines of 't1 t2 x y z roll pitch yaw' [K09].",
)
@case_option(
    "--odometry",
    "odometry",
    "FILE",
    "Raw odometry of the whole run. It carries the nearest pose to the time of a relation.",
)
@case_option(
    "--log",
    "logs",
    "LOG",
    "The log of EST. With --odometry, poses are matched by the odometry of their scan instead of "
    "their stamp.",
)
@case_option(
    "--truth", "truths", "FILE", "The true trajectory, for absolute and relative errors (ATE, RPE)."
)
@file_option(
    "--map",
    "map_path",
    "MAP",
    "A map in the frame of EST, drawn under the path in the report.",
    MAP,
)
@report_option("report_dir")
@with_config("trajectory", "log", "map_files", "report")
@common_options
@results_option
@table_option
def command(config: RunConfig, **asked: Any) -> int:
    """Measure the errors of paths.

    EST is a file of poses (TUM, 't x y theta' or CSV), a log, whose raw odometry is measured, or a
    folder, for all .tum files in it: out/seed-0/graph.tum is graph with seed 0.

    With several truths or relations, a path belongs to the one whose name is a word of its file
    name or folder: graph/intel.tum and intel_graph.tum belong to intel.tum. CASE=EST overrides
    that. The same holds for the files of other options. One table and one report then
    show all paths.
    """
    estimates = [found for item in asked.pop("estimates") for found in paths_in(item)]
    request = _Request(estimates=tuple(estimates), **asked)
    request.check()
    return _measure(request, config)


def _measure(request: _Request, config: RunConfig) -> int:
    """Measure the paths, each by what there is of its case."""
    from slamfusion.jobs.trajectory import (  # noqa: PLC0415
        measure_trajectories,
        trajectories_document,
        write_trajectories,
    )

    placed, held = request.placed()
    found, not_measured = measure_trajectories(placed, held, config)
    first, folder, grid = found[0][1], request.report_dir, None
    if request.map_path is not None:
        (grid,) = load_maps([request.map_path], None, config.map_files, notice)
    if folder is not None:
        write_trajectories([(item, replace(own, grid=grid)) for item, own in found], folder)
    rows = [row for item, own in found for row in own.rows(item)]
    document: TrajectoryDocument | TrajectoriesDocument = first.to_json()
    if not request.is_one:
        document = trajectories_document(found, not_measured, config)
    inputs = [item for item, _ in found]
    save_results(request.results_path, document, rows, lambda: held.inputs(inputs))
    if request.as_json:
        print_json(document)
    elif request.is_one:
        print_measures(first.estimate, first.measures)
    else:
        print_items(rows, "path", ("ate_rmse_m", "relations_mean_m"))
    if not_measured:
        raise SlamFusionError("; ".join(not_measured))
    return 0
