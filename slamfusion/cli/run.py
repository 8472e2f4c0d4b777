"""``slamfusion run``: the main job. The producers on one log, their fusion, errors and report."""

from __future__ import annotations

import importlib.util
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from slamfusion import evaluation, jobs
from slamfusion.cli import options, output, results, tables
from slamfusion.cli.help import Command
from slamfusion.cli.paths import CASE_FILE, FILE, MAP
from slamfusion.config import PAGE, RunConfig
from slamfusion.errors import ConfigError, SlamFusionError, counted
from slamfusion.fleet import executor_for
from slamfusion.io.lines import MAP_SUFFIXES
from slamfusion.jobs.cases import case_of
from slamfusion.jobs.inputs import RUN_DEFAULTS
from slamfusion.jobs.outputs import FAILED, FUSED, REPORT, possible_outputs, possible_report
from slamfusion.jobs.records import Settings, number

# Columns of the table of SLAMs, and their number without --verbose; the errors with their figures
# and digits.
ERRORS = {
    "ATE rmse [m]": ("ate_rmse_m", 3),
    "relations mean [m]": ("relations_mean_m", 4),
    "map error": ("error", 1),
    "wall F1": ("wall_f1", 3),
}
COLUMNS = (
    *("SLAM ", "votes", *ERRORS),
    "time [s]",
    "scan mean [ms]",
    "scan 95 % [ms]",
    "scans used",
    "memory [MB]",
    "match score, mean",
)
BRIEF = 7
# Suffixes of what may follow an option's value as one more; no log has such a name.
MORE = {"--inputs": MAP_SUFFIXES, "--paths": (".tum", ".csv")}


class _ManyInputs(Command):
    """Takes ``--inputs A B`` for ``--inputs A --inputs B``, and likewise ``--paths``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the option before each map or path that follows another one."""
        spread: list[str] = []
        option, wants = "", False
        for argument in args:
            if wants:
                wants = False
            elif argument in MORE:
                option, wants = argument, True
            elif option and Path(argument).suffix in MORE[option]:
                spread.append(option)
            else:
                option = ""
            spread.append(argument)
        return super().parse_args(ctx, spread)


def _files(out: Path, given: Mapping[str, Any]) -> list[Path]:
    """Return what may be written, or removed of an earlier run: of several logs, for each."""
    if out.exists() and not out.is_dir():
        raise click.UsageError(f"-o {out} is not a folder; name one for the maps and the report")
    logs, seeds = given["logs"], given["seeds"]
    runs = [out]
    if len(logs) > 1 or seeds:
        runs = [task.folder for task in jobs.run_many.log_tasks(logs, out, seeds)]
    return [
        file
        for run in runs
        for folder in (run, run / FAILED)
        for file in (*possible_outputs(folder), *possible_report(folder / REPORT))
    ]


@click.command(
    "run",
    cls=_ManyInputs,
    examples=[
        "run drive.log.gz -o out",
        "run drive.bag -o out --inputs slam_toolbox.yaml --paths slam_toolbox.tum",
        "run drive.log -o out --truth floor.yaml --truth-trajectory truth.tum",
    ],
)
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=FILE)
@options.main_output(
    "out",
    "DIR",
    "Write the map, path and record of each SLAM, the fused map and path, the record "
    "fused.json and report/ to this folder.",
    _files,
)
@click.option(
    "--inputs",
    "saved_maps",
    multiple=True,
    type=MAP,
    metavar="MAP",
    help="Saved maps of other SLAMs, one or several. They vote too.",
)
@click.option(
    "--paths",
    "saved_paths",
    multiple=True,
    type=CASE_FILE,
    metavar="PATH",
    help="Paths of these maps, each in its map's frame. The scans rank them, and they join the "
    "fused path. The file name assigns a path to its map: MAP.tum, or MAP=PATH.",
)
@options.file("--truth", "truth_map", "MAP", "The true map. Adds the errors of all maps.", MAP)
@options.truth_scale
@options.file("--truth-trajectory", "truth", "FILE", "The true path. Adds the errors of all paths.")
@options.start(
    "Expected pose of the saved map or SLAM NAME. Several starts share one frame. A single start "
    "is given in the start frame of the drive."
)
@options.drive_files("paths")
@options.probabilities
@options.resolution
@options.scheduler("several logs or seeds")
@options.seeds("DIR/LOG/seed-N")
@options.open_report
@options.settings(
    "run",
    "fusion.*",
    "map_files",
    "log",
    "evaluate",
    "trajectory",
    "report",
    "device",
    "",
    base=RUN_DEFAULTS,
)
@options.common
@results.results_option
@results.table_option
def command(
    logs: tuple[Path, ...],
    out: Path,
    starts: options.GivenStarts,
    scheduler: str | None,
    seeds: tuple[int, ...],
    is_opened: bool,
    config: RunConfig,
    probabilities: bool,
    **asked: Any,
) -> None:
    """Map a log with several SLAMs, fuse their maps, write a report.

    LOG is a CARMEN or tinySLAM log, or a ROS bag. A SLAM that fails is named and left out; at
    least two maps must fit each other. --config sets the settings of each SLAM. Several logs run
    one after the other; the results of each go to DIR/NAME, where NAME is the log's file name.

    A run that makes a fused map replaces the results of an earlier run in DIR. A run that makes
    none leaves them unchanged and writes to DIR/failed.
    """
    # The import takes longer than the look: it is made while the producers are at work.
    if importlib.util.find_spec("matplotlib") is None:
        import slamfusion.report  # noqa: F401, PLC0415  (says what to install)
    message = "--paths needs --inputs MAP, the map of each path"
    options.refuse(asked["saved_paths"] and not asked["saved_maps"], message)
    if click.get_current_context().params["config_run_producers"]:
        from slamfusion.slam.registry import check_names  # noqa: PLC0415  (loads slowly)

        try:
            check_names(config.run.producers)
        except ConfigError as error:
            raise click.BadParameter(str(error), param_hint="'--producers'") from None
    if len(logs) == 1:
        options.check_odometry(asked["odometry"], asked["relations"])
    with options.start_errors(starts):
        config = options.with_starts(config, starts)
        if len(logs) > 1 or seeds:
            if len(logs) > 1:
                for name, option in OF_ONE_LOG.items():
                    options.refuse(asked[name], ALONE.format(option))
                options.refuse(config.start, ALONE.format("--start"))
            _run_several(
                jobs.run_many.log_tasks(logs, out, seeds, probabilities=probabilities),
                out,
                config,
                scheduler,
                asked,
            )
            return
        message = "--scheduler is for several logs or seeds; the SLAMs of one log run in parallel"
        options.refuse(scheduler is not None, message)
        with output.progress_bar() as progress:
            run = jobs.run.run_log(
                logs[0],
                config,
                **asked,
                progress=progress,
                warn=output.notice,
                prepare=jobs.run_files.load_report,
            )
            progress(REPORT, 0, 1)
            run = jobs.run_files.save_run(run, out, probabilities=probabilities)
            progress(jobs.run.WHOLE, 1, 1)
    rows = jobs.run_many.run_rows(run, case_of(logs[0])) if output.settings().results_path else []
    results.save_results(run, rows, lambda: _inputs(logs, asked))
    _print(run)
    if is_opened:
        click.launch(str(run.report))
    if reasons := run.not_measured if run.error is None else [run.error]:
        others = len(reasons) - 1
        more = f"; {others} more in the report" if others else ""
        earlier = "" if run.folder == out else f"; {out} keeps its earlier results"
        raise SlamFusionError(f"{reasons[0]}{more} (the files so far are in {run.folder}{earlier})")


def _print(run: jobs.run_files.LogRun) -> None:
    """Print the document, or tables; warnings to stderr."""
    settings = output.settings()
    if settings.debug:
        for item in run.failed:
            if item.detail:
                print(f"{item.name}: {item.detail}", file=sys.stderr)
    if not settings.as_json:
        _print_tables(run)
    output.notice(
        *jobs.fuse_documents.unaligned_sentences(run.evaluations), *map(": ".join, run.log_faults())
    )
    warnings = run.sentences()
    if settings.as_json or settings.verbose:
        output.notice(*warnings)
    elif warnings:
        output.notice(f"{counted(len(warnings), 'warning')} in the report; --verbose prints them")
    output.print_if_json(run)


def _print_tables(run: jobs.run_files.LogRun) -> None:
    if run.recommendation is not None:
        tables.print_recommendation(run.recommendation)
        print()
    _print_slams(run)
    if output.is_verbose():
        _print_details(run)
    output.print_facts(
        ("fused map", run.fused and f"{run.fused} ({run.fused_mode})"),
        ("fused path", run.fused_path and run.fused_path.file),
        ("drawn map", run.drawn_map and str(run.drawn_map.file)),
        ("report", run.report),
        ("next", run.fused and f"slamfusion show {shlex.quote(str(run.folder))}"),
    )


def _print_slams(run: jobs.run_files.LogRun) -> None:
    """Print a row for each SLAM, saved path and fused result: its vote, its errors, its effort."""
    figures: dict[str, dict[str, float | None]] = {
        name: {**own.measures.figures()} for name, own in run.paths.items()
    }
    notes = {item.name: f"NO MAP: {item.failed}" for item in run.failed}
    made = run.results
    names = [item.name for item in run.producers]
    names += [grid.name for grid in run.grids if grid.name not in names]
    votes = dict.fromkeys(names, "no")
    if run.usable is not None:
        votes |= {item.name: "yes" for item in run.usable.accepted} | {FUSED: "-"}
        notes |= {record.name: record.reason for record in run.usable.rejected}
        if run.fused_path is not None:
            figures[FUSED] = {**run.fused_path.measures.figures()}
    for item in run.evaluations:
        figures.setdefault(item.name, {}).update(evaluation.measured.map_figures(item))
    rows = []
    for name, vote in votes.items():
        own = figures.get(name, {})
        row = [name, vote, *(number(own.get(key), digits) for key, digits in ERRORS.values())]
        if name in made:
            own_run = made[name].run
            ms = own_run.time_per_scan_ms
            row += [number(own_run.time_s, 1), number(ms.mean, 1), number(ms.p95, 1)]
            row += [str(own_run.scans_used), number(own_run.peak_memory_mb, 1)]
            row.append(number(own_run.health.mean_match_score))
        rows.append(row + ["-"] * (len(COLUMNS) - len(row)))
    shown = len(COLUMNS) if output.is_verbose() else BRIEF
    output.Table(
        COLUMNS[:shown],
        [row[:shown] for row in rows],
        notes=[notes.get(name, "") for name in votes] if notes else (),
    ).print()


def _print_details(run: jobs.run_files.LogRun) -> None:
    for sentence in run.log_notes():
        output.say(f"the log: {sentence}")
    if run.usable is not None:
        tables.print_fusion(run.usable, run.fusion.doubled, run.made_with.config.fusion.reference)
        for gap in run.path_gaps:
            output.say(f"paths in the fused map: {gap.sentence()}")
        print()
    elif run.fusion.pairs:
        tables.print_pairs(run.fusion.pairs, run.made_with.device)
    if run.evaluations:
        tables.print_evaluations(run.evaluations)
    if run.recommendation is not None and run.recommendation.paths:
        columns, rows = tables.path_table(run.recommendation)
        output.Table(columns, rows, title="How well the scans support each path").print()
    if run.fused_path is not None:
        trust = ", ".join(f"{name} {share:.2f}" for name, share in run.fused_path.trust.items())
        output.say(f"weights in the fused path: {trust}")
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in run.stages_s.items())
    output.say(f"time: {run.time_s:.1f} s ({stages})")
    if run.fused is not None:
        output.print_facts(("agreement", str(run.agreement)), *output.map_server_facts(run.fused))


ALONE = "{} belongs to one log; run each log that needs it alone"
# What belongs to one log, by the argument of ``run_log``.
OF_ONE_LOG = {
    "saved_paths": "--paths",
    "truth_map": "--truth",
    "truth": "--truth-trajectory",
    "relations": "--relations",
    "odometry": "--odometry",
    "scan_odometry": "--scan-odometry",
}


def _inputs(logs: Sequence[Path], asked: Mapping[str, Any]) -> list[tuple[str, str, Path]]:
    return [("log", case_of(log), log) for log in logs] + [
        (option.removeprefix("--").replace("-", " "), "", asked[name])
        for name, option in OF_ONE_LOG.items()
        if isinstance(asked[name], Path)
    ]


def _run_several(
    tasks: Sequence[jobs.run_many.LogTask],
    out: Path,
    config: RunConfig,
    scheduler: str | None,
    asked: Mapping[str, Any],
) -> None:
    # Workers have another working folder.
    given = {**asked, "saved_maps": tuple(path.absolute() for path in asked["saved_maps"])}
    with (
        executor_for(scheduler, device=config.device.device) as executor,
        output.progress_bar() as progress,
    ):
        runs = jobs.run_many.run_logs(tasks, config, given, executor=executor, progress=progress)
    for run in runs:
        output.notice(*run.warnings, of=f"{run.name}: ")
    document = jobs.run_many.RunsDocument(runs, Settings(config))
    rows = [row for run in runs for row in run.rows]
    logs = list(dict.fromkeys(task.log for task in tasks))
    results.save_results(document, rows, lambda: _inputs(logs, asked))
    if not output.print_if_json(document):
        _print_logs(runs, out)
        if rows and tasks[0].seed is not None:
            results.print_items(rows, "path", ("ate_rmse_m", "relations_mean_m", "error"))
    reasons = []
    if failed := [f"{run.name}: {run.error}" for run in runs if run.error is not None]:
        reasons.append(f"no fused map of {len(failed)} of {len(runs)} logs ({'; '.join(failed)})")
    if partly := [run for run in runs if run.error is None and run.not_measured]:
        words = "; ".join(f"{run.name}: {', '.join(run.not_measured)}" for run in partly)
        reasons.append(f"of {len(partly)} of {len(runs)} logs not all could be measured ({words})")
    if reasons:
        raise SlamFusionError("; ".join(reasons))


def _print_logs(runs: Sequence[jobs.run_many.RunOfLog], out: Path) -> None:
    output.Table(
        ("log ", "maps fused", "use ", "time [s]", "folder "),
        [
            [
                run.name,
                str(run.fused_count) if run.fused_count else "-",
                (run.recommendation and run.recommendation.use) or "-",
                number(run.time_s, 1),
                "-" if run.folder is None else str(out / run.folder.relative_to(out.absolute())),
            ]
            for run in runs
        ],
        notes=["" if run.error is None else f"NO FUSED MAP: {run.error}" for run in runs],
        title=counted(len(runs), "run"),
    ).print()
    if any(run.fused is not None for run in runs):
        output.print_facts(
            ("report", f"FOLDER/{REPORT}/{PAGE}"),
            ("next", f"slamfusion trajectory {shlex.quote(str(out))} --truth TRUTH.tum"),
        )
