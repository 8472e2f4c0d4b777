"""``slamfusion trajectory``: how far a trajectory is from known relations, or from the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.inputs import check_writable, load_maps
from slamfusion.cli.options import common_options, with_config
from slamfusion.cli.output import number, path_text, print_json, print_table, versions
from slamfusion.config import RunConfig, TrajectoryConfig, to_mapping

if TYPE_CHECKING:
    from slamfusion.evaluation import (
        DensePoses,
        ErrorStatistics,
        RelationErrors,
        Relations,
        TrajectoryErrors,
    )
    from slamfusion.jobs.records import MeasuresJson, TrajectoryDocument
    from slamfusion.trajectory import Trajectory

__all__ = ["Measures", "command", "measure_trajectory", "print_measures"]


@dataclass(frozen=True)
class Measures:
    """Everything that was measured of one trajectory; what was not asked for is None.

    Attributes:
        relations: errors on the known relations.
        dense: how the poses at the relations' times were composed with odometry.
        truth: errors against the true trajectory.
        at_scans: errors on those of the relations whose both ends are poses of the trajectory.
        online: the same of the path as it was first reported, before it was corrected.
    """

    relations: RelationErrors | None = None
    dense: DensePoses | None = None
    truth: TrajectoryErrors | None = None
    at_scans: RelationErrors | None = None
    online: Measures | None = None

    def to_json(self) -> MeasuresJson:
        """Return the figures for a JSON document."""
        document: MeasuresJson = {}
        if self.truth is not None:
            document = {**document, **self.truth.to_json()}
        if self.relations is not None:
            document = {**document, **self.relations.to_json()}
            document["odometry"] = None if self.dense is None else self.dense.to_json()
            own = self.at_scans
            document["at_scans"] = None if own is None else own.to_json_with_intervals()
        if self.online is not None:
            document["as_first_reported"] = self.online.to_json()
        return document


@click.command("trajectory")
@click.argument("estimate", metavar="EST", type=click.Path(path_type=Path))
@click.option(
    "--relations",
    "relations_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Known motions between pairs of times, lines of 't1 t2 x y z roll pitch yaw' [K09].",
)
@click.option(
    "--odometry",
    "odometry_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Raw odometry of the whole run: the pose at a relation's time is the nearest estimated "
    "one, carried on by it.",
)
@click.option(
    "--log",
    "log_path",
    type=click.Path(path_type=Path),
    metavar="LOG",
    help="The log that EST was made from: with --odometry, a pose's place in the run is found by "
    "its scan's own odometry and not by its stamp.",
)
@click.option(
    "--truth",
    "truth_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="The true trajectory: absolute and relative errors (ATE, RPE).",
)
@click.option(
    "--map",
    "map_path",
    type=click.Path(path_type=Path),
    metavar="MAP",
    help="A map in the frame of EST, to draw the path over in the report.",
)
@click.option(
    "--report",
    "report_dir",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Write a self-contained HTML report with its pictures here.",
)
@with_config("trajectory", "log", "map_files")
@common_options
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
    _check_request(relations_path, odometry_path, log_path, truth_path)
    if map_path is not None and report_dir is None:
        message = "--map is drawn in the report; give --report DIR"
        raise click.UsageError(message)
    if report_dir is not None:
        import slamfusion.report  # noqa: F401, PLC0415  (says early when its extra is missing)

        check_writable(report_dir)
    from slamfusion.evaluation import read_odometry, read_relations  # noqa: PLC0415
    from slamfusion.io.trajectories import read_trajectory  # noqa: PLC0415

    def read(path: Path | None) -> Trajectory | None:
        return None if path is None else read_trajectory(path, config.log)

    poses = read_trajectory(estimate, config.log)
    truth, scans = read(truth_path), read(log_path)
    rows = None if odometry_path is None else read_odometry(odometry_path, config.log)
    relations = None if relations_path is None else read_relations(relations_path)
    grid = None if map_path is None else load_maps((map_path,), None, config.map_files)[0]
    measures = measure_trajectory(
        poses, config.trajectory, relations=relations, odometry=rows, scans=scans, truth=truth
    )
    if report_dir is not None:
        from slamfusion.report import write_trajectory_report  # noqa: PLC0415

        write_trajectory_report(
            report_dir,
            trajectory=poses,
            config=config,
            relations=measures.relations,
            errors=measures.truth,
            truth=truth,
            odometry=scans,
            grid=grid,
        )

    if as_json:
        document: TrajectoryDocument = {
            "name": poses.name,
            "path_length_m": poses.path_length_m(),
            "duration_s": float(poses.stamps_s[-1] - poses.stamps_s[0]),
            **measures.to_json(),
            "poses": len(poses),
            "estimate": str(estimate),
            "relations": path_text(relations_path),
            "odometry_file": path_text(odometry_path),
            "log": path_text(log_path),
            "truth": path_text(truth_path),
            "config": to_mapping(config),
            "versions": versions(),
        }
        print_json(document)
    else:
        print_measures(poses, measures)
    return 0


def measure_trajectory(
    estimate: Trajectory,
    config: TrajectoryConfig,
    *,
    relations: Relations | None = None,
    odometry: Trajectory | None = None,
    scans: Trajectory | None = None,
    truth: Trajectory | None = None,
) -> Measures:
    """Measure a trajectory in every way that there is something to hold it against.

    Args:
        estimate: the poses.
        config: tolerances, and what the relative error spans.
        relations: known motions between pairs of times.
        odometry: raw odometry of the whole run, to carry poses on to the relations' times.
        scans: raw odometry of the scans of the estimate's log.
        truth: the true poses.

    Raises:
        TrajectoryError: the estimate does not meet the relations, the odometry or the truth.
    """
    from slamfusion.evaluation import (  # noqa: PLC0415
        errors_at_scans,
        poses_by_odometry,
        relation_errors,
        trajectory_errors,
    )

    dense = None
    if relations is not None and odometry is not None:
        dense = poses_by_odometry(
            estimate,
            scans,
            odometry,
            tolerance_s=config.tolerance_s,
            tolerance_m=config.odometry_tolerance_m,
        )
    scored = estimate if dense is None else dense.trajectory
    return Measures(
        relations=None
        if relations is None
        else relation_errors(scored, relations, config.tolerance_s),
        dense=dense,
        truth=None if truth is None else trajectory_errors(estimate, truth, config),
        at_scans=None if relations is None else errors_at_scans(estimate, relations),
    )


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
    rows = [[name, *_figures(statistics, digits)] for name, statistics, digits in kinds]
    columns = ("error ", "mean", "std", "rmse", "median", "min", "max")
    title = f"{estimate.name}: {len(estimate)} poses, {estimate.path_length_m():.1f} m"
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
