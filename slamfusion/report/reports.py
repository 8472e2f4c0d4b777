"""The reports of a SLAM's run, and of paths and maps against a truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

from slamfusion.align.records import Alignment
from slamfusion.config import PICTURE_FORMS, RunConfig
from slamfusion.errors import MapFileError
from slamfusion.evaluation.map_error import MapError
from slamfusion.evaluation.measured import MeasuredPath, Measures, errors_m
from slamfusion.grid import OccupancyGrid
from slamfusion.io.files import write_atomic
from slamfusion.palette import Rgb, colours_of
from slamfusion.report import maps, page, paths
from slamfusion.report.canvas import to_form
from slamfusion.report.errors import drawable, error_facts, errors_section, series_picture
from slamfusion.report.layers import error_layers, map_layers
from slamfusion.slam.common.runner import ProducerRun
from slamfusion.trajectory import Trajectory

# --- a SLAM's run ---------------------------------------------------------------------------------


def write_slam_report(
    directory: str | Path,
    run: ProducerRun,
    *,
    config: RunConfig,
    facts: Sequence[page.Fact] = (),
    figures: Sequence[tuple[str, str]] = (),
    remarks: Sequence[tuple[str, str]] = (),
    truth: Trajectory | None = None,
    measures: Measures | None = None,
    device: str = "",
) -> Path:
    """Write the report of a producer's run; see ``write_page``.

    Args:
        run: its path has at least one pose. The first of the other paths of a producer with
            closures is the path as it was first reported.
        facts: health and timing, for the headline.
        figures: of the run, with their names.
        remarks: of the log and its scans, with their source.
        truth: the true path; drawn where ``measures`` has the errors against it.
        measures: the errors of the path.
    """
    normalize, warnings = config.fusion.normalize, run.warnings
    grid, trajectory = run.grid, run.trajectory
    named = replace(trajectory, name=run.name)
    measured = MeasuredPath(trajectory=named, measures=measures or Measures())
    pictures = [
        maps.input_picture(grid, normalize),
        *paths.path_pictures(
            trajectory,
            config=config,
            grid=grid,
            errors=measured.measures.truth,
            truth=truth,
            odometry=run.odometry,
            others=run.other_paths,
        ),
    ]
    if run.closures:
        pictures.append(
            paths.closures_picture(trajectory, run.closures, grid=grid, normalize=normalize)
        )
    statistics, layers = maps.map_statistics([grid], normalize), map_layers(grid, trajectory)
    sections = [page.Section("Map and path", "", pictures, statistics, layers=layers)]
    sections += errors_section([measured], colours_of([run.name]))
    over_time = []
    if series := drawable(run.series):
        colour = colours_of([trajectory.name])[trajectory.name]
        start_s = float(trajectory.stamps_s[0])
        figure = series_picture(series, colours=[colour] * len(series), start_s=start_s)
        text = f"From the top: {', '.join(item.name for item in series)}."
        over_time = [page.Picture("over-time", figure, "Over the run", text)]
    health = page.NO_TABLES
    if figures:
        health += page.tables().texts("The run", ["what", "value"], figures)
    if remarks:
        health += page.tables().texts("Said of the log and its scans", ["where", "what"], remarks)
    if health or over_time:
        sections.append(page.Section("Health and time", "", over_time, health))
    judged = "its map may be wrong" if warnings else "no warning from its run"
    size = f"{len(trajectory)} poses, {trajectory.path_length_m():.1f} m"
    lines = [(f"{run.name}:", sentence) for sentence in warnings]
    banner = page.Banner("warn" if warnings else "plain", f"{run.name}: {judged} ({size})", lines)
    shown = [*error_facts(measured), *facts]
    report = page.Page("SLAMfusion run", banner, shown, sections, config, device)
    return page.write_page(report, directory)


# --- paths ----------------------------------------------------------------------------------------


def write_trajectory_report(
    directory: str | Path,
    cases: Mapping[str, Sequence[MeasuredPath]],
    *,
    config: RunConfig,
    truths: Mapping[str, Trajectory],
    odometry: Trajectory | None = None,
    grid: OccupancyGrid | None = None,
) -> Path:
    """Write the report of the errors of paths; see ``write_page``.

    Args:
        cases: by case its paths, at least one.
        odometry: raw odometry of a single path.
        grid: a map in the frame of a single path, drawn under it.
    """
    sections, by_path, lines = [], [], []
    is_one = len(cases) == 1
    colours = colours_of(item.name for own in cases.values() for item in own)
    for case, measured in cases.items():
        truth = truths.get(case)
        if len(measured) == 1:
            (item,) = measured
            pictures = paths.path_pictures(
                item.trajectory,
                config=config,
                grid=grid,
                errors=item.measures.truth,
                truth=truth,
                odometry=odometry,
            )
        else:
            pictures = [_paths_over_truth(case, measured, truth, colours)]
        title = f"The path{'s' if len(measured) > 1 else ''}"
        sections.append(page.Section(title if is_one else f"{case}: {title}", "", pictures))
        sections += errors_section(measured, colours, "" if is_one else case)
        by_path += [error_facts(item) for item in measured]
        words: dict[str, list[str]] = {}
        for item in measured:
            counted = item.measures.how_counted()
            words.setdefault("; ".join(counted) + ".", []).append(item.name)
        lines += [(f"{case}, {', '.join(names)}:", text) for text, names in words.items()]
    # The leading error of each path comes first.
    facts = [fact for row in zip_longest(*by_path) for fact in row if fact is not None]
    measured = [item for own in cases.values() for item in own]
    if len(measured) == 1:
        facts += [
            page.Fact(f"{measured[0].poses}", "poses"),
            page.Fact(f"{measured[0].path_length_m:.1f} m", "travelled by the estimate"),
        ]
    banner = page.Banner("plain", _headline(cases), lines)
    report = page.Page("SLAMfusion trajectory", banner, facts, sections, config, "none needed")
    return page.write_page(report, directory)


def _paths_over_truth(
    case: str,
    measured: Sequence[MeasuredPath],
    truth: Trajectory | None,
    colours: Mapping[str, Rgb],
) -> page.Picture:
    """Draw all paths of a case, each aligned with the truth as its errors are."""
    lines = []
    for item in measured:
        path = item.trajectory
        if item.measures.truth is not None:
            path = path.moved(item.measures.truth.alignment.transform)
        lines.append(paths.Line(path, item.name, colours[item.name], 1.0))
    marked = lines[0].path
    if truth is not None:
        lines.append(paths.truth_line(truth))
        marked = truth
    return page.Picture(
        f"{case}-paths",
        paths.paths_picture(lines, marked),
        f"{case}: all paths" + (" over the truth" if truth is not None else ""),
        "Each path is aligned with the truth as a whole." if truth is not None else "",
        legend=paths.paths_legend(lines),
    )


def _headline(cases: Mapping[str, Sequence[MeasuredPath]]) -> str:
    """Name the path with the smallest error; of several cases the number of paths."""
    measured = [item for own in cases.values() for item in own]
    found = errors_m(measured)
    if len(cases) > 1 or not any(found.values()):
        return f"{len(measured)} paths of {len(cases)} cases"
    errors = found["ATE"] or found["relations"]
    best, error_m = next(iter(errors.items()))
    kind = "from the truth (ATE rmse)" if found["ATE"] else "off the relations (mean)"
    place = f", the nearest of {len(errors)}" if len(errors) > 1 else ""
    return f"{best}: {error_m:.4f} m {kind}{place}"


# --- maps -----------------------------------------------------------------------------------------


def write_evaluation_report(
    evaluations: Sequence[MapError],
    directory: str | Path,
    *,
    config: RunConfig,
    alignments: Sequence[Alignment | None] = (),
    device: str = "",
) -> Path:
    """Write the report of the differences of maps to one truth; see ``write_page``.

    Args:
        evaluations: at least one.
        alignments: of each map with the truth, None if it was not moved; rejected ones are named at
            the top.
    """
    section = maps.error_section(evaluations, alignments)
    sections = [replace(section, layers=error_layers(evaluations))]
    searched = [alignment for alignment in alignments if alignment is not None]
    if searched:
        table = page.tables().alignments("Alignment to the truth", searched)
        sections.append(page.Section("Alignment", "", maps.yaw_pictures(searched), table))
    lost = [
        (f"{alignment.moving} could not be aligned:", alignment.reason)
        for alignment in searched
        if not alignment.accepted
    ]
    best, truth = min(evaluations, key=lambda item: item.error), evaluations[0].truth
    is_one = len(evaluations) == 1
    headline = f"{best.name} against {truth}" if is_one else f"{best.name} is nearest to {truth}"
    facts = [
        page.Fact(
            f"{item.error:.2f}",
            f"error of {item.name} [F16]",
            "good" if item.error == best.error and not is_one else "plain",
        )
        for item in evaluations
    ]
    banner = page.Banner("warn" if lost else "good", headline, lost)
    report = page.Page("SLAMfusion evaluation", banner, facts, sections, config, device)
    return page.write_page(report, directory)


def write_difference_image(evaluation: MapError, path: str | Path) -> None:
    """Write the difference to the truth as one picture, in the colours of the report.

    Raises:
        MapFileError: the file is not called ``.png``, ``.svg`` or ``.pdf``, or cannot be written.
    """
    path = Path(path)
    form = path.suffix.lower().removeprefix(".")
    if form not in PICTURE_FORMS:
        raise MapFileError(f"{path}: wanted a name that ends in .{', .'.join(PICTURE_FORMS)}")
    picture = maps.difference_picture(evaluation, None)
    write_atomic(path, to_form(picture.figure, form))
