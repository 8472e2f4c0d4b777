"""``OccupancyGrid``: the map type of SLAMfusion.

Cells follow ``nav_msgs/OccupancyGrid``: -1 unknown, 0 free to 100 occupied, ``cells[row, col]``
with ``row`` growing along +y of the grid's own axes. The origin is the pose of the lower-left
corner of cell [0, 0] in the map frame, yaw included.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from slamfusion.config import YAW_MOST_RAD, NormalizeConfig
from slamfusion.errors import GridError
from slamfusion.geometry import B8, F64, I8, I64, Pose2, Scalar

FREE = 0
OCCUPIED = 100
UNKNOWN = -1
IDENTITY = Pose2()
# Cells of a large map that are processed at once: they fit into the cache.
PART_CELLS = 1 << 17

# Plausible metres per cell: finer than any sensor measures, coarser than any room.
RESOLUTION_LEAST_M, RESOLUTION_MOST_M = 1e-4, 100.0
# Metres from the frame's origin along x or y. UTM northings reach 1e7, where float64 has a step of
# 2e-9 m; float32 and fixed point on the device are relative to a map's own corner or centre.
ORIGIN_MOST_M = 1e7


@dataclass(frozen=True)
class CellBox:
    """A half-open box of cells: rows [row0, row1), columns [col0, col1)."""

    row0: int
    col0: int
    row1: int
    col1: int

    @property
    def height(self) -> int:
        """Rows in the box."""
        return self.row1 - self.row0

    @property
    def width(self) -> int:
        """Columns in the box."""
        return self.col1 - self.col0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its cells."""
        return self.height, self.width

    @property
    def area(self) -> int:
        """Cells in the box."""
        return self.height * self.width

    def hull(self, other: CellBox) -> CellBox:
        """Return the smallest box that holds both."""
        return CellBox(
            min(self.row0, other.row0),
            min(self.col0, other.col0),
            max(self.row1, other.row1),
            max(self.col1, other.col1),
        )

    def overlap(self, other: CellBox) -> CellBox | None:
        """Return the cells of both boxes, None without any."""
        row0, col0 = max(self.row0, other.row0), max(self.col0, other.col0)
        row1, col1 = min(self.row1, other.row1), min(self.col1, other.col1)
        return CellBox(row0, col0, row1, col1) if row1 > row0 and col1 > col0 else None

    def moved(self, rows: int, cols: int) -> CellBox:
        """Return the box some rows and columns further on."""
        return CellBox(self.row0 + rows, self.col0 + cols, self.row1 + rows, self.col1 + cols)

    def padded(self, cells: int) -> CellBox:
        """Return the box with some cells more on every side."""
        return CellBox(self.row0 - cells, self.col0 - cells, self.row1 + cells, self.col1 + cells)

    def grown_inside(self, cells: int, whole: CellBox) -> CellBox:
        """Return the box with some cells more on each side, cut to another one that it meets."""
        return self.padded(cells).overlap(whole) or self

    def slices(self, whole: CellBox | None = None) -> tuple[slice, slice]:
        """Return its indices in an array of the cells of another box; None: from cell [0, 0]."""
        row0, col0 = (0, 0) if whole is None else (whole.row0, whole.col0)
        return slice(self.row0 - row0, self.row1 - row0), slice(self.col0 - col0, self.col1 - col0)

    def tiles(self, side: int) -> Iterator[CellBox]:
        """Yield boxes that cover it once, cut where rows and columns are multiples of a side."""
        rows, cols = (
            [start, *range(start + side - start % side, stop, side), stop]
            for start, stop in ((self.row0, self.row1), (self.col0, self.col1))
        )
        for row0, row1 in pairwise(rows):
            for col0, col1 in pairwise(cols):
                if row1 > row0 and col1 > col0:
                    yield CellBox(row0, col0, row1, col1)

    def cut(
        self, cells: npt.NDArray[Scalar], whole: CellBox, otherwise: int
    ) -> npt.NDArray[Scalar]:
        """Return its part of the cells of another box; ``otherwise`` where those do not reach."""
        out = np.full(self.shape, otherwise, dtype=cells.dtype)
        common = self.overlap(whole)
        if common is not None:
            out[common.slices(self)] = cells[common.slices(whole)]
        return out


def box_origin(origin: Pose2, resolution: float, box: CellBox) -> Pose2:
    """Return the pose (m, rad) of a box's lower-left corner; it may be outside the grid."""
    if box.row0 == 0 and box.col0 == 0:
        return origin
    x, y = origin.transform((box.col0 * resolution, box.row0 * resolution))
    return Pose2(float(x), float(y), origin.yaw_rad)


def implausible(resolution: float, origin: Pose2) -> str | None:
    """Return what is wrong with a map's cell size or origin; None if both are plausible.

    Larger numbers are mistakes (millimetres, degrees, unset memory), and lead to absurd amounts of
    memory or lost digits.

    Args:
        resolution: metres per cell.
        origin: pose of the corner of cell [0, 0]; metres, radians.
    """
    if not RESOLUTION_LEAST_M <= resolution <= RESOLUTION_MOST_M:
        return (
            f"resolution must lie in {RESOLUTION_LEAST_M:g} to {RESOLUTION_MOST_M:g} metres per "
            f"cell, found {resolution:g}"
        )
    for axis, value in (("x", origin.x), ("y", origin.y)):
        if not abs(value) <= ORIGIN_MOST_M:
            return (
                f"{axis} of the origin must lie within {ORIGIN_MOST_M:g} metres of the frame's "
                f"zero, found {value:g}"
            )
    if not abs(origin.yaw_rad) <= YAW_MOST_RAD:
        return (
            f"yaw of the origin must lie within {YAW_MOST_RAD:.2f} radians, found "
            f"{origin.yaw_rad:g} (degrees?)"
        )
    return None


def row_parts(shape: tuple[int, int]) -> Iterator[slice]:
    """Yield the rows of an array in parts that fit into the cache; at least one row each."""
    step = max(1, PART_CELLS // max(1, shape[1]))
    for first in range(0, shape[0], step):
        yield slice(first, first + step)


def known_box(cells: I8) -> CellBox | None:
    """Return the smallest box with all known cells of (H, W) int8, or None without any."""
    height, width = cells.shape
    edges = (cells[:1], cells[-1:], cells[:, :1], cells[:, -1:])
    if all((edge != UNKNOWN).any() for edge in edges):
        return CellBox(0, 0, height, width)
    has_row, has_col = np.zeros(height, dtype=np.bool_), np.zeros(width, dtype=np.bool_)
    for part in row_parts((height, width)):
        known = cells[part] != UNKNOWN
        known.any(axis=1, out=has_row[part])
        has_col |= known.any(axis=0)
    rows, cols = np.flatnonzero(has_row), np.flatnonzero(has_col)
    if rows.size == 0:
        return None
    return CellBox(int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1)


def face_cells(cells: I8) -> B8:
    """Mark the faces of walls, (H, W) bool: occupied cells that share a side with a free one.

    Args:
        cells: (H, W) int8, -1 unknown, 0 free, all others occupied.
    """
    free = np.pad(cells == FREE, 1)
    has_free_side = free[:-2, 1:-1] | free[2:, 1:-1] | free[1:-1, :-2] | free[1:-1, 2:]
    return np.asarray((cells > FREE) & has_free_side)


def trinary_cells(cells: I8, thresholds: NormalizeConfig) -> I8:
    """Return the classes of cells: -1 unknown, 0 free, 1 occupied.

    Source: [F16], the normalisation step (100 becomes 1).
    """
    least_occupied = math.ceil(thresholds.occupied_percent)
    most_free = math.floor(thresholds.free_percent)
    given, classes = cells.ravel(), np.empty(cells.size, dtype=np.int8)
    for first in range(0, cells.size, PART_CELLS):
        some, out = (array[first : first + PART_CELLS] for array in (given, classes))
        # Without a sign unknown cells are the greatest.
        is_free = some.view(np.uint8) <= most_free
        is_occupied = some >= least_occupied
        is_unknown = ~(is_occupied | is_free)
        np.subtract(is_occupied.view(np.int8), is_unknown.view(np.int8), out=out)
    return classes.reshape(cells.shape)


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """An occupancy grid in its map frame; immutable.

    Attributes:
        cells: (H, W) int8, -1 unknown, 0..100 occupancy in percent; made read-only.
        resolution: metres per cell, positive and finite.
        origin: pose of the lower-left corner of cell [0, 0] in the map frame; metres, radians.
        name: what tables and messages call it; often the file's stem or the topic.

    Raises:
        GridError: wrong shape, dtype, value range, resolution or origin.
    """

    cells: I8
    resolution: float
    origin: Pose2 = IDENTITY
    name: str = "map"

    def __post_init__(self) -> None:
        cells = self.cells
        if not isinstance(cells, np.ndarray) or cells.dtype != np.int8 or cells.ndim != 2:
            found = f"{getattr(cells, 'dtype', type(cells).__name__)} {getattr(cells, 'shape', '')}"
            raise GridError(f"{self.name}: cells must be an (H, W) int8 array, found {found}")
        if cells.size == 0:
            message = f"{self.name}: an occupancy grid needs at least one cell, found {cells.shape}"
            raise GridError(message)
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            raise GridError(
                f"{self.name}: resolution must be a positive number of metres per cell, "
                f"found {self.resolution}"
            )
        low, high = int(cells.min()), int(cells.max())
        if low < UNKNOWN or high > OCCUPIED:
            raise GridError(f"{self.name}: cells must lie in -1..100, found {low}..{high}")
        if cells.flags.writeable or not cells.flags.c_contiguous:
            cells = np.ascontiguousarray(cells)
            if cells is self.cells:
                cells = cells.copy()
            cells.flags.writeable = False
            object.__setattr__(self, "cells", cells)

    @property
    def height(self) -> int:
        """Rows of cells."""
        return int(self.cells.shape[0])

    @property
    def width(self) -> int:
        """Columns of cells."""
        return int(self.cells.shape[1])

    def classified(self, thresholds: NormalizeConfig) -> ClassifiedGrid:
        """Return this map with classes as its cells."""
        cells = trinary_cells(self.cells, thresholds)
        return ClassifiedGrid(cells, self.resolution, self.origin, self.name)

    def with_name(self, name: str) -> OccupancyGrid:
        """Return the same grid under another name."""
        return replace(self, name=name)

    @cached_property
    def known_box(self) -> CellBox | None:
        """The smallest box with all known cells, or None."""
        return known_box(self.cells)

    def crop(self, box: CellBox) -> OccupancyGrid:
        """Return a half-open box, unmoved in the map frame; cells outside the grid are unknown."""
        whole = CellBox(0, 0, self.height, self.width)
        if box == whole:
            return self
        cells = box.cut(self.cells, whole, UNKNOWN)
        origin = box_origin(self.origin, self.resolution, box)
        return replace(self, cells=cells, origin=origin)

    def cell_centres(self, rows: I64, cols: I64) -> F64:
        """Return the map-frame positions (N, 2), metres, of the centres of cells."""
        own = np.stack(((cols + 0.5) * self.resolution, (rows + 0.5) * self.resolution), axis=-1)
        return self.origin.transform(own)

    def cell_indices(self, points: F64) -> tuple[I64, I64]:
        """Return rows and columns of the cells under map-frame points (N, 2), metres.

        Indices may be outside the grid.
        """
        own = self.origin.inverse().transform(points) / self.resolution
        index = np.floor(own).astype(np.int64)
        return index[..., 1], index[..., 0]


@dataclass(frozen=True, eq=False)
class ClassifiedGrid(OccupancyGrid):
    """A map whose cells are classes: -1 unknown, 0 free, 1 occupied."""

    def classified(self, thresholds: NormalizeConfig) -> ClassifiedGrid:  # noqa: ARG002
        """Return this map: its cells are no percentages to be classified again."""
        return self
