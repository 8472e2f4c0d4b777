"""The pictures of paths: where they went, how large their errors were, and what the scans say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps  # noqa: TID251
from matplotlib.collections import LineCollection  # noqa: TID251
from matplotlib.colors import LinearSegmentedColormap, Normalize  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.errors import counted
from slamfusion.evaluation.measured import MeasuredPath
from slamfusion.evaluation.trajectory_error import TrajectoryErrors
from slamfusion.evidence.parting import PART_M, path_gap_m
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.evidence.recommendation import Recommendation
from slamfusion.geometry import F64, compose_poses
from slamfusion.grid import ClassifiedGrid
from slamfusion.palette import DISAGREEMENT_RGB, NAMED, Rgb, colours_of
from slamfusion.report import canvas
from slamfusion.report.page import Picture, Section, tables
from slamfusion.slam.common.mapper import Closure
from slamfusion.trajectory import Trajectory

_OTHERS = "other paths"
# Ends of both colour scales that would vanish on white are cut off.
_TIME_SPAN = (0.15, 0.82)
_ERROR_SPAN = (0.30, 1.0)
# What odometry may add to the picture on each side: drift over the edge is cut off.
_DRIFT_SHARE = 0.25
# The alternatives are drawn faintly; where they coincide they add up.
_OTHERS_OPACITY = 0.35
_OTHERS_POINTS = 400_000
# Closures of less weight than this are outliers.
USED_FROM = 0.5
# Gaps below this are drawn here: a logarithmic axis has no zero.
_LEAST_GAP_M = 0.01


def laid_on_start(odometry: Trajectory, path: Trajectory) -> Trajectory:
    """Return raw odometry in the frame of a path: at its start both have one pose."""
    at = odometry.pose(int(odometry.nearest(path.stamps_s[0])))
    return odometry.moved(path.pose(0).compose(at.inverse()))


def path_picture(
    trajectory: Trajectory, *, grid: ClassifiedGrid | None = None, values: F64 | None = None
) -> Figure:
    """Draw a path over its map, coloured by time or by an error of each pose, (N,) float64, m."""
    poses, span = trajectory.poses, _ERROR_SPAN
    label, shown, scale = "error [m]", values, "YlOrRd"
    if shown is None:
        label, scale, span = "time since the start [s]", "plasma", _TIME_SPAN
        shown = trajectory.stamps_s - trajectory.stamps_s[0]
    figure, axes = canvas.map_axes(canvas.place_extent(poses, grid), bar=True)
    canvas.draw_grid(axes, grid)
    lines = LineCollection(
        list(np.stack((poses[:-1, :2], poses[1:, :2]), axis=1)),
        cmap=LinearSegmentedColormap.from_list("part", colormaps[scale](np.linspace(*span, 256))),
        norm=Normalize(0.0, float(shown.max()) or 1.0),
        linewidths=1.3,
        capstyle="round",
    )
    lines.set_array((shown[:-1] + shown[1:]) / 2.0)
    axes.add_collection(lines, autolim=False)
    canvas.draw_marks(axes, poses)
    # The bar stands in a strip of its own, so that the map keeps its shape.
    box = axes.get_position()
    strip = figure.add_axes((box.x1 + 0.025, box.y0, 0.022, box.height))
    bar = figure.colorbar(lines, cax=strip)
    bar.set_label(label, color=canvas.INK, fontsize=canvas.SMALL_PT)
    bar.outline.set_edgecolor(canvas.INK)
    strip.tick_params(colors=canvas.INK, labelsize=canvas.SMALL_PT, width=0.7, length=3)
    return figure


@dataclass(frozen=True, eq=False)
class Line:
    """A path of one or more poses, in the frame of its picture.

    Attributes:
        is_cut: what is far beyond the other lines is cut off, as the drift of odometry is.
    """

    path: Trajectory
    text: str
    rgb: Rgb
    width: float = 1.3
    is_dashed: bool = False
    is_cut: bool = False


def truth_line(path: Trajectory) -> Line:
    """Return the true path as a line."""
    return Line(path, "truth, dashed", NAMED["truth"], 1.0, is_dashed=True)


def odometry_line(path: Trajectory) -> Line:
    """Return where the wheels alone would have gone as a line."""
    return Line(path, "raw odometry", NAMED["odometry"], 0.9, is_cut=True)


def paths_picture(
    lines: Sequence[Line],
    marked: Trajectory,
    *,
    others: Sequence[Trajectory] = (),
    grid: ClassifiedGrid | None = None,
) -> Figure:
    """Draw several paths of one drive in one frame over each other.

    Args:
        lines: at least one, the lowest first.
        marked: the path whose first and last pose are marked.
        others: its alternatives, drawn faintly under the lines; cut off as drift.
    """
    shown = [other for other in others if len(other)]
    extent = canvas.place_extent(marked.poses, grid)
    for line in sorted(lines, key=lambda line: line.is_cut):
        extent = canvas.grown(
            extent, canvas.box_of(line.path.poses), _DRIFT_SHARE if line.is_cut else None
        )
    for other in shown:
        extent = canvas.grown(extent, canvas.box_of(other.poses), _DRIFT_SHARE)
    figure, axes = canvas.map_axes(extent)
    canvas.draw_grid(axes, grid)
    # At a fixed stride, and the last; the first of them is on top.
    step = max(1, -(-sum(map(len, shown)) // _OTHERS_POINTS))
    faint = [path.poses[np.r_[: len(path) - 1 : step, -1], :2] for path in reversed(shown)]
    colour = (*canvas.unit_rgb(_others_rgb(marked.name)), _OTHERS_OPACITY)
    axes.add_collection(LineCollection(faint, colors=[colour], linewidths=0.7), autolim=False)
    for line in lines:
        axes.plot(
            *line.path.poses[:, :2].T,
            color=canvas.unit_rgb(line.rgb),
            lw=line.width,
            ls=(0, (3.0, 2.0)) if line.is_dashed else "-",
            scalex=False,
            scaley=False,
        )
    canvas.draw_marks(axes, marked.poses)
    return figure


def paths_legend(lines: Sequence[Line], others: Sequence[Trajectory] = ()) -> canvas.Legend:
    """Return what the colours of ``paths_picture`` mean, the uppermost line first."""
    legend = {line.text: line.rgb for line in reversed(lines)}
    if others:
        text = f"{counted(len(others), 'other path')}, faint"
        legend[text] = _others_rgb(lines[-1].path.name)
    return {**legend, **canvas.MARKS}


def _others_rgb(name: str) -> Rgb:
    """Return the colour of what else a path of a name may have been."""
    return colours_of((name, _OTHERS))[_OTHERS]


def path_pictures(
    trajectory: Trajectory,
    *,
    grid: ClassifiedGrid | None = None,
    errors: TrajectoryErrors | None = None,
    truth: Trajectory | None = None,
    odometry: Trajectory | None = None,
    others: Sequence[Trajectory] = (),
) -> list[Picture]:
    """Return pictures of the path by time, by its error, and with the truth and raw odometry.

    Args:
        trajectory: the estimate, in the frame of ``grid``, which is classified.
        errors: align the truth with the estimate; without them the truth is left out.
        truth, odometry: each in its own frame.
        others: alternatives that the SLAM still considered.
    """
    pictures = [
        Picture(
            "path",
            path_picture(trajectory, grid=grid),
            "The path over the map" if grid is not None else "The path",
            f"{counted(len(trajectory), 'pose')}, {trajectory.path_length_m():.1f} m.",
            legend=canvas.MARKS,
        )
    ]
    colour = colours_of([trajectory.name])[trajectory.name]
    lines, captions = [Line(trajectory, "estimate", colour)], []
    if odometry is not None and len(odometry):
        lines.insert(0, odometry_line(laid_on_start(odometry, trajectory)))
        captions.append("Raw odometry is aligned with the start; its far drift is cut off.")
    if truth is not None and errors is not None:
        lines.append(truth_line(truth.moved(errors.alignment.transform.inverse())))
        captions.append("The truth is aligned with the whole estimate.")
    if others:
        captions.append("Faint: alternatives of the SLAM; where they spread, it is uncertain.")
    if captions:
        pictures.append(
            Picture(
                "paths",
                paths_picture(lines, trajectory, others=others, grid=grid),
                "The path and others",
                " ".join(captions),
                legend=paths_legend(lines, others),
            )
        )
    if errors is not None:
        aligned = Trajectory(errors.stamps_s, errors.aligned, errors.name)
        figure = path_picture(
            aligned.moved(errors.alignment.transform.inverse()),
            grid=grid,
            values=errors.translation_m,
        )
        caption = "The estimated path, coloured by the distance from the true place."
        where = Picture("error-on-path", figure, "Where the error is", caption)
        pictures.append(where)
    return pictures


def paths_over_truth(
    case: str,
    measured: Sequence[MeasuredPath],
    truth: Trajectory | None,
    colours: Mapping[str, Rgb],
) -> Picture:
    """Draw all paths of a case, each aligned with the truth as its errors are."""
    lines = []
    for item in measured:
        path = item.trajectory
        if item.measures.truth is not None:
            path = path.moved(item.measures.truth.alignment.transform)
        lines.append(Line(path, item.name, colours[item.name], 1.0))
    marked = lines[0].path
    if truth is not None:
        lines.append(truth_line(truth))
        marked = truth
    return Picture(
        f"{case}-paths",
        paths_picture(lines, marked),
        f"{case}: all paths" + (" over the truth" if truth is not None else ""),
        "Each path is aligned with the truth as a whole." if truth is not None else "",
        legend=paths_legend(lines),
    )


def closures_picture(
    path: Trajectory, closures: Sequence[Closure], grid: ClassifiedGrid
) -> Picture:
    """Draw a path, a dot for each closure (at least one), and a line to the pose that it implies.

    Times beyond the path's count as its ends.
    """
    figure, axes = canvas.map_axes(canvas.place_extent(path.poses, grid))
    canvas.draw_grid(axes, grid)
    own, used, outlier = (*colours_of((path.name, "closures")).values(), DISAGREEMENT_RGB)
    still: dict[str, Any] = {"scalex": False, "scaley": False}
    axes.plot(*path.poses[:, :2].T, color=canvas.unit_rgb(own), lw=0.8, **still)
    outliers = [one for one in closures if one.weight < USED_FROM]
    for colour, chosen in (
        (used, [one for one in closures if one.weight >= USED_FROM]),
        (outlier, outliers),
    ):
        if not chosen:
            continue
        stamps = np.array([(one.start_s, one.end_s) for one in chosen])
        starts, ends = np.clip(np.searchsorted(path.stamps_s, stamps), 0, len(path) - 1).T
        motions = np.array([(m.x, m.y, m.yaw_rad) for m in (one.motion for one in chosen)])
        there = compose_poses(path.poses[starts], motions)[:, :2]
        here = path.poses[ends, :2]
        lines = LineCollection(
            list(np.stack((here, there), axis=1)),
            colors=[canvas.unit_rgb(colour)],
            linewidths=0.8,
            zorder=3.0,  # above the path
        )
        axes.add_collection(lines, autolim=False)
        axes.plot(*here.T, color=canvas.unit_rgb(colour), marker=".", ms=2.0, ls="none", **still)
    canvas.draw_marks(axes, path.poses)
    texts = (
        "path",
        f"closures used: {len(closures) - len(outliers)}",
        f"outliers, not used: {len(outliers)}",
    )
    return Picture(
        "closures",
        figure,
        "The loop closures",
        "A line leads to where a closure has the robot; a long one contradicts the path.",
        legend={**dict(zip(texts, (own, used, outlier), strict=True)), **canvas.MARKS},
    )


def evidence_section(
    answer: Recommendation, evidence: PathEvidence, page: Mapping[str, Rgb] | None = None
) -> Section:
    """Return the reasons of a recommendation, in the colours that the page gives the paths."""
    colours = path_colours(answer, evidence, page or {})
    picture = Picture(
        "evidence",
        evidence_picture(answer, evidence, colours),
        "How well each path predicts the scans, over the drive",
        "Above: mean log-likelihood of a hit under what other parts of the drive drew by the same "
        "path; higher is better. Below: distance from the recommended path, after each path is "
        "aligned with it where they agree most.",
        legend=colours,
    )
    return Section("Why this path", answer.headline + ".", [picture], tables().scores(answer.paths))


def strip_picture(answer: Recommendation, colours: Mapping[str, Rgb]) -> Picture:
    """Draw who was off when: a bar for each path, and the places to check across them."""
    names = [path.name for path in answer.paths]
    figure, (axes,) = canvas.stacked_axes(1, 0.16 + 0.32 * len(names))
    canvas.name_rows(axes, names)
    _, top = axes.get_ylim()
    for row, path in enumerate(answer.paths):
        for span in path.spans:
            colour = colours[path.name] if span.agrees else DISAGREEMENT_RGB
            extent = [(span.from_s, span.to_s - span.from_s)]
            axes.broken_barh(extent, (row - 0.3, 0.5), facecolor=canvas.unit_rgb(colour))
    for nth, place in enumerate(answer.check, start=1):
        axes.axvspan(place.from_s, place.to_s, color=canvas.INK, alpha=0.2, lw=0)
        middle_s = 0.5 * (place.from_s + place.to_s)
        axes.annotate(str(nth), (middle_s, top), annotation_clip=False, **canvas.PLACE_LOOK)
    axes.margins(x=0.0)
    canvas.label_axes(axes, x="time since the start [s]")
    legend = {f"{PART_M:g} m or more from the recommended path": DISAGREEMENT_RGB}
    marks = "Numbers and grey bands: the places to check."
    caption = marks if answer.check else "There is no place to check."
    return Picture("who-was-off", figure, "Who was off when", caption, legend=legend)


def evidence_picture(
    answer: Recommendation, evidence: PathEvidence, rgb: Mapping[str, Rgb]
) -> Figure:
    """Draw the score of each path over the drive, and below how far it is from the recommended."""
    best, *others = answer.paths
    figure, axes = canvas.stacked_axes(2, (1.6, 1.0)) if others else canvas.stacked_axes(1, 1.6)
    start_s = float(evidence.scans.stamps_s[0])
    colours = {name: canvas.unit_rgb(colour) for name, colour in rgb.items()}
    for name, colour in colours.items():
        times_s, mean, _, _ = evidence.over_time(name)
        axes[0].plot(times_s - start_s, mean, color=colour, lw=1.1, marker="o", ms=2.0)
    canvas.label_axes(axes[0], "log-likelihood of a hit")
    if others:
        last = axes[1]
        since_s = evidence.scans.stamps_s[evidence.is_judged] - start_s
        for path in others:
            gap_m = np.maximum(path_gap_m(evidence, path.name, best.name), _LEAST_GAP_M)
            last.plot(since_s, gap_m, color=colours[path.name], lw=0.9)
        last.axhline(PART_M, color=canvas.INK, lw=0.8, ls=":")
        canvas.write_note(last, f"dotted: parted, {PART_M:g} m")
        last.set_yscale("log")
        last.tick_params(which="minor", colors=canvas.INK, width=0.5, length=2)
        canvas.label_axes(last, "distance from the recommended path", y="[m]")
    canvas.label_axes(axes[-1], x="time since the start [s]")
    return figure


def path_colours(
    answer: Recommendation, evidence: PathEvidence, page: Mapping[str, Rgb]
) -> dict[str, Rgb]:
    """Return the colour of each path, as elsewhere on the page."""
    colours = {**colours_of(evidence.scores), **page}
    fused = answer.paths[0].name if answer.is_of_fused else None
    return {name: NAMED["fused"] if name == fused else colours[name] for name in evidence.scores}
