"""The report of the main job on one page: maps, paths, health, alignment, errors, timings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamfusion.config import RunConfig
from slamfusion.evaluation import ErrorStatistics, MapError, RelationErrors, TrajectoryErrors
from slamfusion.fusion.path_check import PathGap, moved_path
from slamfusion.fusion.records import Alignment, FusionResult
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io.atomic import AtomicFiles
from slamfusion.report import paths
from slamfusion.report.fusion_report import (
    alignment_section,
    dissent_section,
    fused_section,
    inputs_section,
    shown_box,
    statistics_section,
)
from slamfusion.report.maps import (
    alignment_table,
    error_section,
    input_picture,
    pair_overlay,
    statistics_table,
)
from slamfusion.report.page import (
    Banner,
    Cell,
    Fact,
    Page,
    Picture,
    Section,
    Table,
    circumstances,
    number,
    write_page,
)
from slamfusion.report.series import drawable, series_picture
from slamfusion.slam.common.mapper import Series
from slamfusion.slam.common.runner import ProducerRun
from slamfusion.trajectory import Trajectory

__all__ = ["ReportedRun", "RunReport", "write_run_report"]

BYTES_PER_MB = 1e6
MOST_OVERLAYS = 6
YAW_NOTE = (
    "An overlay shows a pair under the best alignment that was found; where two maps agree their "
    "colours add up to white."
)


@dataclass(frozen=True, eq=False)
class ReportedRun:
    """One producer that made a map.

    Attributes:
        run: what it made.
        relations: its path's errors on known relations.
        errors: its path's errors against the truth.
        time_s: of its whole process.
        cpu_s: processor time of it.
    """

    run: ProducerRun
    relations: RelationErrors | None = None
    errors: TrajectoryErrors | None = None
    time_s: float | None = None
    cpu_s: float | None = None


@dataclass(frozen=True, eq=False)
class RunReport:
    """Everything that the page shows.

    Attributes:
        log: what was driven.
        runs: the producers that made a map.
        failed: the others, each with its reason.
        result: the fusion; None where nothing was fused.
        failure: why the fused map must not be used, or why there is none; empty where all is well.
        grids: all inputs of the fusion, saved maps included.
        pairs: where nothing was fused, the pairs that were tried.
        gaps: between the paths of producers in the fused frame.
        doubled: shares of doubled walls by name, that of the fused map as ``fused map``.
        evaluations: errors of maps against the truth.
        evaluation_alignments: what each of them rests on.
        truth: the true path.
        warnings: what the user must see first, each a subject and a sentence.
        stages: seconds of each stage so far, in order.
        device: what computed the fusion, in words.
    """

    log: str
    runs: Sequence[ReportedRun]
    failed: Sequence[tuple[str, str]] = ()
    result: FusionResult | None = None
    failure: str = ""
    grids: Sequence[OccupancyGrid] = ()
    pairs: Sequence[Alignment] = ()
    gaps: Sequence[PathGap] = ()
    doubled: Mapping[str, float] | None = None
    evaluations: Sequence[MapError] = ()
    evaluation_alignments: Sequence[Alignment | None] = ()
    truth: Trajectory | None = None
    warnings: Sequence[tuple[str, str]] = ()
    stages: Mapping[str, float] = field(default_factory=dict)
    device: str = ""


def write_run_report(
    report: RunReport,
    directory: str | Path,
    *,
    config: RunConfig,
    files: AtomicFiles | None = None,
) -> Path:
    """Write the report of a run as one self-contained page with its pictures beside it.

    Args:
        report: what is shown.
        directory: for ``report.html`` and the PNG files; made when missing.
        config: the effective configuration, written out in full.
        files: the set of files to join; default: one of its own.

    Returns:
        The path of ``report.html``.

    Raises:
        SlamFusionError: the directory cannot be written.
    """
    sections = [_maps_section(report, config)]
    if report.runs:
        sections += [_paths_section(report, config), *_health_section(report)]
    if report.result is not None:
        if any(record.dissent is not None for record in report.result.accepted):
            sections.append(dissent_section(report.result, shown_box(report.result)))
        sections.append(alignment_section(report.result, only_doubtful=True))
    elif report.pairs:
        sections.append(_pairs_section(report, config))
    sections += _path_errors_section(report)
    if report.evaluations:
        sections.append(error_section(report.evaluations, report.evaluation_alignments))
    sections.append(_timings_section(report))
    if report.result is not None:
        sections.append(statistics_section(report.result, config, report.doubled))
    elif report.grids:
        tables = [statistics_table(report.grids, config.fusion.normalize)]
        sections.append(Section("The maps in numbers", "numbers", tables=tables))
    sections.append(circumstances(config, report.device))
    page = Page("SLAMfusion run", _banner(report), _facts(report), sections)
    return write_page(page, directory, files)


def _banner(report: RunReport) -> Banner:
    """Say first what was fused, and loudest what was not."""
    lines = [(f"{name} made no map:", reason) for name, reason in report.failed]
    result = report.result
    if result is not None:
        lines += [(f"{record.name} was rejected:", record.reason) for record in result.rejected]
    lines += list(report.warnings)
    if result is None or report.failure:
        headline = "Do not use this map" if result is not None else "Nothing was fused"
        return Banner("bad", headline, [("", report.failure), *lines])
    accepted = ", ".join(record.name for record in result.accepted)
    lines.append(("Fused:", f"{accepted}; in the frame of {result.reference}."))
    total, fused = len(result.inputs) + len(report.failed), len(result.accepted)
    if fused < total:
        return Banner("warn", f"Only {fused} of {total} maps were fused", lines)
    tone = "warn" if report.warnings else "good"
    return Banner(tone, f"{'Both' if total == 2 else f'All {total}'} maps were fused", lines)


def _facts(report: RunReport) -> list[Fact]:
    """Return the numbers of the headline."""
    facts = []
    if report.runs:
        run = report.runs[0].run
        stamps_s = run.trajectory.stamps_s
        facts += [
            Fact(f"{float(stamps_s[-1] - stamps_s[0]):.0f} s", "of driving"),
            Fact(f"{run.trajectory.path_length_m():.0f} m", f"travelled, says {run.name}"),
            Fact(str(run.scans), "scans"),
        ]
    result = report.result
    if result is not None:
        total, fused = len(result.inputs) + len(report.failed), len(result.accepted)
        facts.append(Fact(f"{fused} of {total}", "maps fused", "good" if fused == total else "bad"))
        known = float(np.count_nonzero(result.fused.cells != -1)) * result.fused.resolution**2
        facts.append(Fact(f"{known:.0f} m²", "known in the fused map"))
        agreement = result.agreement.cells[result.agreement.cells >= 0]
        if agreement.size:
            unanimous = 100.0 * float(np.mean(agreement == 100))
            facts.append(Fact(f"{unanimous:.0f} %", "of the voted cells are unanimous"))
    widest = max((gap.median_m for gap in report.gaps), default=None)
    if widest is not None:
        facts.append(
            Fact(f"{widest:.2f} m", "between the paths in the fused map, at most (median)")
        )
    facts += [
        Fact(f"{item.relations.translation.mean:.4f} m", f"{item.run.name}: error of relations")
        for item in report.runs
        if item.relations is not None
    ]
    facts += [
        Fact(f"{item.error:.1f}", f"{item.name}: map error [F16]") for item in report.evaluations
    ]
    facts.append(Fact(f"{sum(report.stages.values()):.1f} s", "for all, without this page"))
    return facts


def _maps_section(report: RunReport, config: RunConfig) -> Section:
    """Return the fused map, the producers' maps, how they lie on each other, where they agree."""
    result = report.result
    text = "Each input lies in its own frame, as it was made; the fused map in the reference's."
    if result is None:
        pictures = [input_picture(grid, config.fusion.normalize) for grid in report.grids]
        return Section("Maps", "maps", text, pictures)
    fused, *others = fused_section(result, shown_box(result)).pictures
    inputs = inputs_section(result, config).pictures
    return Section("Maps", "maps", text, [fused, *inputs, *others])


def _placed(report: RunReport) -> dict[str, Pose2]:
    """Return the transform into the fused frame of each producer that voted."""
    if report.result is None:
        return {}
    return {
        record.name: Pose2() if record.alignment is None else record.alignment.transform
        for record in report.result.accepted
    }


def _paths_section(report: RunReport, config: RunConfig) -> Section:
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
                legend=paths.mark_legend(),
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
                gap.stamps_s,
                gap.gaps_m,
                limit_m if gap.max_m > limit_m else None,
            )
            for gap in report.gaps
        ]
        start_s = float(report.gaps[0].stamps_s[0])
        pictures.append(
            Picture(
                "path-gaps",
                series_picture(over_time, start_s=start_s),
                "Distance between the paths in the fused map",
                "All producers rode on one robot: where two paths part, one of the two, or the "
                "alignment of their maps, is wrong there.",
            )
        )
        rows = [
            [
                Cell(f"{gap.a} to {gap.b}"),
                number(float(gap.gaps_m[0])),
                number(gap.median_m, tone="plain" if gap.median_m <= limit_m else "bad"),
                number(gap.max_m),
                number(float(np.rad2deg(gap.yaw_rad)), 2),
            ]
            for gap in report.gaps
        ]
        note = (
            f"Laid into the fused map. A producer whose path is more than {limit_m:g} m (median) "
            "from those of the others is left out of the vote, however well its walls fit."
        )
        columns = ("paths", "at the start m", "median m", "at most m", "median yaw °")
        tables.append(Table("The paths against each other", columns, rows, note))
    return Section("Paths", "paths", "", pictures, tables)


def _together(
    report: RunReport,
    together: Sequence[ReportedRun],
    placed: Mapping[str, Pose2],
    config: RunConfig,
) -> Picture:
    """Return the paths of the producers that voted, with truth and odometry, in the fused map."""
    shown = [moved_path(item.run.trajectory, placed[item.run.name]) for item in together]
    first, start = together[0], placed[together[0].run.name]
    truth = None
    if report.truth is not None and first.errors is not None:
        truth = moved_path(report.truth, start.compose(first.errors.pose_truth_estimate.inverse()))
    odometry = first.run.odometry
    if odometry is not None:
        at = odometry.pose(int(odometry.nearest(first.run.trajectory.stamps_s[0])))
        odometry = moved_path(odometry, shown[0].pose(0).compose(at.inverse()))
    names = [item.run.name for item in together]
    sentences = []
    if truth is not None:
        sentences.append("The truth is laid on the first path as a whole.")
    if odometry is not None:
        sentences.append(
            "Raw odometry is laid on its start; drift far beyond the picture is cut off."
        )
    result = report.result
    return Picture(
        "paths",
        paths.run_paths_picture(
            shown,
            truth=truth,
            odometry=odometry,
            grid=None if result is None else result.fused,
            normalize=config.fusion.normalize,
        ),
        "The paths over the fused map",
        " ".join(sentences),
        legend=paths.run_paths_legend(
            names, truth=truth is not None, odometry=odometry is not None
        ),
    )


def _health_section(report: RunReport) -> list[Section]:
    """Return each producer's match score and its own quantities over time, and its doubts."""
    pictures = []
    for item in report.runs:
        shown = drawable(_over_time(item.run))
        if shown:
            png = series_picture(shown, start_s=float(item.run.trajectory.stamps_s[0]))
            pictures.append(Picture(f"over-time-{item.run.name}", png, item.run.name))
    rows = [
        [
            Cell(item.run.name),
            Cell(str(item.run.scans), is_number=True),
            Cell(str(item.run.scans_used), is_number=True),
            number(item.run.health.mean_match_score),
            Cell(str(item.run.health.low_scores), is_number=True),
            Cell(str(item.run.low_in_a_row), is_number=True),
            Cell("; ".join(item.run.doubts()) or "nothing", "bad" if item.run.doubts() else "good"),
        ]
        for item in report.runs
    ]
    rows += [
        [Cell(name), *[Cell("-", is_number=True)] * 5, Cell(f"no map: {reason}", "bad")]
        for name, reason in report.failed
    ]
    columns = (
        "producer",
        "scans",
        "used",
        "mean match score",
        "low scores",
        "in a row",
        "what speaks against its map",
    )
    note = (
        "Match score: share of a scan's hits that fall on known walls. Low: below half of the "
        "mean, the dotted line; a robot that gets lost has many in a row."
    )
    tables = [Table("Health", columns, rows, note)]
    return [Section("Health over time", "health", pictures=pictures, tables=tables)]


def _over_time(run: ProducerRun) -> list[Series]:
    """Return how well the scans matched, and the producer's own quantities."""
    series = list(run.series)
    scores = run.match_scores
    if len(scores):
        mean = run.health.mean_match_score
        limit = None if mean is None else mean / 2.0
        stamps_s = run.trajectory.stamps_s[-len(scores) :]
        series.insert(0, Series("match score", "", stamps_s, scores, limit))
    return series


def _pairs_section(report: RunReport, config: RunConfig) -> Section:
    """Return the pairs that were tried where nothing was fused."""
    by_name = {grid.name: grid for grid in report.grids}
    overlays = [
        pair_overlay(by_name[pair.reference], by_name[pair.moving], pair, config.fusion.normalize)
        for pair in report.pairs[:MOST_OVERLAYS]
        if pair.reference in by_name and pair.moving in by_name
    ]
    shown = [overlay for overlay in overlays if overlay is not None]
    return Section("Pairs", "pairs", YAW_NOTE, shown, alignment_table("All pairs", report.pairs))


def _path_errors_section(report: RunReport) -> list[Section]:
    """Return the errors of all paths in one table, and of each relation over time."""
    rows, pictures = [], []
    for item in report.runs:
        name = item.run.name
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
            pair = f"{found.config.rpe_delta:g} {found.config.rpe_unit}"
            rows += [
                _figures(name, "ATE, place m", found.ate, 4),
                _figures(name, "ATE, heading °", found.ate_rotation_deg, 3),
                _figures(name, f"RPE over {pair}, place m", found.rpe, 4),
            ]
            pictures.append(
                Picture(
                    f"error-{name}",
                    paths.error_picture(found),
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
    columns = ("producer", "error", "mean", "std", "rmse", "median", "min", "max")
    table = Table("Errors of the paths", columns, rows)
    return [Section("Errors of the paths", "path-errors", text, pictures, [table])]


def _figures(name: str, what: str, statistics: ErrorStatistics | None, digits: int) -> list[Cell]:
    """Return a row of figures; dashes where there are none."""
    values = [
        None if statistics is None else getattr(statistics, figure)
        for figure in ("mean", "std", "rmse", "median", "min", "max")
    ]
    return [Cell(name), Cell(what), *(number(value, digits) for value in values)]


def _timings_section(report: RunReport) -> Section:
    """Return what the producers and the stages took."""
    rows = []
    for item in report.runs:
        time_ms = item.run.time_per_scan_ms()
        rows.append(
            [
                Cell(item.run.name),
                *(number(time_ms[key], 2) for key in ("mean", "p50", "p95", "p999", "max")),
                number(item.run.time_s, 1),
                number(item.time_s, 1),
                number(item.cpu_s, 1),
                number(item.run.peak_memory_bytes / BYTES_PER_MB, 1),
                number(item.run.process_peak_memory_bytes / BYTES_PER_MB, 0),
            ]
        )
    columns = (
        "producer",
        "ms a scan",
        "median",
        "95 %",
        "99.9 %",
        "longest",
        "log to map s",
        "process s",
        "processor s",
        "map and filter MB",
        "process MB",
    )
    note = (
        "The producers run side by side, so their times overlap. Process: imports, the device and "
        "the kernels included."
    )
    tables = [Table("Producers", columns, rows, note)] if rows else []
    stages = [[Cell(name), number(seconds, 2)] for name, seconds in report.stages.items()]
    tables.append(Table("Stages", ("stage", "s"), stages, "The drawing of this page comes on top."))
    text = f"The log: {report.log}"
    return Section("Timings and memory", "timings", text, tables=tables)
