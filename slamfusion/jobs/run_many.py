"""The main job on many logs and seeds: each one a task, with results in a folder of its own."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError, error_text
from slamfusion.evaluation.measured import Measures, Row, map_figures, result_rows
from slamfusion.evidence.recommendation import Recommendation
from slamfusion.fleet import as_done
from slamfusion.jobs.fuse_documents import unaligned_sentences
from slamfusion.jobs.inputs import Progress, check_count, distinct_names
from slamfusion.jobs.outputs import FUSED, REPORT, RUN_RECORD
from slamfusion.jobs.records import Settings
from slamfusion.json_values import FLAT
from slamfusion.slam.registry import BUILT_IN, with_producers

if TYPE_CHECKING:
    from slamfusion.jobs.run_files import LogRun


@dataclass(frozen=True, eq=False)
class LogTask:
    """A log and a seed (None: that of the settings), and the folder of the results.

    Attributes:
        name: of the log in tables and messages: its file, or what tells it from others so named.
    """

    log: Path
    folder: Path
    case: str = ""
    name: str = ""
    seed: int | None = None
    probabilities: bool = False
    host: str = field(default_factory=socket.gethostname)


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
    name: str = field(default="", repr=False)


@dataclass(frozen=True)
class RunsDocument:
    """``slamfusion run`` of several logs; exit code 1 for an ``error`` or ``not_measured``."""

    runs: Sequence[RunOfLog]
    """The logs, in the order given."""
    settings: Settings = field(metadata=FLAT)


def run_rows(run: LogRun, case: str, seed: str = "") -> list[Row]:
    """Return the errors of the maps and paths of a run as rows of a table of results."""
    maps = {item.name: map_figures(item) for item in run.evaluations}
    paths = {name: own.measures for name, own in run.paths.items()}
    if run.fused_path is not None:
        paths[FUSED] = run.fused_path.measures
    rows = []
    for name in dict.fromkeys((*paths, *maps)):
        measures = paths.get(name, Measures())
        figures = {**measures.figures(), **maps.get(name, {})}
        rows += result_rows(case, seed, name, figures, measures.series())
    return rows


def log_tasks(
    logs: Sequence[Path], folder: Path, seeds: Sequence[int] = (), *, probabilities: bool = False
) -> list[LogTask]:
    """Return a task for each log and seed; results: ``folder/NAME`` or ``folder/NAME/seed-N``.

    NAME is the log's name without its ending; of several with one name, with what distinguishes it:
    its ending, or its folders.
    """
    names = [name.replace("/", "-") for name in distinct_names(logs)]
    stems = [Path(name).stem for name in names]
    names = stems if len(set(stems)) == len(stems) else names
    is_shared = len({log.name for log in logs}) < len(logs)
    return [
        LogTask(
            log.absolute(),
            folder.absolute() / name / ("" if seed is None else f"seed-{seed}"),
            name,
            (name if is_shared else log.name) + ("" if seed is None else f" seed {seed}"),
            seed,
            probabilities,
        )
        for log, name in zip(logs, names, strict=True)
        for seed in seeds or (None,)
    ]


def run_logs(
    tasks: Sequence[LogTask],
    config: RunConfig,
    options: Mapping[str, Any] | None = None,
    *,
    executor: Executor | None = None,
    progress: Progress = lambda *_: None,
) -> list[RunOfLog]:
    """Run the main job on each log and write its files; a failure is in the log's outcome.

    Logs and results are on the workers' file systems: other machines need the same folders.

    Args:
        options: arguments of ``run_log``.

    Raises:
        ConfigError: an unknown producer, or one alone without a saved map: no log could be run.
    """
    options = options or {}
    names = config.run.producers or BUILT_IN
    config = with_producers(config, names)
    check_count(*names, *map(str, options.get("saved_maps", ())))

    def tell(count: float) -> None:
        progress("logs", count, len(tasks))

    tell(0.0)
    done = dict(as_done(executor, run_one, tasks, config, options, progress=tell))
    return [done[task] for task in tasks]


def run_one(
    task: LogTask, config: RunConfig, options: Mapping[str, Any], tell: Callable[[float], None]
) -> RunOfLog:
    """Run the main job on a log and return the outcome."""
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
            task.log, own, **options, progress=progress, warn=warnings.append, prepare=load_report
        )
        run = save_run(run, task.folder, probabilities=task.probabilities)
    except (SlamFusionError, OSError) as error:
        words, host = " ".join(error_text(error, task.log).split()), socket.gethostname()
        if host != task.host:  # a folder may be missing on that machine
            words += f" (on {host})"
        return RunOfLog(
            log=task.log, seed=task.seed, error=words, warnings=warnings, name=task.name
        )
    return outcome(task, run, warnings)


def outcome(task: LogTask, run: LogRun, warnings: Sequence[str]) -> RunOfLog:
    """Return the outcome of a task whose files are written; ``warnings`` of its inputs."""
    odd = (*unaligned_sentences(run.evaluations), *map(": ".join, run.log_faults()))
    return RunOfLog(
        log=task.log,
        seed=task.seed,
        name=task.name,
        folder=run.folder,
        fused=run.fused,
        record=None if run.fused is None else run.folder / RUN_RECORD,
        report=run.folder / REPORT,
        fused_count=0 if run.usable is None else len(run.usable.accepted),
        recommendation=run.recommendation,
        error=run.error,
        warnings=(*warnings, *odd, *run.sentences()),
        not_measured=run.not_measured,
        time_s=run.time_s,
        rows=run_rows(run, task.case, "" if task.seed is None else str(task.seed)),
    )
