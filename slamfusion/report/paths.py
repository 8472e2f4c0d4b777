"""The pictures of trajectories: where they went, and how large their errors were on the way.

See ``canvas`` for the look.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps  # noqa: TID251
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.collections import LineCollection  # noqa: TID251
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251
from matplotlib.ticker import FuncFormatter  # noqa: TID251

from slamfusion.config import NormalizeConfig
from slamfusion.evaluation import REVISIT_S, RelationErrors, TrajectoryErrors
from slamfusion.fusion.path_check import moved_path
from slamfusion.grid import OccupancyGrid
from slamfusion.palette import DISAGREEMENT_RGB, INK_RGB, NAMED, Rgb, colours_of
from slamfusion.report.canvas import (
    DPI,
    INK,
    WIDTH_IN,
    style_axes,
    to_png,
    unit_rgb,
    write_note,
)
from slamfusion.report.map_axes import (
    draw_grid,
    draw_marks,
    grid_extent,
    map_axes,
    mark_legend,
    path_extent,
)
from slamfusion.report.page import LegendEntry
from slamfusion.trajectory import Trajectory

_NORMALIZE = NormalizeConfig()

# What else a path may have been, beside it.
_OTHERS = "other paths"
# Ends of both colour scales that would vanish on white are cut off.
_TIME_SPAN = (0.15, 0.82)
_ERROR_SPAN = (0.30, 1.0)
# What odometry may add to the picture on each side: drift over the edge is cut off.
_DRIFT_SHARE = 0.25
_POINTS = 4000
# The other paths are drawn faintly; those that lie on each other add up.
_OTHERS_OPACITY = 0.35
_OTHERS_POINTS = 400_000
# Errors below this are drawn here: a logarithmic axis has no zero.
_LEAST_M, _LEAST_DEG = 1e-4, 1e-3


def laid_on_start(odometry: Trajectory, path: Trajectory) -> Trajectory:
    """Return raw odometry in the frame of a path: where that begins, both are one pose."""
    at = odometry.pose(int(odometry.nearest(path.stamps_s[0])))
    return moved_path(odometry, path.pose(0).compose(at.inverse()))


def path_picture(
    trajectory: Trajectory,
    *,
    grid: OccupancyGrid | None = None,
    normalize: NormalizeConfig = _NORMALIZE,
    values: npt.NDArray[np.float64] | None = None,
    label: str = "error in m",
) -> bytes:
    """Draw a path over the map that it belongs to, coloured by time or by an error.

    Args:
        trajectory: the path, in the frame of the map; at least one pose.
        grid: the map; default: none.
        normalize: what counts as wall and as free in it.
        values: (N,) float64, one for each pose, at least 0; default: the time since the first.
        label: what the values are, with their unit.
    """
    poses = trajectory.poses
    extent = path_extent(poses)
    if grid is not None:
        extent = extent.grown(grid_extent(grid, normalize))
    if values is None:
        label = "seconds since the start"
        shown = trajectory.stamps_s - trajectory.stamps_s[0]
        colours = _part(colormaps["plasma"], _TIME_SPAN)
    else:
        shown = np.asarray(values, dtype=np.float64)
        colours = _part(colormaps["YlOrRd"], _ERROR_SPAN)
    figure, axes = map_axes(extent, bar=True)
    if grid is not None:
        draw_grid(axes, grid, normalize)
    top = float(shown.max()) or 1.0
    lines = LineCollection(
        list(_segments(poses[:, :2])),
        cmap=colours,
        norm=Normalize(0.0, top),
        linewidths=1.3,
        capstyle="round",
    )
    lines.set_array((shown[:-1] + shown[1:]) / 2.0)
    axes.add_collection(lines, autolim=False)
    draw_marks(axes, poses)
    # The bar stands in a strip of its own, so that the map keeps its shape.
    box = axes.get_position()
    strip = figure.add_axes((box.x1 + 0.025, box.y0, 0.022, box.height))
    bar = figure.colorbar(lines, cax=strip)
    bar.set_label(label, color=INK, fontsize=7.5)
    bar.outline.set_edgecolor(INK)
    strip.tick_params(colors=INK, labelsize=7.5, width=0.7, length=3)
    return to_png(figure)


def paths_picture(
    trajectory: Trajectory,
    *,
    truth: Trajectory | None = None,
    odometry: Trajectory | None = None,
    others: Sequence[Trajectory] = (),
    grid: OccupancyGrid | None = None,
    normalize: NormalizeConfig = _NORMALIZE,
) -> bytes:
    """Draw several paths of one run, in their colours; the truth dashed.

    Args:
        trajectory: the estimate; like all others in one frame.
        truth: the true path.
        odometry: where the wheels alone would have gone; drift far beyond the rest is cut off.
        others: what else the path may have been, drawn faintly under the estimate; cut off alike.
        grid: a map to draw under them.
        normalize: what counts as wall and as free in it.
    """
    extent = path_extent(trajectory.poses)
    if grid is not None:
        extent = extent.grown(grid_extent(grid, normalize))
    if truth is not None:
        extent = extent.grown(path_extent(truth.poses))
    if odometry is not None:
        extent = extent.grown(path_extent(odometry.poses), _DRIFT_SHARE)
    beliefs = [other for other in others if len(other)]
    for belief in beliefs:
        extent = extent.grown(path_extent(belief.poses), _DRIFT_SHARE)
    figure, axes = map_axes(extent)
    if grid is not None:
        draw_grid(axes, grid, normalize)
    own, faint = colours_of((trajectory.name, _OTHERS)).values()
    _draw_others(axes, beliefs, faint)
    layers = (
        (odometry, NAMED["odometry"], 0.9, "-"),
        (trajectory, own, 1.3, "-"),
        (truth, NAMED["truth"], 1.0, (0, (3.0, 2.0))),
    )
    for path, colour, width, style in layers:
        if path is not None:
            x, y = path.poses[:, 0], path.poses[:, 1]
            axes.plot(x, y, color=unit_rgb(colour), lw=width, ls=style, scalex=False, scaley=False)
    draw_marks(axes, trajectory.poses)
    return to_png(figure)


def run_paths_picture(
    paths: Sequence[Trajectory],
    colours: Sequence[Rgb],
    *,
    fused: Trajectory | None = None,
    truth: Trajectory | None = None,
    odometry: Trajectory | None = None,
    grid: OccupancyGrid | None = None,
    normalize: NormalizeConfig = _NORMALIZE,
) -> bytes:
    """Draw the paths that several producers found on one drive, each in its colour.

    Args:
        paths: at least one, all in the frame of ``grid``; the first lies on top.
        colours: of each of them.
        fused: the path made of them, over them all.
        truth: the true path, dashed.
        odometry: where the wheels alone would have gone; drift far beyond the rest is cut off.
        grid: a map to draw under them.
        normalize: what counts as wall and as free in it.
    """
    extent = path_extent(paths[0].poses)
    if grid is not None:
        extent = extent.grown(grid_extent(grid, normalize))
    for path in (*paths[1:], fused, truth):
        if path is not None:
            extent = extent.grown(path_extent(path.poses))
    if odometry is not None:
        extent = extent.grown(path_extent(odometry.poses), _DRIFT_SHARE)
    figure, axes = map_axes(extent)
    if grid is not None:
        draw_grid(axes, grid, normalize)
    layers = [] if odometry is None else [(odometry, NAMED["odometry"], 0.8, "-")]
    last = len(paths) - 1
    for index, path in reversed(list(enumerate(paths))):
        # The lower ones are wider, so that each is seen where all lie on each other.
        layers.append((path, colours[index], 1.0 + 1.2 * index / max(1, last), "-"))
    if fused is not None:
        layers.append((fused, NAMED["fused"], 0.8, "-"))
    for path, colour, width, style in layers:
        x, y = path.poses[:, 0], path.poses[:, 1]
        axes.plot(x, y, color=unit_rgb(colour), lw=width, ls=style, scalex=False, scaley=False)
    if truth is not None:
        x, y = truth.poses[:, 0], truth.poses[:, 1]
        axes.plot(
            x,
            y,
            color=unit_rgb(NAMED["truth"]),
            lw=0.8,
            ls=(0, (3.0, 2.0)),
            scalex=False,
            scaley=False,
        )
    draw_marks(axes, paths[0].poses)
    return to_png(figure)


def error_picture(errors: TrajectoryErrors, colour: Rgb) -> bytes:
    """Draw the absolute errors over travelled metres: of the place above, of the heading below.

    Args:
        errors: of a path.
        colour: of the path.
    """
    figure, (upper, lower) = _stacked()
    travelled = errors.travelled_m
    for axes, values, label in (
        (upper, errors.translation_m, "error in m"),
        (lower, np.rad2deg(errors.rotation_rad), "error in degrees"),
    ):
        x, y = _thinned(travelled, values)
        axes.fill_between(x, y, color=unit_rgb(colour), alpha=0.16, lw=0)
        axes.plot(x, y, color=unit_rgb(colour), lw=1.0)
        rmse = float(np.sqrt(np.mean(values**2)))
        axes.axhline(rmse, color=INK, lw=0.8, ls=":")
        write_note(axes, f"root mean square {rmse:.3g}")
        axes.set_ylabel(label, color=INK, fontsize=7.5)
        axes.set_ylim(0.0, 1.08 * float(values.max()) + 1e-9)
        axes.margins(x=0)
        style_axes(axes)
    lower.set_xlabel("travelled metres", color=INK, fontsize=7.5)
    return to_png(figure)


def relations_picture(errors: RelationErrors) -> bytes:
    """Draw what is left of each relation over time, revisits marked, on logarithmic axes."""
    figure, (upper, lower) = _stacked()
    since = errors.stamps_s.min(axis=1)
    since = since - since.min()
    revisit = errors.is_revisit()
    for axes, values, least, label in (
        (upper, errors.translation_m, _LEAST_M, "error in m"),
        (lower, np.rad2deg(errors.rotation_rad), _LEAST_DEG, "error in degrees"),
    ):
        shown = np.maximum(values, least)
        style_axes(axes)
        axes.set_yscale("log")
        axes.minorticks_off()
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        for chosen, colour, marker, size in (
            (~revisit, INK_RGB, "o", 3.0),
            (revisit, DISAGREEMENT_RGB, "D", 5.0),
        ):
            axes.scatter(
                since[chosen],
                shown[chosen],
                s=size,
                marker=marker,
                color=unit_rgb(colour),
                alpha=0.75,
                linewidths=0,
            )
        mean = max(float(values.mean()), least)
        axes.axhline(mean, color=INK, lw=0.8, ls=":")
        write_note(axes, f"mean {values.mean():.3g}")
        axes.set_ylabel(label, color=INK, fontsize=7.5)
        axes.set_ylim(shown.min() / 1.6, shown.max() * 1.8)
    lower.set_xlabel("seconds since the first relation", color=INK, fontsize=7.5)
    return to_png(figure)


def paths_legend(name: str, *, truth: bool, odometry: bool) -> tuple[LegendEntry, ...]:
    """Return what the colours of ``paths_picture`` mean; the path has a name."""
    entries = [LegendEntry("estimate", colours_of([name])[name])]
    if truth:
        entries.append(LegendEntry("truth, dashed", NAMED["truth"]))
    if odometry:
        entries.append(LegendEntry("raw odometry", NAMED["odometry"]))
    return (*entries, *mark_legend())


def run_paths_legend(
    colours: Mapping[str, Rgb], *, fused: bool, truth: bool, odometry: bool
) -> tuple[LegendEntry, ...]:
    """Return what the colours of ``run_paths_picture`` mean: those of the paths by their names."""
    entries = [LegendEntry(name, colour) for name, colour in colours.items()]
    if fused:
        entries.append(LegendEntry("fused path", NAMED["fused"]))
    if truth:
        entries.append(LegendEntry("truth, dashed", NAMED["truth"]))
    if odometry:
        entries.append(LegendEntry("raw odometry", NAMED["odometry"]))
    return (*entries, *mark_legend())


def others_legend(name: str, count: int) -> tuple[LegendEntry, ...]:
    """Return what the colours of ``paths_picture`` mean: of a path by its name, and of others."""
    others = "other path" if count == 1 else "other paths"
    own, faint = colours_of((name, _OTHERS)).values()
    return (
        LegendEntry("estimate", own),
        LegendEntry(f"{count} {others}, faint", faint),
        *mark_legend(),
    )


def revisit_legend() -> tuple[LegendEntry, ...]:
    """Return what the colours of ``relations_picture`` mean."""
    return (
        LegendEntry("moments of one visit", INK_RGB),
        LegendEntry(f"revisit, over {REVISIT_S:g} s apart", DISAGREEMENT_RGB),
    )


# --- parts ---------------------------------------------------------------------------------------


def _stacked() -> tuple[Figure, Sequence[Axes]]:
    """Return two axes above each other with one x axis."""
    figure = Figure(figsize=(WIDTH_IN, 3.2), dpi=DPI)
    upper = figure.add_axes((0.155, 0.57, 0.825, 0.37))
    lower = figure.add_axes((0.155, 0.125, 0.825, 0.37), sharex=upper)
    upper.tick_params(labelbottom=False)
    return figure, (upper, lower)


def _draw_others(axes: Axes, others: Sequence[Trajectory], rgb: Rgb) -> None:
    """Draw paths faintly, the first of them on top."""
    poses = sum(len(path) for path in others)
    step = max(1, -(-poses // _OTHERS_POINTS))
    lines = [path.poses[_kept(len(path), step), :2] for path in reversed(others)]
    colour = (*unit_rgb(rgb), _OTHERS_OPACITY)
    axes.add_collection(LineCollection(lines, colors=[colour], linewidths=0.7), autolim=False)


def _kept(count: int, step: int) -> npt.NDArray[np.int64]:
    """Return the indices at a fixed stride, and the last."""
    return np.append(np.arange(0, count - 1, step), count - 1)


def _segments(places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the lines between neighbouring places, (N - 1, 2, 2)."""
    return np.stack((places[:-1], places[1:]), axis=1)


def _thinned(
    x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return at most ``_POINTS`` points; of each run of them the largest."""
    step = -(-len(x) // _POINTS)
    if step == 1:
        return x, y
    starts = np.arange(0, len(x), step)
    return x[starts], np.maximum.reduceat(y, starts)


def _part(colours: Colormap, span: tuple[float, float]) -> Colormap:
    """Return a part of a colour scale as a whole one."""
    return LinearSegmentedColormap.from_list("part", colours(np.linspace(*span, 256)))
