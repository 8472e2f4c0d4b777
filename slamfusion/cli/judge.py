"""``slamfusion judge``: which path of a log to use, with no truth to go by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import click

from slamfusion import evaluation, jobs
from slamfusion.cli import options, output, results
from slamfusion.cli.help import Command
from slamfusion.cli.paths import CASE_FILE, case_folders
from slamfusion.cli.tables import path_table, print_recommendation
from slamfusion.config import PAGE, RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.io.files import AtomicFiles
from slamfusion.jobs.cases import CaseFile, case_names, known_files, measured_inputs, place_files
from slamfusion.jobs.inputs import device_for
from slamfusion.jobs.records import number


@click.command(
    "judge",
    cls=Command,
    examples=[
        "judge drive.log cartographer.tum slam_toolbox.tum",
        "judge drive.log a.tum b.tum --fused fused.tum --report out",
    ],
)
@click.argument("log", type=CASE_FILE)
@click.argument("paths", metavar="PATH...", nargs=-1, required=True, type=CASE_FILE)
@options.case("--log", "more_logs", "LOG", "Another log, with its own paths.")
@options.case(
    "--truth",
    "truth",
    "FILE",
    "The true trajectory. Adds the errors of the paths and their ranking.",
)
@options.drive_files("paths", of_cases=True)
@options.output(
    "--fused",
    "fused",
    metavar="FILE.tum",
    help="Fuse the paths into one, as `run` does, rank it with them, and write it to this file.",
)
@options.report(
    "report_dir", lambda folder, given: case_folders(folder, (given["log"], *given["more_logs"]))
)
@options.settings("log", "trajectory", "report", "device", "")
@options.common
@results.results_option
@results.table_option
def command(
    config: RunConfig,
    log: CaseFile,
    more_logs: tuple[CaseFile, ...],
    paths: tuple[CaseFile, ...],
    fused: Path | None,
    report_dir: Path | None,
    **others: tuple[CaseFile, ...],
) -> None:
    """Rank the paths of a log by its scans, without ground truth.

    A path is better if the scans of other times predict each scan better. LOG is a CARMEN or
    tinySLAM log, or a ROS bag. Each PATH holds the poses that a SLAM found for it: TUM, 't x y
    theta' or CSV. Odometry fills the gaps of a sparse path. With --fused, all scans are aligned
    along one fused path. Use that path unless the scans support another one better; the PATH
    nearest to it is the best single SLAM.

    With several logs (--log), a path belongs to the log whose name is a word of its file name or
    folder: graph/intel.tum and intel_graph.tum belong to intel.log. CASE=PATH overrides that. The
    same holds for the files of other options. One table then shows all paths and the mean of each
    method. Each log gets its own report.
    """
    options.check_odometry(others["odometry"], others["relations"])
    message = "--fused is of one log; with several (--log) call judge for each"
    options.refuse(fused is not None and more_logs, message)
    logs = (log, *more_logs)
    cases = case_names(logs)
    named = [CaseFile(file.path, case) for case, file in zip(cases, logs, strict=True)]
    known = known_files(cases, log=named, **others)
    placed = place_files(cases, paths)
    device = device_for(config)
    found: dict[str, jobs.judge.JudgedPaths] = {}
    several = len(cases) > 1
    with output.progress_bar() as progress:
        for (case, files), own_log in zip(known.items(), logs, strict=True):
            progress("judge", len(found), len(cases))
            found[case] = jobs.judge.judge_paths(
                own_log.path,
                {item.name: item.path for item in placed if item.case == case},
                config,
                device,
                relations=files.relations,
                odometry=files.odometry,
                truth=files.truth,
                scan_odometry=files.scan_odometry,
                fused=fused,
                warn=output.notice,
            )
    with AtomicFiles():
        for case, own in found.items():
            jobs.judge.write_fused_path(own)
            if report_dir is not None:
                folder = report_dir / case if several else report_dir
                jobs.judge.write_judgement(own, folder)
    rows = [row for case, own in found.items() for row in own.rows(case, placed)]
    first = found[cases[0]]
    document = (
        jobs.judge.JudgementsDocument(
            [jobs.judge.CaseJudgement(own, case) for case, own in found.items()],
            jobs.results.summaries(rows),
            first.circumstances,
        )
        if several
        else jobs.judge.JudgeDocument(first, first.circumstances)
    )
    results.save_results(document, rows, lambda: measured_inputs(placed, known))
    if not output.print_if_json(document):
        _print(found, rows, [] if report_dir is None else case_folders(report_dir, logs))
    not_measured = [
        f"{case}: {sentence}" if several else sentence
        for case, own in found.items()
        for sentence in own.not_measured
    ]
    if not_measured:
        raise SlamFusionError("; ".join(not_measured))


def _print(
    found: Mapping[str, jobs.judge.JudgedPaths],
    rows: Sequence[evaluation.measured.Row],
    reports: Sequence[Path],
) -> None:
    if len(found) > 1:
        results.print_items(rows, "path", ("consistency", "ate_rmse_m", "relations_mean_m"))
        for case, own in found.items():
            print(f"{case}: {own.recommendation.headline}")
    else:
        _print_one(*found.values())
        results.print_repetitions(rows, "path")
    output.print_facts(*(("report", folder / PAGE) for folder in reports))


def _print_one(found: jobs.judge.JudgedPaths) -> None:
    answer = found.recommendation
    columns, rows = path_table(answer)
    heads = {"ATE": "ATE rmse [m]", "relations": "relations mean [m]"}
    for kind, errors in evaluation.measured.rankings(found.measured).items():
        if errors:
            columns += [heads[kind], "rank"]
            for row, path in zip(rows, answer.paths, strict=True):
                error_m, rank = errors.get(path.name, (None, None))
                row += [number(error_m, 4), number(rank, 0)]
    output.Table(
        columns, rows, title=f"Paths of {found.files.log}, the recommended one first"
    ).print()
    if found.fused_path is not None:
        output.print_facts(("fused path", found.fused_path.file))
    print_recommendation(answer)
