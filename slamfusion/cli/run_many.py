"""``slamfusion run`` with several logs: each one a task, with a folder of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.output import notice, print_json, print_table, progress_bar
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.jobs.documents import number
from slamfusion.jobs.outputs import PAGE

if TYPE_CHECKING:
    from slamfusion.jobs.run_many import RunOfLog

# What belongs to one log.
OF_ONE_LOG = ("paths", "truth", "truth_trajectory", "relations", "odometry", "scan_odometry")


def run_many(
    logs: Sequence[Path],
    out: Path,
    config: RunConfig,
    scheduler: str | None,
    asked: Mapping[str, Any],
    *,
    as_json: bool,
) -> int:
    """Run the main job on each log, and say what came of each."""
    from slamfusion.fleet import executor_for  # noqa: PLC0415
    from slamfusion.jobs.run_many import log_tasks, run_logs, runs_document  # noqa: PLC0415

    _refuse_files_of_one_log(config, asked)
    tasks = log_tasks(
        logs, out, asked["maps"], asked["resolution"], probabilities=asked["probabilities"]
    )
    with (
        executor_for(scheduler, device=config.device.device) as executor,
        progress_bar() as progress,
    ):
        runs = run_logs(tasks, config, executor, progress)
    for run in runs:
        for sentence in run.warnings:
            notice(f"{run.log.name}: {sentence}")
    if as_json:
        print_json(runs_document(runs, config))
    else:
        _print(runs)
    if reason := _failure(runs):
        raise SlamFusionError(reason)
    return 0


def _failure(runs: Sequence[RunOfLog]) -> str:
    """Return of which logs there is no fused map, or not every measure; empty: of none."""
    failed = [run for run in runs if run.error is not None]
    unmeasured = [run for run in runs if run.error is None and run.not_measured]
    reasons = []
    if failed:
        words = "; ".join(f"{run.log.name}: {run.error}" for run in failed)
        reasons.append(f"{len(failed)} of {len(runs)} logs have no fused map ({words})")
    if unmeasured:
        words = "; ".join(f"{run.log.name}: {', '.join(run.not_measured)}" for run in unmeasured)
        reasons.append(
            f"of {len(unmeasured)} of {len(runs)} logs not all could be measured ({words})"
        )
    return "; ".join(reasons)


def _refuse_files_of_one_log(config: RunConfig, asked: Mapping[str, Any]) -> None:
    """Refuse what says something of one log alone."""
    for name in OF_ONE_LOG:
        if asked[name]:
            option = "--" + name.replace("_", "-")
            message = f"{option} belongs to one log; run each log that has such a file alone"
            raise click.UsageError(message)
    if config.start:
        message = "--start belongs to one log; run each log that needs it alone"
        raise click.UsageError(message)


def _print(runs: Sequence[RunOfLog]) -> None:
    """Print a row for each log, and where the reports lie."""
    print_table(
        ("log ", "fused", "use ", "s", "fused map "),
        [
            [
                run.log.name,
                str(run.fused_count) if run.fused_count else "-",
                (run.recommendation and run.recommendation.use) or "-",
                number(run.time_s, 1),
                str(run.fused or "-"),
            ]
            for run in runs
        ],
        notes=["" if run.error is None else f"NO FUSED MAP: {run.error}" for run in runs],
        title=f"{len(runs)} logs",
    )
    for run in runs:
        if run.report is not None:
            print(f"report:    {run.report / PAGE}")
