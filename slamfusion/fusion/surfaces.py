"""Walls are solid: a laser sees the face of a wall, and matter lies behind it, not in front.

A map draws what beams touched, so that its walls are skins: nothing is known of what lies behind
them, and where a hit falls into the cell before the wall, the skin is too near. Several maps tell
more than one. A cell that they dispute, in front of a wall that stands without it, is such a hit.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.config import NormalizeConfig
from slamfusion.grid import OCCUPIED, CellBox, OccupancyGrid, trinary_cells

__all__ = ["REACH_CELLS", "sharpen_fronts", "wall_backs", "with_backs"]

I8 = npt.NDArray[np.int8]
Mask = npt.NDArray[np.bool_]

# Beside a wall that goes on three neighbours of a cell are of it, round its corner fewer.
LEAST_BESIDE = 3
# A wall stands without its front where this many cells of it lie behind.
DEPTH_CELLS = 2
# How far a cell has a say in what backs and fronts become.
REACH_CELLS = 2 + DEPTH_CELLS


def wall_backs(cells: I8) -> Mask:
    """Say where walls have their backs: unknown cells beside a wall, and beside nothing free.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.

    Returns:
        (H, W) bool; no back is next to a free cell, so none stands in anybody's way.
    """
    beside = _neighbours(cells == 1) >= LEAST_BESIDE
    return np.asarray((cells == -1) & beside & (_neighbours(cells == 0) == 0))


def with_backs(grid: OccupancyGrid, thresholds: NormalizeConfig) -> OccupancyGrid:
    """Return a map whose walls have backs, as a vote on several maps gives them.

    Args:
        grid: any map; one that has backs already gets another layer.
        thresholds: what is a wall, and what free.

    Returns:
        A cell larger on each side.
    """
    wide = grid.crop(CellBox(-1, -1, grid.height + 1, grid.width + 1))
    cells = wide.cells.copy()
    cells[wall_backs(trinary_cells(cells, thresholds))] = OCCUPIED
    return OccupancyGrid(cells, wide.resolution, wide.origin, wide.name)


def sharpen_fronts(cells: I8, is_disputed: Mask) -> Mask:
    """Say which disputed cells are hits before a wall: free on one side, the wall on the other.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
        is_disputed: (H, W) bool, where somebody voted for free.

    Returns:
        (H, W) bool; behind each such cell the wall is two cells deep, and not all of that is cut
        itself: of a wall whose both faces are cut the middle stays.
    """
    is_wall, is_free = (np.pad(cells == value, DEPTH_CELLS) for value in (1, 0))
    fronts = {}
    for way in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        behind = _behind(is_wall, way)
        front = _seen_from(is_free, -way[0], -way[1]) & np.logical_and.reduce(behind)
        fronts[way] = front & is_disputed & (cells == 1)
    candidates = np.pad(np.logical_or.reduce(list(fronts.values())), DEPTH_CELLS)
    found = np.zeros(cells.shape, dtype=np.bool_)
    for way, front in fronts.items():
        found |= front & ~np.logical_and.reduce(_behind(candidates, way))
    return found


def _behind(padded: Mask, way: tuple[int, int]) -> list[Mask]:
    """Return what lies one and more cells away, as deep as a wall behind its front."""
    return [_seen_from(padded, n * way[0], n * way[1]) for n in range(1, DEPTH_CELLS + 1)]


def _seen_from(padded: Mask, down: int, right: int) -> Mask:
    """Return what lies at an offset, in rows and columns, from each cell of the unpadded grid."""
    height, width = (side - 2 * DEPTH_CELLS for side in padded.shape)
    row, col = DEPTH_CELLS + down, DEPTH_CELLS + right
    return padded[row : row + height, col : col + width]


def _neighbours(mask: Mask) -> npt.NDArray[np.uint8]:
    """Count the cells of a mask among the eight around each cell; beyond the edge is none."""
    own = mask.astype(np.uint8)
    block = cv2.boxFilter(own, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(block - own, dtype=np.uint8)
