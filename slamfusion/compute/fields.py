"""Fields: from trinary cells to walls, distances and scores, and grids resampled under motions.

``kernels/fields.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import scipy

from slamfusion.compute.arrays import ArrayDevice, DeviceArray, host
from slamfusion.compute.lattice import cells_at, fixed_cells
from slamfusion.compute.layout import (
    DISTANCE2_MAX,
    DISTANCE_LANES,
    DISTANCE_MAX,
    DISTANCE_TABLE,
    DISTANCE_UNSEEN,
    FIELD_ONE,
    FREE,
    OCCUPIED,
    RUN,
    SPECK_FREE_CELLS,
    UNKNOWN,
    WINDOW_LANES,
)
from slamfusion.geometry import I8, I64, U8, U16

Cell = TypeVar("Cell", np.int8, np.uint8)
# Rows or cells that one work item counts; the host adds the counts.
COUNTED_ROWS, COUNTED_CELLS = 16, 1 << 15


def _free_neighbours(cells: I8) -> U8:
    """Return (H, W) uint8, how many of a cell's 8 neighbours are free; outside is unknown."""
    kernel = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)
    count: U8 = scipy.ndimage.convolve((cells == FREE).astype(np.uint8), kernel, mode="constant")
    return count


class FieldDevice(ArrayDevice):
    """A device that makes fields."""

    def solid_walls(self, cells: DeviceArray[np.int8]) -> DeviceArray[np.uint8]:
        """Return (H, W) uint8, 1 where an occupied cell has at most six free neighbours.

        With seven or eight it is a speck of noise in free space. Cells (H, W) are in {-1, 0, 1}.
        """
        if self.opencl:
            height, width = cells.shape
            size = (-(-width // RUN), height)
            return self.opencl.launch_new(
                cells.shape, np.uint8, "solid_walls", size, cells, height, width
            )
        cells = host(cells)
        solid = (cells == OCCUPIED) & (_free_neighbours(cells) < SPECK_FREE_CELLS)
        return np.asarray(solid, dtype=np.uint8)

    def surface_walls(
        self, cells: DeviceArray[np.int8], solid: DeviceArray[np.uint8]
    ) -> DeviceArray[np.uint8]:
        """Return (H, W) uint8, 1 where a solid wall cell has a free one among its 8 neighbours."""
        if self.opencl:
            height, width = cells.shape
            size = (-(-width // RUN), height)
            return self.opencl.launch_new(
                cells.shape, np.uint8, "surface_walls", size, cells, solid, height, width
            )
        cells, solid = host(cells), host(solid)
        surface = (solid != 0) & (_free_neighbours(cells) > 0)
        return np.asarray(surface, dtype=np.uint8)

    def shrink(
        self, walls: DeviceArray[np.uint8], cells: DeviceArray[np.int8], step: int
    ) -> tuple[DeviceArray[np.uint8], DeviceArray[np.uint8]]:
        """Return walls and free share on a grid of ``step`` x ``step`` blocks.

        Args:
            walls: (H, W) uint8, 0 or 1.
            cells: (H, W) int8 in {-1, 0, 1}.
            step: cells per block side; blocks over the edge count missing cells as unknown.

        Returns:
            wall: (h, w) uint8, 1 where any wall of the block is; free: (h, w) uint8, share 0..255.
        """
        if self.opencl:
            height, width = cells.shape
            shape = (-(-height // step), -(-width // step))
            wall, free = self.opencl.empty(shape, np.uint8), self.opencl.empty(shape, np.uint8)
            sizes = (height, width, step, *shape)
            size = (-(-shape[1] // max(1, RUN // step)), shape[0])
            self.opencl.launch("shrink", size, walls, cells, *sizes, wall, free)
            return wall, free
        walls, cells = host(walls), host(cells)
        height, width = cells.shape
        rows, cols = -(-height // step), -(-width // step)
        pad = ((0, rows * step - height), (0, cols * step - width))
        wall = np.pad(walls, pad).reshape(rows, step, cols, step).max(axis=(1, 3))
        free = np.pad(cells == FREE, pad).reshape(rows, step, cols, step).sum(axis=(1, 3))
        return wall.astype(np.uint8), (free * FIELD_ONE // (step * step)).astype(np.uint8)

    def distance_squared(
        self, walls: DeviceArray[np.uint8], reach: int = DISTANCE_MAX
    ) -> DeviceArray[np.uint16]:
        """Return (H, W) uint16, squared distance in cells to the nearest wall.

        Args:
            walls: (H, W) uint8, 0 or 1.
            reach: cells, 1 to 64; farther walls count as this far.
        """
        if self.opencl:
            height, width = walls.shape
            padded = -(-width // DISTANCE_LANES) * DISTANCE_LANES
            source = walls
            if padded != width:
                source = self.opencl.cleared((height, padded), np.uint8)
                self.opencl.copy_rows(walls, source)
            # Beyond both edges no wall is within reach.
            reached = padded + 2 * DISTANCE_MAX
            columns = self.opencl.launch_new(
                (height, reached), np.uint16, "distance_columns", (reached // DISTANCE_LANES,),
                source, height, padded,
            )  # fmt: skip
            squared = self.opencl.launch_new(
                (height, padded), np.uint16, "distance_rows", (padded // DISTANCE_LANES, height),
                columns, height, padded, reach,
            )  # fmt: skip
            if padded == width:
                return squared
            cut = self.opencl.empty((height, width), np.uint16)
            self.opencl.copy_rows(squared, cut)
            return cut
        walls = host(walls)
        if not walls.any():
            return np.full(walls.shape, reach**2, dtype=np.uint16)
        _, (rows, cols) = scipy.ndimage.distance_transform_edt(walls == 0, return_indices=True)
        own_rows, own_cols = np.indices(walls.shape)
        squared = (rows - own_rows) ** 2 + (cols - own_cols) ** 2
        return np.asarray(np.minimum(squared, reach**2), dtype=np.uint16)

    def start_known_by_distance(
        self,
        distance2: DeviceArray[np.uint16],
        wall: DeviceArray[np.uint8],
        free_share: DeviceArray[np.uint8],
    ) -> Callable[[], I64]:
        """Start to sum how much of the cells is known, by squared distance to a wall.

        Of a wall (uint8, 1) ``FIELD_ONE``, of another cell its free share (uint8, 0..255).

        Returns:
            A function that waits for the sums, and returns them: (4097,) int64.
        """
        if self.opencl:
            chunks = -(-distance2.size // COUNTED_CELLS)
            partial = np.empty((chunks, DISTANCE2_MAX + 1), np.int32)
            started = self.opencl.start_into(
                partial, "known_by_distance", (1, chunks, 1), distance2, wall, free_share,
                distance2.size, COUNTED_CELLS, chunks,
            )  # fmt: skip
            return lambda: np.asarray(started().sum(axis=0, dtype=np.int64))
        known = np.where(host(wall) != 0, np.uint8(FIELD_ONE), host(free_share))
        sums = np.zeros(DISTANCE2_MAX + 1, dtype=np.int64)
        for row, weights in zip(host(distance2), known, strict=True):
            # Whole numbers below 2^53 are exact in the float64 that bincount adds.
            sums += np.bincount(row, weights, len(sums)).astype(np.int64)
        return lambda: sums

    def score_field(
        self,
        distance2: DeviceArray[np.uint16],
        free_share: DeviceArray[np.uint8],
        worths: U16,
        base: int,
    ) -> DeviceArray[np.uint8]:
        """Return what a wall point of the other map is worth in each cell, 0..255.

        Args:
            distance2: (H, W) uint16 from ``distance_squared``.
            free_share: (H, W) uint8, 0..255.
            worths: (4097,) uint16 by squared distance: hit, and miss above 8 bits.
            base: worth of a cell that says nothing.
        """
        if self.opencl:
            return self.opencl.launch_new(
                distance2.shape, np.uint8, "score_field", (-(-distance2.size // RUN),), distance2,
                free_share, self.upload(worths), base, distance2.size,
            )  # fmt: skip
        distance2, free_share = host(distance2), host(free_share)
        worth = worths[distance2].astype(np.int32)
        value = base + (worth & 255) - free_share * (worth >> 8) // FIELD_ONE
        return np.asarray(np.clip(value, 0, FIELD_ONE), dtype=np.uint8)

    def wall_distances(
        self, distance2: DeviceArray[np.uint16], free_share: DeviceArray[np.uint8], most: int
    ) -> DeviceArray[np.uint16]:
        """Return (H, W) uint16, distance in 1/256 cell to the nearest wall.

        ``DISTANCE_UNSEEN`` in cells without free space that are farther than ``most``, 1/256 cell.
        """
        if self.opencl:
            return self.opencl.launch_new(
                distance2.shape, np.uint16, "wall_distances", (-(-distance2.size // RUN),),
                distance2, free_share, self.opencl.table(DISTANCE_TABLE), most, distance2.size,
            )  # fmt: skip
        distance = DISTANCE_TABLE[host(distance2)]
        is_seen = (host(free_share) != 0) | (distance <= most)
        return np.where(is_seen, distance, np.uint16(DISTANCE_UNSEEN))

    def max_ahead(self, field: DeviceArray[np.uint8], shift: int) -> DeviceArray[np.uint8]:
        """Return the largest of each cell, those ``shift`` farther along row and column, and both.

        From maxima of squares of side ``shift`` it makes those of twice the side; outside is 0.
        """
        if self.opencl:
            height, width = field.shape
            size = (-(-width // WINDOW_LANES), height)
            for along_rows in (True, False):
                field = self.opencl.launch_new(
                    field.shape, np.uint8, "max_pair", size, field, height, width, shift, along_rows
                )
            return field
        best = host(field).copy()
        best[:, :-shift] = np.maximum(best[:, :-shift], best[:, shift:])
        best[:-shift] = np.maximum(best[:-shift], best[shift:])
        return best

    def warp(
        self, cells: DeviceArray[Cell], poses: I64, shape: tuple[int, int], fill: int
    ) -> DeviceArray[Cell]:
        """Return the grid resampled by nearest cell under each pose.

        Args:
            cells: (H, W) int8 (or uint8).
            poses: (K, 4) int64 fixed poses, output lattice to input lattice.
            shape: (h, w) of the output.

        Returns:
            (K, h, w), dtype of ``cells``.
        """
        if self.opencl:
            size = (-(-shape[1] // RUN), shape[0], len(poses))
            return self.opencl.launch_new(
                (len(poses), *shape), cells.dtype, "warp", size, cells, *cells.shape,
                self.upload(poses), len(poses), *shape, np.int8(fill),
            )  # fmt: skip
        y2, x2 = 2 * np.indices(shape, dtype=np.int64) + 1
        out = np.empty((len(poses), *shape), dtype=cells.dtype)
        for k, pose in enumerate(poses):
            out[k] = cells_at(host(cells), *fixed_cells(pose, x2, y2), fill)
        return out

    def grid_error(
        self, a: DeviceArray[np.int8], b: DeviceArray[np.int8], poses: I64, stride: int = 1
    ) -> I64:
        """Compare two trinary grids in {-1, 0, 1} cell by cell, the second under each pose.

        Args:
            a: (H, W) int8. b: (h, w) int8; off it counts as unknown.
            poses: (P, 4) int64 fixed poses, lattice of ``a`` to that of ``b``.
            stride: only every stride-th row and column of ``a`` counts.

        Returns:
            (P, 2) int64: the [F16] squared error, and the cells that are known in both.
        """
        if self.opencl:
            n, chunks = len(poses), -(-a.shape[0] // (stride * COUNTED_ROWS))
            partial = self.opencl.launch_into(
                np.empty((n, chunks, 2), np.int32), "grid_error", (chunks, n), a, *a.shape, b,
                *b.shape, self.upload(poses), n, stride, COUNTED_ROWS, chunks,
            )  # fmt: skip
            return np.asarray(partial.sum(axis=1, dtype=np.int64))
        y2, x2 = 2 * np.indices(a.shape, dtype=np.int64)[:, ::stride, ::stride] + 1
        own = host(a)[::stride, ::stride].astype(np.int64)
        out = np.zeros((len(poses), 2), dtype=np.int64)
        for p, pose in enumerate(poses):
            other = cells_at(host(b), *fixed_cells(pose, x2, y2), UNKNOWN)
            out[p] = np.sum((own - other) ** 2), np.sum((own >= 0) & (other >= 0))
        return out
