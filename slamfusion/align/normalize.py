"""Bring inputs to one resolution, cropped to what they know, as unknown / free / occupied."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import FIXED_ONE
from slamfusion.config import NormalizeConfig
from slamfusion.errors import GridError
from slamfusion.geometry import I8, U8, Pose2
from slamfusion.grid import UNKNOWN, CellBox, OccupancyGrid, known_box, trinary_cells
from slamfusion.io.files import check_memory
from slamfusion.vote.lattice import SAME_RESOLUTION, Lattice

# Bytes per cell of an input that is aligned, during its alignment, and during its vote.
ALIGNED_BYTES_PER_CELL, BYTES_PER_CELL, VOTED_BYTES_PER_CELL = 4, 24, 7
# Largest side of a map that is aligned at full resolution, cells.
ALIGNED_CELLS = 3000
# Greatest ratio of a map's cells to the fused ones. Walls are compared within 0.15 m, too fine for
# cells of a metre; and cells of 1 mm make a hall too large.
RATIO_MAX = 16.0
# Ratio from which a cell size looks like centimetres or millimetres.
UNITS_RATIO = 99.0
# To spare memory copies are coarser, down to this number of cells together, up to this cell size in
# metres, at which walls of a building are still separate.
SPARING_CELLS, SPARING_CELL_M = 2**27, 0.15
# Maps that keep their fields with any amount of memory: of two pairs that are aligned at once.
LEAST_KEPT = 4
# Rows of blocks pooled at once.
POOLED_ROWS = 16

INT16_MAX = 2**15 - 1

Part = TypeVar("Part", np.int8, np.int16, np.int32)


@dataclass(frozen=True, eq=False)
class NormalizedGrid:
    """A grid ready to be aligned and to vote.

    Attributes:
        grid: occupancy in percent, at the common resolution, cropped to known cells; its origin
            keeps the lattice (yaw and sub-cell offset) of the input.
        cells: (H, W) int8 in {-1, 0, 1}, the same lattice.
        solid: (H, W) uint8, 1 at wall cells without specks of noise at the input's own resolution;
            every wall cell if all are specks.
    """

    grid: OccupancyGrid
    cells: I8
    solid: U8

    @property
    def name(self) -> str:
        """The input's name."""
        return self.grid.name

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.grid.height, self.grid.width

    @property
    def box(self) -> CellBox:
        """Its cells."""
        return CellBox(0, 0, *self.shape)

    @property
    def lattice(self) -> Lattice:
        """Where its cells lie."""
        return Lattice(self.grid.resolution, self.grid.origin)

    def on(self, lattice: Lattice, transform: Pose2) -> CellBox:
        """Return the cells of another lattice that hold all of it; see ``Lattice.box_of``."""
        return lattice.box_of(self.box, self.lattice, transform)


def common_resolution(grids: list[OccupancyGrid], config: NormalizeConfig) -> float:
    """Return the configured resolution, else the finest."""
    if config.resolution is not None:
        return config.resolution
    return min(grid.resolution for grid in grids)


def odd_resolution(size: float, typical: float) -> str | None:
    """Return in words that cells are too coarse or too fine for others, or None; m per cell."""
    ratio = max(size / typical, typical / size)
    if ratio <= RATIO_MAX:
        return None
    word = "coarser" if size > typical else "finer"
    said = (
        f"cells of {size:g} m are {ratio:.4g} times {word} than those of the others ({typical:g} "
        f"m); up to {RATIO_MAX:g} times is supported"
    )
    return f"{said}; is one in other units than metres?" if ratio >= UNITS_RATIO else said


def check_ratio(grid: OccupancyGrid, typical: float) -> None:
    """Refuse a grid whose cells are too coarse or too fine for others, by ``GridError``."""
    if odd := odd_resolution(grid.resolution, typical):
        raise GridError(f"{grid.name}: {odd}")


def check_resampling(
    grids: Sequence[OccupancyGrid], config: NormalizeConfig, what: str, *, is_stored: bool = False
) -> None:
    """Refuse grids that would not fit into memory at their common resolution.

    Args:
        what: the operation for the message: ``fusing``, ``aligning``.
        is_stored: the grids vote tile by tile, with little memory.

    Raises:
        MemoryBudgetError: with the sizes, the resolutions and what to do; nothing was allocated.
    """
    resolution = common_resolution(list(grids), config)
    own_cells = [_cells_at(grid, resolution) for grid in grids]
    largest = grids[own_cells.index(max(own_cells))]
    said = (
        f"{what} {sum(own_cells)} known-box cells at {resolution:g} m (this map: {max(own_cells)})"
    )
    factor = coarsening(grids, resolution, is_sparing=is_stored)
    looked_at = sum(sorted(own_cells)[-LEAST_KEPT:])
    needed = sum(own_cells) * ALIGNED_BYTES_PER_CELL
    needed += looked_at * (BYTES_PER_CELL - ALIGNED_BYTES_PER_CELL)
    needed //= factor**2
    if factor > 1:
        # All data of one input at a time, or the voting data of all of them.
        needed += max(own_cells) * BYTES_PER_CELL if is_stored else 0
        needed += 0 if is_stored else sum(own_cells) * VOTED_BYTES_PER_CELL
    check_memory(needed, said, largest.name)


def coarsening(
    grids: Sequence[OccupancyGrid], resolution: float, *, is_sparing: bool = False
) -> int:
    """Return the ratio of the cell sizes for alignment and for the fused map.

    1 except for maps whose fields would not fit into memory. Alignments are finer than a cell, so a
    coarser copy costs less than one fused cell of accuracy. ``is_sparing`` limits the memory of all
    copies together.
    """
    boxes = [(box, grid.resolution) for grid in grids if (box := grid.known_box) is not None]
    sides = [max(box.height, box.width) * size for box, size in boxes]
    factor = max(1, math.ceil(max(sides, default=0.0) / resolution / ALIGNED_CELLS))
    if is_sparing:
        cells = sum(box.area * (size / resolution) ** 2 for box, size in boxes)
        wanted = math.ceil(math.sqrt(cells / SPARING_CELLS))
        factor = max(factor, min(wanted, math.floor(SPARING_CELL_M / resolution + 1e-9)))
    return factor


def _cells_at(grid: OccupancyGrid, resolution: float) -> int:
    """Return how many cells the known box of a grid has at another resolution."""
    box = grid.known_box
    return 0 if box is None else int(box.area * (grid.resolution / resolution) ** 2)


def normalize_grid(
    grid: OccupancyGrid, resolution: float, config: NormalizeConfig, device: ComputeDevice
) -> NormalizedGrid:
    """Resample to ``resolution``, threshold, crop to the known cells, and find the solid walls.

    Raises:
        GridError: no cell of the grid is known under these thresholds.
    """
    name, shape, box = grid.name, grid.cells.shape, grid.known_box
    if box is not None:
        # Without unknown margins, so that a large canvas costs nothing.
        grid = grid.crop(box)
        classes = own_classes = trinary_cells(grid.cells, config)
        resampled = _resample(grid, resolution, config, device)
        if resampled is not grid:
            classes = trinary_cells(resampled.cells, config)
        box = known_box(classes)
    if box is None:
        raise GridError(
            f"{name}: all {shape[0]} x {shape[1]} cells are unknown at "
            f"free <= {config.free_percent:g} % and occupied >= {config.occupied_percent:g} %; "
            "give a map with known cells or other thresholds"
        )
    walls = device.download(device.solid_walls(device.upload(own_classes))).view(np.bool_)
    if resampled is not grid:
        blocks = _blocks(walls.view(np.int8), resolution / grid.resolution, 0, device)
        walls = (_each_part(np.maximum, blocks) != 0) & (classes == 1)
    window = np.s_[box.row0 : box.row1, box.col0 : box.col1]
    cells, walls = np.ascontiguousarray(classes[window]), np.ascontiguousarray(walls[window])
    solid = (walls if walls.any() else cells == 1).view(np.uint8)
    cells.flags.writeable = solid.flags.writeable = False
    return NormalizedGrid(resampled.crop(box), cells, solid)


def _resample(
    grid: OccupancyGrid, resolution: float, config: NormalizeConfig, device: ComputeDevice
) -> OccupancyGrid:
    """Return the grid on its own axes and corner, with cells of another size.

    To finer cells: the nearest cell. To coarser cells: the source is read at a whole number of
    points a cell; a wall at any of them stays a wall, so that thin walls survive.
    """
    if grid.resolution == resolution:
        return grid
    blocks = _blocks(grid.cells, resolution / grid.resolution, UNKNOWN, device)
    fine = blocks[:, 0, :, 0] if blocks.shape[1] == 1 else pool_cells(blocks, config)
    return OccupancyGrid(fine, resolution, grid.origin, grid.name)


def _blocks(cells: I8, ratio: float, fill: int, device: ComputeDevice) -> I8:
    """Return the points (H, n, W, n) at which cells of ``ratio`` times the size read a grid."""
    if abs(ratio - 1.0) < SAME_RESOLUTION:
        return cells.reshape(cells.shape[0], 1, cells.shape[1], 1)
    height, width = (max(1, int(np.ceil(size / ratio - 1e-9))) for size in cells.shape)
    parts = max(1, int(np.ceil(ratio - 1e-9)))
    scale = round(ratio / parts * FIXED_ONE)
    size = (height * parts, width * parts)
    if scale == FIXED_ONE:
        # The points are the cells.
        fine = np.pad(
            cells,
            [(0, wanted - own) for wanted, own in zip(size, cells.shape, strict=True)],
            constant_values=fill,
        )
    else:
        poses = np.array([[scale, 0, 0, 0]], dtype=np.int64)
        fine = device.download(device.warp(device.upload(cells), poses, size, fill))[0]
    return fine.reshape(height, parts, width, parts)


def pool_cells(blocks: I8, config: NormalizeConfig) -> I8:
    """Return one cell a block (H, n, W, n): any wall wins, else the mean if half is known."""
    height, parts, width, _ = blocks.shape
    pooled = np.empty((height, width), dtype=np.int8)
    kind: npt.DTypeLike = np.int16 if 100 * parts**2 <= INT16_MAX else np.int32
    # A few rows at once, whose sums fit into the cache.
    for first in range(0, height, POOLED_ROWS):
        some = blocks[first : first + POOLED_ROWS]
        highest = _each_part(np.maximum, some)
        count = _each_part(np.add, (some >= 0).astype(kind))
        total = _each_part(np.add, np.maximum(some, 0).astype(kind))
        mean = (total / np.maximum(count, 1)).round().astype(np.int8)
        out = np.where(2 * count >= parts**2, mean, np.int8(UNKNOWN))
        is_wall = highest >= config.occupied_percent
        pooled[first : first + POOLED_ROWS] = np.where(is_wall, highest, out)
    return pooled


def _each_part(join: np.ufunc, blocks: npt.NDArray[Part]) -> npt.NDArray[Part]:
    """Return the parts of each block (H, n, W, n) joined to one, (H, W): first whole rows."""
    height, parts, width, _ = blocks.shape
    rows = join.reduce(blocks.reshape(height, parts, width * parts), axis=1, dtype=blocks.dtype)
    joined: npt.NDArray[Part] = rows[:, ::parts].copy()
    for column in range(1, parts):
        join(joined, rows[:, column::parts], out=joined)
    return joined
