"""Doubled walls: the trace that a wrong alignment, or a lost SLAM, leaves in a map.

A wall drawn twice a few cells apart costs little in a cell-by-cell error and much to a robot, which
plans through the gap. The share of doubled walls needs no truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.compute.doubled_walls import DOUBLED, RaySteps
from slamfusion.config import NormalizeConfig
from slamfusion.cores import usable_cores
from slamfusion.grid import CellBox, OccupancyGrid, trinary_cells

# Rows and columns of a part of an array.
Window = tuple[slice, slice]
IsWall = Callable[[npt.NDArray[np.int8]], npt.NDArray[np.bool_]]

_DEFAULT_NORMALIZE = NormalizeConfig()
# Cells around a part of a map that decide what is doubled in it: rays of twice 8 cells, and windows
# of the filters at their ends.
REACH_CELLS, FILTERS_CELLS = 48, 32
# A map with longer sides than the first is looked at in tiles: its filters would not fit into
# memory, and NumPy's are several times as large as a device's. Tiles in which some cells are asked
# about are smaller: those without any cost nothing.
WHOLE_CELLS, DEVICE_TILE_CELLS, TILE_CELLS, ASKED_CELLS = 2048, 2048, 1024, 384
# Distances of doubled walls, cells.
NEAR, FAR = 2.0, 8.0


def doubled_wall_share(
    grid: OccupancyGrid | npt.NDArray[np.bool_],
    near: float = NEAR,
    far: float = FAR,
    *,
    normalize: NormalizeConfig = _DEFAULT_NORMALIZE,
    device: ComputeDevice | None = None,
) -> float:
    """Return the share of wall cells that have a parallel wall ``near`` to ``far`` cells away.

    Args:
        grid: a grid, or (H, W) bool with True for a wall.
        near: least cells from the last cell of the own wall to the first of the other, at least
            2, which leaves one cell between them.
        far: most cells likewise.
        normalize: the thresholds of a grid.
        device: computes, the same on every one; None: NumPy.

    Returns:
        0..1; 0 for a map without walls.
    """
    considered, doubled = _count(_walls(grid, normalize), near, far, device)
    return int(np.count_nonzero(doubled)) / considered if considered else 0.0


def _is_occupied(cells: npt.NDArray[np.int8]) -> npt.NDArray[np.bool_]:
    return np.equal(cells, 1)


def fused_doubled_shares(
    fused: npt.NDArray[np.int8],
    inputs: Iterable[tuple[npt.NDArray[np.int8], CellBox]],
    *,
    device: ComputeDevice | None = None,
    is_wall: IsWall = _is_occupied,
) -> tuple[float, float]:
    """Return the shares of fused wall cells that are doubled, and doubled in no input.

    The second is what a slip would make.

    A place may have parallel walls close together, and a map that knows little of it shows few of
    them; so the fused map's share alone cannot tell a slip from a narrow passage. Here a doubled
    cell of the fused map counts only where no aligned input is doubled within two cells.

    Args:
        fused: (H, W) int8, above 0 at a wall.
        inputs: the aligned inputs, (h, w) int8 in {-1, 0, 1}, each with the box of cells of the
            fused lattice that it covers.
        device: computes, the same on every one; None: NumPy.
        is_wall: tells the walls among the cells of a part of an input, where these are others.

    Returns:
        0..1 each; 0 for a map without walls.
    """
    considered, doubled = _count(fused > 0, NEAR, FAR, device)
    if not considered:
        return 0.0, 0.0
    share = int(np.count_nonzero(doubled)) / considered
    device = device or NumpyDevice()
    for cells, box in inputs:
        _take_doubled(doubled, cells, box, device, is_wall)
    return share, int(np.count_nonzero(doubled)) / considered


def _take_doubled(
    doubled: npt.NDArray[np.bool_],
    cells: npt.NDArray[np.int8],
    box: CellBox,
    device: ComputeDevice,
    is_wall: IsWall,
) -> None:
    """Clear the doubled cells near which an input has doubled walls, in place.

    Args:
        doubled: (H, W) bool.
        cells: (h, w) int8, the input.
        box: where in the array it lies.
        device: computes.
        is_wall: tells the walls among its cells.
    """
    for tile, wide, inner in _tiles(doubled.shape, ASKED_CELLS, REACH_CELLS):
        if not doubled[tile].any():
            continue
        height, width = doubled[wide].shape
        asked = np.zeros((height, width), dtype=np.bool_)
        asked[inner] = doubled[tile]
        row, col = wide[0].start - box.row0, wide[1].start - box.col0
        part = is_wall(cells[max(row, 0) : max(row + height, 0), max(col, 0) : max(col + width, 0)])
        if not part.any():
            continue
        top, left = max(-row, 0), max(-col, 0)
        walls = np.zeros((height, width), dtype=np.uint8)
        walls[top : top + part.shape[0], left : left + part.shape[1]] = part
        marks = device.mark_doubled(walls, _grown(asked).view(np.uint8), RaySteps.of(NEAR, FAR))
        doubled[tile] &= ~_grown(marks == DOUBLED)[inner]


def _grown(cells: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return cells, and those within two steps along rows and columns of one."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    grown = cv2.dilate(np.ascontiguousarray(cells).view(np.uint8), cross, iterations=2)
    return np.asarray(grown).view(np.bool_)


def doubled_wall_cells(
    grid: OccupancyGrid | npt.NDArray[np.bool_],
    near: float = NEAR,
    far: float = FAR,
    *,
    normalize: NormalizeConfig = _DEFAULT_NORMALIZE,
    device: ComputeDevice | None = None,
) -> npt.NDArray[np.bool_]:
    """Mark the wall cells that have a parallel wall ``near`` to ``far`` cells away.

    From each wall cell a ray goes along the wall's normal to either side. It first crosses its own
    wall, however thick up to ``far`` cells, holes narrower than ``near`` included; so neither a
    thick nor a ragged wall is doubled. When the next wall begins within ``far`` cells and runs
    parallel within 20 degrees, the cell is doubled. Groups of fewer than five connected cells are
    specks, not walls, and left out.

    The normal is the main direction of the structure tensor, which several parallel walls in the
    window strengthen where a fit of a line to the wall cells would turn away from all of them.

    Args:
        grid: a grid, or (H, W) bool with True for a wall.
        near: least cells from the last cell of the own wall to the first of the other, at least
            2, which leaves one cell between them.
        far: most cells likewise.
        normalize: the thresholds of a grid.
        device: computes, the same on every one; None: NumPy.

    Returns:
        (H, W) bool.

    Raises:
        ValueError: ``near`` is below 2, or ``far`` below ``near``.
    Source: structure tensor and coherence as in Bigun and Granlund, "Optimal orientation detection
        of linear symmetry", ICCV 1987.
    """
    return _count(_walls(grid, normalize), near, far, device)[1]


def _count(
    walls: npt.NDArray[np.bool_],
    near: float,
    far: float,
    device: ComputeDevice | None,
) -> tuple[int, npt.NDArray[np.bool_]]:
    """Return how many cells are walls and no specks, and the doubled ones."""
    if not 2.0 <= near <= far:
        message = f"near and far must satisfy 2 <= near <= far cells, found {near:g} and {far:g}"
        raise ValueError(message)
    device = device or NumpyDevice()
    steps = RaySteps.of(near, far)
    doubled = np.zeros(walls.shape, dtype=np.bool_)

    def look(part: tuple[Window, Window, Window]) -> int:
        """Look at one tile; tiles are written by nobody else.

        Groups that the part's edge cuts are no specks that reach what is asked about.
        """
        tile, wide, inner = part
        if not walls[tile].any():
            return 0
        asked = np.zeros(walls[wide].shape, dtype=np.uint8)
        asked[inner] = walls[tile]
        marks = device.mark_doubled(walls[wide].view(np.uint8), asked, steps)[inner]
        doubled[tile] = marks == DOUBLED
        return int(np.count_nonzero(marks))

    side = DEVICE_TILE_CELLS if device.opencl else TILE_CELLS
    parts = list(_tiles(walls.shape, side, 2 * math.ceil(far) + FILTERS_CELLS))
    if len(parts) == 1 or device.opencl:
        return sum(map(look, parts)), doubled
    with ThreadPoolExecutor(usable_cores()) as threads:
        return sum(threads.map(look, parts)), doubled


def _tiles(
    shape: tuple[int, ...], side: int, reach: int
) -> Iterator[tuple[Window, Window, Window]]:
    """Yield tiles that together are all of an array of a shape.

    Args:
        shape: rows and columns.
        side: rows and columns of a tile, where the array is not looked at as a whole.
        reach: cells around a tile that decide what is found in it.

    Yields:
        The tile, the same with the cells around it, and where in these the tile lies.
    """
    side = side if max(shape) > WHOLE_CELLS else WHOLE_CELLS
    for row in range(0, shape[0], side):
        for col in range(0, shape[1], side):
            tile = slice(row, min(row + side, shape[0])), slice(col, min(col + side, shape[1]))
            first = max(row - reach, 0), max(col - reach, 0)
            wide = slice(first[0], tile[0].stop + reach), slice(first[1], tile[1].stop + reach)
            rows, cols = (
                slice(part.start - at, part.stop - at) for part, at in zip(tile, first, strict=True)
            )
            yield tile, wide, (rows, cols)


def _walls(
    grid: OccupancyGrid | npt.NDArray[np.bool_], normalize: NormalizeConfig
) -> npt.NDArray[np.bool_]:
    """Return the occupied cells as (H, W) bool."""
    if isinstance(grid, OccupancyGrid):
        classes = trinary_cells(grid.cells, normalize)
        return np.equal(classes, 1, out=classes.view(np.bool_))
    return np.asarray(grid, dtype=np.bool_)
