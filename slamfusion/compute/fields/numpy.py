"""The NumPy twins of the field kernels: each function defines the kernels of its name.

All whole numbers: equal to the kernels' exactly.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.compute.lattice import fixed_cells
from slamfusion.compute.layout import DISTANCE_MAX, FIELD_ONE, FREE, OCCUPIED, SPECK_FREE_CELLS

__all__ = [
    "distance_squared",
    "look_up",
    "look_up_where",
    "max_window",
    "score_field",
    "shrink",
    "solid_walls",
    "surface_walls",
    "warp",
]

U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
I8 = npt.NDArray[np.int8]
I64 = npt.NDArray[np.int64]


def _free_neighbours(cells: I8) -> U8:
    """Return (H, W) uint8, how many of a cell's 8 neighbours are free; outside is unknown."""
    kernel = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)
    count: U8 = scipy.ndimage.convolve((cells == FREE).astype(np.uint8), kernel, mode="constant")
    return count


def solid_walls(cells: I8) -> U8:
    """Return (H, W) uint8, 1 where an occupied cell has at most six free ones among its neighbours.

    With seven or eight it stands in free space alone, or beside one other: a speck of noise.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
    """
    solid = (cells == OCCUPIED) & (_free_neighbours(cells) < SPECK_FREE_CELLS)
    return np.asarray(solid, dtype=np.uint8)


def surface_walls(cells: I8, solid: U8) -> U8:
    """Return (H, W) uint8, 1 where a solid wall cell has a free one among its 8 neighbours.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
        solid: (H, W) uint8, 1 at the wall cells that count.
    """
    surface = (solid != 0) & (_free_neighbours(cells) > 0)
    return np.asarray(surface, dtype=np.uint8)


def shrink(walls: U8, cells: I8, step: int) -> tuple[U8, U8]:
    """Return walls and free share on a grid of ``step`` x ``step`` blocks.

    Args:
        walls: (H, W) uint8, 0 or 1.
        cells: (H, W) int8 in {-1, 0, 1}.
        step: cells per block side; blocks over the edge count missing cells as unknown.

    Returns:
        wall: (h, w) uint8, 1 where any wall of the block is; free: (h, w) uint8, share 0..255.
    """
    height, width = cells.shape
    rows, cols = -(-height // step), -(-width // step)
    pad = ((0, rows * step - height), (0, cols * step - width))
    wall = np.pad(walls, pad).reshape(rows, step, cols, step).max(axis=(1, 3))
    free = np.pad(cells == FREE, pad).reshape(rows, step, cols, step).sum(axis=(1, 3))
    return wall.astype(np.uint8), (free * FIELD_ONE // (step * step)).astype(np.uint8)


def distance_squared(walls: U8, reach: int = DISTANCE_MAX) -> U16:
    """Return (H, W) uint16, squared distance in cells to the nearest wall, at most reach squared.

    Args:
        walls: (H, W) uint8, 0 or 1.
        reach: cells, 1 to 64; farther walls count as this far.
    """
    if not walls.any():
        return np.full(walls.shape, reach**2, dtype=np.uint16)
    _, (rows, cols) = scipy.ndimage.distance_transform_edt(walls == 0, return_indices=True)
    own_rows, own_cols = np.indices(walls.shape)
    squared = (rows - own_rows) ** 2 + (cols - own_cols) ** 2
    return np.asarray(np.minimum(squared, reach**2), dtype=np.uint16)


def score_field(distance2: U16, free_share: U8, hit: U16, miss: U16, base: int) -> U8:
    """Return what a wall point of the other map is worth in each cell, 0..255.

    Args:
        distance2: (H, W) uint16 from ``distance_squared``.
        free_share: (H, W) uint8, 0..255.
        hit, miss: (4097,) uint16, by squared distance.
        base: worth of a cell that says nothing.
    """
    value = base + hit[distance2].astype(np.int32)
    value -= free_share.astype(np.int32) * miss[distance2] // FIELD_ONE
    return np.clip(value, 0, FIELD_ONE).astype(np.uint8)


def look_up(values: U16, table: U16) -> U16:
    """Return ``table[values]``.

    Args:
        values: any shape, uint16. table: (M,) uint16, longer than the largest value.
    """
    return np.asarray(table[values], dtype=np.uint16)


def look_up_where(values: U16, mask: U8, table: U16, otherwise: U16) -> U16:
    """Return ``table[values]`` where the mask is not 0, ``otherwise[values]`` elsewhere.

    Args:
        values: any shape, uint16. mask: the same shape, uint8.
        table, otherwise: (M,) uint16, longer than the largest value.
    """
    return np.where(mask != 0, table[values], otherwise[values]).astype(np.uint16)


def max_window(field: U8, window: int, *, along_rows: bool, fill: int) -> U8:
    """Return the largest of the ``window`` cells that start at each cell; outside counts as fill.

    Args:
        field: (H, W) uint8.
        window: cells, at least 1.
        along_rows: over columns of one row; otherwise over rows of one column.
        fill: value outside the field, 0..255.
    """
    axis = 1 if along_rows else 0
    pad = [(0, 0), (0, 0)]
    pad[axis] = (0, window - 1)
    padded = np.pad(field, pad, constant_values=fill)
    views = np.lib.stride_tricks.sliding_window_view(padded, window, axis=axis)
    best: U8 = views.max(axis=-1)
    return best


def warp(cells: I8, poses: I64, shape: tuple[int, int], fill: int) -> I8:
    """Return the grid resampled by nearest cell under each pose.

    Args:
        cells: (H, W) int8 (or uint8).
        poses: (K, 4) int64 fixed poses, output lattice to input lattice.
        shape: (h, w) of the output.
        fill: value outside the input.

    Returns:
        (K, h, w), dtype of ``cells``.
    """
    height, width = cells.shape
    y2, x2 = np.meshgrid(
        2 * np.arange(shape[0], dtype=np.int64) + 1,
        2 * np.arange(shape[1], dtype=np.int64) + 1,
        indexing="ij",
    )
    out = np.full((len(poses), *shape), fill, dtype=cells.dtype)
    for k, pose in enumerate(poses):
        row, col = fixed_cells(pose, x2, y2)
        inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
        out[k][inside] = cells[row[inside], col[inside]]
    return out
