"""Cells as the measures see them: one map read on another map's lattice."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, UNKNOWN, CellBox, OccupancyGrid

_ROWS_PER_BLOCK = 256

# A centre that falls on the border of two cells belongs to the upper one, whatever the rounding of
# the poses says; the last digits must not decide row by row.
_BORDER_CELLS = 1e-6


def sample_on_lattice(
    classes: npt.NDArray[np.int8],
    grid: OccupancyGrid,
    lattice: OccupancyGrid,
    box: CellBox,
    transform: Pose2,
) -> npt.NDArray[np.int8]:
    """Read a map at the cell centres of another map's lattice, by nearest cell.

    Args:
        classes: (H, W) int8, one value per cell of ``grid``.
        grid: gives resolution and origin of ``classes``; origin yaw is honoured.
        lattice: gives resolution and origin of the lattice; its cells are not read.
        box: the cells of the lattice to fill.
        transform: maps a point of ``grid``'s map frame into ``lattice``'s, metres.

    Returns:
        (box.height, box.width) int8; -1 where the centre lies outside ``grid``.
    """
    pose_grid_lattice = grid.origin.inverse().compose(transform.inverse()).compose(lattice.origin)
    scale = lattice.resolution / grid.resolution
    step_x = math.cos(pose_grid_lattice.yaw_rad) * scale
    step_y = math.sin(pose_grid_lattice.yaw_rad) * scale
    shift_x = pose_grid_lattice.x / grid.resolution + _BORDER_CELLS
    shift_y = pose_grid_lattice.y / grid.resolution + _BORDER_CELLS

    sampled = np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
    col_centres = np.arange(box.col0, box.col1) + 0.5
    for first in range(0, box.height, _ROWS_PER_BLOCK):
        block = sampled[first : first + _ROWS_PER_BLOCK]
        row_centres = (np.arange(first, first + block.shape[0]) + box.row0 + 0.5)[:, None]
        cols = np.floor(step_x * col_centres - step_y * row_centres + shift_x)
        rows = np.floor(step_y * col_centres + step_x * row_centres + shift_y)
        inside = (rows >= 0) & (rows < grid.height) & (cols >= 0) & (cols < grid.width)
        block[inside] = classes[rows[inside].astype(np.int64), cols[inside].astype(np.int64)]
    return sampled


def wall_centres(
    classes: npt.NDArray[np.int8], grid: OccupancyGrid, transform: Pose2 = IDENTITY
) -> npt.NDArray[np.float64]:
    """Return the centres of the occupied cells, carried through ``transform``.

    Args:
        classes: (H, W) int8 in {-1, 0, 1}, one per cell of ``grid``.
        grid: gives resolution and origin of ``classes``.
        transform: maps a point of ``grid``'s map frame into the frame of the answer, metres.

    Returns:
        (N, 2) float64, metres, row by row.
    """
    rows, cols = np.nonzero(classes == 1)
    return transform.transform(grid.cell_centres(rows, cols))
