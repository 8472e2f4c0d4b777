"""``slamfusion judge``: which path of a log to use, with no truth to go by."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.help import Command
from slamfusion.cli.options import (
    case_option,
    check_odometry,
    check_report,
    common_options,
    drive_files,
    output_option,
    report_option,
    with_config,
)
from slamfusion.cli.output import notice, print_facts, print_json, print_table, progress_bar
from slamfusion.cli.paths import CASE_FILE
from slamfusion.cli.results import (
    print_items,
    print_repetitions,
    results_option,
    save_results,
    table_option,
)
from slamfusion.cli.tables import path_columns, path_row, print_recommendation
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.jobs.cases import CaseFile, Placed, case_names, files_by_case, place_files
from slamfusion.jobs.documents import number
from slamfusion.jobs.inputs import device_for

if TYPE_CHECKING:
    from slamfusion.evidence import RankedPath
    from slamfusion.jobs.judge import JudgedPaths
    from slamfusion.jobs.trajectory import CaseFiles


@dataclass(frozen=True)
class _Request:
    """The request, without the settings."""

    log: CaseFile
    more_logs: tuple[CaseFile, ...]
    paths: tuple[CaseFile, ...]
    truths: tuple[CaseFile, ...]
    relations: tuple[CaseFile, ...]
    odometry: tuple[CaseFile, ...]
    scan_odometry: tuple[CaseFile, ...]
    fused: Path | None
    report_dir: Path | None
    results_path: Path | None
    as_json: bool

    def check(self) -> None:
        """Refuse what cannot be done before any work."""
        check_odometry(self.odometry, self.relations)
        if self.fused is not None and self.more_logs:
            message = "--fused is of one log; with several (--log) call judge for each"
            raise click.UsageError(message)
        check_report(self.report_dir)

    def placed(self) -> tuple[list[Placed], CaseFiles]:
        """Return the paths of each log, and what they are held against."""
        from slamfusion.jobs.trajectory import CaseFiles  # noqa: PLC0415  (loads slowly)

        logs = (self.log, *self.more_logs)
        cases = case_names(logs)
        held = CaseFiles(
            relations=files_by_case(cases, self.relations, "--relations"),
            odometry=files_by_case(cases, self.odometry, "--odometry"),
            logs={case: file.path for case, file in zip(cases, logs, strict=True)},
            truths=files_by_case(cases, self.truths, "--truth"),
            scan_odometry=files_by_case(cases, self.scan_odometry, "--scan-odometry"),
        )
        return place_files(cases, self.paths), held


def _report_folders(folder: Path, given: Mapping[str, Any]) -> list[Path]:
    logs = (given["log"], *given["more_logs"])
    return [folder] if len(logs) == 1 else [folder / case for case in case_names(logs)]


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
@case_option("--log", "more_logs", "LOG", "Another log, with its own paths.")
@case_option(
    "--truth",
    "truths",
    "FILE",
    "The true trajectory. Adds the errors of the paths and their ranking.",
)
@drive_files("paths", of_cases=True)
@output_option(
    "--fused",
    "fused",
    metavar="FILE.tum",
    help="Fuse the paths into one, as `run` does, rank it with them, and write it to this file.",
)
@report_option("report_dir", _report_folders)
@with_config("log", "trajectory", "report", "device", "")
@common_options
@results_option
@table_option
def command(config: RunConfig, **asked: Any) -> int:
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
    request = _Request(**asked)
    request.check()
    return _judge(request, config)


def _judge(request: _Request, config: RunConfig) -> int:
    """Rank the paths of each log."""
    from slamfusion.io.files import AtomicFiles  # noqa: PLC0415
    from slamfusion.jobs.judge import (  # noqa: PLC0415
        judge_paths,
        judgements_document,
        write_fused_path,
        write_judgement,
    )

    placed, held = request.placed()
    device = device_for(config)
    logs: dict[str, JudgedPaths] = {}
    several = len(held.logs) > 1
    with contextlib.ExitStack() as ends:
        progress = ends.enter_context(progress_bar()) if several else None
        for done, (case, log) in enumerate(held.logs.items()):
            if progress is not None:
                progress("judge", done, len(held.logs))
            logs[case] = judge_paths(
                log,
                {item.name: item.path for item in placed if item.case == case},
                config,
                device,
                relations=held.relations.get(case),
                odometry=held.odometry.get(case),
                truth=held.truths.get(case),
                scan_odometry=held.scan_odometry.get(case),
                fused=request.fused,
                warn=notice,
            )
    with AtomicFiles() as files:
        for case, found in logs.items():
            write_fused_path(found, files)
            if request.report_dir is not None:
                folder = request.report_dir / case if several else request.report_dir
                write_judgement(found, folder, files)
    rows = [row for case, found in logs.items() for row in found.rows(case, placed)]
    first = next(iter(logs.values()))
    document = judgements_document(logs, rows, config) if several else first.to_json()
    save_results(request.results_path, document, rows, lambda: held.inputs(placed))
    if request.as_json:
        print_json(document)
    elif several:
        print_items(rows, "path", ("consistency", "ate_rmse_m", "relations_mean_m"))
        for case, found in logs.items():
            print(f"{case}: {found.recommendation.headline}")
    else:
        _print(first)
        print_repetitions(rows, "path")
    not_measured = [
        f"{case}: {sentence}" if several else sentence
        for case, found in logs.items()
        for sentence in found.not_measured
    ]
    if not_measured:
        raise SlamFusionError("; ".join(not_measured))
    return 0


def _print(found: JudgedPaths) -> None:
    """Print the paths, the rankings by what is known, and which one to use."""
    answer = found.recommendation
    by_truth, by_relations = found.ranking_by_truth(), found.ranking_by_relations()
    columns = path_columns(answer)
    columns += ["ATE rmse [m]", "rank"] if by_truth else []
    columns += ["relations mean [m]", "rank"] if by_relations else []
    rows = []
    for path in answer.paths:
        measures = found.measures.get(path.name)
        row = path_row(answer, path)
        if by_truth:
            errors = None if measures is None else measures.truth
            row += [number(None if errors is None else errors.ate.rmse, 4), _rank(path, by_truth)]
        if by_relations:
            known = None if measures is None else measures.relations
            row += [
                number(None if known is None else known.translation.mean, 4),
                _rank(path, by_relations),
            ]
        rows.append(row)
    print_table(columns, rows, title=f"Paths of {found.files.log}, the recommended one first")
    if found.files.fused is not None:
        print_facts(("fused path", found.files.fused))
    print_recommendation(answer)


def _rank(path: RankedPath, ranking: tuple[str, ...]) -> str:
    return str(ranking.index(path.name) + 1) if path.name in ranking else "-"
