"""Several maps or paths in several cases: the jobs of one, and the means over all.

A case is a truth or a log; ``slamfusion.jobs.cases`` says which file belongs to which.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import (
    DistanceComparison,
    MeasuredItem,
    load_distances,
)
from slamfusion.io import AtomicFiles, read_trajectory
from slamfusion.jobs.cases import Placed
from slamfusion.jobs.documents import circumstances, settings_used
from slamfusion.jobs.evaluate import (
    Evaluation,
    evaluate_maps,
    evaluated_items,
    measure_distances,
    write_evaluation,
)
from slamfusion.jobs.inputs import (
    Progress,
    Warn,
    device_for,
    distinct_names,
    load_maps,
    map_file,
)
from slamfusion.jobs.judge import JudgedPaths, judge_paths, write_judgement
from slamfusion.jobs.records import (
    CaseEvaluationJson,
    CasesEvaluationDocument,
    CaseTrajectoryJson,
    JudgementsDocument,
    TrajectoriesDocument,
)
from slamfusion.jobs.results import summaries
from slamfusion.jobs.trajectory import (
    CaseFiles,
    MeasuredTrajectory,
    Yardsticks,
    write_trajectory,
)

__all__ = [
    "CaseEvaluations",
    "CaseTrajectories",
    "JudgedLogs",
    "evaluate_cases",
    "judge_logs",
    "measure_trajectories",
    "write_case_evaluations",
    "write_judgements",
    "write_trajectories",
]

_LOG = logging.getLogger(__name__)


# --- maps -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CaseEvaluations:
    """The errors of maps, each against the truth of its case.

    Attributes:
        placed: the maps' files in the order given.
        evaluations: of these.
        truths: the true maps' files, by case.
        config: the settings in effect.
        device: what computed, in words.
        distances: of the maps against measured distances; empty without them.
    """

    placed: tuple[Placed, ...]
    evaluations: tuple[Evaluation, ...]
    truths: Mapping[str, Path]
    config: RunConfig
    device: str
    distances: tuple[DistanceComparison, ...] = ()

    def items(self) -> list[MeasuredItem]:
        """Return the figures of each map."""
        return evaluated_items(self.placed, self.evaluations)

    def to_json(self) -> CasesEvaluationDocument:
        """Return what ``slamfusion evaluate`` prints as JSON."""
        maps: list[CaseEvaluationJson] = [
            {**evaluation.to_json(), **placed.to_json()}
            for placed, evaluation in zip(self.placed, self.evaluations, strict=True)
        ]
        return {
            "maps": maps,
            **summaries(self.items()),
            "distances": [comparison.to_json() for comparison in self.distances],
            "truths": {case: str(path) for case, path in self.truths.items()},
            **circumstances(self.config, self.device),
        }


def evaluate_cases(
    placed: Sequence[Placed],
    truths: Mapping[str, Path],
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    align: bool = True,
    resolution: float | None = None,
    distances: str | Path | None = None,
    progress: Progress | None = None,
    warn: Warn = _LOG.warning,
) -> CaseEvaluations:
    """Compare each map with the truth of its case; see ``evaluate_maps``.

    Args:
        placed: the maps.
        truths: the true maps, by case.
        config, device, align, resolution: see ``evaluate_maps``.
        distances: distances measured in the building, to be compared with those in each map, too;
            see ``measure_distances``.
        progress: told the maps that are done.
        warn: told in a sentence what is doubtful about a map.

    Raises:
        MapFileError, GridError, DeviceError: see ``evaluate_maps``.
    """
    config = config or RunConfig()
    device = device_for(config, device)
    true_grids = {
        case: load_maps([path], resolution, config.map_files, warn)[0].with_name(case)
        for case, path in truths.items()
    }
    rows = () if distances is None else load_distances(distances)
    names = distinct_names([map_file(item.path) for item in placed])
    evaluations: list[Evaluation] = []
    compared: list[DistanceComparison] = []
    for done, (item, name) in enumerate(zip(placed, names, strict=True)):
        if progress is not None:
            progress("evaluate", done, len(placed))
        (grid,) = load_maps([item.path], resolution, config.map_files, warn)
        evaluations += evaluate_maps(
            [grid.with_name(item.name)], true_grids[item.case], config, device, align=align
        )
        if rows:
            compared += measure_distances([grid.with_name(name)], rows, config)
    if progress is not None:
        progress("evaluate", len(placed), len(placed))
    return CaseEvaluations(
        tuple(placed), tuple(evaluations), dict(truths), config, device.name, tuple(compared)
    )


def write_case_evaluations(
    found: CaseEvaluations, *, report: Path | None = None, image: Path | None = None
) -> None:
    """Write a report a case, and the difference images, that are asked for; all or none.

    Args:
        found: what was measured.
        report: folder of a folder for each case; None: no reports.
        image: picture of the differences, whose name is followed by case and map; None: none.

    Raises:
        SlamFusionError: matplotlib is missing, or a file cannot be written.
    """
    with AtomicFiles() as files:
        for case in found.truths:
            own = [
                evaluation
                for placed, evaluation in zip(found.placed, found.evaluations, strict=True)
                if placed.case == case
            ]
            if own:
                write_evaluation(
                    own,
                    found.config,
                    device=found.device,
                    report=None if report is None else report / case,
                    image=None if image is None else image.with_stem(f"{image.stem}_{case}"),
                    name_each=True,
                    files=files,
                )


# --- paths against truths and relations ---------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CaseTrajectories:
    """Several paths with their errors.

    Attributes:
        placed: the files of those that could be measured, in the order given.
        measured: their errors.
        not_measured: what could not be measured, a sentence each.
        config: the settings in effect.
    """

    placed: tuple[Placed, ...]
    measured: tuple[MeasuredTrajectory, ...]
    not_measured: tuple[str, ...]
    config: RunConfig

    def items(self) -> list[MeasuredItem]:
        """Return the figures and single errors of each path."""
        return [
            measured.item(placed)
            for placed, measured in zip(self.placed, self.measured, strict=True)
        ]

    def to_json(self) -> TrajectoriesDocument:
        """Return what ``slamfusion trajectory`` prints of several as JSON."""
        paths: list[CaseTrajectoryJson] = [
            {**measured.record_to_json(), **placed.to_json()}
            for placed, measured in zip(self.placed, self.measured, strict=True)
        ]
        return {
            "trajectories": paths,
            **summaries(self.items()),
            "not_measured": self.not_measured,
            **settings_used(self.config),
        }


def measure_trajectories(
    placed: Sequence[Placed], held: CaseFiles, config: RunConfig | None = None
) -> CaseTrajectories:
    """Measure paths, each by what there is of its case.

    Args:
        placed: the paths.
        held: what they are measured by.
        config: ``trajectory`` and ``log`` are used; default: the defaults.

    Raises:
        TrajectoryError: a file of a case is damaged.
        LogError: a log cannot be read.
        OSError: a file cannot be opened.
        SlamFusionError: none of the paths could be measured.
    """
    config = config or RunConfig()
    yardsticks = {}
    for case in dict.fromkeys(item.case for item in placed):
        log = held.logs.get(case)
        yardsticks[case] = (
            Yardsticks.read(
                config,
                relations=held.relations.get(case),
                odometry=held.odometry.get(case),
                truth=held.truths.get(case),
            ),
            None if log is None else read_trajectory(log, config.log),
        )
    kept, measured, not_measured = [], [], []
    for item in placed:
        known, scans = yardsticks[item.case]
        if known.relations is None and known.truth is None:
            not_measured.append(
                f"{item.path}: neither truth nor relations of {item.case} was given"
            )
            continue
        try:
            estimate = read_trajectory(item.path, config.log)
            measures = known.measure(estimate, config, scans)
        except (SlamFusionError, OSError) as error:
            not_measured.append(f"{item.path}: {_without(item.path, error)}")
            continue
        kept.append(item)
        files = held.of(item.case, item.path)
        measured.append(MeasuredTrajectory(files, config, estimate, measures, known.truth, scans))
    if not measured:
        raise SlamFusionError("; ".join(not_measured) or "no path to measure; give at least one")
    return CaseTrajectories(tuple(kept), tuple(measured), tuple(not_measured), config)


def _without(path: Path, error: SlamFusionError | OSError) -> str:
    """Return what an error says beside the path."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return str(error).removeprefix(f"{path}: ")


def write_trajectories(found: CaseTrajectories, directory: Path) -> None:
    """Write the reports of all paths, ``CASE/METHOD`` each, all or none.

    Args:
        found: what was measured.
        directory: of their folders.

    Raises:
        SlamFusionError: matplotlib is missing, or a file cannot be written.
    """
    with AtomicFiles() as files:
        for placed, measured in zip(found.placed, found.measured, strict=True):
            write_trajectory(measured, report_folder(directory, placed), files)


def report_folder(directory: Path, placed: Placed) -> Path:
    """Return the folder of the report of one of several paths."""
    return directory / placed.case / placed.name.replace("/", "_")


# --- paths of several logs ----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class JudgedLogs:
    """What the scans of several logs say of their paths.

    Attributes:
        logs: by case, its paths named by their methods and seeds.
        placed: the paths' files.
        config: the settings in effect.
    """

    logs: Mapping[str, JudgedPaths]
    placed: tuple[Placed, ...]
    config: RunConfig

    @property
    def device(self) -> str:
        """What computed, in words."""
        return next(iter(self.logs.values())).device

    @property
    def not_measured(self) -> list[str]:
        """What could not be measured, a sentence each."""
        return [
            f"{case}: {sentence}"
            for case, found in self.logs.items()
            for sentence in found.not_measured
        ]

    def items(self) -> list[MeasuredItem]:
        """Return the figures and single scores of each path of each log."""
        return [
            item for case, found in self.logs.items() for item in found.items(case, self.placed)
        ]

    def to_json(self) -> JudgementsDocument:
        """Return what ``slamfusion judge`` prints of several logs as JSON."""
        return {
            "logs": [{**found.record_to_json(), "case": case} for case, found in self.logs.items()],
            **summaries(self.items()),
            **circumstances(self.config, self.device),
        }


def judge_logs(
    placed: Sequence[Placed],
    held: CaseFiles,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    progress: Progress | None = None,
    warn: Warn = _LOG.warning,
) -> JudgedLogs:
    """Rank the paths of each of several logs; see ``judge_paths``.

    Args:
        placed: the paths.
        held: ``logs`` and what the paths are measured by.
        config, device: see ``judge_paths``.
        progress: told the logs that are done.
        warn: told in a sentence what is doubtful about a log.

    Raises:
        SlamFusionError: a log has no path; or see ``judge_paths``.
        OSError: a file cannot be opened.
    """
    config = config or RunConfig()
    device = device_for(config, device)
    found = {}
    for done, (case, log) in enumerate(held.logs.items()):
        if progress is not None:
            progress("judge", done, len(held.logs))
        paths = {item.name: item.path for item in placed if item.case == case}
        found[case] = judge_paths(
            log,
            paths,
            config,
            device,
            relations=held.relations.get(case),
            odometry=held.odometry.get(case),
            truth=held.truths.get(case),
            scan_odometry=held.scan_odometry.get(case),
            warn=warn,
        )
    if progress is not None:
        progress("judge", len(held.logs), len(held.logs))
    return JudgedLogs(found, tuple(placed), config)


def write_judgements(found: JudgedLogs, directory: Path) -> None:
    """Write a report a log, in a folder of its case's name each, all or none.

    Args:
        found: what the scans say.
        directory: of the folders.

    Raises:
        SlamFusionError: matplotlib is missing, or a file cannot be written.
    """
    with AtomicFiles() as files:
        for case, judged in found.logs.items():
            write_judgement(judged, directory / case, files)
