"""The paths on the page of the main job: where they lie, how far apart, how wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from slamfusion.config import RunConfig
from slamfusion.evaluation import ErrorStatistics
from slamfusion.fusion.path_check import PathGap, moved_path
from slamfusion.geometry import Pose2
from slamfusion.report import paths
from slamfusion.report.map_axes import mark_legend
from slamfusion.report.page import Cell, Picture, Section, Table, number
from slamfusion.report.run_contents import ReportedRun, RunReport
from slamfusion.report.series import broken, series_picture
from slamfusion.report.trajectory_report import FIGURES, figure_cells
from slamfusion.slam.common.mapper import Series
from slamfusion.trajectory import flag_runs


def _placed(report: RunReport) -> dict[str, Pose2]:
    """Return the transform into the fused frame of each producer that voted."""
    if report.result is None:
        return {}
    return {
        record.name: Pose2() if record.alignment is None else record.alignment.transform
        for record in report.result.accepted
    }


def paths_section(report: RunReport, config: RunConfig) -> Section:
    """Return all paths in the fused map, how far they are apart, and each over its own map."""
    normalize = config.fusion.normalize
    placed = _placed(report)
    pictures = []
    together = [item for item in report.runs if item.run.name in placed]
    if together and report.result is not None:
        pictures.append(_together(report, together, placed, config))
    else:
        pictures += [
            Picture(
                f"path-{item.run.name}",
                paths.path_picture(item.run.trajectory, grid=item.run.grid, normalize=normalize),
                f"{item.run.name}: its path over its map",
                legend=mark_legend(),
            )
            for item in report.runs
        ]
    tables = []
    if report.gaps:
        limit_m = config.run.path_gap_m
        over_time = [
            Series(
                f"{gap.a} to {gap.b}",
                "m",
                *broken(gap.stamps_s, gap.gaps_m),
                limit_m if gap.max_m > limit_m else None,
            )
            for gap in report.gaps
        ]
        shaded = {f"{gap.a} to {gap.b}": _without_vote(gap) for gap in report.gaps}
        start_s = float(report.gaps[0].stamps_s[0])
        pictures.append(
            Picture(
                "path-gaps",
                series_picture(over_time, start_s=start_s, shaded=shaded),
                "Distance between the paths in the fused map",
                "All producers rode on one robot: where two paths part, one of the two, or the "
                "alignment of their maps, is wrong there. Shaded: one of the two has no vote. A "
                "line is broken where one has no pose.",
            )
        )
        rows = [_gap_row(gap, limit_m) for gap in report.gaps]
        note = (
            "Laid into the fused map. A producer whose path is, while both vote, more than "
            f"{limit_m:g} m (median) from those of the others is left out of the vote, however "
            "well its walls fit."
        )
        columns = (
            *("paths", "at the start m", "median m", "at most m", "median yaw °"),
            *("median m, both vote", "at most m, both vote"),
        )
        tables.append(Table("The paths against each other", columns, rows, note))
    return Section("Paths", "paths", "", pictures, tables)


def _without_vote(gap: PathGap) -> list[tuple[float, float]]:
    """Return the times, stamps in seconds, in which one of two paths has no vote."""
    last = len(gap.stamps_s) - 1
    return [
        (float(gap.stamps_s[here.start]), float(gap.stamps_s[min(here.stop, last)]))
        for here in flag_runs(~gap.both_vote)
    ]


def _gap_row(gap: PathGap, limit_m: float) -> list[Cell]:
    """Return the figures of a gap, over the drive and while both paths have a vote."""
    median_m = gap.voting_median_m
    return [
        Cell(f"{gap.a} to {gap.b}"),
        number(gap.start_m),
        number(gap.median_m),
        number(gap.max_m),
        number(float(np.rad2deg(gap.median_yaw_rad)), 2),
        number(median_m, tone="bad" if median_m is not None and median_m > limit_m else "plain"),
        number(gap.voting_max_m),
    ]


def _together(
    report: RunReport,
    together: Sequence[ReportedRun],
    placed: Mapping[str, Pose2],
    config: RunConfig,
) -> Picture:
    """Return the paths whose maps were fused, with truth and odometry, in the fused map."""
    shown = [moved_path(item.run.trajectory, placed[item.run.name]) for item in together]
    others = [item.path for item in report.saved_paths if item.path.name in placed]
    shown += [moved_path(path, placed[path.name]) for path in others]
    first, start = together[0], placed[together[0].run.name]
    truth = None
    if report.truth is not None and first.errors is not None:
        truth = moved_path(report.truth, start.compose(first.errors.pose_truth_estimate.inverse()))
    odometry = first.run.odometry
    if odometry is not None:
        odometry = paths.laid_on_start(odometry, shown[0])
    names = [*(item.run.name for item in together), *(path.name for path in others)]
    colours = {name: report.colours[name] for name in names}
    sentences = []
    if truth is not None:
        sentences.append("The truth is laid on the first path as a whole.")
    if odometry is not None:
        sentences.append(
            "Raw odometry is laid on its start; drift far beyond the picture is cut off."
        )
    result = report.result
    fused = None if report.fused_path is None else report.fused_path.path
    return Picture(
        "paths",
        paths.run_paths_picture(
            shown,
            list(colours.values()),
            fused=fused,
            truth=truth,
            odometry=odometry,
            grid=None if result is None else result.fused,
            normalize=config.fusion.normalize,
        ),
        "The paths over the fused map",
        " ".join(sentences),
        legend=paths.run_paths_legend(
            colours,
            fused=fused is not None,
            truth=truth is not None,
            odometry=odometry is not None,
        ),
    )


def path_errors_section(report: RunReport) -> list[Section]:
    """Return the errors of all paths in one table, and of each relation over time."""
    rows, pictures = [], []
    for name, item in report.measured_paths:
        if item.relations is not None:
            errors = item.relations
            used = f"{errors.relations_used} of {errors.relations_total}"
            rows += [
                _figures(name, f"relations ({used}), translation m", errors.translation, 4),
                _figures(name, f"relations ({used}), rotation °", errors.rotation_deg, 3),
            ]
            pictures.append(
                Picture(
                    f"relations-{name}",
                    paths.relations_picture(errors),
                    f"{name}: error of each relation",
                    legend=paths.revisit_legend(),
                )
            )
        if item.errors is not None:
            found = item.errors
            pair = f"{found.rpe_delta:g} {found.rpe_unit}"
            rows += [
                _figures(name, "ATE, place m", found.ate, 4),
                _figures(name, "ATE, heading °", found.ate_rotation_deg, 3),
                _figures(name, f"RPE over {pair}, place m", found.rpe, 4),
            ]
            pictures.append(
                Picture(
                    f"error-{name}",
                    paths.error_picture(found, report.colours[name]),
                    f"{name}: error along the path",
                )
            )
    if not rows:
        return []
    text = (
        "Relations [K09]: the motion between two times as it should be, against what the path made "
        "of it. ATE: of each pose after the best rigid motion of the whole; RPE: of the motion "
        "between two poses."
    )
    columns = ("path", "error", *FIGURES)
    table = Table("Errors of the paths", columns, rows)
    return [Section("Errors of the paths", "path-errors", text, pictures, [table])]


def _figures(name: str, what: str, statistics: ErrorStatistics | None, digits: int) -> list[Cell]:
    """Return a row of figures; dashes where there are none."""
    return [Cell(name), Cell(what), *figure_cells(statistics, digits)]
