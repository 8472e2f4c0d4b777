"""``slamfusion run``: the main job. The producers on one log, their fusion, errors and report."""

from __future__ import annotations

import importlib.util
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.help import Command
from slamfusion.cli.options import (
    GivenStarts,
    check_odometry,
    common_options,
    drive_options,
    file_option,
    map_resolution_option,
    open_option,
    output_option,
    scheduler_option,
    seeds_option,
    start_errors,
    start_option,
    truth_scale_option,
    with_config,
    with_starts,
)
from slamfusion.cli.output import (
    Settings,
    is_verbose,
    map_server_facts,
    notice,
    print_facts,
    print_json,
    print_table,
    progress_bar,
    say,
)
from slamfusion.cli.paths import CASE_FILE, FILE, MAP
from slamfusion.cli.results import print_items, results_option, save_results, table_option
from slamfusion.cli.tables import (
    print_evaluations,
    print_fusion,
    print_pairs,
    print_reasons,
    print_recommendation,
    tell_unaligned,
)
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.jobs.documents import number
from slamfusion.jobs.inputs import RUN_DEFAULTS
from slamfusion.jobs.outputs import (
    AGREEMENT,
    DRAWN,
    FAILED,
    FUSED,
    FUSED_PATH,
    PAGE,
    REPORT,
    possible_outputs,
    possible_report,
)

if TYPE_CHECKING:
    from slamfusion.jobs.run import LogRun
    from slamfusion.jobs.run_files import SavedRun
    from slamfusion.jobs.run_many import RunOfLog
    from slamfusion.jobs.trajectory import Measures

# Columns of the table of SLAMs without --verbose.
BRIEF = 7
# Suffixes of what may follow an option's value as one more; no log has such a name.
MORE = {"--inputs": {".yaml", ".yml", ".pgm", ".png", ".bmp", ".pnm"}, "--paths": {".tum", ".csv"}}


class _ManyInputs(Command):
    """A command that takes ``--inputs A.yaml B.yaml`` for ``--inputs A.yaml --inputs B.yaml``.

    Likewise ``--paths A.tum B.tum``.
    """

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
    from slamfusion.jobs.run_many import log_tasks  # noqa: PLC0415

    if out.exists() and not out.is_dir():
        raise click.UsageError(f"-o {out} is not a folder; name one for the maps and the report")
    logs = given["logs"]
    seeds = given["seeds"]
    runs = (
        [out]
        if len(logs) == 1 and not seeds
        else [task.folder for task in log_tasks(logs, out, seeds=seeds)]
    )
    folders = [folder for run in runs for folder in (run, run / FAILED)]
    return [
        file
        for folder in folders
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
@output_option(
    "-o",
    "--output",
    "out",
    files=_files,
    required=True,
    metavar="DIR",
    help="Write the map, path and record of each SLAM, the fused map and path, the record "
    "fused.json and report/ to this folder.",
)
@click.option(
    "--inputs",
    "maps",
    multiple=True,
    type=MAP,
    metavar="MAP",
    help="Saved maps of other SLAMs, one or several. They vote too.",
)
@click.option(
    "--paths",
    "paths",
    multiple=True,
    type=CASE_FILE,
    metavar="PATH",
    help="Paths of these maps, each in its map's frame. The scans rank them, and they join the "
    "fused path. The file name assigns a path to its map: MAP.tum, or MAP=PATH.",
)
@file_option("--truth", "truth", "MAP", "The true map. Adds the errors of all maps.", MAP)
@truth_scale_option
@file_option(
    "--truth-trajectory", "truth_trajectory", "FILE", "The true path. Adds the errors of all paths."
)
@start_option(
    "Expected pose of the saved map or SLAM NAME. Several starts share one frame. A single start "
    "is given in the start frame of the drive."
)
@drive_options("paths")
@map_resolution_option
@scheduler_option("several logs or seeds")
@seeds_option("DIR/LOG/seed-N")
@open_option
@with_config(
    "run",
    "fusion",
    "fusion.normalize",
    "fusion.align",
    "fusion.vote",
    "map_files",
    "log",
    "evaluate",
    "trajectory",
    "report",
    "device",
    "",
    base=RUN_DEFAULTS,
)
@common_options
@results_option
@table_option
def command(
    logs: tuple[Path, ...],
    out: Path,
    starts: GivenStarts,
    scheduler: str | None,
    seeds: tuple[int, ...],
    results_path: Path | None,
    is_opened: bool,
    config: RunConfig,
    as_json: bool,
    **asked: Any,
) -> int:
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
    if len(logs) == 1:
        check_odometry(asked["odometry"], asked["relations"])
    with start_errors(starts):
        config = with_starts(config, starts)
        if len(logs) > 1 or seeds:
            return run_many(
                logs, out, config, scheduler, asked,
                seeds=seeds, results_path=results_path, as_json=as_json,
            )  # fmt: skip
        if scheduler is not None:
            message = (
                "--scheduler is for several logs or seeds; the SLAMs of one log run in parallel"
            )
            raise click.UsageError(message)
        return _run(
            logs[0], out, config, results_path, is_opened=is_opened, as_json=as_json, **asked
        )


def _run(
    log: Path,
    out: Path,
    config: RunConfig,
    results_path: Path | None,
    *,
    is_opened: bool,
    as_json: bool,
    probabilities: bool,
    **asked: Any,
) -> int:
    """Run, write, print."""
    from slamfusion.jobs.run import run_log  # noqa: PLC0415
    from slamfusion.jobs.run_files import load_report, save_run  # noqa: PLC0415

    with progress_bar() as progress:
        run = run_log(
            log, config, **_run_options(asked), progress=progress, warn=notice, prepare=load_report
        )
        progress(REPORT, 0, 1)
        saved = save_run(run, out, probabilities=probabilities)
    if click.get_current_context().ensure_object(Settings).debug:
        for outcome in run.failed:
            if outcome.detail:
                print(f"{outcome.name}: {outcome.detail}", file=sys.stderr)
    if results_path is not None:
        from slamfusion.jobs.run_many import run_rows  # noqa: PLC0415

        rows = run_rows(run, log.stem)
        save_results(results_path, saved.document, rows, lambda: _inputs([log], asked))
    if as_json:
        for sentence in run.sentences():
            notice(sentence)
        print_json(saved.document)
    else:
        _print(run, saved)
    if is_opened:
        click.launch(str(saved.folder / REPORT / PAGE))
    reason = "; ".join(run.not_measured) if run.failure is None else str(run.failure)
    if reason:
        earlier = "" if saved.folder == out else f"; {out} keeps its earlier results"
        raise SlamFusionError(f"{reason} (the files so far are in {saved.folder}{earlier})")
    return 0


def _run_options(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of ``run_log`` that the command's options give."""
    names = {"maps": "saved_maps", "paths": "saved_paths", "truth": "truth_map"}
    names["truth_trajectory"] = "truth"
    return {names.get(name, name): value for name, value in asked.items()}


def _print(run: LogRun, saved: SavedRun) -> None:
    """Print what to use, one table of the SLAMs, the files and what to do next."""
    answer = run.recommendation
    if answer is not None:
        print_recommendation(answer)
        print()
    _print_slams(run)
    if is_verbose():
        _print_details(run, saved)
    files: list[tuple[str, object]] = []
    if run.usable is not None:
        files.append(("fused map", f"{saved.folder / FUSED}.yaml ({run.fused_mode})"))
    if run.fused_path is not None:
        files.append(("fused path", saved.folder / FUSED_PATH))
    if run.drawn is not None:
        files.append(("drawn map", f"{saved.folder / DRAWN}.yaml"))
    print_facts(*files, ("report", saved.folder / REPORT / PAGE))
    if run.usable is not None:
        print_facts(("next", f"slamfusion show {shlex.quote(str(saved.folder))}"))
    warnings = run.sentences()
    for sentence in warnings if is_verbose() else ():
        notice(sentence)
    if warnings and not is_verbose():
        count = f"{len(warnings)} warning{'s' * (len(warnings) > 1)}"
        notice(f"{count} in the report; --verbose prints them")


def _print_slams(run: LogRun) -> None:
    """Print a row for each SLAM, saved path and fused result: its vote, its errors, its effort."""
    from slamfusion.jobs.trajectory import Measures  # noqa: PLC0415  (loads slowly)

    errors = {item.name: item for item in run.evaluations}
    accepted = {item.name for item in (run.usable.accepted if run.usable is not None else ())}
    voted = dict.fromkeys(accepted, "yes")
    names = [item.name for item in run.outcomes]
    names += [grid.name for grid in run.grids if grid.name not in names]
    measures = {name: item.measures for name, item in run.results.items()}
    measures |= {name: item.measures for name, item in run.saved_paths.items()}
    if run.usable is not None:
        names.append(FUSED)
        if run.fused_path is not None:
            measures[FUSED] = run.fused_path.measures
    reasons = {item.name: f"NO MAP: {item.reason}" for item in run.failed}
    if run.usable is not None:
        reasons |= {record.name: record.reason for record in run.usable.rejected}
    rows = []
    for name in names:
        own, found = measures.get(name, Measures()), run.results.get(name)
        row = [name, voted.get(name, "-" if name == FUSED else "no")]
        row += _path_cells(own)
        row.append(number(errors[name].error if name in errors else None, 1))
        row.append(number(errors[name].wall_f1 if name in errors else None))
        if found is None:
            rows.append([*row, *["-"] * 6])
        else:
            made, ms = found.run, found.run.time_per_scan_ms()
            row += [number(made.time_s, 1), number(ms["mean"], 1), number(ms["p95"], 1)]
            row += [str(made.scans_used), number(made.peak_memory_bytes / 1e6, 1)]
            rows.append([*row, number(made.health.mean_match_score)])
    columns = ["SLAM ", "votes", "ATE rmse [m]", "relations mean [m]", "map error", "wall F1"]
    columns += ["time [s]", "scan mean [ms]", "scan 95 % [ms]", "scans used", "memory [MB]"]
    columns.append("match score, mean")
    shown = len(columns) if is_verbose() else BRIEF
    notes = [reasons.get(name, "") for name in names] if reasons else ()
    print_table(columns[:shown], [row[:shown] for row in rows], notes=notes)


def _path_cells(measures: Measures) -> list[str]:
    """Return the errors of a path as cells: ATE rmse and relations mean, metres."""
    truth, relations = measures.truth, measures.relations
    return [
        number(None if truth is None else truth.ate.rmse, 3),
        number(None if relations is None else relations.translation.mean, 4),
    ]


def _print_details(run: LogRun, saved: SavedRun) -> None:
    """Print the alignment, the gaps between the paths, all errors, the evidence and the times."""
    for sentence in run.log_notes():
        say(f"the log: {sentence}")
    if run.usable is not None:
        print_fusion(run.usable, run.doubled, run.config.fusion.reference)
        for gap in run.fusion.gaps:
            say(f"paths in the fused map: {gap.sentence()}")
        print()
    elif run.fusion.pairs:
        print_pairs(run.fusion.pairs, run.device)
    if run.evaluations:
        tell_unaligned(run.evaluations)
        print_evaluations(run.evaluations)
    if run.recommendation is not None:
        print_reasons(run.recommendation)
    if run.fused_path is not None:
        trust = ", ".join(f"{name} {share:.2f}" for name, share in run.fused_path.trust.items())
        say(f"weights in the fused path: {trust}")
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in saved.stages.items())
    say(f"time: {saved.document['time_s']:.1f} s ({stages})")
    if run.usable is not None:
        print_facts(
            ("agreement", f"{saved.folder / AGREEMENT}.yaml"),
            *map_server_facts(saved.folder / f"{FUSED}.yaml"),
        )


# --- several logs ---------------------------------------------------------------------------------


# What belongs to one log.
OF_ONE_LOG = ("paths", "truth", "truth_trajectory", "relations", "odometry", "scan_odometry")


def run_many(
    logs: Sequence[Path],
    out: Path,
    config: RunConfig,
    scheduler: str | None,
    asked: Mapping[str, Any],
    *,
    seeds: Sequence[int],
    results_path: Path | None,
    as_json: bool,
) -> int:
    """Run the main job on each log with each seed, and print the outcome of each."""
    from slamfusion.fleet import executor_for  # noqa: PLC0415
    from slamfusion.jobs.run_many import log_tasks, run_logs, runs_document  # noqa: PLC0415

    if len(logs) > 1:
        _refuse_files_of_one_log(config, asked)
    probabilities = asked["probabilities"]
    options = _run_options({key: asked[key] for key in asked if key != "probabilities"})
    # Workers have another working folder.
    options["saved_maps"] = tuple(path.absolute() for path in options["saved_maps"])
    tasks = log_tasks(logs, out, options, seeds=seeds, probabilities=probabilities)
    with (
        executor_for(scheduler, device=config.device.device) as executor,
        progress_bar() as progress,
    ):
        runs = run_logs(tasks, config, executor, progress)
    for run in runs:
        for sentence in run.warnings:
            notice(f"{_name(run)}: {sentence}")
    document, rows = runs_document(runs, config), [row for run in runs for row in run.rows]
    save_results(results_path, document, rows, lambda: _inputs(logs, asked))
    if as_json:
        print_json(document)
    else:
        _print_logs(runs, out)
        if rows and seeds:
            print_items(rows, "path", ("ate_rmse_m", "relations_mean_m", "error"))
    if reason := _failure(runs):
        raise SlamFusionError(reason)
    return 0


def _name(run: RunOfLog) -> str:
    """Return what a run is called: its log, and its seed."""
    return run.log.name if run.seed is None else f"{run.log.name} seed {run.seed}"


def _inputs(logs: Sequence[Path], asked: Mapping[str, Any]) -> list[tuple[str, str, Path]]:
    """Return role, case and path of the files that runs read."""
    roles = ("truth", "relations", "odometry", "scan_odometry", "truth_trajectory")
    read = [(role.replace("_", " "), "", asked[role]) for role in roles if asked[role] is not None]
    return [*(("log", log.stem, log) for log in logs), *read]


def _failure(runs: Sequence[RunOfLog]) -> str:
    """Return of which logs there is no fused map, or not every measure; empty: of none."""
    failed = [run for run in runs if run.error is not None]
    unmeasured = [run for run in runs if run.error is None and run.not_measured]
    reasons = []
    if failed:
        words = "; ".join(f"{_name(run)}: {run.error}" for run in failed)
        reasons.append(f"{len(failed)} of {len(runs)} logs have no fused map ({words})")
    if unmeasured:
        words = "; ".join(f"{_name(run)}: {', '.join(run.not_measured)}" for run in unmeasured)
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
        raise click.UsageError("--start belongs to one log; run each log that needs it alone")


def _print_logs(runs: Sequence[RunOfLog], out: Path) -> None:
    """Print a row for each log, with its folder, and what to do next."""
    print_table(
        ("log ", "maps fused", "use ", "time [s]", "folder "),
        [
            [
                _name(run),
                str(run.fused_count) if run.fused_count else "-",
                (run.recommendation and run.recommendation.use) or "-",
                number(run.time_s, 1),
                "-" if run.folder is None else str(out / run.folder.relative_to(out.absolute())),
            ]
            for run in runs
        ],
        notes=["" if run.error is None else f"NO FUSED MAP: {run.error}" for run in runs],
        title=f"{len(runs)} runs",
    )
    if any(run.fused is not None for run in runs):
        print_facts(
            ("report", f"FOLDER/{REPORT}/{PAGE}"),
            ("next", f"slamfusion trajectory {shlex.quote(str(out))} --truth TRUTH.tum"),
        )
