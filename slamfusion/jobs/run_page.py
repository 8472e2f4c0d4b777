"""The report of the main job on one page: maps, paths, health, alignment, errors, timings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from slamfusion.errors import counted
from slamfusion.evaluation.measured import MeasuredPath
from slamfusion.fusion.path_check import PATH_GAP_M
from slamfusion.geometry import Pose2
from slamfusion.grid import ClassifiedGrid
from slamfusion.jobs.run_files import LogRun
from slamfusion.palette import NAMED, Rgb
from slamfusion.report import fusion_report, maps, page, paths
from slamfusion.report.canvas import MARKS
from slamfusion.report.errors import broken, drawable, error_facts, errors_section, series_picture
from slamfusion.slam.common.mapper import Series
from slamfusion.slam.common.runner import ProducerRun

# What the path is called that is made of those of the producers; among those of the verdict; and
# the fused map among the doubled walls.
FUSED_PATH, FUSED_VERDICT = "fused path", "fused"


def run_page(run: LogRun) -> page.Page:
    """Return the report of a run."""
    config, result = run.made_with.config, run.fusion.result
    # Each input and path has one colour on all of the page.
    colours = maps.input_colours([*(grid.name for grid in run.grids), *run.paths])
    colours[FUSED_PATH] = NAMED["fused"]
    measured = list(run.paths.values())
    if (fused := run.fused_path) is not None:
        named = replace(fused.trajectory, name=FUSED_PATH)
        measured.append(MeasuredPath(trajectory=named, measures=fused.measures))
    sections = [_maps_section(run, colours)]
    if run.results:
        sections += [*_drive_section(run, colours), _paths_section(run, colours)]
    if run.recommendation is not None and run.evidence is not None:
        sections.append(paths.evidence_section(run.recommendation, run.evidence, colours))
    if result is not None:
        sections.append(fusion_report.alignment_section(result))
    elif run.fusion.pairs:
        sections.append(maps.pairs_section(_classified(run), run.fusion.pairs))
    sections += errors_section(measured, colours)
    if run.evaluations:
        alignments = [item.alignment for item in run.evaluations]
        sections.append(maps.error_section(run.evaluations, alignments))
    sections.append(_timings_section(run))
    if result is not None:
        walls = run.fusion.doubled
        doubled = None if walls is None else walls.of_maps(fusion_report.FUSED_MAP)
        sections.append(fusion_report.statistics_section(result, config, doubled))
    elif run.grids:
        table = maps.map_statistics(_classified(run))
        sections.append(page.Section("The maps in numbers", tables=table))
    facts = _facts(run, measured)
    return page.Page("SLAMfusion run", _banner(run), facts, sections, config, run.made_with.device)


def _classified(run: LogRun) -> list[ClassifiedGrid]:
    return [grid.classified(run.made_with.config.fusion.normalize) for grid in run.grids]


def _banner(run: LogRun) -> page.Banner:
    """Say first what to use, then what to check, then what was fused and what was not."""
    answer, result = run.recommendation, run.fusion.result
    lines = [] if answer is None else answer.lines()
    lines += run.remarks()
    lines += [(f"{where.capitalize()}:", text) for where, text in run.log_faults()]
    lines += [("Not measured:", trouble) for trouble in run.not_measured]
    if result is None or run.error is not None:
        headline = "Do not use this map" if result is not None else "Nothing was fused"
        return page.Banner("bad", headline, [("", run.error or ""), *lines])
    accepted = ", ".join(record.name for record in result.accepted)
    how = f"by vote ({run.fused_mode})"
    if run.fused_mode == "drawn":
        how = "the map is drawn from all scans at their fused path"
    lines.append(("Fused:", f"{accepted}; {how}; in the frame of {result.reference}."))
    how_many = fusion_report.how_many_fused(result, len(run.failed))
    if answer is None:
        tone = "warn" if result.rejected or run.failed else "plain"
        return page.Banner(tone, how_many, lines)
    lines.append(("", f"{how_many}."))
    return page.Banner(answer.tone, answer.headline, lines)


def _facts(run: LogRun, measured: Sequence[MeasuredPath]) -> list[page.Fact]:
    facts = []
    for item in list(run.results.values())[:1]:
        length = f"{item.run.path_length_m:.0f} m in {item.run.duration_s:.0f} s"
        facts.append(page.Fact(length, f"drive, {counted(item.run.scans, 'scan')}"))
    if run.fusion.result is not None:
        facts += fusion_report.fusion_facts(run.fusion.result, len(run.failed))
    if run.path_gaps:
        widest = max(gap.median_m for gap in run.path_gaps)
        what = "between the paths farthest apart in the fused map (median)"
        facts.append(page.Fact(f"{widest:.2f} m", what))
    facts += [fact for path in measured for fact in error_facts(path)]
    facts += [
        page.Fact(f"{one.error:.1f}", f"{one.name}: map error [F16]") for one in run.evaluations
    ]
    time = page.Fact(f"{sum(run.stages_s.values()):.1f} s", "for all, without this page")
    return [*facts, time]


def _maps_section(run: LogRun, colours: Mapping[str, Rgb]) -> page.Section:
    """Return who was off when, the fused map, the inputs that voted, and where they agree."""
    result, config, answer = run.fusion.result, run.made_with.config, run.recommendation
    if result is None:
        pictures = [maps.input_picture(grid) for grid in _classified(run)]
        return page.Section("Maps", "Each map in its own frame.", pictures)
    voted = {record.name for record in result.accepted}
    shown = {name: own.trajectory for name, own in run.paths.items() if name in voted}
    if run.fused_path is not None:
        shown[FUSED_VERDICT] = run.fused_path.trajectory
    places = [] if answer is None else [(place.x, place.y) for place in answer.check]
    section = fusion_report.fused_section(result, shown, places)
    fused, *others = section.pictures
    inputs = fusion_report.inputs_section(result, config)
    pictures = [fused, *inputs.pictures, *others]
    if answer is not None and run.evidence is not None:
        strip = paths.strip_picture(answer, paths.path_colours(answer, run.evidence, colours))
        pictures.insert(0, strip)
    return page.Section("Maps", inputs.text, pictures, layers=section.layers)


def _drive_section(run: LogRun, colours: Mapping[str, Rgb]) -> list[page.Section]:
    """Return the match scores and each SLAM's own quantities over time; empty without any."""
    runs = [item.run for item in run.results.values()]
    series = [(item.name, one) for item in runs for one in drawable(_over_time(item))]
    if not series:
        return []
    figure = series_picture(
        [one for _, one in series],
        colours=[colours[name] for name, _ in series],
        start_s=min(float(item.trajectory.stamps_s[0]) for item in runs),
    )
    legend = {name: colours[name] for name, _ in series}
    caption = (
        "Match score: share of a scan's hits that fall on known walls; a robot that gets lost has "
        "many low ones in a row. Dotted: limits."
    )
    picture = page.Picture("over-time", figure, "The SLAMs over the drive", caption, legend=legend)
    return [page.Section("Over the drive", pictures=[picture])]


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


def _timings_section(run: LogRun) -> page.Section:
    """Return the numbers of each SLAM, and the time of the stages."""
    shown = {name: dict(item.figures()) for name, item in run.results.items()}
    rows = list(dict.fromkeys(row for own in shown.values() for row in own))
    slams = [(row, [own.get(row, "-") for own in shown.values()]) for row in rows]
    found = page.tables().timings(list(shown), slams, run.stages_s)
    text = "; ".join((f"The log: {run.files.log}", *run.log_notes()))
    return page.Section("Health, times and memory", text, tables=found)


def _paths_section(run: LogRun, colours: Mapping[str, Rgb]) -> page.Section:
    """Return all paths in the fused map, or each over its own map, and how far they are apart."""
    config, pictures, table = run.made_with.config, [], page.NO_TABLES
    accepted = [] if run.fusion.result is None else run.fusion.result.accepted
    placed = {
        record.name: Pose2() if record.alignment is None else record.alignment.transform
        for record in accepted
    }
    if placed.keys() & run.results.keys():
        pictures.append(_together(run, placed, colours))
    else:
        for name, item in run.results.items():
            grid = item.run.grid.classified(config.fusion.normalize)
            picture = paths.path_picture(item.run.trajectory, grid=grid)
            title = f"{name}: its path over its map"
            pictures.append(page.Picture(f"path-{name}", picture, title, legend=MARKS))
    if gaps := run.path_gaps:
        over_time = [
            Series(
                f"{gap.a} to {gap.b}",
                "m",
                *broken(gap.stamps_s, gap.gaps_m),
                PATH_GAP_M if gap.max_m > PATH_GAP_M else None,
            )
            for gap in gaps
        ]
        figure = series_picture(over_time, start_s=float(gaps[0].stamps_s[0]))
        title = "Distance between the paths in the fused map"
        caption = (
            "All SLAMs ran on one robot: where two paths part, one of them or the alignment of "
            "their maps is wrong."
        )
        pictures.append(page.Picture("path-gaps", figure, title, caption))
        table = page.tables().path_gaps(gaps, PATH_GAP_M)
    return page.Section("Paths", "", pictures, table)


def _together(run: LogRun, placed: Mapping[str, Pose2], colours: Mapping[str, Rgb]) -> page.Picture:
    """Return the paths whose maps were fused, with truth and odometry, in the fused map."""
    result = run.fusion.result
    shown = {
        name: own.trajectory.moved(placed[name])
        for name, own in run.paths.items()
        if name in placed
    }
    # The first lies on top; the lower ones are wider, so that each is seen where all are one line.
    step = 1.2 / max(1, len(shown) - 1)
    lines = [
        paths.Line(path, name, colours[name], 1.0 + step * index)
        for index, (name, path) in reversed(list(enumerate(shown.items())))
    ]
    if run.fused_path is not None:
        path = run.fused_path.trajectory
        lines.append(paths.Line(path, FUSED_PATH, colours[FUSED_PATH], width=0.8))
    name, top = next(iter(shown.items()))
    first, sentences = run.results[name], []
    if run.true_path is not None and (errors := first.measures.truth) is not None:
        motion = placed[name].compose(errors.alignment.transform.inverse())
        lines.append(paths.truth_line(run.true_path.moved(motion)))
        sentences.append("The truth is aligned with the whole first path.")
    if first.run.odometry is not None:
        lines.insert(0, paths.odometry_line(paths.laid_on_start(first.run.odometry, top)))
        sentences.append(
            "Raw odometry is aligned with its start; drift far beyond the picture is cut off."
        )
    normalize = run.made_with.config.fusion.normalize
    grid = None if result is None else result.fused.classified(normalize)
    picture = paths.paths_picture(lines, top, grid=grid)
    title, text = "The paths over the fused map", " ".join(sentences)
    return page.Picture("paths", picture, title, text, legend=paths.paths_legend(lines))
