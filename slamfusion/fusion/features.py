"""What alignment looks at in one grid: wall points, distance and score fields, coarser levels.

Computed once a grid and device, then shared by every pair the grid takes part in.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.fields import FieldDevice
from slamfusion.compute.layout import DISTANCE2_MAX, DISTANCE_TABLE
from slamfusion.fusion.cancel import CancelToken, check_cancelled
from slamfusion.fusion.normalize import NormalizedGrid

__all__ = ["GridFeatures", "Level", "ScoreTable", "score_table", "spread_sample"]


@dataclass(frozen=True, eq=False)
class ScoreTable:
    """The worth of a wall point by its squared distance to the other map's nearest wall.

    Attributes:
        hit, miss: (4097,) uint16; ``base + hit - miss * free share`` is a field's cell.
        base: worth of a point in unknown space.
        span: largest gain over the base, so that (value - base) / span is 1 on a wall.
        name: tells tables apart.
    """

    hit: npt.NDArray[np.uint16]
    miss: npt.NDArray[np.uint16]
    base: int
    span: int
    name: str


def score_table(sigma: float, base: int, span: int) -> ScoreTable:
    """Return the table of ``exp(-d^2 / 2)`` less ``min(1, d / 4)`` in free space beyond 1.5.

    Args:
        sigma: the width of a wall in cells; d above is in units of it.
        base: lowest reward that is left for walls in free space.
        span: reward of a point on a wall.
    """
    d = np.sqrt(np.arange(DISTANCE2_MAX + 1)) / sigma
    hit = np.rint(span * np.exp(-0.5 * d * d)).astype(np.uint16)
    miss = np.rint(base * np.where(d > 1.5, np.minimum(1.0, d / 4.0), 0.0)).astype(np.uint16)
    return ScoreTable(hit, miss, base, span, f"{sigma:g}/{base}/{span}")


# The last fit is narrow: it needs no distances beyond this, in cells.
SOLID_REACH = 24
# Sixteen levels fit the packed adds of the correlate kernel; a byte serves single lookups.
COARSE_TABLE = score_table(1.0, base=4, span=11)
FINE_TABLE = score_table(3.0, base=64, span=191)


def spread_sample(points: npt.NDArray[np.int32], most: int) -> npt.NDArray[np.int32]:
    """Return at most ``most`` of the points, evenly strided through their raster order."""
    if len(points) <= most:
        return points
    index = (np.arange(most, dtype=np.int64) * len(points)) // most
    return np.ascontiguousarray(points[index])


@dataclass(frozen=True, eq=False)
class Level:
    """One grid at one cell size.

    Attributes:
        step: fine cells per cell of this level.
        shape: rows and columns.
        wall: (H, W) uint8 on the device, 1 at a surface wall.
        free: (H, W) uint8 on the device, free share 0..255.
        distance2: (H, W) uint16 on the device, squared, cells.
        distance: (H, W) uint16 on the device, 1/256 cell.
        points: (N, 2) int32, surface walls as lattice positions x, y in half cells.
    """

    step: int
    shape: tuple[int, int]
    wall: DeviceArray[Any]
    free: DeviceArray[Any]
    distance2: DeviceArray[Any]
    distance: DeviceArray[Any]
    points: npt.NDArray[np.int32]

    @property
    def wall_share(self) -> float:
        """Share of walls among the cells of the level that are wall or mostly known."""
        return len(self.points) / max(1, self.shape[0] * self.shape[1])


class GridFeatures:
    """The levels and fields of one normalised grid on one device.

    What takes several operations can be cancelled between them; what was finished is kept.
    """

    def __init__(self, grid: NormalizedGrid, device: FieldDevice) -> None:
        """Upload the cells; everything else is computed when first asked for."""
        self.grid = grid
        self.device = device
        self.cells = device.upload(grid.cells)
        self._levels: dict[int, Level] = {}
        self._fields: dict[tuple[int, str], DeviceArray[Any]] = {}
        self._near_wall_share: dict[int, float] = {}
        self._surface_walls: DeviceArray[Any] | None = None
        self._solid_level: Level | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.grid.shape

    @cached_property
    def centre(self) -> tuple[float, float]:
        """Centre of the known box, x and y in cells: the point whose displacement counts."""
        return self.shape[1] / 2.0, self.shape[0] / 2.0

    @cached_property
    def known_cells(self) -> int:
        """Known cells."""
        return int(np.count_nonzero(self.grid.cells >= 0))

    @cached_property
    def wall_points(self) -> npt.NDArray[np.int32]:
        """The solid wall cells, surface or not: lattice positions (N, 2) int32 in half cells."""
        return _lattice_points(self.grid.solid != 0)

    @cached_property
    def known(self) -> DeviceArray[Any]:
        """(H, W) uint8 on the device, 1 where known."""
        return self.device.upload((self.grid.cells >= 0).astype(np.uint8))

    def near_wall_share(self, near2: int) -> float:
        """Return the share of known cells within this squared distance (cells) of a wall."""
        if near2 not in self._near_wall_share:
            distance2 = self.device.download(self.level(1).distance2)
            near = np.count_nonzero((distance2 <= near2) & (self.grid.cells >= 0))
            self._near_wall_share[near2] = near / max(1, self.known_cells)
        return self._near_wall_share[near2]

    def _surface(self, cancel: CancelToken | None) -> DeviceArray[Any]:
        """Return the surface walls; all solid walls where none touches free space."""
        if self._surface_walls is None:
            check_cancelled(cancel)
            solid = self.device.upload(self.grid.solid)
            surface = self.device.surface_walls(self.cells, solid)
            check_cancelled(cancel)
            self._surface_walls = surface if self.device.download(surface).any() else solid
        return self._surface_walls

    def level(self, step: int, cancel: CancelToken | None = None) -> Level:
        """Return the grid at ``step`` fine cells a cell.

        Raises:
            CancelledSearchError: ``cancel`` says so.
        """
        if step not in self._levels:
            wall = self._surface(cancel)
            check_cancelled(cancel)
            if step == 1:
                free = self.device.upload((self.grid.cells == 0).astype(np.uint8) * np.uint8(255))
            else:
                wall, free = self.device.shrink(wall, self.cells, step)
            check_cancelled(cancel)
            distance2 = self.device.distance_squared(wall)
            check_cancelled(cancel)
            distance = self.device.look_up(distance2, DISTANCE_TABLE)
            check_cancelled(cancel)
            mask = self.device.download(wall)
            self._levels[step] = Level(
                step, mask.shape, wall, free, distance2, distance, _lattice_points(mask != 0)
            )
        return self._levels[step]

    def solid_level(self, cancel: CancelToken | None = None) -> Level:
        """Return the finest level with every solid wall cell, not only the surfaces.

        Raises:
            CancelledSearchError: ``cancel`` says so.
        """
        if self._solid_level is None:
            free = self.level(1, cancel).free
            check_cancelled(cancel)
            wall = self.device.upload(self.grid.solid)
            distance2 = self.device.distance_squared(wall, SOLID_REACH)
            check_cancelled(cancel)
            distance = self.device.look_up(distance2, DISTANCE_TABLE)
            self._solid_level = Level(
                1, self.shape, wall, free, distance2, distance, self.wall_points
            )
        return self._solid_level

    def field(
        self, step: int, table: ScoreTable, cancel: CancelToken | None = None
    ) -> DeviceArray[Any]:
        """Return the score field of a level, uint8 on the device.

        Raises:
            CancelledSearchError: ``cancel`` says so.
        """
        key = (step, table.name)
        if key not in self._fields:
            level = self.level(step, cancel)
            check_cancelled(cancel)
            self._fields[key] = self.device.score_field(
                level.distance2, level.free, table.hit, table.miss, table.base
            )
        return self._fields[key]


def _lattice_points(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Return the centres of the set cells, x and y in half cells, in raster order."""
    found = cv2.findNonZero(mask.astype(np.uint8))
    if found is None:
        return np.zeros((0, 2), dtype=np.int32)
    return np.asarray(2 * found.reshape(-1, 2) + 1, dtype=np.int32)
