"""Doubled walls: the trace that a wrong alignment, or a lost SLAM, leaves in a map.

A wall drawn twice a few cells apart costs little in a cell-by-cell error and much to a robot, which
plans through the gap. The share of doubled walls needs no truth.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.config import NormalizeConfig
from slamfusion.cores import usable_cores
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
# Cells around a part of a map that decide what is doubled in it: rays of twice 8 cells, and windows
# of the filters at their ends.
REACH_CELLS, FILTERS_CELLS = 48, 32
# A map with longer sides is looked at in tiles of this side: its filters would not fit into memory.
# Where some cells are asked about, tiles are smaller: those without any cost nothing.
WHOLE_CELLS, TILE_CELLS, ASKED_CELLS = 2048, 1024, 384
# Cells behind its own wall at which a ray is asked whether anything is ahead of it at all.
CLEAR_FROM_CELLS = 2.5
# Cells of a part whose distances to walls take as long as what they save a ray.
RAY_CELLS = 30
# Distances of doubled walls, cells.
NEAR, FAR = 2.0, 8.0


def doubled_wall_share(
    grid: OccupancyGrid | npt.NDArray[np.bool_],
    near: float = NEAR,
    far: float = FAR,
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
    considered, doubled = _count(_walls(grid, normalize), near, far)
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
    considered, doubled = _count(fused == 1, NEAR, FAR)
    if not considered:
        return 0.0, 0.0
    share = int(np.count_nonzero(doubled)) / considered
    for cells, box in inputs:
        row, col = max(box.row0 - REACH_CELLS, 0), max(box.col0 - REACH_CELLS, 0)
        window = doubled[row : box.row1 + REACH_CELLS, col : box.col1 + REACH_CELLS]
        walls = np.zeros(window.shape, dtype=np.bool_)
        own = walls[box.row0 - row :, box.col0 - col :]
        own[: cells.shape[0], : cells.shape[1]] = cells == 1
        window &= ~_grown(doubled_wall_cells(walls, where=_grown(window)))
    return share, int(np.count_nonzero(doubled)) / considered


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
    return _count(_walls(grid, normalize), near, far, where)[1]


def _count(
    walls: npt.NDArray[np.bool_],
    near: float,
    far: float,
    where: npt.NDArray[np.bool_] | None = None,
) -> tuple[int, npt.NDArray[np.bool_]]:
    """Return how many of the cells asked about are walls and no specks, and the doubled ones."""
    if not 2.0 <= near <= far:
        message = f"near and far must satisfy 2 <= near <= far cells, found {near:g} and {far:g}"
        raise ValueError(message)
    doubled = np.zeros(walls.shape, dtype=np.bool_)

    def look(part: tuple[Window, Window, Window]) -> int:
        """Look at one tile; tiles are written by nobody else."""
        tile, wide, inner = part
        asked = np.zeros(walls[wide].shape, dtype=np.bool_)
        asked[inner] = True if where is None else where[tile]
        looked_at, found = _doubled_in(walls[wide], near, far, asked)
        doubled[tile] = found[inner]
        return looked_at

    side = TILE_CELLS if where is None else ASKED_CELLS
    parts = list(_tiles(walls.shape, side, 2 * math.ceil(far) + FILTERS_CELLS))
    if len(parts) == 1:
        return look(parts[0]), doubled
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


def _doubled_in(
    walls: npt.NDArray[np.bool_], near: float, far: float, where: npt.NDArray[np.bool_]
) -> tuple[int, npt.NDArray[np.bool_]]:
    """Return the walls asked about, and the doubled cells of them, of a part of a map; see above.

    Groups that the part's edge cuts are no specks that reach what is asked about.
    """
    doubled = np.zeros(walls.shape, dtype=np.bool_)
    if not (where & walls).any():
        return 0, doubled
    walls = _without_specks(walls)
    rows, cols = np.nonzero(walls)
    asked = where[rows, cols]
    considered = int(np.count_nonzero(asked))
    if considered == 0:
        return 0, doubled

    # Only where there are walls, and a border wide enough for every ray: no bounds to check below.
    border = 2 * int(np.ceil(far)) + 3
    row0, col0 = int(rows.min()), int(cols.min())
    padded = np.pad(walls[row0 : int(rows.max()) + 1, col0 : int(cols.max()) + 1], border)
    tensor = _structure_tensor(padded)
    padded_rows, padded_cols = rows - row0 + border, cols - col0 + border
    rows, cols = rows[asked], cols[asked]
    padded_rows, padded_cols = padded_rows[asked], padded_cols[asked]
    nx, ny, coherence = _orientation(tensor, padded_rows, padded_cols)
    is_wall_like = coherence >= _MIN_COHERENCE
    rows, cols, nx, ny = rows[is_wall_like], cols[is_wall_like], nx[is_wall_like], ny[is_wall_like]
    x = padded_cols[is_wall_like].astype(np.float64)
    y = padded_rows[is_wall_like].astype(np.float64)
    around = _Surroundings(padded)

    for side in (1.0, -1.0):
        hit_t, hit = _next_wall(around, (x, y), (side * nx, side * ny), near, far)
        # Half a cell further the ray is inside the other wall.
        hit_cols = np.rint(x[hit] + (hit_t + 0.5) * side * nx[hit]).astype(np.int64)
        hit_rows = np.rint(y[hit] + (hit_t + 0.5) * side * ny[hit]).astype(np.int64)
        hit_nx, hit_ny, coherence = _orientation(tensor, hit_rows, hit_cols)
        is_parallel = np.abs(hit_nx * nx[hit] + hit_ny * ny[hit]) >= _PARALLEL_COS
        is_other = is_parallel & (coherence >= _MIN_COHERENCE)
        doubled[rows[hit][is_other], cols[hit][is_other]] = True
    return considered, doubled


def _walls(
    grid: OccupancyGrid | npt.NDArray[np.bool_], normalize: NormalizeConfig
) -> npt.NDArray[np.bool_]:
    """Return the occupied cells as (H, W) bool."""
    if isinstance(grid, OccupancyGrid):
        return np.asarray(trinary_cells(grid.cells, normalize) == 1, dtype=np.bool_)
    return np.asarray(grid, dtype=np.bool_)


def _without_specks(walls: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the walls without groups of fewer than five 8-connected cells."""
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


class _Surroundings:
    """Walls as rays see them.

    Attributes:
        level: (H, W) float32, 1 at a wall; a border that no ray leaves is free.
        corners: see ``_corner_counts``.
    """

    def __init__(self, walls: npt.NDArray[np.bool_]) -> None:
        self.level, self.corners = walls.astype(np.float32), _corner_counts(walls)
        self._walls = walls

    @cached_property
    def clear(self) -> F32:
        """(H, W) float32, cells around a cell's centre in which no sample is a wall."""
        distance = cv2.distanceTransform(
            (~self._walls).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5
        )
        # A sample meets a wall whose centre is less than a cell away along both axes; it may lie
        # half a cell along both from the centre at which this is read; and the distance is of
        # steps over 5 x 5 cells, at most 3 % too large.
        clear = np.asarray(distance, dtype=np.float32) * np.float32(0.97)
        clear -= np.float32(1.5 * math.sqrt(2.0))
        return clear

    def are_walls(
        self, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.bool_]:
        """Return whether samples at (x, y), (N,) each, count as wall."""
        return _sample(self.level, self.corners, x, y)

    def clear_around(
        self, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float32]:
        """Return how many cells around (x, y), (N,) each, are free of walls, at least."""
        return self.clear[np.rint(y).astype(np.int64), np.rint(x).astype(np.int64)]


def _next_wall(
    around: _Surroundings,
    start: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]],
    direction: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]],
    near: float,
    far: float,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.intp]]:
    """Walk from each wall cell along its normal to the beginning of the next wall.

    Args:
        around: the walls.
        start: x and y, (N,) each, in cells; integers are cell centres.
        direction: x and y of a unit vector, (N,) each.
        near: least distance in cells; one less in free width, since both walls reach half a cell
            beyond their centres.
        far: most distance likewise.

    Returns:
        (K,) cells from the start to the first sample of the next wall, and (K,) which of the rays
        meet one.
    """
    (x, y), (nx, ny) = start, direction
    own_end = np.zeros(x.shape)
    hits: list[npt.NDArray[np.intp]] = []
    hits_at: list[float] = []
    asks_ahead = x.size * RAY_CELLS > around.level.size
    # Rays that go on: their numbers, and what is asked of them each step, side by side in memory.
    rays = np.arange(x.size)
    for step in range(1, int(2 * far / _STEP_CELLS) + 1):
        t = step * _STEP_CELLS
        on_wall = around.are_walls(x + t * nx, y + t * ny)
        width = t - own_end
        is_own = on_wall & (width < near - 1.0)
        is_other = on_wall & ~is_own & (width <= far - 1.0)
        own_end[is_own] = t
        hits.append(rays[is_other])
        hits_at += [t] * len(hits[-1])
        goes_on = ~is_other & (t - own_end < far - 1.0) & (own_end <= far)
        if asks_ahead:
            # A few samples behind the own wall: nothing is there up to the ray's end, as a rule.
            leaves = np.flatnonzero(goes_on & (t - own_end == CLEAR_FROM_CELLS))
            end = own_end[leaves] + (far - 1.0)
            clear = around.clear_around(x[leaves] + end * nx[leaves], y[leaves] + end * ny[leaves])
            goes_on[leaves[clear > end - (t + _STEP_CELLS)]] = False
        if not goes_on.any():
            break
        rays, own_end = rays[goes_on], own_end[goes_on]
        x, y, nx, ny = x[goes_on], y[goes_on], nx[goes_on], ny[goes_on]
    return np.array(hits_at), np.concatenate([*hits, rays[:0]])


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
