"""The report of the main job on one page: maps, paths, health, alignment, errors, timings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from slamfusion.fusion.path_check import PathGap, moved_path
from slamfusion.geometry import Pose2
from slamfusion.io.files import AtomicFiles
from slamfusion.jobs.map_log import ProducerResult
from slamfusion.jobs.run import LogRun
from slamfusion.palette import NAMED, Rgb
from slamfusion.report import paths
from slamfusion.report.canvas import MARKS
from slamfusion.report.errors import (
    MeasuredPath,
    broken,
    drawable,
    error_facts,
    errors_section,
    series_picture,
)
from slamfusion.report.evidence import evidence_section, path_colours, place_lines, strip_picture
from slamfusion.report.fusion_report import (
    alignment_section,
    doubtful_lines,
    fused_section,
    fusion_facts,
    inputs_section,
    shown_box,
    statistics_section,
)
from slamfusion.report.maps import (
    error_section,
    input_colours,
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
    number,
    write_page,
)
from slamfusion.slam.common.mapper import Series
from slamfusion.slam.common.runner import ProducerRun

BYTES_PER_MB = 1e6
# What the path is called that is made of those of the producers; among those of the verdict; and
# the fused map among the doubled walls.
FUSED_PATH, FUSED_VERDICT, FUSED_MAP = "fused path", "fused", "fused map"


def _measured_paths(run: LogRun) -> list[MeasuredPath]:
    """Return the producers' paths, those of saved maps and the fused one, with their errors."""
    found = [(name, item.run.trajectory, item.measures) for name, item in run.results.items()]
    found += [(name, item.path, item.measures) for name, item in run.saved_paths.items()]
    if run.fused_path is not None:
        found.append((FUSED_PATH, run.fused_path.trajectory, run.fused_path.measures))
    return [
        MeasuredPath(name, path, own.truth, own.relations, own.at_scans)
        for name, path, own in found
    ]


def _colours(run: LogRun) -> dict[str, Rgb]:
    """Return the colour of each input, of each path, and of the fused one, on all of the page."""
    names = [*(grid.name for grid in run.grids), *run.results, *run.saved_paths]
    return {**input_colours(names), FUSED_PATH: NAMED["fused"]}


def _warnings(run: LogRun) -> list[tuple[str, str]]:
    """Return what the user must see first, each a subject and a sentence."""
    found = [
        (f"{name}:", text) for name, item in run.results.items() for text in item.run.warnings()
    ]
    if run.why_voted is not None:
        found.append(("Not drawn:", f"the maps vote ({run.fused_mode}): {run.why_voted}"))
    return [*found, *(("Not measured:", trouble) for trouble in run.not_measured)]


def write_run_page(run: LogRun, directory: str | Path, files: AtomicFiles | None = None) -> Path:
    """Write the report of a run; see ``write_page``."""
    return write_page(run_page(run), directory, files)


def run_page(run: LogRun) -> Page:
    """Return the report of a run."""
    config, result, normalize = run.config, run.fusion.result, run.config.fusion.normalize
    sections = [_maps_section(run)]
    if run.results:
        sections += [_drive_section(run), _paths_section(run)]
    if run.recommendation is not None and run.evidence is not None:
        sections.append(evidence_section(run.recommendation, run.evidence, _colours(run)))
    if result is not None:
        sections.append(alignment_section(result))
    elif run.fusion.pairs:
        sections.append(pairs_section(run.grids, run.fusion.pairs, normalize))
    sections += errors_section(_measured_paths(run), _colours(run))
    if run.evaluations:
        alignments = [item.alignment for item in run.evaluations]
        sections.append(error_section(run.evaluations, alignments))
    sections.append(_timings_section(run))
    if result is not None:
        doubled = (
            None if run.doubled is None else run.doubled.inputs | {FUSED_MAP: run.doubled.fused}
        )
        sections.append(statistics_section(result, config, doubled))
    elif run.grids:
        tables = [statistics_table(run.grids, normalize)]
        sections.append(Section("The maps in numbers", tables=tables))
    return Page("SLAMfusion run", _banner(run), _facts(run), sections, config, run.device)


def _banner(run: LogRun) -> Banner:
    """Say first what to use, then what to check, then what was fused and what was not."""
    answer, result = run.recommendation, run.fusion.result
    lines = [] if answer is None else place_lines(answer)
    lines += [(f"{item.name} made no map:", item.reason) for item in run.failed]
    if result is not None:
        lines += doubtful_lines(result)
    lines += _warnings(run)
    if result is None or run.failure is not None:
        headline = "Do not use this map" if result is not None else "Nothing was fused"
        return Banner("bad", headline, [("", str(run.failure or "")), *lines])
    accepted = ", ".join(record.name for record in result.accepted)
    lines.append(
        ("Fused:", f"{accepted}{_how(run.fused_mode)}; in the frame of {result.reference}.")
    )
    total = len(result.inputs) - len(result.copies) + len(run.failed)
    fused = len(result.accepted)
    how_many = (
        f"Only {fused} of {total}" if fused < total else ("Both" if total == 2 else f"All {total}")
    )
    if answer is None:
        return Banner("warn" if fused < total else "plain", f"{how_many} maps were fused", lines)
    lines.append(("", f"{how_many} maps were fused."))
    return Banner(answer.tone, answer.headline, lines)


def _how(mode: str | None) -> str:
    """Return how a fused map came to be, for the end of a list of names."""
    if mode == "drawn":
        return "; the map is drawn from all scans at the path fused of theirs"
    return f"; by vote ({mode})" if mode else ""


def _facts(run: LogRun) -> list[Fact]:
    """Return the numbers of the headline, the first four as cards."""
    facts, more = [], []
    result, all_gaps = run.fusion.result, run.fusion.gaps
    if run.results:
        first = next(iter(run.results.values())).run
        stamps_s = first.trajectory.stamps_s
        length_m = first.trajectory.path_length_m()
        duration_s = float(stamps_s[-1] - stamps_s[0])
        facts.append(Fact(f"{length_m:.0f} m in {duration_s:.0f} s", f"drive, {first.scans} scans"))
    if result is not None:
        facts += fusion_facts(result, len(run.failed))
    if all_gaps:
        widest = max(gap.median_m for gap in all_gaps)
        what = "between the paths farthest apart in the fused map (median)"
        more.append(Fact(f"{widest:.2f} m", what))
    more += [fact for item in _measured_paths(run) for fact in error_facts(item)]
    more += [Fact(f"{item.error:.1f}", f"{item.name}: map error [F16]") for item in run.evaluations]
    time = Fact(f"{sum(run.stages.values()):.1f} s", "for all, without this page")
    return [*facts, *more, time]


def _places(run: LogRun) -> list[tuple[float, float]]:
    """Return the places to check, x and y in metres in the fused frame."""
    return [(place.x, place.y) for place in run.recommendation.check] if run.recommendation else []


def _maps_section(run: LogRun) -> Section:
    """Return the fused map, the inputs that voted, and where they agree."""
    result = run.fusion.result
    if result is None:
        pictures = [input_picture(grid, run.config.fusion.normalize) for grid in run.grids]
        return Section("Maps", "Each map in its own frame.", pictures)
    voted = {record.name for record in result.accepted}
    found = {name: item.run.trajectory for name, item in run.results.items()}
    found |= {name: item.path for name, item in run.saved_paths.items()}
    shown = {name: path for name, path in found.items() if name in voted}
    if run.fused_path is not None:
        shown[FUSED_VERDICT] = run.fused_path.trajectory
    section = fused_section(result, shown_box(result), shown, _places(run))
    fused, *others = section.pictures
    inputs = inputs_section(result, run.config)
    pictures = [*_strip(run), fused, *inputs.pictures, *others]
    return Section("Maps", inputs.text, pictures, layers=section.layers)


def _strip(run: LogRun) -> list[Picture]:
    """Return who was off when; empty if the scans could not be asked."""
    answer, evidence = run.recommendation, run.evidence
    if answer is None or evidence is None:
        return []
    return [strip_picture(answer, path_colours(answer, evidence, _colours(run)))]


def _drive_section(run: LogRun) -> Section:
    """Return the match scores, each SLAM's own quantities, and its warnings."""
    colours, pictures = _colours(run), []
    runs = [item.run for item in run.results.values()]
    series = [(item.name, one) for item in runs for one in drawable(_over_time(item))]
    if series:
        figure = series_picture(
            [one for _, one in series],
            colours=[colours[name] for name, _ in series],
            start_s=min(float(item.trajectory.stamps_s[0]) for item in runs),
        )
        legend = {name: colours[name] for name, _ in series}
        title = "The SLAMs over the drive"
        pictures.append(Picture("over-time", figure, title, "Dotted: limits.", legend=legend))
    health = Table.of(
        "Health",
        runs,
        {
            "producer": lambda own: own.name,
            "scans": lambda own: own.scans,
            "used": lambda own: own.scans_used,
            "mean match score": lambda own: number(own.health.mean_match_score),
            "low scores": lambda own: own.health.low_scores,
            "in a row": lambda own: own.low_in_a_row,
            "warnings": lambda own: Cell(
                "; ".join(own.warnings()) or "none", "bad" if own.warnings() else "good"
            ),
        },
        "Match score: share of a scan's hits that fall on known walls. Low: below half of the "
        "mean, the dotted line; a robot that gets lost has many in a row.",
    )
    failed = [
        [Cell(item.name), *[Cell("-", is_number=True)] * 5, Cell(f"no map: {item.reason}", "bad")]
        for item in run.failed
    ]
    tables = [replace(health, rows=[*health.rows, *failed])]
    return Section("Over the drive", pictures=pictures, tables=tables)


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


def _timings_section(run: LogRun) -> Section:
    """Return what the producers and the stages took."""
    producers = Table.of(
        "Producers",
        [(item, item.run, item.run.time_per_scan_ms()) for item in run.outcomes if item.run],
        {
            "producer": lambda own: own[0].name,
            "ms a scan": lambda own: number(own[2]["mean"], 2),
            "median": lambda own: number(own[2]["p50"], 2),
            "95 %": lambda own: number(own[2]["p95"], 2),
            "99.9 %": lambda own: number(own[2]["p999"], 2),
            "longest": lambda own: number(own[2]["max"], 2),
            "log to map [s]": lambda own: number(own[1].time_s, 1),
            "process [s]": lambda own: number(own[0].time_s, 1),
            "processor [s]": lambda own: number(own[0].cpu_s, 1),
            "map and filter [MB]": lambda own: number(own[1].peak_memory_bytes / BYTES_PER_MB, 1),
            "process [MB]": lambda own: number(own[1].process_peak_memory_bytes / BYTES_PER_MB, 0),
        },
        "The producers run side by side, so their times overlap. Process: imports, the device and "
        "the kernels included.",
    )
    stages = Table.of(
        "Stages",
        run.stages.items(),
        {"stage": lambda own: own[0], "s": lambda own: number(own[1], 2)},
        "The drawing of this page comes on top.",
    )
    tables = [producers, stages] if producers.rows else [stages]
    text = "; ".join((f"The log: {run.files.log}", *run.log_notes()))
    return Section("Timings and memory", text, tables=tables)


# --- paths -------------------------------------------------------------------------------------


def _placed(run: LogRun) -> dict[str, Pose2]:
    """Return the transform into the fused frame of each producer that voted."""
    if run.fusion.result is None:
        return {}
    return {
        record.name: Pose2() if record.alignment is None else record.alignment.transform
        for record in run.fusion.result.accepted
    }


def _paths_section(run: LogRun) -> Section:
    """Return all paths in the fused map, how far they are apart, and each over its own map."""
    placed, gaps, pictures = _placed(run), run.fusion.gaps, []
    together = [item for name, item in run.results.items() if name in placed]
    if together:
        pictures.append(_together(run, together, placed))
    else:
        pictures += [
            Picture(
                f"path-{item.run.name}",
                paths.path_picture(
                    item.run.trajectory, grid=item.run.grid, normalize=run.config.fusion.normalize
                ),
                f"{item.run.name}: its path over its map",
                legend=MARKS,
            )
            for item in run.results.values()
        ]
    tables = []
    if gaps:
        limit_m = run.config.run.path_gap_m
        over_time = [
            Series(
                f"{gap.a} to {gap.b}",
                "m",
                *broken(gap.stamps_s, gap.gaps_m),
                limit_m if gap.max_m > limit_m else None,
            )
            for gap in gaps
        ]
        start_s = float(gaps[0].stamps_s[0])
        pictures.append(
            Picture(
                "path-gaps",
                series_picture(over_time, start_s=start_s),
                "Distance between the paths in the fused map",
                "All SLAMs ran on one robot: where two paths part, one of them or the alignment of "
                "their maps is wrong.",
            )
        )
        tables.append(_gaps_table(gaps, limit_m))
    return Section("Paths", "", pictures, tables)


def _gaps_table(gaps: Sequence[PathGap], limit_m: float) -> Table:
    """Return how far every two paths are apart over the drive."""
    return Table.of(
        "The paths against each other",
        gaps,
        {
            "paths": lambda gap: f"{gap.a} to {gap.b}",
            "at the start [m]": lambda gap: number(gap.start_m),
            "median [m]": lambda gap: number(
                gap.median_m, tone="bad" if gap.median_m > limit_m else "plain"
            ),
            "at most [m]": lambda gap: number(gap.max_m),
            "median yaw °": lambda gap: number(math.degrees(gap.median_yaw_rad), 2),
        },
        f"In the fused map. A SLAM whose path is more than {limit_m:g} m (median) from those of "
        "the others has no vote.",
    )


def _together(
    run: LogRun, together: Sequence[ProducerResult], placed: Mapping[str, Pose2]
) -> Picture:
    """Return the paths whose maps were fused, with truth and odometry, in the fused map."""
    first, colours, result = together[0], _colours(run), run.fusion.result
    found = {item.run.name: item.run.trajectory for item in together}
    found |= {name: item.path for name, item in run.saved_paths.items() if name in placed}
    shown = {name: moved_path(path, placed[name]) for name, path in found.items()}
    # The first lies on top; the lower ones are wider, so that each is seen where all are one line.
    step = 1.2 / max(1, len(shown) - 1)
    lines = [
        paths.Line(path, name, colours[name], 1.0 + step * index)
        for index, (name, path) in reversed(list(enumerate(shown.items())))
    ]
    top, sentences = shown[first.run.name], []
    if run.fused_path is not None:
        lines.append(
            paths.Line(run.fused_path.trajectory, FUSED_PATH, colours[FUSED_PATH], width=0.8)
        )
    if run.truth is not None and (errors := first.measures.truth) is not None:
        motion = placed[first.run.name].compose(errors.pose_truth_estimate.inverse())
        lines.append(paths.truth_line(moved_path(run.truth, motion)))
        sentences.append("The truth is aligned with the whole first path.")
    if first.run.odometry is not None:
        lines.insert(0, paths.odometry_line(paths.laid_on_start(first.run.odometry, top)))
        sentences.append(
            "Raw odometry is aligned with its start; drift far beyond the picture is cut off."
        )
    return Picture(
        "paths",
        paths.paths_picture(
            lines,
            top,
            grid=None if result is None else result.fused,
            normalize=run.config.fusion.normalize,
        ),
        "The paths over the fused map",
        " ".join(sentences),
        legend=paths.paths_legend(lines),
    )
