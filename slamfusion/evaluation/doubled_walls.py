"""Doubled walls: the trace that a wrong alignment, or a lost SLAM, leaves in a map.

A wall drawn twice a few cells apart costs little in a cell-by-cell error and much to a robot, which
plans through the gap. The share of doubled walls needs no truth.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from slamfusion.config import NormalizeConfig
from slamfusion.grid import CellBox, OccupancyGrid, trinary_cells

__all__ = ["doubled_wall_cells", "doubled_wall_share", "fused_doubled_shares"]

F32 = npt.NDArray[np.float32]
# Rows and columns of a part of an array.
Window = tuple[slice, slice]

_DEFAULT_NORMALIZE = NormalizeConfig()
_GRADIENT_SIGMA_CELLS = 1.0
_WINDOW_SIGMA_CELLS = 2.5
_MIN_COHERENCE = 0.4
_MIN_COMPONENT_CELLS = 5
_PARALLEL_COS = float(np.cos(np.deg2rad(20.0)))
_STEP_CELLS = 0.5
# Between the centres of two diagonal neighbours the interpolated wall falls to 0.5; a ray that
# samples every half cell still meets 0.4 there, so that it cannot slip through a diagonal wall.
_WALL_LEVEL = 0.4
# Cells around a part of a map that decide what is doubled in it: rays of twice 8 cells, windows of
# the filters at their ends, and specks.
REACH_CELLS, FILTERS_CELLS, SPECK_CELLS = 48, 32, 8
# A map with longer sides is looked at in tiles of this side: its filters would not fit into memory.
WHOLE_CELLS, TILE_CELLS = 2048, 1024


def doubled_wall_share(
    grid: OccupancyGrid | npt.NDArray[np.bool_],
    near: float = 2.0,
    far: float = 8.0,
    *,
    normalize: NormalizeConfig = _DEFAULT_NORMALIZE,
) -> float:
    """Return the share of wall cells that have a parallel wall ``near`` to ``far`` cells away.

    Args:
        grid: a grid, or (H, W) bool with True for a wall.
        near: least cells from the last cell of the own wall to the first of the other, at least
            2, which leaves one cell between them.
        far: most cells likewise.
        normalize: the thresholds of a grid.

    Returns:
        0..1; 0 for a map without walls.
    """
    walls = _without_specks(_walls(grid, normalize))
    considered = int(np.count_nonzero(walls))
    doubled = doubled_wall_cells(walls, near, far)
    return int(np.count_nonzero(doubled)) / considered if considered else 0.0


def fused_doubled_shares(
    fused: npt.NDArray[np.int8], inputs: Iterable[tuple[npt.NDArray[np.int8], CellBox]]
) -> tuple[float, float]:
    """Return the shares of fused wall cells that are doubled, and doubled in no input.

    The second is what a slip would make.

    A place may have parallel walls close together, and a map that knows little of it shows few of
    them; so the fused map's share alone cannot tell a slip from a narrow passage. Here a doubled
    cell of the fused map counts only where no aligned input is doubled within two cells.

    Args:
        fused: (H, W) int8 in {-1, 0, 1}.
        inputs: the aligned inputs, (h, w) int8 in {-1, 0, 1}, each with the box of cells of the
            fused lattice that it covers.

    Returns:
        0..1 each; 0 for a map without walls.
    """
    walls = _without_specks(fused == 1)
    considered = int(np.count_nonzero(walls))
    if not considered:
        return 0.0, 0.0
    doubled = doubled_wall_cells(fused == 1)
    share = int(np.count_nonzero(doubled)) / considered
    for cells, box in inputs:
        row, col = max(box.row0 - REACH_CELLS, 0), max(box.col0 - REACH_CELLS, 0)
        window = doubled[row : box.row1 + REACH_CELLS, col : box.col1 + REACH_CELLS]
        walls = np.zeros(window.shape, dtype=np.bool_)
        own = walls[box.row0 - row :, box.col0 - col :]
        own[: cells.shape[0], : cells.shape[1]] = cells == 1
        asked = ndimage.binary_dilation(window, iterations=2)
        window &= ~ndimage.binary_dilation(doubled_wall_cells(walls, where=asked), iterations=2)
    return share, int(np.count_nonzero(doubled)) / considered


def doubled_wall_cells(
    grid: OccupancyGrid | npt.NDArray[np.bool_],
    near: float = 2.0,
    far: float = 8.0,
    *,
    normalize: NormalizeConfig = _DEFAULT_NORMALIZE,
    where: npt.NDArray[np.bool_] | None = None,
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
        where: (H, W) bool, the cells that are asked about; None: all.

    Returns:
        (H, W) bool.

    Raises:
        ValueError: ``near`` is below 2, or ``far`` below ``near``.
    Source: structure tensor and coherence as in Bigun and Granlund, "Optimal orientation detection
        of linear symmetry", ICCV 1987.
    """
    if not 2.0 <= near <= far:
        message = f"near and far must satisfy 2 <= near <= far cells, found {near:g} and {far:g}"
        raise ValueError(message)
    walls = _walls(grid, normalize)
    doubled = np.zeros(walls.shape, dtype=np.bool_)
    for tile, wide, inner in _tiles(walls.shape, 2 * math.ceil(far) + FILTERS_CELLS):
        asked = None if where is None else where[wide]
        doubled[tile] = _doubled_in(walls[wide], near, far, asked)[inner]
    return doubled


def _tiles(shape: tuple[int, ...], reach: int) -> Iterator[tuple[Window, Window, Window]]:
    """Yield tiles that together are all of an array of a shape.

    Args:
        shape: rows and columns.
        reach: cells around a tile that decide what is found in it.

    Yields:
        The tile, the same with the cells around it, and where in these the tile lies.
    """
    side = TILE_CELLS if max(shape) > WHOLE_CELLS else WHOLE_CELLS
    for row in range(0, shape[0], side):
        for col in range(0, shape[1], side):
            tile = slice(row, min(row + side, shape[0])), slice(col, min(col + side, shape[1]))
            first = max(row - reach, 0), max(col - reach, 0)
            wide = slice(first[0], tile[0].stop + reach), slice(first[1], tile[1].stop + reach)
            rows, cols = (
                slice(part.start - at, part.stop - at) for part, at in zip(tile, first, strict=True)
            )
            yield tile, wide, (rows, cols)


def _doubled_in(
    walls: npt.NDArray[np.bool_],
    near: float,
    far: float,
    where: npt.NDArray[np.bool_] | None,
) -> npt.NDArray[np.bool_]:
    """Return the doubled cells of a map that is looked at as a whole; see above."""
    doubled = np.zeros(walls.shape, dtype=np.bool_)
    if not walls.any() or (where is not None and not (where & walls).any()):
        return doubled
    walls = _without_specks(walls)
    rows, cols = np.nonzero(walls)
    if rows.size == 0:
        return doubled

    # Only where there are walls, and a border wide enough for every ray: no bounds to check below.
    border = 2 * int(np.ceil(far)) + 3
    row0, col0 = int(rows.min()), int(cols.min())
    padded = np.pad(walls[row0 : int(rows.max()) + 1, col0 : int(cols.max()) + 1], border)
    tensor = _structure_tensor(padded)
    padded_rows, padded_cols = rows - row0 + border, cols - col0 + border
    x, y = padded_cols.astype(np.float64), padded_rows.astype(np.float64)
    nx, ny, coherence = _orientation(tensor, padded_rows, padded_cols)
    asked = coherence >= _MIN_COHERENCE
    if where is not None:
        asked &= where[rows, cols]
    rows, cols, x, y = rows[asked], cols[asked], x[asked], y[asked]
    nx, ny = nx[asked], ny[asked]

    for side in (1.0, -1.0):
        hit_t, hit = _next_wall(padded, (x, y), (side * nx, side * ny), near, far)
        # Half a cell further the ray is inside the other wall.
        hit_cols = np.rint(x + (hit_t + 0.5) * side * nx).astype(np.int64)
        hit_rows = np.rint(y + (hit_t + 0.5) * side * ny).astype(np.int64)
        hit_nx, hit_ny, coherence = _orientation(tensor, hit_rows, hit_cols)
        is_parallel = np.abs(hit_nx * nx + hit_ny * ny) >= _PARALLEL_COS
        is_wall_like = coherence >= _MIN_COHERENCE
        doubled[rows, cols] |= hit & is_parallel & is_wall_like
    return doubled


def _walls(
    grid: OccupancyGrid | npt.NDArray[np.bool_], normalize: NormalizeConfig
) -> npt.NDArray[np.bool_]:
    """Return the occupied cells as (H, W) bool."""
    if isinstance(grid, OccupancyGrid):
        return np.asarray(trinary_cells(grid.cells, normalize) == 1, dtype=np.bool_)
    return np.asarray(grid, dtype=np.bool_)


def _without_specks(walls: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the walls without groups of fewer than five 8-connected cells."""
    kept = np.zeros(walls.shape, dtype=np.bool_)
    for tile, wide, inner in _tiles(walls.shape, SPECK_CELLS):
        kept[tile] = _without_specks_in(walls[wide])[inner]
    return kept


def _without_specks_in(walls: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Do the same for a part of a map; groups that its edge cuts are no specks that reach in."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(walls.astype(np.uint8), connectivity=8)
    is_wall = np.asarray(stats)[:, cv2.CC_STAT_AREA] >= _MIN_COMPONENT_CELLS
    is_wall[0] = False
    return np.asarray(is_wall[labels], dtype=np.bool_)


def _structure_tensor(walls: npt.NDArray[np.bool_]) -> tuple[F32, F32, F32]:
    """Return the structure tensor around each cell: xx, yy and xy, x along columns; (H, W) each."""
    smooth = cv2.GaussianBlur(walls.astype(np.float32), (0, 0), _GRADIENT_SIGMA_CELLS)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    jxx, jyy, jxy = (
        np.asarray(cv2.GaussianBlur(product, (0, 0), _WINDOW_SIGMA_CELLS), dtype=np.float32)
        for product in (gx * gx, gy * gy, gx * gy)
    )
    return jxx, jyy, jxy


def _orientation(
    tensor: tuple[F32, F32, F32], rows: npt.NDArray[np.intp], cols: npt.NDArray[np.intp]
) -> tuple[F32, F32, F32]:
    """Return the unit normal (x along columns, y along rows) and the coherence at cells, (N,) each.

    Coherence is (l1 - l2) / (l1 + l2) of the structure tensor's eigenvalues: 1 along a straight
    wall, 0 where all directions are equal.
    """
    jxx, jyy, jxy = (part[rows, cols] for part in tensor)
    angle = 0.5 * np.arctan2(2.0 * jxy, jxx - jyy)
    energy = jxx + jyy
    coherence = np.hypot(jxx - jyy, 2.0 * jxy) / np.maximum(energy, np.float32(1e-12))
    return np.cos(angle), np.sin(angle), coherence


def _next_wall(
    walls: npt.NDArray[np.bool_],
    start: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]],
    direction: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]],
    near: float,
    far: float,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Walk from each wall cell along its normal to the beginning of the next wall.

    Args:
        walls: (H, W) bool with a border that no ray leaves.
        start: x and y, (N,) each, in cells; integers are cell centres.
        direction: x and y of a unit vector, (N,) each.
        near: least distance in cells; one less in free width, since both walls reach half a cell
            beyond their centres.
        far: most distance likewise.

    Returns:
        (N,) cells from the start to the first sample of the next wall, and (N,) bool whether
        there is one.
    """
    (x, y), (nx, ny) = start, direction
    level, corners = walls.astype(np.float32), _corner_counts(walls)
    own_end = np.zeros(x.shape)
    hit_at = np.zeros(x.shape)
    hit = np.zeros(x.shape, dtype=np.bool_)
    active = np.arange(x.size)
    for step in range(1, int(2 * far / _STEP_CELLS) + 1):
        t = step * _STEP_CELLS
        on_wall = _sample(level, corners, x[active] + t * nx[active], y[active] + t * ny[active])
        width = t - own_end[active]
        is_own = on_wall & (width < near - 1.0)
        is_other = on_wall & ~is_own & (width <= far - 1.0)
        own_end[active[is_own]] = t
        hit_at[active[is_other]] = t
        hit[active[is_other]] = True
        goes_on = ~is_other & (t - own_end[active] < far - 1.0) & (own_end[active] <= far)
        active = active[goes_on]
        if active.size == 0:
            break
    return hit_at, hit


def _corner_counts(walls: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """Return how many of a cell and its next ones in x, in y and in both are walls, (H, W)."""
    counts = walls.astype(np.uint8)
    counts[:, :-1] += walls[:, 1:]
    counts[:-1] += walls[1:]
    counts[:-1, :-1] += walls[1:, 1:]
    return counts


def _sample(
    level: npt.NDArray[np.float32],
    corners: npt.NDArray[np.uint8],
    x: npt.NDArray[np.float64],
    y: npt.NDArray[np.float64],
) -> npt.NDArray[np.bool_]:
    """Return whether the bilinear value at (x, y), in cells and not negative, counts as wall.

    Args:
        level: (H, W), 1 at a wall.
        corners: see ``_corner_counts``: between four cells that are alike nothing is interpolated.
        x, y: (N,).
    """
    index = y.astype(np.int64) * level.shape[1] + x.astype(np.int64)
    count = corners.ravel()[index]
    is_wall: npt.NDArray[np.bool_] = count == 4
    some = np.flatnonzero((count > 0) & (count < 4))
    x, y, index = x[some], y[some], index[some]
    u, v = x - np.floor(x), y - np.floor(y)
    values, width = level.ravel(), level.shape[1]
    value = (1.0 - v) * ((1.0 - u) * values[index] + u * values[index + 1]) + v * (
        (1.0 - u) * values[index + width] + u * values[index + width + 1]
    )
    is_wall[some] = value >= _WALL_LEVEL
    return is_wall
