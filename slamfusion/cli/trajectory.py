"""``slamfusion trajectory``: how far a trajectory is from known relations, or from the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.options import (
    case_option,
    check_odometry,
    check_report,
    common_options,
    file_option,
    report_option,
    with_config,
)
from slamfusion.cli.output import notice, print_json, print_table
from slamfusion.cli.paths import CASE_FILE, MAP
from slamfusion.cli.results import print_items, results_option, save_results
from slamfusion.cli.table_files import table_option
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.jobs.cases import CaseFile, Placed, files_by_case, place_files, shared_case_names
from slamfusion.jobs.documents import number

if TYPE_CHECKING:
    from slamfusion.evaluation import DensePoses, ErrorStatistics
    from slamfusion.jobs.trajectory import CaseFiles, Measures
    from slamfusion.trajectory import Trajectory


@dataclass(frozen=True)
class _Request:
    """What is asked for beside the settings."""

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
            message = "give --relations FILE, --truth FILE, or both"
            raise click.UsageError(message)
        check_odometry(self.odometry, self.relations)
        if self.logs and not self.odometry:
            message = "--log places the scans in the odometry of the run; give --odometry FILE"
            raise click.UsageError(message)
        if self.map_path is not None and self.report_dir is None:
            message = "--map is drawn in the report; give --report DIR"
            raise click.UsageError(message)
        if self.map_path is not None and not self.is_one:
            message = "--map lies under one path; give one EST with it"
            raise click.UsageError(message)
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


def _report_folders(folder: Path, given: Mapping[str, Any]) -> list[Path]:
    kinds = given["truths"], given["relations"]
    if max(map(len, (given["estimates"], *kinds))) == 1:
        return [folder]
    placed = place_files(shared_case_names(*kinds), given["estimates"])
    return [_report_folder(folder, item) for item in placed]


def _report_folder(folder: Path, placed: Placed) -> Path:
    """Return the folder of the report of one of several paths."""
    return folder / placed.case / placed.name.replace("/", "_")


@click.command("trajectory")
@click.argument("estimates", metavar="EST...", nargs=-1, required=True, type=CASE_FILE)
@case_option(
    "--relations",
    "relations",
    "FILE",
    "Known motions between pairs of times, lines of 't1 t2 x y z roll pitch yaw' [K09].",
)
@case_option(
    "--odometry",
    "odometry",
    "FILE",
    "Raw odometry of the whole run: the pose at a relation's time is the nearest estimated one, "
    "carried on by it.",
)
@case_option(
    "--log",
    "logs",
    "LOG",
    "The log that EST was made from: with --odometry, a pose's place in the run is found by its "
    "scan's own odometry and not by its stamp.",
)
@case_option(
    "--truth", "truths", "FILE", "The true trajectory: absolute and relative errors (ATE, RPE)."
)
@file_option(
    "--map",
    "map_path",
    "MAP",
    "A map in the frame of EST, to draw the path over in the report.",
    MAP,
)
@report_option("report_dir", _report_folders)
@with_config("trajectory", "log", "map_files", "report")
@common_options
@results_option
@table_option
def command(config: RunConfig, **asked: Any) -> int:
    """Measure the errors of trajectories, one EST or several.

    Files hold poses as TUM, 't x y theta' or CSV; of a log, the raw odometry of its scans counts.

    With several truths or relations an EST belongs to the one whose name its own name or folder
    says as a word (graph/intel.tum and intel_graph.tum to intel.tum), or that it is given:
    CASE=EST; so do the files of the other options. All paths then stand in one table with the means
    of each method; a report is written for each path.
    """
    request = _Request(**asked)
    request.check()
    return _measure_one(request, config) if request.is_one else _measure_several(request, config)


def _measure_one(request: _Request, config: RunConfig) -> int:
    """Measure one path."""
    from slamfusion.jobs.trajectory import (  # noqa: PLC0415
        measure_trajectory_file,
        write_trajectory,
    )

    (placed,), held = request.placed()
    found = measure_trajectory_file(
        held.of(placed.case, placed.path), config, grid=request.map_path, warn=notice
    )
    if request.report_dir is not None:
        write_trajectory(found, request.report_dir)
    document = found.to_json()
    save_results(
        request.results_path,
        document,
        found.rows(placed),
        lambda: held.inputs([placed]),
    )
    if request.as_json:
        print_json(document)
    else:
        print_measures(found.estimate, found.measures)
    return 0


def _measure_several(request: _Request, config: RunConfig) -> int:
    """Measure several paths, each by what there is of its case."""
    from slamfusion.io import AtomicFiles  # noqa: PLC0415
    from slamfusion.jobs.trajectory import (  # noqa: PLC0415
        measure_trajectories,
        trajectories_document,
        write_trajectory,
    )

    placed, held = request.placed()
    found, not_measured = measure_trajectories(placed, held, config)
    if request.report_dir is not None:
        with AtomicFiles() as files:
            for item, own in found:
                write_trajectory(own, _report_folder(request.report_dir, item), files)
    document = trajectories_document(found, not_measured, config)
    rows = [row for item, own in found for row in own.rows(item)]
    inputs = [item for item, _ in found]
    save_results(request.results_path, document, rows, lambda: held.inputs(inputs))
    if request.as_json:
        print_json(document)
    else:
        print_items(rows, "path", ("ate_rmse_m", "relations_mean_m"))
    if not_measured:
        raise SlamFusionError("; ".join(not_measured))
    return 0


def print_measures(estimate: Trajectory, measures: Measures) -> None:
    """Print one row for each kind of error, then how it was counted."""
    from slamfusion.evaluation import mean_interval  # noqa: PLC0415

    kinds = _kinds(measures, "")
    if measures.online is not None:
        kinds += _kinds(measures.online, ", as first reported")
    notes = []
    if measures.relations is not None:
        errors = measures.relations
        notes.append(
            f"{errors.relations_used} of {errors.relations_total} relations used, "
            f"{_how(measures.dense, errors.tolerance_s)}"
        )
    if measures.at_scans is not None:
        own = measures.at_scans
        low, high = mean_interval(own.translation_m)
        notes.append(
            f"both ends are poses of the trajectory in {own.relations_used} of "
            f"{own.relations_total} relations; the mean of their translation errors is "
            f"{number(low, 4)} to {number(high, 4)} m with 95 %"
        )
    if measures.truth is not None:
        found = measures.truth
        aligned = "aligned" if found.alignment.kind == "se2" else "not aligned"
        notes.append(
            f"{found.poses_matched} of {found.poses} poses met one of {found.truth} within "
            f"{found.tolerance_s:g} s, {aligned}; "
            f"{len(found.relative_translation_m)} pairs"
        )
    title = f"{estimate.name}: {len(estimate)} poses, {estimate.path_length_m():.1f} m"
    print_errors(title, kinds, notes)


def print_errors(
    title: str, kinds: Sequence[tuple[str, ErrorStatistics | None, int]], notes: Sequence[str]
) -> None:
    """Print a row of figures for each kind of error (name with its unit, figures, digits)."""
    rows = [[name, *_figures(statistics, digits)] for name, statistics, digits in kinds]
    columns = ("error ", "mean", "std", "rmse", "median", "min", "max")
    print_table(columns, rows, title=title)
    for note in notes:
        print(note)


def _kinds(measures: Measures, which: str) -> list[tuple[str, ErrorStatistics | None, int]]:
    """Return name, figures and digits of each kind of error.

    Args:
        measures: of one path.
        which: one, added to the names.
    """
    kinds: list[tuple[str, ErrorStatistics | None, int]] = []
    for errors, where in ((measures.relations, ""), (measures.at_scans, " at scans")):
        if errors is not None:
            kinds += [
                (f"relations{where}, translation m{which}", errors.translation, 4),
                (f"relations{where}, rotation deg{which}", errors.rotation_deg, 3),
            ]
    if measures.truth is not None:
        found = measures.truth
        pair = f"{found.rpe_delta:g} {found.rpe_unit}"
        kinds += [
            (f"ATE, translation m{which}", found.ate, 4),
            (f"ATE, rotation deg{which}", found.ate_rotation_deg, 3),
            (f"RPE over {pair}, translation m{which}", found.rpe, 4),
            (f"RPE over {pair}, rotation deg{which}", found.rpe_rotation_deg, 3),
        ]
    return kinds


def _figures(statistics: ErrorStatistics | None, digits: int) -> list[str]:
    """Return the figures as cells; dashes where there are none."""
    if statistics is None:
        return ["-"] * 6
    values = (
        statistics.mean,
        statistics.std,
        statistics.rmse,
        statistics.median,
        statistics.min,
        statistics.max,
    )
    return [number(value, digits) for value in values]


def _how(dense: DensePoses | None, tolerance_s: float) -> str:
    """Say how a pose was found for a relation's time."""
    if dense is None:
        return f"poses within {tolerance_s:g} s of both times"
    total = dense.poses_used + dense.poses_without_row
    return (
        f"poses carried on by {dense.rows} rows of odometry; rows of the poses found "
        f"by {dense.rows_found_by}, {dense.poses_without_row} of {total} poses without one"
    )
