"""A map with axes in metres, on which paths are drawn: its extent, its cells, marks on it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes  # noqa: TID251
from matplotlib.figure import Figure  # noqa: TID251
from matplotlib.ticker import MaxNLocator  # noqa: TID251
from matplotlib.transforms import Affine2D  # noqa: TID251

from slamfusion.config import NormalizeConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid, box_origin, trinary_cells
from slamfusion.palette import DISAGREEMENT_RGB, END_RGB, FREE_RGB, START_RGB, UNKNOWN_RGB, WALL_RGB
from slamfusion.report.canvas import (
    DPI,
    INK,
    SMALL_PT,
    WIDTH_IN,
    LegendEntry,
    crop_box,
    cut_cells,
    label_axes,
    pool_cells,
    style_axes,
    unit_rgb,
)

# A number in a circle: a place to check.
PLACE_LOOK: dict[str, Any] = {
    "color": "white",
    "fontsize": SMALL_PT,
    "fontweight": "bold",
    "ha": "center",
    "va": "center",
    "bbox": {"boxstyle": "circle,pad=0.25", "facecolor": unit_rgb(DISAGREEMENT_RGB), "lw": 0.0},
    "zorder": 6.0,
}
# A box grows by this at least where its growth is limited to a share of its size.
_LEAST_GROWTH_M = 1.0
_LONGEST = 1.25 * WIDTH_IN


@dataclass(frozen=True)
class Extent:
    """A box in the map frame, metres."""

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]

    @property
    def size(self) -> npt.NDArray[np.float64]:
        """(2,) float64: width and height, metres."""
        return np.asarray(self.high - self.low)

    def grown(self, other: Extent, most: float | None = None) -> Extent:
        """Return the box with another taken in, by at most ``most`` of its size a side."""
        low, high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        if most is not None:
            limit = max(most * float(self.size.max()), _LEAST_GROWTH_M)
            low, high = np.maximum(low, self.low - limit), np.minimum(high, self.high + limit)
        return Extent(low, high)


def mark_legend() -> tuple[LegendEntry, ...]:
    """Return what the marks on a path mean."""
    return LegendEntry("start (circle)", START_RGB), LegendEntry("end (square)", END_RGB)


def map_axes(
    extent: Extent, *, bar: bool = False, margin_m: float | None = None
) -> tuple[Figure, Axes]:
    """Return axes of the shape of a place, in metres.

    Args:
        bar: leave room for a colour bar next to them.
        margin_m: around the place; default: a little.
    """
    margin = 0.03 * float(extent.size.max()) + 0.2 if margin_m is None else margin_m
    low, high = extent.low - margin, extent.high + margin
    wide, tall = (float(side) for side in high - low)
    left, right, bottom, top = 0.5, (0.72 if bar else 0.08), 0.4, 0.03
    width = WIDTH_IN - left - right
    height = width * tall / wide
    if height > _LONGEST:
        width, height = max(_LONGEST * wide / tall, 1.0), _LONGEST
    height = max(height, 0.6)
    size = (width + left + right, height + bottom + top)
    figure = Figure(figsize=size, dpi=DPI)
    axes = figure.add_axes((left / size[0], bottom / size[1], width / size[0], height / size[1]))
    # Where a side was widened for the lettering, the place shows more around it.
    scale = max(wide / width, tall / height)
    middle = (low + high) / 2.0
    axes.set_xlim(middle[0] - scale * width / 2, middle[0] + scale * width / 2)
    axes.set_ylim(middle[1] - scale * height / 2, middle[1] + scale * height / 2)
    for axis, inches in ((axes.xaxis, width), (axes.yaxis, height)):
        axis.set_major_locator(MaxNLocator(nbins=max(2, round(1.8 * inches)), steps=[1, 2, 5, 10]))
    label_axes(axes, x="x [m]", y="y [m]")
    style_axes(axes)
    _draw_scale(axes)
    return figure, axes


def _draw_scale(axes: Axes) -> None:
    """Draw a bar of a round length, at most a quarter of the width, at the lower left."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    most = 0.25 * (right - left)
    unit = 10.0 ** math.floor(math.log10(most))
    length = max(step * unit for step in (1.0, 2.0, 5.0) if step * unit <= most)
    x, y = left + 0.04 * (right - left), bottom + 0.04 * (top - bottom)
    ends: dict[str, Any] = {"color": INK, "lw": 1.6, "marker": "|", "ms": 5.0, "zorder": 5.0}
    axes.plot([x, x + length], [y, y], scalex=False, scaley=False, **ends)
    ground = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.8}
    look: dict[str, Any] = {"color": INK, "fontsize": SMALL_PT, "bbox": ground, "zorder": 5.0}
    up = y + 0.02 * (top - bottom)
    axes.text(x + 0.5 * length, up, f"{length:g} m", ha="center", va="bottom", **look)


def draw_grid(axes: Axes, grid: OccupancyGrid, normalize: NormalizeConfig) -> None:
    """Draw a map in its frame, in the colours of ``plots.map_picture``."""
    cells = trinary_cells(grid.cells, normalize)
    box = crop_box(cells != -1)
    pooled, factor = pool_cells(cut_cells(cells, box), grid.origin)
    palette = np.array((UNKNOWN_RGB, FREE_RGB, WALL_RGB), dtype=np.uint8)
    # Unknown cells have no colour here: around the map there is nothing either.
    rgba = np.dstack((palette[pooled + 1], np.where(pooled == -1, 0, 255).astype(np.uint8)))
    draw_cells(axes, rgba, factor * grid.resolution, box_origin(grid.origin, grid.resolution, box))


def draw_cells(axes: Axes, colours: npt.NDArray[np.uint8], side_m: float, corner: Pose2) -> None:
    """Draw an image of cells in the map frame, row 0 at the bottom; beyond it nothing is known.

    Args:
        axes: keep their limits.
        colours: (h, w, 3) or (h, w, 4) uint8.
        side_m: of a pixel, metres.
        corner: pose of the lower-left corner of pixel [0, 0] in the map frame.
    """
    height, width = colours.shape[:2]
    turned = Affine2D().rotate(corner.yaw_rad).translate(corner.x, corner.y)
    limits = axes.get_xlim(), axes.get_ylim()
    axes.imshow(
        colours,
        origin="lower",
        interpolation="nearest",
        extent=(0.0, width * side_m, 0.0, height * side_m),
        transform=turned + axes.transData,
        aspect="auto",
    )
    axes.set_facecolor(unit_rgb(UNKNOWN_RGB))
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])


def draw_marks(axes: Axes, poses: npt.NDArray[np.float64]) -> None:
    """Mark the first and the last pose; where they are one place both are seen."""
    for pose, colour, marker, size in (
        (poses[0], START_RGB, "o", 8.5),
        (poses[-1], END_RGB, "s", 4.0),
    ):
        axes.plot(
            [pose[0]],
            [pose[1]],
            marker=marker,
            ms=size,
            color=unit_rgb(colour),
            markeredgecolor="white",
            markeredgewidth=0.7,
            ls="none",
            scalex=False,
            scaley=False,
        )


def draw_places(figure: Figure, places: Iterable[tuple[float, float]]) -> None:
    """Number places on the map of a figure, x and y in metres; the first is 1."""
    for number, place in enumerate(places, start=1):
        figure.axes[0].annotate(str(number), place, annotation_clip=True, **PLACE_LOOK)


def path_extent(poses: npt.NDArray[np.float64]) -> Extent:
    """Return the box of the places of poses, (N, 3) x, y, yaw."""
    return Extent(poses[:, :2].min(axis=0), poses[:, :2].max(axis=0))


def grid_extent(grid: OccupancyGrid, normalize: NormalizeConfig) -> Extent:
    """Return the box of what the map knows."""
    box = crop_box(trinary_cells(grid.cells, normalize) != -1)
    corner = box_origin(grid.origin, grid.resolution, box)
    return cells_extent((box.height, box.width), grid.resolution, corner)


def cells_extent(shape: tuple[int, ...], side_m: float, corner: Pose2) -> Extent:
    """Return the box of an image of cells; see ``draw_cells``."""
    tall, wide = side_m * shape[0], side_m * shape[1]
    corners = corner.transform([(0, 0), (wide, 0), (0, tall), (wide, tall)])
    return Extent(corners.min(axis=0), corners.max(axis=0))
