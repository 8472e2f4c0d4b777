"""Make of a true map what another SLAM would have saved of the same place, transform known."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.config import NormalizeConfig
from slamfusion.errors import GridError
from slamfusion.geometry import Pose2, fit_motion
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid, trinary_cells

# Side of the blocks in which walls gain or lose their cell on the same side.
THICKNESS_BLOCK = 12
# Rows rendered at a time: few enough to stay in the cache.
BAND_ROWS = 64


@dataclass(frozen=True)
class Degradation:
    """What happens to a true map; the defaults change nothing but the rendering.

    Attributes:
        yaw_rad: turn of the returned pose (degraded frame into truth frame), any angle.
        shift_share: x and y by which the place's centre moves in the degraded frame, in units of
            the longer side of the truth's known box; -0.5..0.5 is "up to half the map".
        resample: render onto a lattice of its own, turned and shifted by part of a cell. When
            false the truth's cells are kept and the whole motion goes into the origin.
        origin_yaw_rad: yaw of the rendered map's origin in its own frame; its lattice is turned
            by this on top of ``yaw_rad``. Needs ``resample``.
        resolution: metres per rendered cell; None keeps the truth's. Needs ``resample``.
        bend_cells: amplitude of a smooth warp of the walls, in cells of the truth. Needs
            ``resample``.
        crop_share: share of the known cells that is kept, 0..1; a straight cut in a random
            direction takes the rest.
        wall_change_cells: cells by which walls get thicker (positive) or thinner (negative);
            a wall of one cell never gets thinner.
        flip_share: share of the known cells that turn from free to occupied or back, 0..1.
        speckle_share: share of the free cells that become unknown, 0..1.
        margin_share: share of the map's area that is added as an unknown margin, 0 up to 0.95;
            at 0 the map ends where its known cells end.
    """

    yaw_rad: float = 0.0
    shift_share: tuple[float, float] = (0.0, 0.0)
    resample: bool = True
    origin_yaw_rad: float = 0.0
    resolution: float | None = None
    bend_cells: float = 0.0
    crop_share: float = 1.0
    wall_change_cells: int = 0
    flip_share: float = 0.0
    speckle_share: float = 0.0
    margin_share: float = 0.0


def degrade_map(
    truth_grid: OccupancyGrid, rng: np.random.Generator, degradation: Degradation
) -> tuple[OccupancyGrid, Pose2]:
    """Make a faulty map of the place that ``truth_grid`` shows, in a frame of its own.

    Args:
        truth_grid: any occupancy grid; at or above 65 % is wall, at or below 25 % free.
        rng: source of cuts, flips, speckles, margins and the warp.
        degradation: how much of each fault.

    Returns:
        The map (cells -1, 0 or 100), and the pose that maps a point of its map frame into the
        truth's map frame, metres. With a warp the pose is the rigid motion that brings the bent
        walls nearest to the true ones in the least-squares sense.

    Raises:
        GridError: the truth has no known cell.
    """
    truth = trinary(truth_grid)
    box = truth.known_box
    if box is None:
        raise GridError(f"{truth.name}: every cell is unknown; nothing to degrade")
    truth = _cut(truth, rng, degradation.crop_share)
    pose = _motion(truth_grid, box, degradation)

    if degradation.resample:
        grid, pose = _render(truth, pose, rng, degradation)
    else:
        origin = pose.inverse().compose(truth.origin)
        grid = OccupancyGrid(truth.cells, truth.resolution, origin, truth.name)

    cells = _change_walls(grid.cells, degradation.wall_change_cells).copy()
    flipped = _some(cells != UNKNOWN, rng, degradation.flip_share)
    cells[flipped] = np.where(cells[flipped] == OCCUPIED, FREE, OCCUPIED)
    cells[_some(cells == FREE, rng, degradation.speckle_share)] = UNKNOWN
    grid = OccupancyGrid(cells, grid.resolution, grid.origin, grid.name)
    return _with_margin(grid, rng, degradation.margin_share), pose


def trinary(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the grid with cells -1, 0 and 100 alone."""
    classes = trinary_cells(grid.cells, NormalizeConfig())
    cells = np.where(classes == 1, np.int8(OCCUPIED), classes)
    return replace(grid, cells=cells)


def _motion(truth: OccupancyGrid, box: CellBox, degradation: Degradation) -> Pose2:
    """Return the pose of the degraded frame in the truth frame, turned about the box's centre."""
    middle = np.array([(box.col0 + box.col1) / 2, (box.row0 + box.row1) / 2]) * truth.resolution
    centre_x, centre_y = (float(value) for value in truth.origin.transform(middle))
    side = max(box.height, box.width) * truth.resolution
    shift_x, shift_y = degradation.shift_share
    turn_there = Pose2(centre_x, centre_y, degradation.yaw_rad)
    return turn_there.compose(Pose2(-centre_x - shift_x * side, -centre_y - shift_y * side))


def _cut(truth: OccupancyGrid, rng: np.random.Generator, share: float) -> OccupancyGrid:
    """Keep the given share of the known cells: those on one side of a random straight line."""
    angle = float(rng.uniform(-math.pi, math.pi))
    if share >= 1.0:
        return truth
    rows, cols = np.nonzero(truth.cells != UNKNOWN)
    along = cols * math.cos(angle) + rows * math.sin(angle)
    beyond = along > np.quantile(along, share)
    cells = truth.cells.copy()
    cells[rows[beyond], cols[beyond]] = UNKNOWN
    return OccupancyGrid(cells, truth.resolution, truth.origin, truth.name)


IndexArray = tuple[npt.NDArray[np.intp], ...]
XY = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]


@dataclass(frozen=True)
class _Warp:
    """A smooth displacement field on the truth's own axes, in cells: sums of two plane waves."""

    amplitude: float
    waves: npt.NDArray[np.float64]  # (4, 3): wave numbers kx, ky in rad/cell, phase in rad

    def displacement(self, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> XY:
        """Return how far the place under each point has moved, x and y in cells."""
        waves = [np.sin(kx * x + ky * y + phase) for kx, ky, phase in self.waves]
        half = self.amplitude / 2
        return half * (waves[0] + waves[1]), half * (waves[2] + waves[3])


def _draw_warp(rng: np.random.Generator, amplitude: float, side: int) -> _Warp:
    """Draw waves of one half to one and a half periods over the map."""
    periods = rng.uniform(0.5, 1.5, size=4)
    angles = rng.uniform(-math.pi, math.pi, size=4)
    phases = rng.uniform(-math.pi, math.pi, size=4)
    number = 2 * math.pi * periods / side
    waves = np.stack((number * np.cos(angles), number * np.sin(angles), phases), axis=1)
    return _Warp(amplitude, waves)


def _render(
    truth: OccupancyGrid, pose: Pose2, rng: np.random.Generator, degradation: Degradation
) -> tuple[OccupancyGrid, Pose2]:
    """Draw the truth on the degraded map's own lattice, walls without holes.

    Each cell looks at a few points of itself, at most half a truth cell apart: occupied when one
    of them is, otherwise free when half of them are, otherwise unknown.
    """
    resolution = degradation.resolution or truth.resolution
    warp = _draw_warp(rng, degradation.bend_cells, max(truth.cells.shape))

    # The lattice: multiples of the resolution along the turned axes, as far as the walls reach.
    axes = Pose2(0.0, 0.0, degradation.origin_yaw_rad)
    rows, cols = np.nonzero(truth.cells != UNKNOWN)
    lattice_from_truth = axes.inverse().compose(pose.inverse())
    known = lattice_from_truth.transform(truth.cell_centres(rows, cols)) / resolution
    reach = (1 + 2 * warp.amplitude) * truth.resolution / resolution
    first = np.floor(known.min(axis=0) - reach)
    count = np.ceil(known.max(axis=0) + reach) - first
    width, height = int(count[0]), int(count[1])
    corner = axes.transform(first * resolution)
    origin = Pose2(float(corner[0]), float(corner[1]), degradation.origin_yaw_rad)

    # From the new lattice's axes to the truth's, both in cells of the truth.
    to_truth = truth.origin.inverse().compose(pose).compose(origin).scaled(1 / truth.resolution)
    ratio = resolution / truth.resolution
    points = max(2, math.ceil(2 * ratio))
    parts = (np.arange(points) + 0.5) / points
    bordered = np.pad(truth.cells, 1, constant_values=UNKNOWN)
    cells = np.full((height, width), UNKNOWN, dtype=np.int8)
    for row0 in range(0, height, BAND_ROWS):
        band = cells[row0 : row0 + BAND_ROWS]
        rows_here = row0 + np.arange(band.shape[0])
        occupied = np.zeros(band.shape, dtype=bool)
        free_votes = np.zeros(band.shape, dtype=np.int16)
        for row_part, col_part in itertools.product(parts, parts):
            y, x = (rows_here + row_part) * ratio, (np.arange(width) + col_part) * ratio
            values = _sample(bordered, to_truth, x, y, warp)
            occupied |= values == OCCUPIED
            free_votes += values == FREE
        band[2 * free_votes >= points * points] = FREE
        band[occupied] = OCCUPIED
    grid = OccupancyGrid(cells, resolution, origin, truth.name)
    return grid, _rigid_part(truth, warp).compose(pose)


def _sample(
    bordered: npt.NDArray[np.int8],
    to_truth: Pose2,
    x_cols: npt.NDArray[np.float64],
    y_rows: npt.NDArray[np.float64],
    warp: _Warp,
) -> npt.NDArray[np.int8]:
    """Return the truth's cells under the points (x, y) of a lattice; unknown outside.

    Args:
        bordered: the truth's cells with one row or column of unknown ones on each side.
        to_truth: lattice axes to the truth's axes, in cells of the truth.
        x_cols: x of each column's points on the lattice's axes, in cells of the truth.
        y_rows: y of each row's points, likewise.
        warp: added on the truth's axes.
    """
    cos, sin = math.cos(to_truth.yaw_rad), math.sin(to_truth.yaw_rad)
    x = np.add.outer(to_truth.x - sin * y_rows, cos * x_cols)
    y = np.add.outer(to_truth.y + cos * y_rows, sin * x_cols)
    if warp.amplitude > 0:
        moved_x, moved_y = warp.displacement(x, y)
        x += moved_x
        y += moved_y
    height, width = bordered.shape
    col = np.clip(x + 1, 0, width - 1).astype(np.intp)
    row = np.clip(y + 1, 0, height - 1).astype(np.intp)
    values: npt.NDArray[np.int8] = bordered.ravel()[row * width + col]
    return values


def _rigid_part(truth: OccupancyGrid, warp: _Warp) -> Pose2:
    """Return the rigid motion of the map frame that best undoes the warp over the walls."""
    rows, cols = np.nonzero(truth.cells == OCCUPIED)
    if warp.amplitude <= 0 or rows.size < 2:
        return Pose2()
    true = np.stack((cols + 0.5, rows + 0.5), axis=-1)
    bent = true.copy()
    for _ in range(5):  # bent + displacement(bent) = true, by fixed point
        bent = true - np.stack(warp.displacement(bent[:, 0], bent[:, 1]), axis=-1)
    bent, true = (np.insert(places, 2, 0.0, axis=1) for places in (bent, true))
    own = fit_motion(bent, true).scaled(truth.resolution)
    return truth.origin.compose(own).compose(truth.origin.inverse())


def _change_walls(cells: npt.NDArray[np.int8], change: int) -> npt.NDArray[np.int8]:
    """Make walls thicker or thinner by whole cells, on alternating sides.

    One cell more or less on the same side everywhere would move all walls by half a cell and
    with them the true transform; the side changes from block to block instead.
    """
    rows, cols = np.indices(cells.shape)
    block = (rows // THICKNESS_BLOCK + cols // THICKNESS_BLOCK) % 2 == 0
    for _ in range(abs(change)):
        walls = cells == OCCUPIED
        if change > 0:
            square = np.ones((2, 2), dtype=bool)
            lower = scipy.ndimage.binary_dilation(walls, square, origin=0)
            upper = scipy.ndimage.binary_dilation(walls, square, origin=-1)
            cells = np.where(np.where(block, lower, upper), np.int8(OCCUPIED), cells)
        else:
            left = walls & ~(block & _peel(walls))
            left &= ~(~block & _peel(left[::-1, ::-1])[::-1, ::-1])
            beside_free = scipy.ndimage.binary_dilation(cells == FREE)
            bared = np.where(beside_free, np.int8(FREE), np.int8(UNKNOWN))
            cells = np.where(walls & ~left, bared, cells)
    return cells


def _peel(walls: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the wall cells of one side that may go without opening a hole.

    Source: Zhang and Suen, A fast parallel algorithm for thinning digital patterns, 1984, the
    first sub-iteration; its neighbours p2 to p9 run clockwise from the row above.
    """
    padded = np.pad(walls, 1).astype(np.int8)
    height, width = walls.shape
    steps = ((0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0))
    ring = [padded[row : row + height, col : col + width] for row, col in steps]
    count = np.sum(ring, axis=0)
    rises = np.sum(
        [(here == 0) & (after == 1) for here, after in zip(ring, ring[1:] + ring[:1], strict=True)],
        axis=0,
    )
    p2, p4, p6, p8 = ring[0], ring[2], ring[4], ring[6]
    edge = (p2 * p4 * p6 == 0) & (p4 * p6 * p8 == 0)
    peeled: npt.NDArray[np.bool_] = walls & (count >= 2) & (count <= 6) & (rises == 1) & edge
    return peeled


def _some(where: npt.NDArray[np.bool_], rng: np.random.Generator, share: float) -> IndexArray:
    """Return the places of a share of the cells that are marked."""
    marked = np.flatnonzero(where)
    return np.unravel_index(
        rng.choice(marked, size=round(share * marked.size), replace=False), where.shape
    )


def _with_margin(grid: OccupancyGrid, rng: np.random.Generator, share: float) -> OccupancyGrid:
    """Crop to the known cells, then add unknown ones until they are ``share`` of the area."""
    box = grid.known_box
    if box is None:
        return grid
    growth = 1.0 / math.sqrt(1.0 - share)
    height, width = round(box.height * growth), round(box.width * growth)
    row0 = box.row0 - int(rng.integers(0, height - box.height + 1))
    col0 = box.col0 - int(rng.integers(0, width - box.width + 1))
    return grid.crop(CellBox(row0, col0, row0 + height, col0 + width))
