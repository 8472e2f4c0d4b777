"""How far a trajectory is from known relations, and from the truth."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypedDict, cast

from slamfusion.config import RunConfig, TrajectoryConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import (
    DensePoses,
    RelationErrors,
    Relations,
    Row,
    TrajectoryErrors,
    errors_at_scans,
    path_figures,
    path_series,
    poses_by_odometry,
    read_relations,
    relation_errors,
    result_rows,
    trajectory_errors,
)
from slamfusion.evaluation.relations import RelationErrorsAtScans
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, read_trajectory
from slamfusion.jobs.cases import CaseFile, Placed, files_by_case
from slamfusion.jobs.inputs import Warn, as_path
from slamfusion.jobs.records import Settings, Summaries
from slamfusion.json_values import FLAT, record_keys
from slamfusion.trajectory import Trajectory

_LOG = logging.getLogger(__name__)


class PathErrorsJson(TypedDict, total=False):
    """Errors of a path: against the truth, on known relations, both or none."""

    # And the keys of TrajectoryErrors and RelationErrors; see tests/support/make_schema.py.
    odometry: DensePoses | None
    """How poses at the relations' times were composed with odometry; null: they were not."""
    at_scans: RelationErrorsAtScans | None
    """Errors on the relations whose both ends are poses of the path; null: the same or none."""


class MeasuresJson(PathErrorsJson, total=False):
    """Errors of a path, and of the same path as it was first reported."""

    as_first_reported: PathErrorsJson
    """The same of the path as it was first reported, of a producer that corrects it later."""


@dataclass(frozen=True)
class Measures:
    """Everything that was measured of one trajectory; None: not asked for.

    Attributes:
        dense: how the poses at the relations' times were composed with odometry.
        at_scans: errors on the relations with poses of the trajectory at both ends.
        online: errors of the path as it was first reported, before it was corrected.
    """

    relations: RelationErrors | None = None
    dense: DensePoses | None = None
    truth: TrajectoryErrors | None = None
    at_scans: RelationErrorsAtScans | None = None
    online: Measures | None = None

    def to_json(self) -> MeasuresJson:
        """Return the figures for a JSON document."""
        document: dict[str, Any] = {}
        if self.truth is not None:
            document |= record_keys(self.truth)
        if self.relations is not None:
            document |= record_keys(self.relations)
            document |= {"odometry": self.dense, "at_scans": self.at_scans}
        if self.online is not None:
            document["as_first_reported"] = self.online.to_json()
        return cast("MeasuresJson", document)


@dataclass(frozen=True, eq=False)
class Yardsticks:
    """What paths are compared with.

    Attributes:
        relations: known motions between pairs of times.
        odometry: raw odometry of the whole run, to carry poses on to the relations' times.
        scans: raw odometry of the scans of the path's log.
    """

    relations: Relations | None = None
    odometry: Trajectory | None = None
    truth: Trajectory | None = None
    scans: Trajectory | None = None

    @classmethod
    def read(
        cls,
        config: RunConfig,
        relations: str | Path | None = None,
        odometry: str | Path | None = None,
        truth: str | Path | None = None,
        warn: Warn = _LOG.warning,
    ) -> Yardsticks:
        """Read the files that are named."""
        at_relations, rows, poses = as_path(relations), as_path(odometry), as_path(truth)
        return cls(
            None if at_relations is None else read_relations(at_relations),
            None if rows is None else read_trajectory(rows, config.log),
            None
            if poses is None
            else read_trajectory(poses, config.log, config.trajectory.pose_topic, warn),
        )

    def measure(
        self, path: Trajectory, config: RunConfig, scans: Trajectory | None = None
    ) -> Measures:
        """Measure a path by all that there is; see ``measure_trajectory``."""
        return measure_trajectory(
            path,
            config.trajectory,
            relations=self.relations,
            odometry=self.odometry,
            scans=scans or self.scans,
            truth=self.truth,
        )


def measure_trajectory(
    estimate: Trajectory,
    config: TrajectoryConfig | None = None,
    *,
    relations: Relations | None = None,
    odometry: Trajectory | None = None,
    scans: Trajectory | None = None,
    truth: Trajectory | None = None,
) -> Measures:
    """Measure a trajectory by everything given; see ``Yardsticks``.

    Raises:
        TrajectoryError: the estimate has no times in common with one of them.
    """
    config = config or TrajectoryConfig()
    dense = None
    if relations is not None and odometry is not None:
        dense = poses_by_odometry(estimate, scans, odometry, tolerance_s=config.tolerance_s)
    scored = estimate if dense is None else dense.trajectory
    return Measures(
        relations=None
        if relations is None
        else relation_errors(scored, relations, config.tolerance_s),
        dense=dense,
        truth=None if truth is None else trajectory_errors(estimate, truth, config),
        at_scans=None if relations is None else errors_at_scans(estimate, relations),
    )


# --- trajectories in files --------------------------------------------------------------------


@dataclass(frozen=True)
class KnownFiles:
    """The files that the paths of one drive are measured with.

    Attributes:
        log: what the paths were made from.
        scan_odometry: gives the scans of the log their odometry.
    """

    relations: Path | None = None
    odometry: Path | None = None
    log: Path | None = None
    truth: Path | None = None
    scan_odometry: Path | None = None


def known_files(
    cases: Sequence[str], logs: Sequence[CaseFile], **others: Sequence[CaseFile]
) -> dict[str, KnownFiles]:
    """Return the files of each case; ``others`` are the other kinds of ``KnownFiles`` by name.

    Raises:
        ConfigError: a file belongs to no case or to several, or a case has two of a kind.
    """
    found = {
        kind: files_by_case(cases, own, f"--{kind.replace('_', '-')}")
        for kind, own in {"log": logs, **others}.items()
    }
    return {
        case: KnownFiles(**{kind: own.get(case) for kind, own in found.items()}) for case in cases
    }


def known_inputs(
    placed: Sequence[Placed], known: Mapping[str, KnownFiles]
) -> list[tuple[str, str, Path]]:
    """Return role, case and path of paths and of the files that they are measured with."""
    return [("path", item.case, item.path) for item in placed] + [
        (item.name.replace("_", " "), case, path)
        for item in fields(KnownFiles)
        for case, files in known.items()
        if (path := getattr(files, item.name)) is not None
    ]


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredTrajectory:
    """A trajectory with its errors, and the files that they rest on."""

    placed: Placed = field(repr=False)
    trajectory: Trajectory = field(repr=False)
    held: Yardsticks = field(repr=False)
    """What it was measured by."""
    grid: OccupancyGrid | None = field(default=None, repr=False)
    """A map in its frame, to be drawn under it."""
    name: str
    """The trajectory."""
    path_length_m: float
    """Its length, metres."""
    duration_s: float
    """From its first pose to its last, seconds."""
    measures: Measures = field(metadata=FLAT)
    poses: int
    """Its poses."""
    estimate: Path
    """Its file."""
    relations: Path | None
    """The file of known relations."""
    odometry_file: Path | None
    """The file of raw odometry."""
    log: Path | None
    """The log that the trajectory was made from."""
    truth: Path | None
    """The file of the true trajectory."""

    def rows(self) -> list[Row]:
        """Return figures and single errors as rows of a table of results."""
        held = (self.measures.truth, self.measures.relations)
        return result_rows(*self.placed.keys, path_figures(*held), path_series(*held))


@dataclass(frozen=True, eq=False)
class TrajectoryDocument:
    """``slamfusion trajectory`` of one trajectory."""

    measured: MeasuredTrajectory = field(metadata=FLAT)
    settings: Settings = field(metadata=FLAT)


@dataclass(frozen=True, eq=False)
class CaseTrajectory:
    """One of several trajectories."""

    measured: MeasuredTrajectory = field(metadata=FLAT)
    placed: Placed = field(metadata=FLAT)


@dataclass(frozen=True, eq=False)
class TrajectoriesDocument:
    """``slamfusion trajectory`` of several; exit code 1 where something is ``not_measured``."""

    trajectories: Sequence[CaseTrajectory]
    """The trajectories in the order given."""
    summaries: Summaries = field(metadata=FLAT)
    not_measured: Sequence[str]
    """What could not be measured, a sentence each."""
    settings: Settings = field(metadata=FLAT)


def measure_trajectories(
    placed: Sequence[Placed], known: Mapping[str, KnownFiles], config: RunConfig | None = None
) -> tuple[list[MeasuredTrajectory], list[str]]:
    """Measure each path by the files of its case.

    Returns:
        The measured paths, in the order given, and a sentence for each other one.

    Raises:
        TrajectoryError: a file of a case is damaged, or the only path cannot be measured.
        LogError: a log cannot be read.
        SlamFusionError: none of the paths could be measured.
    """
    config = config or RunConfig()
    yardsticks = {}
    for case in dict.fromkeys(item.case for item in placed):
        files = known[case]
        held = Yardsticks.read(config, files.relations, files.odometry, files.truth)
        scans = None if files.log is None else read_trajectory(files.log, config.log)
        yardsticks[case] = replace(held, scans=scans)
    found, not_measured = [], []
    for item in placed:
        held = yardsticks[item.case]
        if held.relations is None and held.truth is None:
            not_measured.append(
                f"{item.path}: neither truth nor relations of {item.case} was given"
            )
            continue
        try:
            estimate = read_trajectory(item.path, config.log)
            measures = held.measure(estimate, config)
        except (SlamFusionError, OSError) as error:
            if len(placed) == 1:
                raise
            why = (error.strerror if isinstance(error, OSError) else None) or str(error)
            not_measured.append(f"{item.path}: {why.removeprefix(f'{item.path}: ')}")
            continue
        files = known[item.case]
        found.append(
            MeasuredTrajectory(
                placed=item,
                trajectory=estimate,
                held=held,
                name=estimate.name,
                path_length_m=estimate.path_length_m(),
                duration_s=float(estimate.stamps_s[-1] - estimate.stamps_s[0]),
                measures=measures,
                poses=len(estimate),
                estimate=item.path,
                relations=files.relations,
                odometry_file=files.odometry,
                log=files.log,
                truth=files.truth,
            )
        )
    if not found:
        raise SlamFusionError("; ".join(not_measured) or "no path to measure; give at least one")
    return found, not_measured


def trajectories_document(
    found: Sequence[MeasuredTrajectory], not_measured: Sequence[str], config: RunConfig
) -> TrajectoriesDocument:
    """Return what ``slamfusion trajectory`` prints of several paths as JSON."""
    from slamfusion.jobs.results import summaries  # noqa: PLC0415  (pandas is an extra)

    return TrajectoriesDocument(
        [CaseTrajectory(own, own.placed) for own in found],
        summaries(row for own in found for row in own.rows()),
        not_measured,
        Settings(config),
    )


def write_trajectories(
    found: Sequence[MeasuredTrajectory],
    directory: str | Path,
    config: RunConfig | None = None,
    files: AtomicFiles | None = None,
) -> Path:
    """Write one report of the errors of paths; see ``slamfusion.report.page.write_page``."""
    from slamfusion.report import MeasuredPath, write_trajectory_report  # noqa: PLC0415  (an extra)

    cases: dict[str, list[MeasuredPath]] = {}
    for own in found:
        errors = own.measures
        path = MeasuredPath(
            own.placed.name, own.trajectory, errors.truth, errors.relations, errors.at_scans
        )
        cases.setdefault(own.placed.case, []).append(path)
    first = found[0]
    return write_trajectory_report(
        directory,
        cases,
        config=config or RunConfig(),
        truths={own.placed.case: own.held.truth for own in found if own.held.truth is not None},
        odometry=first.held.scans if len(found) == 1 else None,
        grid=first.grid,
        files=files,
    )
