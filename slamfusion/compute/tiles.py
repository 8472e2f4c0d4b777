"""Tiles: the memory of maps that grow, shared tile by tile between maps of one window.

A tiled map is a window of pages (PH, PW) int32 and pools (T, TILE, TILE): a page holds the number
of a tile, and tile 0 is the empty tile that every unused page shares. Positions on it are in cells
of the window, (0, 0) its lower-left corner.

``kernels/tiles.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray, host
from slamfusion.compute.layout import (
    BEAM_SHIFT,
    COPIED_BYTES,
    TAKEN_BYTES,
    TILE,
    WALK_SHIFT,
    WALK_TO_BEAM_SHIFT,
)
from slamfusion.geometry import F32, F64, I32, I64, U8, Scalar


def walk_cells(beams: I32 | I64, behind: I64 | int = 0) -> tuple[I64, I64, I64, I64]:
    """Walk beams from their ends to the laser, one cell of the longer axis a step.

    Args:
        beams: (B, 4 or more), x and y of end and laser in 1/1024 cell.
        behind: (B,) steps before the end at which a walk starts.

    Returns:
        Beam, row and column of every step, flat, and its number, 0 at the end of the beam.
    """
    x, y, laser_x, laser_y = beams.astype(np.int64).T[:4]
    dx, dy = laser_x - x, laser_y - y
    longest = np.maximum(np.maximum(np.abs(dx), np.abs(dy)), 1)
    step_x = np.abs(dx) * (1 << WALK_SHIFT) // longest * np.where(dx < 0, -1, 1)
    step_y = np.abs(dy) * (1 << WALK_SHIFT) // longest * np.where(dy < 0, -1, 1)
    counts = behind + (longest >> BEAM_SHIFT) + 1
    beam = np.repeat(np.arange(len(counts)), counts)
    i = np.arange(len(beam)) - np.repeat(np.cumsum(counts) - counts + behind, counts)
    col = ((x[beam] << WALK_TO_BEAM_SHIFT) + i * step_x[beam]) >> WALK_SHIFT
    row = ((y[beam] << WALK_TO_BEAM_SHIFT) + i * step_y[beam]) >> WALK_SHIFT
    return beam, row, col, i


def move_points(points: F32, poses: F32) -> tuple[F32, F32]:
    """Return x and y of (P, 2) points under (N, 4) poses x, y, cos, sin; each (N, P)."""
    px, py = points.T
    x, y, cos, sin = (poses[:, i : i + 1] for i in range(4))
    return x + (cos * px - sin * py), y + (sin * px + cos * py)


def tile_places(pages: I32, maps: I64 | int, row: I64, col: I64) -> tuple[I64, I64, I64]:
    """Return the index into a pool of cells of maps (N, PH, PW); beyond the window, tile 0."""
    height, width = pages.shape[1] * TILE, pages.shape[2] * TILE
    inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
    row, col = np.where(inside, row, 0), np.where(inside, col, 0)
    tiles = np.where(inside, pages[maps, row // TILE, col // TILE], 0)
    return tiles.astype(np.int64), row % TILE, col % TILE


class FieldWindow(NamedTuple):
    """A rectangle of one tiled map's field, dense.

    Hits beyond it read its border: it reaches as far as they do, or to the map's empty border.

    Attributes:
        cells: (H, W) uint8 on the device, whole pages; the last row is not looked at.
        first: x and y of its first cell, in cells of the map's pages.
    """

    cells: DeviceArray[np.uint8]
    first: tuple[int, int]

    def has(
        self, low: Sequence[float], high: Sequence[float], pages: DeviceArray[np.int32]
    ) -> bool:
        """Whether it has all of the map between two corners, x and y each in cells of its pages."""
        (left, bottom), (height, width) = self.first, self.cells.shape
        rows, cols = pages.shape
        return (
            left <= max(0.0, low[0])
            and bottom <= max(0.0, low[1])
            and min(cols * TILE, high[0]) <= left + width
            and min(rows * TILE, high[1]) <= bottom + height
        )

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Column and row of its first page, and columns and rows of pages."""
        height, width = self.cells.shape
        return self.first[0] // TILE, self.first[1] // TILE, width // TILE, height // TILE


def _span(low: float, high: float, pages: int) -> tuple[int, int]:
    """Return the first page and the end of a window along one side of a map."""
    first = min(max(math.floor(low / TILE), 0), pages - 1)
    return first, min(max(math.ceil(high / TILE), first + 1), pages)


def dense_pages(field: npt.NDArray[Any], pages: I32) -> U8:
    """Return the field (H, W) of pages (PH, PW)."""
    tiles = field[pages][..., :TILE].astype(np.uint8)
    return tiles.transpose(0, 2, 1, 3).reshape(pages.shape[0] * TILE, pages.shape[1] * TILE)


def tile_bytes(pool: DeviceArray[Any]) -> int:
    """Return the bytes of a tile of a pool (T, ...)."""
    return math.prod(pool.shape[1:]) * pool.dtype.itemsize


class TileDevice(ArrayDevice):
    """A device that keeps pools of tiles."""

    def extend(
        self, pool: DeviceArray[Scalar], count: int, fill: int | None, room: int = 0
    ) -> DeviceArray[Scalar]:
        """Return a pool (T, ...) with ``count`` tiles, T or more, in place of the given one.

        Args:
            fill: value of the new tiles; None: undefined.
            room: tiles that the pool may grow to before it is copied, at the least, where tiles
                that were never written take no memory; 0: it will not grow.
        """
        if self.opencl:
            return self.opencl.extended(pool, count, fill, room)
        longer = np.full((count, *pool.shape[1:]), fill or 0, dtype=pool.dtype)
        longer[: pool.shape[0]] = host(pool)
        return longer

    def discard_tiles(self, pool: DeviceArray[Any], numbers: I64) -> None:
        """Return what memory of tiles can be, by their numbers (K,), rising; undefined then."""
        if self.opencl:
            self.opencl.discard_rows(pool, numbers)

    def copy_tiles(self, pools: tuple[DeviceArray[Any], ...], pairs: I32) -> None:
        """Copy tiles, in place.

        Args:
            pools: (T, ...) each, of any dtype, the bytes of a tile a multiple of COPIED_BYTES.
            pairs: (M, 2) int32, source and target; source 0 clears the target. Targets differ from
                each other and are no sources.
        """
        if self.opencl:
            table, count = self.upload(pairs), len(pairs)
            for pool in pools:
                words = tile_bytes(pool) // COPIED_BYTES
                self.opencl.launch("copy_tiles", (words, count), pool, words, table, count)
            return
        for pool in map(host, pools):
            pool[pairs[:, 1]] = pool[pairs[:, 0]]

    def take_tiles(self, pool: DeviceArray[Scalar], numbers: I32) -> npt.NDArray[Scalar]:
        """Fetch tiles (K, ...) of a pool (T, ...) by their numbers (K,) int32 to the host."""
        if self.opencl:
            count, words = len(numbers), tile_bytes(pool) // TAKEN_BYTES
            return self.opencl.launch_into(
                np.empty((count, *pool.shape[1:]), dtype=pool.dtype), "take_tiles", (words, count),
                pool, words, self.upload(numbers), count,
            )  # fmt: skip
        return np.asarray(host(pool)[numbers])

    def field_window(
        self,
        field: DeviceArray[Any],
        pages: DeviceArray[np.int32],
        low: Sequence[float] | F64 | I64,
        high: Sequence[float] | F64 | I64,
    ) -> FieldWindow:
        """Return the pages of a map between two corners, x and y each in cells of its pages.

        Its field is uint8, (T, TILE, TILE), or of pairs, see ``hit_counts``.
        """
        width = pages.shape[1]
        left, right = _span(low[0], high[0], width)
        bottom, top = _span(low[1], high[1], pages.shape[0])
        first, cols, rows = (left * TILE, bottom * TILE), right - left, top - bottom
        if self.opencl:
            cells = self.opencl.launch_new(
                (rows * TILE, cols * TILE), np.uint8, "copy_window", (rows * cols,), field,
                field.shape[2], field.dtype.itemsize, pages, width, left, bottom, cols, rows,
            )  # fmt: skip
            return FieldWindow(cells, first)
        return FieldWindow(dense_pages(host(field), host(pages)[bottom:top, left:right]), first)
