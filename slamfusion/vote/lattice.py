"""``Lattice``: where the cells of a grid may lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamfusion.config import NormalizeConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid, box_origin, row_parts, trinary_cells

# Origins this near to a whole number of cells apart lie on one lattice.
SAME_PHASE = 1e-3
SAME_YAW_RAD = 1e-6
# Resolutions this close are one resolution: 0.05 and 0.050000001 need no resampling.
SAME_RESOLUTION = 1e-4


@dataclass(frozen=True)
class Lattice:
    """Where the cells of a grid may lie, from cell [0, 0]; indices may be negative.

    Attributes:
        resolution: metres per cell.
        origin: pose of the lower-left corner of cell [0, 0] in its frame; metres, radians.
    """

    resolution: float
    origin: Pose2

    def corner(self, row: int, col: int) -> Pose2:
        """Return the pose of the lower-left corner of a cell in the lattice's frame."""
        return box_origin(self.origin, self.resolution, CellBox(row, col, row, col))

    def cell_of(self, grid: OccupancyGrid) -> tuple[int, int] | None:
        """Return the row and column of a grid's first cell, or None when it lies on none."""
        if abs(grid.resolution / self.resolution - 1.0) > SAME_RESOLUTION:
            return None
        own = self.origin.inverse().compose(grid.origin)
        cells = np.array((own.y, own.x)) / self.resolution
        whole = np.rint(cells)
        if abs(own.yaw_rad) > SAME_YAW_RAD or np.abs(cells - whole).max() > SAME_PHASE:
            return None
        return int(whole[0]), int(whole[1])

    def box_of(self, box: CellBox, other: Lattice, transform: Pose2) -> CellBox:
        """Return the cells of this lattice that hold a box of ``other``; metres."""
        rows, cols = (box.row0, box.row1), (box.col0, box.col1)
        corners = np.array([(x, y) for x in cols for y in rows], dtype=np.float64)
        mapped = transform.transform(other.origin.transform(corners * other.resolution))
        own = self.origin.inverse().transform(mapped) / self.resolution
        low = np.floor(own.min(axis=0) + 1e-6).astype(int)
        high = np.ceil(own.max(axis=0) - 1e-6).astype(int)
        return CellBox(int(low[1]), int(low[0]), int(high[1]), int(high[0]))

    def area_outside(
        self, box: CellBox, grid: OccupancyGrid, transform: Pose2, thresholds: NormalizeConfig
    ) -> float:
        """Return the area of a grid's known cells outside of a box of cells, square metres."""
        into = self.origin.inverse().compose(transform)
        count = 0
        for part in row_parts(grid.cells.shape):
            rows, cols = np.nonzero(trinary_cells(grid.cells[part], thresholds) >= 0)
            centres = into.transform(grid.cell_centres(rows + part.start, cols))
            x, y = centres.T / self.resolution
            is_inside = (x >= box.col0) & (x < box.col1) & (y >= box.row0) & (y < box.row1)
            count += len(rows) - int(np.count_nonzero(is_inside))
        return count * grid.resolution**2
