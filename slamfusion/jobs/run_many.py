"""The main job on many logs and seeds: each one a task, with results in a folder of its own."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import Row, map_figures, path_figures, path_series, result_rows
from slamfusion.evidence.recommendation import Recommendation
from slamfusion.fleet import as_done
from slamfusion.jobs.documents import settings_used
from slamfusion.jobs.inputs import Progress, distinct_names
from slamfusion.jobs.outputs import FUSED, REPORT, RUN_RECORD
from slamfusion.jobs.records import SettingsJson

if TYPE_CHECKING:
    from slamfusion.jobs.run import LogRun
    from slamfusion.jobs.run_files import SavedRun


class RunsDocument(SettingsJson):
    """``slamfusion run`` of several logs; exit code 1 for an ``error`` or ``not_measured``."""

    runs: Sequence[RunOfLog]
    """The logs, in the order given."""


@dataclass(frozen=True, eq=False)
class LogTask:
    """What is done with one log and one seed.

    Attributes:
        case: the log's name among the others.
        seed: of the run; None: that of the settings.
        probabilities: also write the producers' maps with their probabilities.
    """

    log: Path
    folder: Path
    case: str = ""
    seed: int | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    probabilities: bool = False


@dataclass(frozen=True, kw_only=True)
class RunOfLog:
    """The outcome of one of several logs."""

    log: Path
    """The log."""
    folder: Path | None = None
    """Folder of its files; null where none were written."""
    fused: Path | None = None
    """YAML file of the fused map; null where nothing was fused."""
    record: Path | None = None
    """The document of this run alone, as a file; null where nothing was fused."""
    report: Path | None = None
    """Folder of the report; null where none was written."""
    fused_count: int = 0
    """Inputs that voted."""
    recommendation: Recommendation | None = None
    """What to use, and what to check first; null if no map was made."""
    error: str | None = None
    """Why nothing was fused; null where it was."""
    warnings: Sequence[str] = ()
    """What was left out and what is doubtful, a sentence each."""
    not_measured: Sequence[str] = ()
    """What could not be measured, a sentence each."""
    time_s: float | None = None
    """Wall time, seconds; null where the log could not be run."""
    seed: int | None = None
    """Seed of the run; null: that of the settings."""
    rows: Sequence[Row] = field(default=(), repr=False)
    """What was measured of its maps and paths."""

    @classmethod
    def of(cls, task: LogTask, run: LogRun, saved: SavedRun, warnings: Sequence[str]) -> RunOfLog:
        """Return the outcome of a task, with where its files lie and the warnings of its inputs."""
        is_fused = run.usable is not None
        return cls(
            log=task.log,
            seed=task.seed,
            folder=saved.folder,
            fused=saved.folder / f"{FUSED}.yaml" if is_fused else None,
            record=saved.folder / RUN_RECORD if is_fused else None,
            report=saved.folder / REPORT,
            fused_count=len(run.usable.accepted) if run.usable is not None else 0,
            recommendation=run.recommendation,
            error=None if run.failure is None else str(run.failure),
            warnings=(*warnings, *run.sentences()),
            not_measured=run.not_measured,
            time_s=saved.document["time_s"],
            rows=run_rows(run, task.case, "" if task.seed is None else str(task.seed)),
        )


def run_rows(run: LogRun, case: str, seed: str = "") -> list[Row]:
    """Return the errors of the maps and paths of a run as rows of a table of results."""
    maps = {item.name: map_figures(item) for item in run.evaluations}
    measures = {name: item.measures for name, item in run.results.items()}
    measures |= {name: item.measures for name, item in run.saved_paths.items()}
    if run.fused_path is not None:
        measures[FUSED] = run.fused_path.measures
    rows = []
    for name in dict.fromkeys((*measures, *maps)):
        own = measures.get(name)
        held = (None, None) if own is None else (own.truth, own.relations)
        figures = {**path_figures(*held), **maps.get(name, {})}
        rows += result_rows(case, seed, name, figures, path_series(*held))
    return rows


def log_tasks(
    logs: Sequence[Path],
    folder: Path,
    options: Mapping[str, Any] | None = None,
    *,
    seeds: Sequence[int] = (),
    probabilities: bool = False,
) -> tuple[LogTask, ...]:
    """Return a task for each log and seed, with results in ``folder/NAME/seed-N``.

    NAME is the log's file without its ending, and what tells it from the others where there are
    several of one name: its ending, or as many of its folders as that takes. Without seeds the
    results go to ``folder/NAME``.
    """
    names = [name.replace("/", "-") for name in distinct_names(logs)]
    stems = [Path(name).stem for name in names]
    names = stems if len(set(stems)) == len(stems) else names
    return tuple(
        LogTask(
            log.absolute(),
            folder.absolute() / name / ("" if seed is None else f"seed-{seed}"),
            name,
            seed,
            options or {},
            probabilities,
        )
        for log, name in zip(logs, names, strict=True)
        for seed in seeds or (None,)
    )


def run_logs(
    tasks: Sequence[LogTask],
    config: RunConfig,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> tuple[RunOfLog, ...]:
    """Run the main job on each log, and write its files; see ``run_log`` and ``save_run``.

    Logs are read and results are written where the tasks are done: workers of other machines need
    the same folders under the same names.

    Returns:
        The outcome of each, in order. One that fails is named there and raises nothing.
    """
    done: dict[LogTask, RunOfLog] = {}

    def tell(count: float) -> None:
        if progress is not None:
            progress("logs", count, len(tasks))

    tell(0.0)
    for task, (found, host) in as_done(executor, run_one, tasks, config, progress=tell):
        if found.error is not None and host != socket.gethostname():
            # A folder may be missing on that machine.
            found = replace(found, error=f"{found.error} (on {host})")  # noqa: PLW2901
        done[task] = found
    return tuple(done[task] for task in tasks)


def run_one(
    task: LogTask, config: RunConfig, tell: Callable[[float], None]
) -> tuple[RunOfLog, str]:
    """Run the main job on a log; return the outcome, and the machine that did it."""
    # Where the task is done, not where it is handed over: the SLAMs load slowly.
    from slamfusion.jobs.run import WHOLE, run_log  # noqa: PLC0415
    from slamfusion.jobs.run_files import load_report, save_run  # noqa: PLC0415

    warnings: list[str] = []

    def progress(stage: str, done: float, total: int) -> None:
        if stage == WHOLE:
            tell(done / total)

    try:
        own = config if task.seed is None else replace(config, seed=task.seed)
        run = run_log(
            task.log, own, **task.options,
            progress=progress, warn=warnings.append, prepare=load_report,
        )  # fmt: skip
        saved = save_run(run, task.folder, probabilities=task.probabilities)
    except (SlamFusionError, OSError) as error:
        words = " ".join(str(error).split())
        failed = RunOfLog(log=task.log, seed=task.seed, error=words, warnings=tuple(warnings))
        return failed, socket.gethostname()
    return RunOfLog.of(task, run, saved, warnings), socket.gethostname()


def runs_document(runs: Sequence[RunOfLog], config: RunConfig) -> RunsDocument:
    """Return what ``slamfusion run`` prints as JSON of several logs."""
    return {"runs": runs, **settings_used(config)}
