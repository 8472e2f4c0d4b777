"""Doubled walls: cells of a wall that has another one, parallel, close before or behind it.

From each wall cell a ray goes along the wall's normal to either side. It first crosses its own
wall and then looks for the next one. The normal is the main direction of the structure tensor.
All is in whole numbers, so that every device marks the same cells.

``kernels/doubled_walls.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import I32, I64, U8, ArrayDevice
from slamfusion.compute.layout import (
    BLUR_RADIUS,
    COHERENCE_PART,
    COHERENCE_WHOLE,
    LEAST_GROUP,
    NORMAL_BLOCK,
    NORMAL_SHIFT,
    PARALLEL,
    PRODUCT_SHIFT,
    RAY_SHIFT,
    TENSOR_SHIFT,
    WALL_LEVEL,
    WEIGHT_SHIFT,
    WINDOW_RADIUS,
)

# The mark of a doubled wall.
DOUBLED = 2


BLUR_SIGMA_CELLS = 1.0


WINDOW_SIGMA_CELLS = 2.5


STEPS_PER_CELL = 2


class RaySteps(NamedTuple):
    """How far rays go, in steps of half a cell.

    Attributes:
        total: steps of a ray.
        own: most steps from the last sample on the own wall to one that is on it, too.
        other: most steps from there to the first sample of another wall.
        gap: most steps from there at which a ray goes on.
        thickness: most steps from the start to the last sample on the own wall.
    """

    total: int
    own: int
    other: int
    gap: int
    thickness: int

    @classmethod
    def of(cls, near: float, far: float) -> RaySteps:
        """Return the steps for other walls at a distance.

        Args:
            near: least cells from the last cell of the own wall to the first of the other; one
                less in free width, since both walls reach half a cell beyond their centres.
            far: most cells likewise, and the greatest thickness of the own wall.
        """
        return cls(
            total=int(2 * far * STEPS_PER_CELL),
            own=math.ceil((near - 1.0) * STEPS_PER_CELL) - 1,
            other=math.floor((far - 1.0) * STEPS_PER_CELL),
            gap=math.ceil((far - 1.0) * STEPS_PER_CELL) - 1,
            thickness=math.floor(far * STEPS_PER_CELL),
        )


def blur_weights() -> I32:
    """Return the weights that smooth walls before their gradient is taken, see ``_gaussian``."""
    return _gaussian(BLUR_SIGMA_CELLS, BLUR_RADIUS)


def window_weights() -> I32:
    """Return the weights of the structure tensor's window, see ``_gaussian``."""
    return _gaussian(WINDOW_SIGMA_CELLS, WINDOW_RADIUS)


def pad_walls(cells: U8, steps: RaySteps) -> tuple[U8, tuple[slice, slice]]:
    """Return cells with a free border that no ray leaves, and where in it they lie.

    The border is two blocks wide or more: one of these has normals, since a ray may end a cell
    beyond the walls. Both sides are a whole number of blocks.
    """
    blocks = max(2, math.ceil((steps.total / STEPS_PER_CELL + 3) / NORMAL_BLOCK))
    border = blocks * NORMAL_BLOCK
    height, width = cells.shape
    padded = np.zeros(
        [-(-size // NORMAL_BLOCK) * NORMAL_BLOCK + 2 * border for size in cells.shape], np.uint8
    )
    inner = slice(border, border + height), slice(border, border + width)
    padded[inner] = cells
    return padded, inner


@cache
def _gaussian(sigma: float, radius: int) -> I32:
    """Return (2 radius + 1,) int32 weights of a Gaussian that add up to 2^WEIGHT_SHIFT."""
    weight = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    whole: I32 = np.rint(weight / weight.sum() * (1 << WEIGHT_SHIFT)).astype(np.int32)
    whole[radius] += (1 << WEIGHT_SHIFT) - int(whole.sum())
    whole.flags.writeable = False
    return whole


Tensor = tuple[I32, I32, I32]


ONE = np.ones(1, dtype=np.int32)


def _without_specks(walls: U8) -> U8:
    """Return the walls without small groups of connected cells."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        np.ascontiguousarray(walls), connectivity=8
    )
    is_wall = np.asarray(stats)[:, cv2.CC_STAT_AREA] >= LEAST_GROUP
    is_wall[0] = False
    return np.asarray(is_wall[labels], dtype=np.uint8)


def _structure_tensor(walls: U8) -> Tensor:
    """Return the structure tensor around each cell: xx, yy and xy, x along columns; (H, W) each."""
    blur, window = blur_weights(), window_weights()
    # Below 2^24 whole numbers are exact as float32.
    smooth = _rounded(_filtered(walls, blur, blur, depth=cv2.CV_32F), WEIGHT_SHIFT)
    slope, across = np.array([-1, 0, 1]), np.array([1, 2, 1])
    gx = _filtered(smooth, slope, across, depth=cv2.CV_32F)
    gy = _filtered(smooth, across, slope, depth=cv2.CV_32F)
    jxx, jyy, jxy = (
        _rounded(
            _filtered(_rounded(_filtered(product, window), WEIGHT_SHIFT), down=window), TENSOR_SHIFT
        )
        for product in (_rounded(part, PRODUCT_SHIFT) for part in (gx * gx, gy * gy, gx * gy))
    )
    return jxx, jyy, jxy


def _filtered(
    values: U8 | I32, along: I64 | I32 = ONE, down: I64 | I32 = ONE, *, depth: int = cv2.CV_64F
) -> I32:
    """Return sums weighted along rows and down columns; 0 outside.

    Args:
        values: (H, W) whole numbers below 2^24.
        along, down: weights, an odd number each.
        depth: in what cv2 adds; whole numbers must be exact in it.
    """
    weights = (along.astype(np.float64), down.astype(np.float64))
    source = values.astype(np.float32)
    sums = cv2.sepFilter2D(source, depth, *weights, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(sums).astype(np.int32)


def _rounded(values: I32, shift: int) -> I32:
    """Return whole numbers divided by a power of two, halves rounded up."""
    return (values + (1 << (shift - 1))) >> shift


def _normals(tensor: Tensor, rows: I64, cols: I64) -> tuple[I64, I64]:
    """Return the unit normals (x along columns, y along rows) at cells, in 1/2^NORMAL_SHIFT.

    Coherence is (l1 - l2) / (l1 + l2) of the structure tensor's eigenvalues: 1 along a straight
    wall, 0 where all directions are equal. Below the least one both parts are 0. The normal is at
    half the angle of (jxx - jyy, 2 jxy); the greater part comes from a root, the other from it.
    """
    jxx, jyy, jxy = (part[rows, cols].astype(np.int64) for part in tensor)
    cosine, sine, energy = jxx - jyy, 2 * jxy, jxx + jyy
    squared = cosine * cosine + sine * sine
    is_wall = (energy > 0) & (COHERENCE_WHOLE * squared >= COHERENCE_PART * energy * energy)
    length = np.where(is_wall, _root(squared), 1)
    lean = np.where(is_wall, np.abs(cosine), 0)
    greater = _root(((length + lean) << (2 * NORMAL_SHIFT - 1)) // length)
    least = (np.abs(sine) << (2 * NORMAL_SHIFT - 1)) // np.maximum(length * greater, 1)
    nx, ny = np.where(cosine >= 0, (greater, least), (least, greater))
    ny = np.where(sine < 0, -ny, ny)
    return np.where(is_wall, nx, 0), np.where(is_wall, ny, 0)


def _root(values: I64) -> I64:
    """Return the whole part of square roots."""
    root = np.sqrt(values.astype(np.float64)).astype(np.int64)
    root -= root * root > values
    root += (root + 1) * (root + 1) <= values
    return root


def _next_wall(
    corners: U8, start: I64, step: tuple[I64, I64], steps: RaySteps
) -> tuple[npt.NDArray[np.intp], I64]:
    """Walk from each wall cell along its normal to the beginning of the next wall.

    Args:
        corners: (H, W) uint8, see ``_corners``.
        start: (N,) places of the cells in it.
        step: x and y of a step of half a cell, (N,) each, in 1/2^RAY_SHIFT cell.
        steps: how far.

    Returns:
        (K,) which of the rays meet one, and (K,) the number of the step.
    """
    cell, (step_x, step_y) = start, step
    rays = np.arange(cell.size)
    own_end = np.zeros(cell.size, dtype=np.int64)
    hits, hits_at = [rays[:0]], [own_end[:0]]
    for number in range(1, steps.total + 1):
        on_wall = _samples(corners, cell, (number * step_x, number * step_y))
        width = number - own_end
        is_own = on_wall & (width <= steps.own)
        is_other = on_wall & ~is_own & (width <= steps.other)
        own_end[is_own] = number
        hits.append(rays[is_other])
        hits_at.append(np.full(hits[-1].size, number))
        goes_on = ~is_other & (number - own_end <= steps.gap) & (own_end <= steps.thickness)
        if not goes_on.any():
            break
        rays, own_end, cell, step_x, step_y = (
            part[goes_on] for part in (rays, own_end, cell, step_x, step_y)
        )
    return np.concatenate(hits), np.concatenate(hits_at)


def _corners(walls: U8) -> U8:
    """Return which of a cell and the next ones along x, y and both are walls: bits 0 to 3."""
    corners = walls.copy()
    corners[:, :-1] |= walls[:, 1:] << 1
    corners[:-1] |= walls[1:] << 2
    corners[:-1, :-1] |= walls[1:, 1:] << 3
    return corners


def _samples(corners: U8, cell: I64, offset: tuple[I64, I64]) -> npt.NDArray[np.bool_]:
    """Return whether walls interpolated at offsets, in 1/2^RAY_SHIFT cell, count as wall, (N,).

    Args:
        corners: see ``_corners``.
        cell: (N,) places in it.
        offset: along x and along y, (N,) each.
    """
    at = cell + (offset[1] >> RAY_SHIFT) * corners.shape[1] + (offset[0] >> RAY_SHIFT)
    around = corners.ravel()[at]
    on_wall: npt.NDArray[np.bool_] = around != 0
    # Only where something is near.
    some = np.flatnonzero(on_wall)
    one = 1 << RAY_SHIFT
    u, v = offset[0][some] & (one - 1), offset[1][some] & (one - 1)
    walls = [(around[some] >> corner & 1).astype(np.int64) for corner in range(4)]
    lower = (one - u) * walls[0] + u * walls[1]
    upper = (one - u) * walls[2] + u * walls[3]
    on_wall[some] = (one - v) * lower + v * upper >= WALL_LEVEL
    return on_wall


class DoubledWallDevice(ArrayDevice):
    """A device that marks doubled walls."""

    def mark_doubled(self, walls: U8, asked: U8, steps: RaySteps) -> U8:
        """Say which of the cells asked about are walls, and which of these are doubled.

        Groups of fewer than ``LEAST_GROUP`` connected cells (8 neighbours) are no walls. A ray goes
        from a wall cell along its normal, with a sample each half cell. Samples at most
        ``steps.own`` after the last on the own wall are on it too; the first later one, within
        ``steps.other``, is of another wall. The cell is doubled where that wall, half a cell
        further, is parallel within 20 degrees. Cells around which no direction prevails have no
        normal, and are not doubled.

        Args:
            walls: (H, W) uint8, 1 at a wall, 0 elsewhere; none outside.
            asked: (H, W) uint8, not 0 at the cells asked about.
            steps: how far rays go.

        Returns:
            (H, W) uint8: 0 no wall or not asked about, 1 a wall, 2 a doubled wall.

        Source: structure tensor and coherence as in Bigun and Granlund, "Optimal orientation
        detection
            of linear symmetry", ICCV 1987.
        """
        if self.opencl:
            cells, inner = pad_walls(walls, steps)
            height, width = cells.shape
            size = (width // NORMAL_BLOCK, height)
            given = self.upload(cells)
            walled = self.opencl.empty(cells.shape, np.uint8)
            self.opencl.launch("drop_specks", size, given, height, width, walled)
            normals = self.opencl.empty((height, width, 2), np.int16)
            weights = self.opencl.table(blur_weights()), self.opencl.table(window_weights())
            blocks = (width // NORMAL_BLOCK, height // NORMAL_BLOCK)
            self.opencl.launch("wall_normals", blocks, walled, height, width, *weights, normals)
            # The walls as they were given are of no more use.
            corners = given
            self.opencl.launch("wall_corners", size, walled, height, width, corners)
            marks = self.upload(pad_walls(asked, steps)[0])
            self.opencl.launch("mark_doubled", size, corners, normals, height, width, *steps, marks)
            return np.ascontiguousarray(self.download(marks)[inner])
        marks = np.zeros(walls.shape, dtype=np.uint8)
        kept = _without_specks(walls)
        is_asked = (kept != 0) & (asked != 0)
        if not is_asked.any():
            return marks
        marks[is_asked] = 1
        padded, inner = pad_walls(kept, steps)
        tensor = _structure_tensor(padded)
        rows, cols = np.nonzero(is_asked)
        y, x = rows + inner[0].start, cols + inner[1].start
        nx, ny = _normals(tensor, y, x)
        corners = _corners(padded)
        for side in (1, -1):
            rays = np.flatnonzero((nx != 0) | (ny != 0))
            step_x, step_y = side * nx[rays], side * ny[rays]
            hits, at = _next_wall(
                corners, y[rays] * padded.shape[1] + x[rays], (step_x, step_y), steps
            )
            rays, step_x, step_y = rays[hits], step_x[hits], step_y[hits]
            # Half a cell further the ray is inside the other wall.
            half = 1 << (RAY_SHIFT - 1)
            hit_x = x[rays] + (((at + 1) * step_x + half) >> RAY_SHIFT)
            hit_y = y[rays] + (((at + 1) * step_y + half) >> RAY_SHIFT)
            hit_nx, hit_ny = _normals(tensor, hit_y, hit_x)
            is_parallel = np.abs(hit_nx * step_x + hit_ny * step_y) >= PARALLEL
            marks[rows[rays][is_parallel], cols[rays][is_parallel]] = DOUBLED
        return marks
