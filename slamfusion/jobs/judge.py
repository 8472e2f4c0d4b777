"""Which path of a drive to use, with no truth to go by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError, TrajectoryError
from slamfusion.evaluation.measured import (
    GroundTruth,
    MeasuredPath,
    Measures,
    Row,
    error_series,
    rankings,
    result_rows,
)
from slamfusion.evaluation.trajectory_error import on_clock
from slamfusion.evidence.beams import judged_scans
from slamfusion.evidence.predictive import PathEvidence, score_paths
from slamfusion.evidence.recommendation import RankedPath, Recommendation, recommend
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.io import open_log, read_trajectory, write_tum
from slamfusion.jobs.cases import Placed
from slamfusion.jobs.fused_path import FusedPath, fuse_weighed_paths, path_at_scans
from slamfusion.jobs.inputs import LogFiles, Warn, as_path, device_for, distinct_names, log_warning
from slamfusion.jobs.outputs import FUSED
from slamfusion.jobs.records import Circumstances, Summaries
from slamfusion.json_values import FLAT
from slamfusion.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class JudgedPaths:
    """The paths of a log, what its scans say of them, and their errors."""

    evidence: PathEvidence = field(repr=False)
    recommendation: Recommendation
    """Which path to use, and what to check first."""
    path_evidence: Sequence[RankedPath] = field(init=False)
    """What the scans say of each path, the recommended one first."""
    paths: Sequence[MeasuredPath]
    """The paths as they were given."""
    fused_path: FusedPath | None
    """The path fused of them, with ``--fused``."""
    ranking_by_truth: Sequence[str] = field(init=False)
    """The paths by their ATE, the least first; empty without a truth."""
    ranking_by_relations: Sequence[str] = field(init=False)
    """The paths by their mean error on the relations, the least first; empty without relations."""
    not_measured: Sequence[str]
    """What could not be measured, a sentence each."""
    files: LogFiles = field(metadata=FLAT)
    circumstances: Circumstances = field(repr=False)

    def __post_init__(self) -> None:
        """Rank the paths."""
        ranked = rankings(self.measured)
        vars(self).update(
            path_evidence=self.recommendation.paths,
            ranking_by_truth=tuple(ranked["ATE"]),
            ranking_by_relations=tuple(ranked["relations"]),
        )

    @property
    def measured(self) -> tuple[MeasuredPath, ...]:
        """The paths as they were given, and the fused one, if there is one."""
        return (*self.paths, *(() if self.fused_path is None else (self.fused_path,)))

    def rows(self, case: str, placed: Sequence[Placed]) -> list[Row]:
        """Return figures and single scores of each path as rows, the recommended path first."""
        by_name = {item.name: item for item in placed if item.case == case}
        errors = {item.name: item.measures for item in self.measured}
        rows: list[Row] = []
        for path in self.recommendation.paths:
            score = self.evidence.scores[path.name]
            keys = by_name.get(path.name, Placed(case, path.name, Path())).keys
            measures = errors[path.name]
            figures = {"consistency": score.consistency, "seen_share": score.seen_share}
            is_judged = score.beams > 0
            likelihoods = error_series(
                score.sums[is_judged] / score.beams[is_judged],
                self.evidence.scans.stamps_s[is_judged],
            )
            series = {"consistency": likelihoods, **measures.series()}
            rows += result_rows(*keys, {**figures, **measures.figures()}, series)
        return rows


@dataclass(frozen=True, eq=False)
class JudgeDocument:
    """``slamfusion judge`` of one log; exit code 1 where something is ``not_measured``."""

    judged: JudgedPaths = field(metadata=FLAT)
    circumstances: Circumstances = field(metadata=FLAT)


@dataclass(frozen=True, eq=False)
class CaseJudgement:
    """One of several logs."""

    judged: JudgedPaths = field(metadata=FLAT)
    case: str
    """Its name."""


@dataclass(frozen=True, eq=False)
class JudgementsDocument:
    """``slamfusion judge`` of several logs; exit code 1 where something is ``not_measured``."""

    logs: Sequence[CaseJudgement]
    """The logs in the order given; paths are named by what made them."""
    summaries: Summaries = field(metadata=FLAT)
    circumstances: Circumstances = field(metadata=FLAT)


def judge_paths(
    log: str | Path,
    paths: Sequence[str | Path] | Mapping[str, str | Path],
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    relations: str | Path | None = None,
    odometry: str | Path | None = None,
    truth: str | Path | None = None,
    scan_odometry: str | Path | None = None,
    fused: str | Path | None = None,
    warn: Warn = log_warning,
) -> JudgedPaths:
    """Rank the paths of a log by its scans, and measure their errors if there is a truth.

    Args:
        log: a CARMEN or tinySLAM log, or a ROS bag.
        paths: files of poses on the clock of the log, made by any SLAM, each in its own frame; or
            a mapping from names to such files.
        relations: known motions between pairs of times: errors of the paths.
        odometry: raw odometry of the whole run, to carry poses on to the relations' times.
        truth: the true trajectory: errors of the paths.
        scan_odometry: replaces the odometry of the log's scans.
        fused: fuse the paths as ``run`` does and judge the result, too; the file that
            ``write_fused_path`` will write.

    Raises:
        LogError: the log cannot be read, or has too few scans.
        TrajectoryError: a file of poses or relations cannot be read, a path and the scans have no
            times in common, or paths cannot be fused.
        GraphError: the equations of the fused path cannot be solved.
    """
    if not paths:
        raise TrajectoryError(f"{log}: no path to judge; give at least one file of poses")
    config = config or RunConfig()
    if not isinstance(paths, Mapping):
        paths = dict(zip(distinct_names([*map(Path, paths)]), paths, strict=True))
    given = {name: Path(path) for name, path in paths.items()}
    fused_file = as_path(fused)
    if fused_file is not None:
        _check_fused(given)
    read = {name: read_trajectory(path, config.log) for name, path in given.items()}
    others = map(as_path, (relations, odometry, truth))
    files = LogFiles(Path(log), *others, scan_odometry=as_path(scan_odometry))
    ground_truth = GroundTruth.read(config, relations, odometry, truth, warn)
    device = device_for(config, device)
    source = open_log(log, config.log, files.scan_odometry)
    scans = judged_scans(source)
    for sentence in (*source.skips.sentences(), *source.warnings.sentences(), *source.notes):
        warn(f"{log}: {sentence}")
    wheels = scans.driven
    offset = config.trajectory.time_offset
    read = {name: replace(on_clock(path, wheels, offset), name=name) for name, path in read.items()}
    evidence = score_paths(scans, read, device)
    fused_path = None
    if fused_file is not None:
        fused_path, with_fused = _fuse(read, evidence)
        evidence = with_fused or evidence
    found = recommend(evidence, tuple(read), fused=None if fused_path is None else FUSED)
    for name, fault in found.path_faults():
        warn(f"{name}: {fault}")
    not_measured = []

    def measured(path: Trajectory) -> Measures:
        try:
            return ground_truth.measure(path, config, wheels)
        except SlamFusionError as error:
            not_measured.append(f"{path.name}: {error}")
        return Measures()

    paths_found = [
        MeasuredPath(trajectory=path, measures=measured(path), file=given[name])
        for name, path in read.items()
    ]
    if fused_path is not None:
        own = measured(fused_path.trajectory)
        fused_path = replace(fused_path, measures=own, file=fused_file)
    return JudgedPaths(
        evidence=evidence,
        recommendation=found,
        paths=paths_found,
        fused_path=fused_path,
        not_measured=not_measured,
        files=files,
        circumstances=Circumstances(device.name, config),
    )


def write_fused_path(found: JudgedPaths) -> None:
    """Write the fused path as TUM, if there is one."""
    fused = found.fused_path
    if fused is not None and fused.file is not None:
        write_tum(fused.file, fused.trajectory)


def write_judgement(found: JudgedPaths, directory: str | Path) -> Path:
    """Write the report of which path to use; see ``slamfusion.report.page.write_page``."""
    from slamfusion.report import page, paths  # noqa: PLC0415  (an extra)

    answer, evidence, made_by = found.recommendation, found.evidence, found.circumstances
    strip = paths.strip_picture(answer, paths.path_colours(answer, evidence, {}))
    sections = [
        page.Section("Over the drive", "", [strip]),
        paths.evidence_section(answer, evidence),
    ]
    if known := {kind: own for kind, own in rankings(found.measured).items() if own}:
        rows = [
            (path.name, [own.get(path.name, (None, None)) for own in known.values()])
            for path in answer.paths
        ]
        heads = [word for kind in known for word in (f"#{kind} [m]", "#rank")]
        text = "The order by the scans next to the errors against the truth or known relations."
        table = page.tables().ranks(heads, rows)
        sections.append(page.Section("Compared with what is known", text, tables=table))
    lines = answer.lines()
    lines += [(f"{name}:", fault) for name, fault in answer.path_faults()]
    lines += [("Not measured:", sentence) for sentence in found.not_measured]
    lines.append(("Log:", str(found.files.log)))
    facts = [
        page.Fact(
            f"{path.consistency:.3f}",
            f"log-likelihood of a hit, {path.name}",
            "good" if path.behind_95 is None else "plain",
        )
        for path in answer.paths
    ]
    banner = page.Banner(answer.tone, answer.headline, lines)
    report = page.Page("SLAMfusion judge", banner, facts, sections, made_by.config, made_by.device)
    return page.write_page(report, directory)


def _check_fused(files: Mapping[str, Path]) -> None:
    """Refuse paths of which none can be fused, before any work."""
    if len(files) < LEAST_FUSED:
        message = f"{len(files)} path cannot be fused; give at least {LEAST_FUSED}"
        raise TrajectoryError(message)
    if FUSED in files:
        raise TrajectoryError(
            f"{files[FUSED]}: the path that is made of the others is called {FUSED}, too; "
            "give this one another name, or leave it out"
        )


def _fuse(
    paths: Mapping[str, Trajectory], evidence: PathEvidence
) -> tuple[FusedPath, PathEvidence | None]:
    """Make one path of several, each at the scans that it has a pose for or odometry gives one."""
    at_scans = {}
    for name, path in paths.items():
        try:
            at_scans[name] = path_at_scans(path, evidence.scans)
        except TrajectoryError as error:
            raise TrajectoryError(f"{name}: {error}") from error
    return fuse_weighed_paths(at_scans, evidence)
