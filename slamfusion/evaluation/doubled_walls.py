"""Doubled walls, as a wrong alignment or a lost SLAM draws them.

A wall drawn twice a few cells apart hardly changes a cell-by-cell error, but a robot plans through
the gap. No truth is needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.geometry import B8, F32, I8, I64
from slamfusion.grid import CellBox

# Tile size; tiles without walls are skipped.
TILE_CELLS = 1024
# Cells beyond the end of a ray that the filter windows reach.
FILTERS_CELLS = 32
# Distances of doubled walls, cells, between the facing cells.
NEAR, FAR = 2.0, 8.0
# Smaller groups of connected cells are specks, not walls.
LEAST_GROUP = 5
# Deviations of the Gaussian filters of walls and of the structure tensor, cells.
SMOOTH_CELLS, WINDOW_CELLS = 1.0, 2.5
# Least coherence of a wall: difference of the tensor's eigenvalues over their sum.
LEAST_COHERENCE = 0.4
# Between diagonal neighbours the interpolated wall falls to 0.5; a ray sampled every half cell
# still meets 0.4, so that it does not pass through a diagonal wall.
WALL_LEVEL, STEPS_PER_CELL = 0.4, 2
# Walls within this angle are parallel, degrees.
PARALLEL_DEG = 20.0


def doubled_wall_share(walls: B8) -> float:
    """Return the share of wall cells that have a parallel wall ``NEAR`` to ``FAR`` cells away.

    From each wall cell a ray goes along the wall's normal to either side. It crosses its own wall,
    up to ``FAR`` cells thick, and holes narrower than ``NEAR``; so thick or ragged walls are not
    doubled. If the next wall starts within ``FAR`` cells and is parallel within 20 degrees, the
    cell is doubled. Groups of fewer than five connected cells are ignored.

    The normal is the main direction of the structure tensor, which parallel walls strengthen, while
    a line fit would turn away from them.

    Args:
        walls: (H, W) bool.

    Returns:
        0..1; 0 for a map without walls.

    Source: structure tensor and coherence as in Bigun and Granlund, "Optimal orientation detection
        of linear symmetry", ICCV 1987.
    """
    considered, doubled = _count(walls)
    return int(np.count_nonzero(doubled)) / considered if considered else 0.0


def fused_doubled_shares(fused: I8, inputs: Iterable[tuple[B8, CellBox]]) -> tuple[float, float]:
    """Return the shares of fused wall cells that are doubled, and doubled in no input.

    A narrow passage also has close parallel walls, so the first share alone does not show a wrong
    alignment. For the second a doubled cell counts only if no aligned input is doubled within two
    cells.

    Args:
        fused: (H, W) int8, above 0 at a wall.
        inputs: walls of the aligned inputs, (h, w) bool, each with its box of cells of the fused
            lattice.

    Returns:
        0..1 each; 0 for a map without walls.
    """
    considered, doubled = _count(fused > 0)
    if not considered:
        return 0.0, 0.0
    share = int(np.count_nonzero(doubled)) / considered
    for walls, box in inputs:
        _take_doubled(doubled, walls, box)
    return share, int(np.count_nonzero(doubled)) / considered


def _take_doubled(doubled: B8, known: B8, box: CellBox) -> None:
    """Clear doubled cells near doubled walls of an input, in place."""
    for tile, wide in _tiles(doubled.shape):
        left = doubled[tile.slices()]
        if left.any() and (walls := wide.cut(known, box, False)).any():
            asked = wide.cut(left, tile, False)
            left &= ~_grown(_doubled(walls, _grown(asked))[1])[tile.slices(wide)]


def _grown(cells: B8) -> B8:
    """Return the cells dilated by two steps along rows and columns."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    grown = cv2.dilate(np.ascontiguousarray(cells).view(np.uint8), cross, iterations=2)
    return np.asarray(grown).view(np.bool_)


def _count(walls: B8) -> tuple[int, B8]:
    """Return the number of wall cells without specks, and the doubled ones."""
    considered, doubled = 0, np.zeros(walls.shape, dtype=np.bool_)
    for tile, wide in _tiles(walls.shape):
        own = walls[tile.slices()]
        if own.any():
            asked = wide.cut(np.ones_like(own), tile, False)
            # The margin is wide enough that groups cut by its edge do not matter.
            kept, marks = _doubled(walls[wide.slices()], asked)
            considered += int(np.count_nonzero(kept))
            doubled[tile.slices()] = marks[tile.slices(wide)]
    return considered, doubled


def _doubled(walls: B8, asked: B8) -> tuple[B8, B8]:
    """Return which of the asked (H, W) cells are walls, and which of these are doubled."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(walls.astype(np.uint8), connectivity=8)
    is_large = np.asarray(stats)[:, cv2.CC_STAT_AREA] >= LEAST_GROUP
    is_large[0] = False
    walls = is_large[labels]
    kept = walls & asked
    doubled = np.zeros_like(kept)
    rows, cols = np.nonzero(kept)
    drawn = walls.astype(np.float32)
    angles = _Normals(drawn)
    angle = angles.at(rows, cols)
    for side in (0.0, math.pi):
        ways = np.stack([np.sin(angle + side), np.cos(angle + side)])
        # Half a cell further, the ray is inside the other wall.
        steps = _next_wall(drawn, np.stack([rows, cols]), ways)
        rays = np.flatnonzero(steps)
        hits = np.stack([rows, cols])[:, rays] + (steps[rays] + 1) / STEPS_PER_CELL * ways[:, rays]
        hit_rows, hit_cols = np.floor(hits + 0.5).astype(np.intp)
        turn = angles.at(hit_rows, hit_cols) - angle[rays]
        is_parallel = np.abs(np.cos(turn)) >= math.cos(math.radians(PARALLEL_DEG))
        doubled[rows[rays[is_parallel]], cols[rays[is_parallel]]] = True
    return kept, doubled


class _Normals:
    """Directions across walls by the structure tensor; ``drawn`` is (H, W), 1 at a wall."""

    def __init__(self, drawn: F32) -> None:
        smooth = _smoothed(drawn, SMOOTH_CELLS)
        gx, gy = (
            cv2.Sobel(smooth, cv2.CV_32F, *way, borderType=cv2.BORDER_CONSTANT)
            for way in ((1, 0), (0, 1))
        )
        products = np.stack([gx * gx, gy * gy, gx * gy])
        self._tensor = [_smoothed(product, WINDOW_CELLS) for product in products]

    def at(self, rows: npt.NDArray[np.intp], cols: npt.NDArray[np.intp]) -> F32:
        """Return angles from the x axis at cells, radians; NaN without a clear direction."""
        height, width = self._tensor[0].shape
        inside = np.clip(rows, 0, height - 1), np.clip(cols, 0, width - 1)
        jxx, jyy, jxy = (part[inside] for part in self._tensor)
        cosine, sine, energy = jxx - jyy, 2.0 * jxy, jxx + jyy
        is_clear = (energy > 0.0) & (np.hypot(cosine, sine) >= LEAST_COHERENCE * energy)
        return np.where(is_clear, 0.5 * np.arctan2(sine, cosine), np.float32(np.nan))


def _smoothed(values: F32, sigma: float) -> F32:
    size = 2 * math.ceil(3.5 * sigma) + 1
    blurred = cv2.GaussianBlur(values, (size, size), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, dtype=np.float32)


def _next_wall(drawn: F32, cells: npt.NDArray[np.intp], ways: F32) -> I64:
    """Walk along rays to the next wall.

    Args:
        drawn: (H, W), 1 at a wall.
        cells: (2, N) rows and columns of the starts, on a wall.
        ways: (2, N) unit vectors; NaN is skipped.

    Returns:
        (N,) number of half-cell steps; 0 if there is none.
    """
    from scipy import ndimage  # noqa: PLC0415 - slow to load

    # Steps from the last sample on the own wall to one still on it, and to the first of another;
    # one cell less, since walls reach half a cell beyond centres.
    most_own = math.ceil((NEAR - 1.0) * STEPS_PER_CELL) - 1
    most_other = math.floor((FAR - 1.0) * STEPS_PER_CELL)
    found, own_end = np.zeros((2, cells.shape[1]), dtype=np.int64)
    goes_on = np.isfinite(ways[0])
    for step in range(1, int(2 * FAR * STEPS_PER_CELL) + 1):
        rays = np.flatnonzero(goes_on)
        if rays.size == 0:
            break
        places = cells[:, rays] + step / STEPS_PER_CELL * ways[:, rays]
        level = ndimage.map_coordinates(drawn, places, order=1, mode="constant", prefilter=False)
        width = step - own_end[rays]
        is_own = (level >= WALL_LEVEL) & (width <= most_own)
        is_other = (level >= WALL_LEVEL) & ~is_own & (width <= most_other)
        own_end[rays[is_own]] = step
        found[rays[is_other]] = step
        width = step - own_end[rays]
        is_thick = own_end[rays] > FAR * STEPS_PER_CELL
        goes_on[rays] = ~is_other & ~is_thick & (width < (FAR - 1.0) * STEPS_PER_CELL)
    return found


def _tiles(shape: tuple[int, int]) -> Iterator[tuple[CellBox, CellBox]]:
    """Yield the tiles of an array, each with its margin."""
    whole = CellBox(0, 0, *shape)
    for tile in whole.tiles(TILE_CELLS):
        yield tile, tile.grown_inside(2 * math.ceil(FAR) + FILTERS_CELLS, whole)
