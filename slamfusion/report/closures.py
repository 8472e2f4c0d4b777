"""The picture of a pose graph: the path over the map, and which moments the closures join."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.collections import LineCollection  # noqa: TID251

from slamfusion.config import NormalizeConfig
from slamfusion.geometry import compose_poses
from slamfusion.grid import OccupancyGrid
from slamfusion.palette import DISAGREEMENT_RGB, Rgb, colours_of
from slamfusion.report.canvas import to_png, unit_rgb
from slamfusion.report.map_axes import (
    draw_grid,
    draw_marks,
    grid_extent,
    map_axes,
    mark_legend,
    path_extent,
)
from slamfusion.report.page import LegendEntry, Picture
from slamfusion.slam.common.mapper import Closure
from slamfusion.trajectory import Trajectory

BELIEVED_FROM = 0.5


def closures_picture(
    path: Trajectory,
    closures: Sequence[Closure],
    *,
    grid: OccupancyGrid,
    normalize: NormalizeConfig,
    colours: Sequence[Rgb],
) -> bytes:
    """Draw a path, a dot where a closure was found, a line to where that has the robot.

    Args:
        path: in the frame of the map; at least one pose.
        closures: of the graph; times beyond the path's count as its ends.
        grid: the map under them.
        normalize: what counts as wall and as free in it.
        colours: of the path, of closures that hold, and of those that do not.
    """
    figure, axes = map_axes(path_extent(path.poses).grown(grid_extent(grid, normalize)))
    draw_grid(axes, grid, normalize)
    x, y = path.poses[:, 0], path.poses[:, 1]
    own, believed, outlier = colours
    axes.plot(x, y, color=unit_rgb(own), lw=0.8, scalex=False, scaley=False)
    for colour, is_shown in ((believed, True), (outlier, False)):
        chosen = [one for one in closures if (one.weight >= BELIEVED_FROM) == is_shown]
        if not chosen:
            continue
        stamps = np.array([(one.start_s, one.end_s) for one in chosen])
        starts, ends = np.clip(np.searchsorted(path.stamps_s, stamps), 0, len(path) - 1).T
        motions = np.array([(m.x, m.y, m.yaw_rad) for m in (one.motion for one in chosen)])
        told = compose_poses(path.poses[starts], motions)[:, :2]
        here = path.poses[ends, :2]
        lines = LineCollection(
            list(np.stack((here, told), axis=1)),
            colors=[unit_rgb(colour)],
            linewidths=0.8,
            zorder=3.0,  # above the path
        )
        axes.add_collection(lines, autolim=False)
        axes.plot(
            *here.T,
            color=unit_rgb(colour),
            marker=".",
            ms=2.0,
            ls="none",
            scalex=False,
            scaley=False,
        )
    draw_marks(axes, path.poses)
    return to_png(figure)


def closure_pictures(
    final: Trajectory,
    first_reported: Trajectory | None,
    closures: Sequence[Closure],
    *,
    grid: OccupancyGrid,
    normalize: NormalizeConfig,
) -> list[Picture]:
    """Return the graph before and after its closures; nothing where it has none."""
    if not closures:
        return []
    outliers = sum(one.weight < BELIEVED_FROM for one in closures)
    texts = ("path", f"{len(closures) - outliers} closures", f"outliers, not used: {outliers}")
    colours = (*colours_of((final.name, "closures")).values(), DISAGREEMENT_RGB)
    legend = (*map(LegendEntry, texts, colours), *mark_legend())
    shown = [
        (
            "graph-before",
            first_reported,
            "The graph before its closures",
            "The path as first reported. A line leads to where a recognised place has the robot.",
        ),
        (
            "graph-after",
            final,
            "The graph after its closures",
            "The path of today. A long blue line would be a closure that does not hold.",
        ),
    ]
    return [
        Picture(
            name,
            closures_picture(path, closures, grid=grid, normalize=normalize, colours=colours),
            title,
            text,
            legend=legend,
        )
        for name, path, title, text in shown
        if path is not None and len(path)
    ]
