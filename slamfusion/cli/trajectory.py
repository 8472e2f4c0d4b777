"""``slamfusion trajectory``: how far a trajectory is from known relations, or from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.options import FILE, common_options, with_config
from slamfusion.cli.output import notice, number, print_json, print_table
from slamfusion.cli.table_files import table_option
from slamfusion.config import RunConfig
from slamfusion.jobs.inputs import check_writable

if TYPE_CHECKING:
    from slamfusion.evaluation import DensePoses, ErrorStatistics
    from slamfusion.jobs.trajectory import Measures
    from slamfusion.trajectory import Trajectory

__all__ = ["command", "print_errors", "print_measures"]


@click.command("trajectory")
@click.argument("estimate", metavar="EST", type=FILE)
@click.option(
    "--relations",
    "relations_path",
    type=FILE,
    metavar="FILE",
    help="Known motions between pairs of times, lines of 't1 t2 x y z roll pitch yaw' [K09].",
)
@click.option(
    "--odometry",
    "odometry_path",
    type=FILE,
    metavar="FILE",
    help="Raw odometry of the whole run: the pose at a relation's time is the nearest estimated "
    "one, carried on by it.",
)
@click.option(
    "--log",
    "log_path",
    type=FILE,
    metavar="LOG",
    help="The log that EST was made from: with --odometry, a pose's place in the run is found by "
    "its scan's own odometry and not by its stamp.",
)
@click.option(
    "--truth",
    "truth_path",
    type=FILE,
    metavar="FILE",
    help="The true trajectory: absolute and relative errors (ATE, RPE).",
)
@click.option(
    "--map",
    "map_path",
    type=FILE,
    metavar="MAP",
    help="A map in the frame of EST, to draw the path over in the report.",
)
@click.option(
    "--report",
    "report_dir",
    type=FILE,
    metavar="DIR",
    help="Write a self-contained HTML report with its pictures here.",
)
@with_config("trajectory", "log", "map_files")
@common_options
@table_option
def command(
    estimate: Path,
    relations_path: Path | None,
    odometry_path: Path | None,
    log_path: Path | None,
    truth_path: Path | None,
    map_path: Path | None,
    report_dir: Path | None,
    config: RunConfig,
    as_json: bool,
) -> int:
    """Measure the errors of the trajectory EST.

    Files hold poses as TUM, 't x y theta' or CSV; of a log, the raw odometry of its scans counts.
    """
    from slamfusion.jobs.trajectory import (  # noqa: PLC0415
        TrajectoryFiles,
        measure_trajectory_file,
        write_trajectory,
    )

    _check_request(relations_path, odometry_path, log_path, truth_path)
    if map_path is not None and report_dir is None:
        message = "--map is drawn in the report; give --report DIR"
        raise click.UsageError(message)
    if report_dir is not None:
        import slamfusion.report  # noqa: F401, PLC0415  (says early when its extra is missing)

        check_writable(report_dir)
    files = TrajectoryFiles(estimate, relations_path, odometry_path, log_path, truth_path)
    found = measure_trajectory_file(files, config, grid=map_path, warn=notice)
    if report_dir is not None:
        write_trajectory(found, report_dir)
    if as_json:
        print_json(found.to_json())
    else:
        print_measures(found.estimate, found.measures)
    return 0


def _check_request(
    relations_path: Path | None,
    odometry_path: Path | None,
    log_path: Path | None,
    truth_path: Path | None,
) -> None:
    """Refuse what cannot be measured before any work."""
    if relations_path is None and truth_path is None:
        message = "give --relations FILE, --truth FILE, or both"
        raise click.UsageError(message)
    if odometry_path is not None and relations_path is None:
        message = "--odometry carries poses to the times of relations; give --relations FILE"
        raise click.UsageError(message)
    if log_path is not None and odometry_path is None:
        message = "--log places the scans in the odometry of the run; give --odometry FILE"
        raise click.UsageError(message)


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
        low, high = mean_interval(own.translation_m).to_json()
        notes.append(
            f"both ends are poses of the trajectory in {own.relations_used} of "
            f"{own.relations_total} relations; the mean of their translation errors is "
            f"{number(low, 4)} to {number(high, 4)} m with 95 %"
        )
    if measures.truth is not None:
        found = measures.truth
        aligned = "aligned" if found.config.alignment == "se2" else "not aligned"
        notes.append(
            f"{found.poses_matched} of {found.poses_total} poses met one of {found.truth} within "
            f"{found.config.tolerance_s:g} s, {aligned}; "
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
        pair = f"{found.config.rpe_delta:g} {found.config.rpe_unit}"
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
    without = dense.poses_total - dense.poses_used
    return (
        f"poses carried on by {len(dense.trajectory)} rows of odometry; rows of the poses found "
        f"by {dense.by}, {without} of {dense.poses_total} poses without one"
    )
