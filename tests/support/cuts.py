"""Cut a map, turn it onto another lattice, and wear it: how the pairs of ``overlap`` are made."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from slamfusion.evaluation.distances import sample_on_lattice
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid
from tests.support.degrade import trinary

Axis = Literal["x", "y"]
Side = Literal["low", "high"]

# The middle of a moved map lies within this of its new frame's zero along x and y, metres.
ORIGIN_WITHIN_M = 30.0
# Share of the moved maps whose cells stay as they are: all of the motion is in the origin.
ORIGIN_ALONE = 1 / 8


@dataclass(frozen=True)
class Halves:
    """Where a map is cut along one axis of its lattice, in cells from its corner; half-open.

    Attributes:
        low: first cell of the low half; the extent of what is known begins here.
        low_end: end of the low half.
        high_start: first cell of the high half; below ``low_end`` where the halves share a strip.
        high: end of the high half and of the extent.
    """

    low: int
    low_end: int
    high_start: int
    high: int

    def range_of(self, side: Side) -> tuple[int, int]:
        """Return begin and end of one half."""
        return (self.low, self.low_end) if side == "low" else (self.high_start, self.high)


def halves_of(low: int, high: int, overlap: float) -> Halves:
    """Cut an extent into two halves of one length that share a strip.

    Args:
        low, high: the extent, cells.
        overlap: strip over length of a half, below 1; negative for a gap.
    """
    length = round((high - low) / (2.0 - overlap))
    return Halves(low, low + length, high - length, high)


def cropped(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the grid with cells -1, 0 and 100 alone, cropped to what is known."""
    whole = trinary(grid)
    box = whole.known_box
    return whole if box is None else whole.crop(box)


def along(
    grid: OccupancyGrid, lattice: OccupancyGrid, motion: Pose2, axis: Axis
) -> npt.NDArray[np.float64]:
    """Return where the cells' centres lie along an axis of another grid's lattice.

    Args:
        grid: (H, W).
        lattice: whose axis it is.
        motion: from the map frame of ``grid`` to that of ``lattice``, metres.
        axis: of the lattice.

    Returns:
        (H, W) float64, cells of ``lattice`` from its corner.
    """
    pose = lattice.origin.inverse().compose(motion).compose(grid.origin)
    rows, cols = np.indices(grid.cells.shape)
    own = np.stack((cols + 0.5, rows + 0.5), axis=-1) * grid.resolution
    return np.asarray(pose.transform(own)[..., 0 if axis == "x" else 1] / lattice.resolution)


def kept(
    grid: OccupancyGrid, places: npt.NDArray[np.float64], span: tuple[int, int]
) -> OccupancyGrid:
    """Return the cells within a span of ``along``, cropped; the rest is unknown."""
    inside = (places >= span[0]) & (places < span[1])
    cells = np.where(inside, grid.cells, np.int8(UNKNOWN))
    return cropped(OccupancyGrid(cells, grid.resolution, grid.origin, grid.name))


def mirror_image(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the map as a laser that hangs upside down would draw it, on the same corner."""
    return OccupancyGrid(grid.cells[:, ::-1].copy(), grid.resolution, grid.origin, grid.name)


def move_frame(
    grid: OccupancyGrid, rng: np.random.Generator, factor: float = 1.0
) -> tuple[OccupancyGrid, Pose2]:
    """Put a map into another frame: any yaw, another origin, most often other cells.

    Args:
        grid: with a known cell.
        rng: of yaw, place and the yaw of the cells.
        factor: the map's lengths are multiplied by this; cells keep their stated size.

    Returns:
        The moved map, and the pose that maps a point of its map frame into that of ``grid``,
        metres; with a factor, into that of ``grid`` stretched about the corner of cell [0, 0].
    """
    size = grid.resolution
    large = OccupancyGrid(grid.cells, size * factor, grid.origin, grid.name)
    middle = np.array((grid.width, grid.height)) / 2 * large.resolution
    x, y = (float(value) for value in grid.origin.transform(middle))
    yaw_rad = float(rng.uniform(-math.pi, math.pi))
    place = rng.uniform(-ORIGIN_WITHIN_M, ORIGIN_WITHIN_M, 2)
    pose = Pose2(x, y, yaw_rad).compose(Pose2(-float(place[0]), -float(place[1])))
    lattice_yaw_rad = float(rng.uniform(-math.pi, math.pi)) * float(rng.integers(0, 2))
    if rng.random() < ORIGIN_ALONE and factor == 1.0:
        origin = pose.inverse().compose(grid.origin)
        return OccupancyGrid(grid.cells, size, origin, grid.name), pose
    return render(large, pose, lattice_yaw_rad, size), pose


def render(
    grid: OccupancyGrid, pose: Pose2, lattice_yaw_rad: float, resolution: float
) -> OccupancyGrid:
    """Draw a map on the lattice of another frame: each cell is what lies under its centre.

    Args:
        grid: with a known cell.
        pose: of the new map frame in that of ``grid``, metres.
        lattice_yaw_rad: yaw of the new grid's origin in its own frame.
        resolution: metres per new cell.
    """
    axes = Pose2(0.0, 0.0, lattice_yaw_rad)
    rows, cols = np.nonzero(grid.cells != UNKNOWN)
    to_axes = axes.inverse().compose(pose.inverse())
    known = to_axes.transform(grid.cell_centres(rows, cols)) / resolution
    first = np.floor(known.min(axis=0)) - 1.0
    width, height = (int(count) for count in np.ceil(known.max(axis=0) + 1.0 - first))
    corner = axes.transform(first * resolution)
    origin = Pose2(float(corner[0]), float(corner[1]), lattice_yaw_rad)

    lattice = OccupancyGrid(np.zeros((1, 1), dtype=np.int8), resolution, origin, grid.name)
    box = CellBox(0, 0, height, width)
    return cropped(replace(lattice, cells=sample_on_lattice(grid, lattice, box, pose.inverse())))


def wear(
    grid: OccupancyGrid, rng: np.random.Generator, dropped: float, specks: float
) -> OccupancyGrid:
    """Drop wall cells and add specks in free space.

    Args:
        grid: cells -1, 0, 100.
        rng: chooses both.
        dropped: share of the wall cells that become free.
        specks: how many are added, as a share of the wall cells; single cells and pairs.
    """
    cells = grid.cells.copy()
    walls, free = np.argwhere(cells == OCCUPIED), np.argwhere(cells == FREE)
    gone = rng.choice(len(walls), round(dropped * len(walls)), replace=False)
    cells[tuple(walls[gone].T)] = FREE
    count = min(round(specks * len(walls)), len(free))
    places = free[rng.choice(len(free), count, replace=False)]
    cells[tuple(places.T)] = OCCUPIED
    # Every other speck has a second cell, where that one is free as well.
    beside = places[::2] + rng.integers(-1, 2, (len(places[::2]), 2))
    inside = ((beside >= 0) & (beside < cells.shape)).all(axis=1)
    rows, cols = beside[inside].T
    cells[rows, cols] = np.where(cells[rows, cols] == FREE, np.int8(OCCUPIED), cells[rows, cols])
    return OccupancyGrid(cells, grid.resolution, grid.origin, grid.name)
