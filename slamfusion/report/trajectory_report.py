"""The report of one or several paths against the truth or known relations, and its parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

from slamfusion.config import RunConfig
from slamfusion.evaluation import TrajectoryErrors
from slamfusion.fusion.path_check import moved_path
from slamfusion.grid import OccupancyGrid
from slamfusion.io.files import AtomicFiles
from slamfusion.palette import Rgb, colours_of
from slamfusion.report import paths
from slamfusion.report.errors import MeasuredPath, error_facts, errors_section
from slamfusion.report.map_axes import mark_legend
from slamfusion.report.page import Banner, Fact, Page, Picture, Section, write_page
from slamfusion.trajectory import Trajectory


def write_trajectory_report(
    directory: str | Path,
    cases: Mapping[str, Sequence[MeasuredPath]],
    *,
    config: RunConfig,
    truths: Mapping[str, Trajectory],
    odometry: Trajectory | None = None,
    grid: OccupancyGrid | None = None,
    files: AtomicFiles | None = None,
) -> Path:
    """Write the errors of paths as one self-contained page with its pictures.

    Args:
        directory, files: see ``write_page``, also for what is returned and raised.
        cases: by case its paths, at least one.
        odometry: of a single path, where the wheels alone would have gone.
        grid: a map in the frame of a single path, drawn under it.
    """
    sections, by_path, lines = [], [], []
    is_one = len(cases) == 1
    colours = colours_of(item.name for own in cases.values() for item in own)
    for case, measured in cases.items():
        truth = truths.get(case)
        if len(measured) == 1:
            (item,) = measured
            pictures = path_pictures(
                item.path,
                config=config,
                grid=grid,
                errors=item.truth,
                truth=truth,
                odometry=odometry,
            )
        else:
            pictures = [_paths_over_truth(case, measured, truth, colours)]
        title = f"The path{'s' if len(measured) > 1 else ''}"
        sections.append(Section(title if is_one else f"{case}: {title}", "", pictures))
        sections += errors_section(measured, colours, "" if is_one else case)
        by_path += [error_facts(item) for item in measured]
        words: dict[str, list[str]] = {}
        for item in measured:
            words.setdefault(_how_counted(item), []).append(item.name)
        lines += [(f"{case}, {', '.join(names)}:", text) for text, names in words.items()]
    # The leading error of each path comes first.
    facts = [fact for row in zip_longest(*by_path) for fact in row if fact is not None]
    measured = [item for own in cases.values() for item in own]
    if len(measured) == 1:
        facts += [
            Fact(f"{len(measured[0].path)}", "poses"),
            Fact(f"{measured[0].path.path_length_m():.1f} m", "travelled by the estimate"),
        ]
    banner = Banner("plain", _headline(cases), lines)
    page = Page("SLAMfusion trajectory", banner, facts, sections, config, "none needed")
    return write_page(page, directory, files)


def path_pictures(
    trajectory: Trajectory,
    *,
    config: RunConfig,
    grid: OccupancyGrid | None = None,
    errors: TrajectoryErrors | None = None,
    truth: Trajectory | None = None,
    odometry: Trajectory | None = None,
    others: Sequence[Trajectory] = (),
) -> list[Picture]:
    """Return the path by time, by its error, and with the truth and raw odometry.

    Args:
        trajectory: the estimate, in the frame of ``grid``.
        errors: align the truth with the estimate; without them the truth is left out.
        truth: the true path, in its own frame.
        odometry: raw odometry, in its own frame; it is aligned with the estimate's start.
        others: alternatives that the SLAM still considered.
    """
    normalize = config.fusion.normalize
    pictures = [
        Picture(
            "path",
            paths.path_picture(trajectory, grid=grid, normalize=normalize),
            "The path over the map" if grid is not None else "The path",
            f"{len(trajectory)} poses, {trajectory.path_length_m():.1f} m.",
            legend=mark_legend(),
        )
    ]
    lines, captions = [paths.estimate_line(trajectory)], []
    if odometry is not None and len(odometry):
        lines.insert(0, paths.odometry_line(paths.laid_on_start(odometry, trajectory)))
        captions.append("Raw odometry is aligned with the start; its far drift is cut off.")
    if truth is not None and errors is not None:
        lines.append(paths.truth_line(moved_path(truth, errors.pose_truth_estimate.inverse())))
        captions.append("The truth is aligned with the whole estimate.")
    if others:
        captions.append("Faint: alternatives of the SLAM; where they spread, it is uncertain.")
    if captions:
        pictures.append(
            Picture(
                "paths",
                paths.paths_picture(
                    lines, trajectory, others=others, grid=grid, normalize=normalize
                ),
                "The path and others",
                " ".join(captions),
                legend=paths.paths_legend(lines, others),
            )
        )
    if errors is not None:
        aligned = Trajectory(errors.stamps_s, errors.aligned, errors.name)
        figure = paths.path_picture(
            moved_path(aligned, errors.pose_truth_estimate.inverse()),
            grid=grid,
            normalize=normalize,
            values=errors.translation_m,
        )
        caption = "The estimated path, coloured by the distance from the true place."
        where = Picture("error-on-path", figure, "Where the error is", caption)
        pictures.append(where)
    return pictures


def _paths_over_truth(
    case: str,
    measured: Sequence[MeasuredPath],
    truth: Trajectory | None,
    colours: Mapping[str, Rgb],
) -> Picture:
    """Draw all paths of a case, each aligned with the truth as its errors are."""
    lines = []
    for item in measured:
        path = item.path
        if item.truth is not None:
            path = moved_path(path, item.truth.pose_truth_estimate)
        lines.append(paths.Line(path, item.name, colours[item.name], 1.0))
    marked = lines[0].path
    if truth is not None:
        lines.append(paths.truth_line(truth))
        marked = truth
    return Picture(
        f"{case}-paths",
        paths.paths_picture(lines, marked),
        f"{case}: all paths" + (" over the truth" if truth is not None else ""),
        "Each path is aligned with the truth as a whole." if truth is not None else "",
        legend=paths.paths_legend(lines),
    )


def _headline(cases: Mapping[str, Sequence[MeasuredPath]]) -> str:
    """Name the path with the smallest error; of several cases the number of paths."""
    measured = [item for own in cases.values() for item in own]
    truth = {item.name: item.truth.ate.rmse for item in measured if item.truth is not None}
    known = {
        item.name: item.relations.translation.mean
        for item in measured
        if item.relations is not None
    }
    if len(cases) > 1 or not (truth or known):
        return f"{len(measured)} paths of {len(cases)} cases"
    errors_m = truth or known
    best = min(errors_m, key=errors_m.__getitem__)
    kind = "from the truth (ATE rmse)" if truth else "off the relations (mean)"
    place = f", the nearest of {len(errors_m)}" if len(errors_m) > 1 else ""
    return f"{best}: {errors_m[best]:.4f} m {kind}{place}"


def _how_counted(item: MeasuredPath) -> str:
    """Return which poses and relations the numbers rest on."""
    words = []
    if item.relations is not None:
        own = item.relations
        words.append(
            f"{own.relations_used} of {own.relations_total} of {own.relations}, poses within "
            f"{own.tolerance_s:g} s of both times."
        )
    if item.truth is not None:
        errors = item.truth
        aligned = "aligned" if errors.alignment.kind == "se2" else "not aligned"
        words.append(
            f"{errors.poses_matched} of {errors.poses} poses have one of {errors.truth} within "
            f"{errors.tolerance_s:g} s; {aligned}."
        )
    return " ".join(words)
