"""``slamfusion judge``: which path of a log its scans bear out best, with no truth to go by."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.options import (
    FILE,
    common_options,
    drive_files,
    file_option,
    report_option,
    with_config,
)
from slamfusion.cli.output import notice, number, print_json, print_table
from slamfusion.cli.table_files import table_option
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.jobs.inputs import check_writable

if TYPE_CHECKING:
    from slamfusion.evidence.verdict import PathVerdict, Verdict
    from slamfusion.jobs.judge import JudgedPaths

__all__ = ["command", "print_verdict"]


@click.command("judge")
@click.argument("log", type=FILE)
@click.argument("paths", metavar="PATH...", nargs=-1, required=True, type=FILE)
@file_option(
    "--truth", "truth", "FILE", "The true trajectory: errors of the paths, ranked beside the scans."
)
@drive_files("paths")
@report_option("report_dir")
@with_config("log", "trajectory", "device", "")
@common_options
@table_option
def command(
    log: Path,
    paths: tuple[Path, ...],
    report_dir: Path | None,
    config: RunConfig,
    as_json: bool,
    **asked: Any,
) -> int:
    """Rank paths of LOG by how well what was seen at other times predicts each scan.

    LOG is a CARMEN or tinySLAM log, or a ROS bag; each PATH a file of poses that any SLAM made of
    it: TUM, 't x y theta' or CSV. No truth is needed. A path may be sparse: odometry fills it.
    """
    from slamfusion.jobs.judge import judge_paths, write_judgement  # noqa: PLC0415

    if asked["odometry"] is not None and asked["relations"] is None:
        message = "--odometry carries poses to the times of relations; give --relations FILE"
        raise click.UsageError(message)
    if report_dir is not None:
        import slamfusion.report  # noqa: F401, PLC0415  (says early when its extra is missing)

        check_writable(report_dir)
    found = judge_paths(log, paths, config, warn=notice, **asked)
    if report_dir is not None:
        write_judgement(found, report_dir)
    if as_json:
        print_json(found.to_json())
    else:
        _print(found)
    if found.not_measured:
        raise SlamFusionError("; ".join(found.not_measured))
    return 0


def _print(found: JudgedPaths) -> None:
    """Print the ranking, where paths part, the rankings by what is known, and the verdict."""
    rows = []
    by_truth, by_relations = found.ranking_by_truth(), found.ranking_by_relations()
    columns = [*_COLUMNS]
    columns += ["ATE m", "rank"] if by_truth else []
    columns += ["relations m", "rank"] if by_relations else []
    for path in found.verdict.paths:
        measures = found.measures.get(path.name)
        row = _path_row(found.verdict, path)
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
    print_table(columns, rows, title=f"Paths of {found.files.log}, best first")
    print(f"verdict: {found.verdict.sentence}")


def print_verdict(verdict: Verdict) -> None:
    """Print a row for each path, the best first, and the verdict in words."""
    rows = [_path_row(verdict, path) for path in verdict.paths]
    print_table(_COLUMNS, rows, title="What the scans say of the paths, best first")
    print(f"verdict: {verdict.sentence}")


_COLUMNS = (
    *("path ", "log-likelihood a hit", "behind best", "95 % interval", "p", "tied "),
    *("hits judged", "seen again %", "own poses %", "left best s", "by m"),
)


def _path_row(verdict: Verdict, path: PathVerdict) -> list[str]:
    """Return the figures of a path."""
    score, against = verdict.evidence.scores[path.name], path.against_best
    apart = [span for span in path.spans if not span.agrees]
    return [
        path.name,
        number(path.consistency, 4),
        number(None if against is None else against.difference, 4),
        "-" if against is None else f"{against.low:.4f} to {against.high:.4f}",
        number(None if against is None else against.p_value),
        "yes" if path.tied else "no",
        str(score.beams_judged),
        number(100.0 * score.seen_share, 0),
        number(100.0 * score.path.own_share, 0),
        number(sum(span.to_s - span.from_s for span in apart), 0),
        number(max((span.gap_m for span in apart), default=None), 2),
    ]


def _rank(path: PathVerdict, ranking: tuple[str, ...]) -> str:
    return str(ranking.index(path.name) + 1) if path.name in ranking else "-"
