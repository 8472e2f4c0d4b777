"""``Canvas``: cells to draw a place on, in metres."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.grid import OCCUPIED, UNKNOWN

WALL_M = 0.1
# A rectangle as x0, y0, x1, y1 in metres from the canvas's lower-left corner.
Rect = tuple[float, float, float, float]


class Canvas:
    """Cells to draw on in metres from the lower-left corner; all unknown at first.

    Attributes:
        cells: (H, W) int8, in {-1, 0, 100}.
        resolution: metres per cell.
        wall_m: how thick walls are drawn: 0.1 m, at least one cell.
    """

    def __init__(self, width_m: float, height_m: float, resolution: float) -> None:
        self.resolution = resolution
        shape = (self.cell(height_m), self.cell(width_m))
        self.cells: npt.NDArray[np.int8] = np.full(shape, UNKNOWN, dtype=np.int8)
        self.wall_m = max(WALL_M, resolution)

    def cell(self, length_m: float) -> int:
        """Return the nearest whole number of cells."""
        return int(length_m / self.resolution + 0.5)

    def fill(self, rect: Rect, value: int) -> None:
        """Set every cell of a rectangle, clipped to the canvas."""
        x0, y0, x1, y1 = (max(self.cell(length), 0) for length in rect)
        self.cells[y0:y1, x0:x1] = value

    def outline(self, rect: Rect) -> None:
        """Draw the walls just inside the edges of a rectangle."""
        x0, y0, x1, y1 = rect
        wall = self.wall_m
        for side in (
            (x0, y0, x1, y0 + wall),
            (x0, y1 - wall, x1, y1),
            (x0, y0, x0 + wall, y1),
            (x1 - wall, y0, x1, y1),
        ):
            self.fill(side, OCCUPIED)

    def turned_box(
        self, centre: tuple[float, float], size: tuple[float, float], yaw_rad: float, value: int
    ) -> None:
        """Set the cells whose centre lies in a rectangle that may be turned.

        Args:
            centre: metres.
            size: length along its own x and y, metres; at least a cell and a half, so that a thin
                turned wall has no holes.
            yaw_rad: of its x axis, counter-clockwise.
            value: of the cells.
        """
        x, y = self._offsets(centre)
        along = np.abs(math.cos(yaw_rad) * x + math.sin(yaw_rad) * y)
        across = np.abs(math.cos(yaw_rad) * y - math.sin(yaw_rad) * x)
        half_x, half_y = (max(side, 1.5 * self.resolution) / 2.0 for side in size)
        self.cells[(along <= half_x) & (across <= half_y)] = value

    def disc(self, centre: tuple[float, float], radius_m: float, value: int) -> None:
        """Set the cells whose centre lies in a disc."""
        x, y = self._offsets(centre)
        self.cells[np.hypot(x, y) <= max(radius_m, self.resolution)] = value

    def _offsets(
        self, centre: tuple[float, float]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return x (1, W) and y (H, 1) of every cell centre from a point, metres."""
        rows, cols = (np.arange(size, dtype=np.float64) + 0.5 for size in self.cells.shape)
        x = np.asarray(cols * self.resolution - centre[0], dtype=np.float64)
        y = np.asarray(rows * self.resolution - centre[1], dtype=np.float64)
        return x[None, :], y[:, None]
