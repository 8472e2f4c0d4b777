"""Bring inputs to one resolution, cropped to what they know, as unknown / free / occupied."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.compute.fields import FieldDevice
from slamfusion.compute.layout import FIXED_ONE
from slamfusion.config import NormalizeConfig
from slamfusion.errors import GridError
from slamfusion.fusion.cancel import CancelToken, check_cancelled
from slamfusion.fusion.lattice import SAME_RESOLUTION, Extent, Lattice
from slamfusion.grid import OCCUPIED, UNKNOWN, OccupancyGrid, known_box, trinary_cells
from slamfusion.io.memory import check_memory

__all__ = [
    "NormalizedGrid",
    "check_resampling",
    "coarsening",
    "common_resolution",
    "normalize_grid",
    "pool_cells",
]

# What preparing and aligning hold at once for each cell of an input that they look at, and what
# voting does.
BYTES_PER_CELL, VOTED_BYTES_PER_CELL = 24, 7
# Cells on the longest side of a map that is aligned as it is: of larger ones a coarser copy is.
ALIGNED_CELLS = 3000


@dataclass(frozen=True, eq=False)
class NormalizedGrid:
    """A grid ready to be aligned and to vote.

    Attributes:
        grid: occupancy in percent, at the common resolution, cropped to known cells; its origin
            keeps the lattice (yaw and sub-cell offset) of the input.
        cells: (H, W) int8 in {-1, 0, 1}, the same lattice.
        solid: (H, W) uint8, 1 at the wall cells that alignment looks at: no specks of noise, judged
            at the input's own resolution; every wall cell where all are specks.
    """

    grid: OccupancyGrid
    cells: npt.NDArray[np.int8]
    solid: npt.NDArray[np.uint8]

    @property
    def name(self) -> str:
        """The input's name."""
        return self.grid.name

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.grid.height, self.grid.width

    @property
    def extent(self) -> Extent:
        """Where its cells lie."""
        return Extent(Lattice(self.grid.resolution, self.grid.origin), self.shape)


def common_resolution(grids: list[OccupancyGrid], config: NormalizeConfig) -> float:
    """Return the resolution to bring every grid to: the given one, else the finest."""
    if config.resolution is not None:
        return config.resolution
    return min(grid.resolution for grid in grids)


def check_resampling(
    grids: Sequence[OccupancyGrid], config: NormalizeConfig, what: str, *, is_stored: bool = False
) -> None:
    """Refuse grids that would not fit into memory at their common resolution.

    Args:
        grids: one or more.
        config: may give the resolution.
        what: is done with them: ``fusing``, ``aligning``.
        is_stored: they will vote tile by tile, which takes no memory to speak of.

    Raises:
        MemoryBudgetError: with the sizes, the resolutions and what to do; nothing was allocated.
    """
    resolution = common_resolution(list(grids), config)
    own_cells = [_cells_at(grid, resolution) for grid in grids]
    largest = grids[own_cells.index(max(own_cells))]
    finest = min(grids, key=lambda grid: grid.resolution)
    said = (
        f"{what} {sum(own_cells)} known-box cells at {resolution:g} m (this map: {max(own_cells)})"
    )
    if config.resolution is None and finest.resolution < largest.resolution:
        said += (
            f", the cell size of {finest.name}, to which this map's {largest.resolution:g} m is "
            "brought (is it right? fusion.normalize.resolution sets another),"
        )
    factor = coarsening(grids, resolution)
    needed = sum(own_cells) * BYTES_PER_CELL // factor**2
    if factor > 1:
        # Of one input at a time everything, or of all of them what votes.
        needed += max(own_cells) * BYTES_PER_CELL if is_stored else 0
        needed += 0 if is_stored else sum(own_cells) * VOTED_BYTES_PER_CELL
    check_memory(needed, said, largest.name)


def coarsening(grids: Sequence[OccupancyGrid], resolution: float) -> int:
    """Return how many times coarser the cells are on which grids are aligned than those fused.

    1 but for maps so large that their fields would not fit into memory. Alignments are told in
    metres and are finer than a cell, so a coarser copy costs less than one fused cell.

    Args:
        grids: one or more.
        resolution: of the fused cells, metres.
    """
    sides = [
        max(box.height, box.width) * grid.resolution
        for grid in grids
        if (box := grid.known_box()) is not None
    ]
    return max(1, math.ceil(max(sides, default=0.0) / resolution / ALIGNED_CELLS))


def _cells_at(grid: OccupancyGrid, resolution: float) -> int:
    """Return how many cells the known box of a grid has at another resolution."""
    box = grid.known_box()
    return 0 if box is None else int(box.area * (grid.resolution / resolution) ** 2)


def normalize_grid(
    grid: OccupancyGrid,
    resolution: float,
    config: NormalizeConfig,
    device: FieldDevice,
    cancel: CancelToken | None = None,
) -> NormalizedGrid:
    """Resample to ``resolution``, threshold, and crop to the known cells.

    Args:
        grid: any occupancy grid.
        resolution: metres per cell of the result.
        config: thresholds.
        device: does the resampling.
        cancel: asked between the operations.

    Raises:
        CancelledSearchError: ``cancel`` says so.
        GridError: no cell of the grid is known under these thresholds.
    """
    nothing_known = (
        f"{grid.name}: all {grid.height} x {grid.width} cells are unknown at "
        f"free <= {config.free_percent:g} % and occupied >= {config.occupied_percent:g} %; "
        "give a map with known cells or other thresholds"
    )
    given = grid.known_box()
    if given is None:
        raise GridError(nothing_known)
    # Margins go first: a map of a small place on a huge canvas costs no more than the place.
    grid = grid.crop(given)
    cells = trinary_cells(grid.cells, config)
    check_cancelled(cancel)
    solid = device.download(device.solid_walls(device.upload(cells))).view(np.int8)
    check_cancelled(cancel)
    resampled = _resample(grid, resolution, config, device)
    if resampled is not grid:
        check_cancelled(cancel)
        mask = OccupancyGrid(solid * np.int8(OCCUPIED), grid.resolution, grid.origin, grid.name)
        solid = (_resample(mask, resolution, config, device).cells > 0).astype(np.int8)
        cells = trinary_cells(resampled.cells, config)
    box = known_box(cells)
    if box is None:
        raise GridError(nothing_known)
    window = np.s_[box.row0 : box.row1, box.col0 : box.col1]
    kept = np.ascontiguousarray(cells[window])
    walls = np.ascontiguousarray((solid[window] != 0) & (kept == 1)).astype(np.uint8)
    if not walls.any():
        walls = (kept == 1).astype(np.uint8)
    kept.flags.writeable = False
    walls.flags.writeable = False
    return NormalizedGrid(resampled.crop(box), kept, walls)


def _resample(
    grid: OccupancyGrid, resolution: float, config: NormalizeConfig, device: FieldDevice
) -> OccupancyGrid:
    """Return the grid on its own axes and corner, with cells of another size.

    To finer cells: the nearest cell. To coarser cells: the source is read at a whole number of
    points a cell; a wall at any of them stays a wall, so that thin walls survive.
    """
    ratio = resolution / grid.resolution
    if abs(ratio - 1.0) < SAME_RESOLUTION:
        if grid.resolution == resolution:
            return grid
        return OccupancyGrid(grid.cells, resolution, grid.origin, grid.name)
    height = max(1, int(np.ceil(grid.height / ratio - 1e-9)))
    width = max(1, int(np.ceil(grid.width / ratio - 1e-9)))
    parts = max(1, int(np.ceil(ratio - 1e-9)))
    scale = round(ratio / parts * FIXED_ONE)
    poses = np.array([[scale, 0, 0, 0]], dtype=np.int64)
    fine = device.download(
        device.warp(device.upload(grid.cells), poses, (height * parts, width * parts), UNKNOWN)
    )[0]
    if parts > 1:
        fine = pool_cells(fine.reshape(height, parts, width, parts), config)
    return OccupancyGrid(np.ascontiguousarray(fine), resolution, grid.origin, grid.name)


def pool_cells(blocks: npt.NDArray[np.int8], config: NormalizeConfig) -> npt.NDArray[np.int8]:
    """Return one cell a block (H, n, W, n): any wall wins, else the mean if half is known."""
    # Part by part: sums over two axes of a large map take long and several times its memory.
    parts = [blocks[:, row, :, col] for row, col in np.ndindex(blocks.shape[1], blocks.shape[3])]
    highest = parts[0].copy()
    count, total = (np.zeros(highest.shape, dtype=np.int32) for _ in range(2))
    for part in parts:
        np.maximum(highest, part, out=highest)
        count += part >= 0
        total += np.maximum(part, 0)
    mean = (total / np.maximum(count, 1)).round().astype(np.int8)
    per_block = blocks.shape[1] * blocks.shape[3]
    out = np.where(2 * count >= per_block, mean, np.int8(UNKNOWN))
    return np.where(highest >= config.occupied_percent, highest, out).astype(np.int8)
