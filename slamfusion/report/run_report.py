"""The report of the main job on one page: maps, paths, health, alignment, errors, timings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamfusion.config import RunConfig
from slamfusion.io.atomic import AtomicFiles
from slamfusion.report.evidence import evidence_section
from slamfusion.report.fusion_report import (
    alignment_section,
    dissent_section,
    doubtful_lines,
    fused_section,
    inputs_section,
    shown_box,
    statistics_section,
)
from slamfusion.report.maps import (
    error_section,
    input_picture,
    pairs_section,
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
from slamfusion.report.run_contents import RunReport
from slamfusion.report.run_paths import path_errors_section, paths_section
from slamfusion.report.series import drawable, series_picture
from slamfusion.slam.common.mapper import Series
from slamfusion.slam.common.runner import ProducerRun

BYTES_PER_MB = 1e6
MOST_OVERLAYS = 6
# The fused path among those of the verdict.
FUSED_PATH = "fused"


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
    if report.recommendation is not None and report.evidence is not None:
        sections.append(evidence_section(report.recommendation, report.evidence, report.colours))
    if report.runs:
        sections += [paths_section(report, config), *_health_section(report)]
    if report.result is not None:
        if any(record.dissent is not None for record in report.result.accepted):
            sections.append(dissent_section(report.result, shown_box(report.result)))
        sections.append(alignment_section(report.result, only_doubtful=True))
    elif report.pairs:
        normalize = config.fusion.normalize
        sections.append(
            pairs_section(report.grids, report.pairs, normalize, most_overlays=MOST_OVERLAYS)
        )
    sections += path_errors_section(report)
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
    return write_page(page, directory, files, forms=config.report.pictures)


def _banner(report: RunReport) -> Banner:
    """Say first what to use, then what to check, then what was fused and what was not."""
    answer, result = report.recommendation, report.result
    lines = [] if answer is None else answer.lines()
    lines += [(f"{name} made no map:", reason) for name, reason in report.failed]
    if result is not None:
        lines += doubtful_lines(result)
    lines += list(report.warnings)
    if result is None or report.failure:
        headline = "Do not use this map" if result is not None else "Nothing was fused"
        return Banner("bad", headline, [("", report.failure), *lines])
    accepted = ", ".join(record.name for record in result.accepted)
    lines.append(("Fused:", f"{accepted}{_how(report.mode)}; in the frame of {result.reference}."))
    total = len(result.inputs) - len(result.copies) + len(report.failed)
    fused = len(result.accepted)
    how_many = (
        f"Only {fused} of {total}" if fused < total else ("Both" if total == 2 else f"All {total}")
    )
    if answer is None:
        return Banner("warn" if fused < total else "plain", f"{how_many} maps were fused", lines)
    lines.append(("", f"{how_many} maps were fused."))
    return Banner(answer.tone, answer.headline, lines)


def _how(mode: str) -> str:
    """Return how a fused map came to be, for the end of a list of names."""
    if mode == "drawn":
        return "; the map is drawn from all scans at the path fused of theirs"
    return f"; by vote ({mode})" if mode else ""


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
    for gaps, when in (
        (report.gaps, "over the drive"),
        ([gap.voting for gap in report.gaps if not gap.both_vote.all()], "while both vote"),
    ):
        widest = max((gap.median_m for gap in gaps if gap is not None), default=None)
        if widest is not None:
            what = f"between the paths farthest apart in the fused map, {when} (median)"
            facts.append(Fact(f"{widest:.2f} m", what))
    facts += [
        Fact(f"{item.relations.translation.mean:.4f} m", f"{name}: error of relations")
        for name, item in report.measured_paths
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
    text = (
        "In its picture each input lies in its own frame, as it was made; the fused map in that of "
        "the reference, and so do all layers."
    )
    if result is None:
        pictures = [input_picture(grid, config.fusion.normalize) for grid in report.grids]
        return Section("Maps", "maps", text, pictures)
    voted = {record.name for record in result.accepted}
    found = {item.run.name: item.run.trajectory for item in report.runs}
    found |= {item.path.name: item.path for item in report.saved_paths}
    paths = {name: path for name, path in found.items() if name in voted}
    if report.fused_path is not None:
        paths[FUSED_PATH] = report.fused_path.path
    section = fused_section(result, shown_box(result), paths)
    fused, *others = section.pictures
    inputs = inputs_section(result, config).pictures
    return Section("Maps", "maps", text, [fused, *inputs, *others], layers=section.layers)


def _health_section(report: RunReport) -> list[Section]:
    """Return each producer's match score and its own quantities over time, and its warnings."""
    pictures = []
    for item in report.runs:
        shown = drawable(_over_time(item.run))
        if shown:
            start_s = float(item.run.trajectory.stamps_s[0])
            png = series_picture(shown, colour=report.colours[item.run.name], start_s=start_s)
            pictures.append(Picture(f"over-time-{item.run.name}", png, item.run.name))
    rows = [
        [
            Cell(item.run.name),
            Cell(str(item.run.scans), is_number=True),
            Cell(str(item.run.scans_used), is_number=True),
            number(item.run.health.mean_match_score),
            Cell(str(item.run.health.low_scores), is_number=True),
            Cell(str(item.run.low_in_a_row), is_number=True),
            Cell(
                "; ".join(item.run.warnings()) or "nothing",
                "bad" if item.run.warnings() else "good",
            ),
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
