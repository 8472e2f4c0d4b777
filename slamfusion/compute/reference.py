"""The NumPy twins: each function here defines what the kernel of the same name computes.

Written for clarity. Integer results equal the kernels' exactly; ``refine_terms`` is float32 on the
device and float64 here, and agrees to a stated tolerance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

__all__ = [
    "DISTANCE2_MAX",
    "DISTANCE_MAX",
    "MOST_INPUTS",
    "Votes",
    "bound_blocks",
    "cast_rays",
    "confusion",
    "correlate",
    "distance_squared",
    "fixed_cells",
    "fixed_poses",
    "look_up",
    "max_window",
    "polyphase",
    "pose_counts",
    "refine_terms",
    "score_field",
    "shrink",
    "solid_walls",
    "squared_error",
    "surface_walls",
    "tile_peaks",
    "vote_log_odds",
    "vote_majority",
    "vote_weighted",
    "warp",
]

U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
I8 = npt.NDArray[np.int8]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

DISTANCE_MAX = 64
DISTANCE2_MAX = DISTANCE_MAX**2
FIXED_ONE = 1 << 30
SPECK_FREE_CELLS = 7
# Squared distance to distance in 1/256 cell.
DISTANCE_TABLE = np.rint(256.0 * np.sqrt(np.arange(DISTANCE2_MAX + 1))).astype(np.uint16)
MOST_INPUTS = 32
# A ray with a smaller cosine runs along the cells' edges.
SMALLEST_COSINE = 1e-9


def fixed_poses(poses: npt.ArrayLike) -> I64:
    """Return poses as the kernels' fixed-point motions.

    Args:
        poses: (N, 3) float, x and y in cells, yaw in rad; maps cells of one lattice to another.

    Returns:
        (N, 4) int64: cos and sin in Q30, x and y in Q30 half cells.
    """
    array = np.atleast_2d(np.asarray(poses, dtype=np.float64))
    columns = (np.cos(array[:, 2]), np.sin(array[:, 2]), 2.0 * array[:, 0], 2.0 * array[:, 1])
    return np.asarray(np.rint(np.stack(columns, axis=1) * FIXED_ONE), dtype=np.int64)


def fixed_cells(pose: I64, x2: I64, y2: I64) -> tuple[I64, I64]:
    """Return (row, col) of lattice positions (half cells) after one fixed pose; exact."""
    x = pose[0] * x2 - pose[1] * y2 + pose[2]
    y = pose[1] * x2 + pose[0] * y2 + pose[3]
    return y >> 31, x >> 31


def _free_neighbours(cells: I8) -> U8:
    """Return (H, W) uint8, how many of a cell's 8 neighbours are free; outside is unknown."""
    kernel = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)
    count: U8 = ndimage.convolve((cells == 0).astype(np.uint8), kernel, mode="constant")
    return count


def solid_walls(cells: I8) -> U8:
    """Return (H, W) uint8, 1 where an occupied cell has at most six free ones among its neighbours.

    With seven or eight it stands in free space alone, or beside one other: a speck of noise.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
    """
    solid = (cells == 1) & (_free_neighbours(cells) < SPECK_FREE_CELLS)
    return np.asarray(solid, dtype=np.uint8)


def surface_walls(cells: I8, solid: U8) -> U8:
    """Return (H, W) uint8, 1 where a solid wall cell has a free one among its 8 neighbours.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
        solid: (H, W) uint8, 1 at the wall cells that count.
    """
    surface = (solid != 0) & (_free_neighbours(cells) > 0)
    return np.asarray(surface, dtype=np.uint8)


def shrink(walls: U8, cells: I8, step: int) -> tuple[U8, U8]:
    """Return walls and free share on a grid of ``step`` x ``step`` blocks.

    Args:
        walls: (H, W) uint8, 0 or 1.
        cells: (H, W) int8 in {-1, 0, 1}.
        step: cells per block side; blocks over the edge count missing cells as unknown.

    Returns:
        wall: (h, w) uint8, 1 where any wall of the block is; free: (h, w) uint8, share 0..255.
    """
    height, width = cells.shape
    rows, cols = -(-height // step), -(-width // step)
    pad = ((0, rows * step - height), (0, cols * step - width))
    wall = np.pad(walls, pad).reshape(rows, step, cols, step).max(axis=(1, 3))
    free = np.pad(cells == 0, pad).reshape(rows, step, cols, step).sum(axis=(1, 3))
    return wall.astype(np.uint8), (free * 255 // (step * step)).astype(np.uint8)


def distance_squared(walls: U8, reach: int = DISTANCE_MAX) -> U16:
    """Return (H, W) uint16, squared distance in cells to the nearest wall, at most reach squared.

    Args:
        walls: (H, W) uint8, 0 or 1.
        reach: cells, 1 to 64; farther walls count as this far.
    """
    if not walls.any():
        return np.full(walls.shape, reach**2, dtype=np.uint16)
    _, (rows, cols) = ndimage.distance_transform_edt(walls == 0, return_indices=True)
    own_rows, own_cols = np.indices(walls.shape)
    squared = (rows - own_rows) ** 2 + (cols - own_cols) ** 2
    return np.asarray(np.minimum(squared, reach**2), dtype=np.uint16)


def score_field(distance2: U16, free_share: U8, hit: U16, miss: U16, base: int) -> U8:
    """Return what a wall point of the other map is worth in each cell, 0..255.

    Args:
        distance2: (H, W) uint16 from ``distance_squared``.
        free_share: (H, W) uint8, 0..255.
        hit, miss: (4097,) uint16, by squared distance.
        base: worth of a cell that says nothing.
    """
    value = base + hit[distance2].astype(np.int32)
    value -= free_share.astype(np.int32) * miss[distance2] // 255
    return np.clip(value, 0, 255).astype(np.uint8)


def max_window(field: U8, window: int, *, along_rows: bool, fill: int) -> U8:
    """Return the largest of the ``window`` cells that start at each cell; outside counts as fill.

    Args:
        field: (H, W) uint8.
        window: cells, at least 1.
        along_rows: over columns of one row; otherwise over rows of one column.
        fill: value outside the field, 0..255.
    """
    axis = 1 if along_rows else 0
    pad = [(0, 0), (0, 0)]
    pad[axis] = (0, window - 1)
    padded = np.pad(field, pad, constant_values=fill)
    views = np.lib.stride_tricks.sliding_window_view(padded, window, axis=axis)
    best: U8 = views.max(axis=-1)
    return best


def warp(cells: I8, poses: I64, shape: tuple[int, int], fill: int) -> I8:
    """Return the grid resampled by nearest cell under each pose.

    Args:
        cells: (H, W) int8 (or uint8).
        poses: (K, 4) int64 fixed poses, output lattice to input lattice.
        shape: (h, w) of the output.
        fill: value outside the input.

    Returns:
        (K, h, w), dtype of ``cells``.
    """
    height, width = cells.shape
    y2, x2 = np.meshgrid(
        2 * np.arange(shape[0], dtype=np.int64) + 1,
        2 * np.arange(shape[1], dtype=np.int64) + 1,
        indexing="ij",
    )
    out = np.full((len(poses), *shape), fill, dtype=cells.dtype)
    for k, pose in enumerate(poses):
        row, col = fixed_cells(pose, x2, y2)
        inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
        out[k][inside] = cells[row[inside], col[inside]]
    return out


def confusion(a: I8, b: I8) -> I64:
    """Return (3, 3) int64 joint counts of two trinary grids of one shape; index is value + 1."""
    index = 3 * (a.astype(np.int64) + 1) + (b + 1)
    return np.bincount(index.ravel(), minlength=9).reshape(3, 3).astype(np.int64)


def squared_error(a: I8, b: I8, poses: I64, stride: int) -> I64:
    """Return the [F16] squared error of the moving grid under each pose.

    Args:
        a: (H, W) int8 reference in {-1, 0, 1}. b: (h, w) int8 moving; off it counts as unknown.
        poses: (P, 4) int64 fixed poses, reference lattice to moving lattice.
        stride: only every stride-th row and column of the reference counts.

    Returns:
        (P,) int64.
    """
    y2, x2 = np.meshgrid(
        2 * np.arange(0, a.shape[0], stride, dtype=np.int64) + 1,
        2 * np.arange(0, a.shape[1], stride, dtype=np.int64) + 1,
        indexing="ij",
    )
    own = a[::stride, ::stride].astype(np.int64)
    out = np.zeros(len(poses), dtype=np.int64)
    for p, pose in enumerate(poses):
        row, col = fixed_cells(pose, x2, y2)
        inside = (row >= 0) & (col >= 0) & (row < b.shape[0]) & (col < b.shape[1])
        other = np.full(own.shape, -1, dtype=np.int64)
        other[inside] = b[row[inside], col[inside]]
        out[p] = np.sum((own - other) ** 2)
    return out


def correlate(fields: U8, offsets: I32, shift_shape: tuple[int, int]) -> I32:
    """Return the sum over points of the field at point plus shift, for every whole-cell shift.

    Args:
        fields: (K or 1, FH, FW) uint8, values 0..15.
        offsets: (K or 1, N) int32, ``row * FW + col`` of each point; every shift stays inside.
        shift_shape: (SH, SW).

    Returns:
        (K, SH, SW) int32.
    """
    count = max(len(fields), len(offsets))
    height, width = shift_shape
    scores = np.zeros((count, height, width), dtype=np.int32)
    field_width = fields.shape[2]
    for k in range(count):
        field = fields[k if len(fields) > 1 else 0]
        for offset in offsets[k if len(offsets) > 1 else 0]:
            row, col = divmod(int(offset), field_width)
            scores[k] += field[row : row + height, col : col + width]
    return scores


def polyphase(
    field: U8, corner: tuple[int, int], step: int, shape: tuple[int, int], fill: int
) -> U8:
    """Return the field rearranged so that cells ``step`` apart lie side by side.

    Args:
        field: (H, W) uint8.
        corner: row and column of the field where plane (0, 0) starts; may lie outside.
        step: cells between neighbours of a plane.
        shape: rows and columns of each plane.
        fill: value outside the field.

    Returns:
        (step, step, rows, cols) uint8; [a, b, i, j] is cell (corner + (a + step i, b + step j)).
    """
    rows = corner[0] + np.arange(step * shape[0])
    cols = corner[1] + np.arange(step * shape[1])
    inside = (
        ((rows >= 0) & (rows < field.shape[0]))[:, None] & (cols >= 0) & (cols < field.shape[1])
    )
    clipped = field[rows.clip(0, field.shape[0] - 1)][:, cols.clip(0, field.shape[1] - 1)]
    dense = np.where(inside, clipped, np.uint8(fill))
    planes = dense.reshape(shape[0], step, shape[1], step).transpose(1, 3, 0, 2)
    return np.ascontiguousarray(planes)


def bound_blocks(
    blocks: I32, starts: I32, classes: U8, fields: U8, fill: int, *, least: int = -1
) -> I32:
    """Return the sum over points of their pooled field at the block's first shift.

    Args:
        blocks: (B, 3) int32: yaw group, row and column of the first shift.
        starts: (G, 2, N) int32: rows, then columns of the points' windows for shift 0.
        classes: (N,) uint8: the pooled field that a point reads.
        fields: (C, H, W) uint8; outside counts as ``fill``.
        fill: value outside.
        least: a sum at or below it is of no use.

    Returns:
        (B,) int32; -1 where the sum is of no use.
    """
    _, height, width = fields.shape
    out = np.zeros(len(blocks), dtype=np.int32)
    for b, (group, row0, col0) in enumerate(blocks):
        row, col = starts[group, 0] + row0, starts[group, 1] + col0
        inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
        values = fields[classes[inside], row[inside], col[inside]]
        out[b] = values.sum(dtype=np.int32) + fill * np.count_nonzero(~inside)
    return np.where(out > least, out, np.int32(-1))


def tile_peaks(forward: I32, backward: I32, width: int, tile: int) -> tuple[I32, I32]:
    """Return the best of each tile of shifts of ``forward`` plus reversed ``backward``.

    Args:
        forward: (K, SH, SW) int32; only the first ``width`` columns count.
        backward: same shape, read at (SH - 1 - i, width - 1 - j).
        width: shifts along a row.
        tile: shifts per tile side.

    Returns:
        values: (K, TY, TX) int32, and places: same shape, ``i * width + j``; first of equals wins.
    """
    total = forward[:, :, :width] + backward[:, ::-1, width - 1 :: -1]
    count, height, _ = total.shape
    tiles_y, tiles_x = -(-height // tile), -(-width // tile)
    values = np.empty((count, tiles_y, tiles_x), dtype=np.int32)
    places = np.empty_like(values)
    for ty in range(tiles_y):
        for tx in range(tiles_x):
            part = total[:, ty * tile : (ty + 1) * tile, tx * tile : (tx + 1) * tile]
            flat = part.reshape(count, -1)
            best = flat.argmax(axis=1)
            row, col = np.divmod(best, part.shape[2])
            values[:, ty, tx] = flat[np.arange(count), best]
            places[:, ty, tx] = (ty * tile + row) * width + tx * tile + col
    return values, places


def pose_counts(
    points: I32,
    poses: I64,
    field: U8,
    distance2: U16,
    free_cell: U8,
    *,
    base: int,
    near2: int,
    far2: int,
) -> I64:
    """Return what the points meet under each pose.

    Args:
        points: (N, 2) int32 lattice positions, x and y in half cells.
        poses: (P, 4) int64 fixed poses, points to field.
        field: (H, W) uint8 score field; points off it score ``base``.
        distance2: (H, W) uint16. free_cell: (H, W) uint8, 1 where free.
        base: score of a point off the field.
        near2: a point within this squared distance of a wall is a hit.
        far2: a point in free space beyond this squared distance is a clash.

    Returns:
        (P, 4) int64: score, hits, clashes, points on the field.
    """
    height, width = field.shape
    out = np.zeros((len(poses), 4), dtype=np.int64)
    x2, y2 = points[:, 0].astype(np.int64), points[:, 1].astype(np.int64)
    for p, pose in enumerate(poses):
        row, col = fixed_cells(pose, x2, y2)
        inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
        row, col = row[inside], col[inside]
        d2 = distance2[row, col]
        out[p, 0] = field[row, col].sum(dtype=np.int64) + base * (len(points) - len(row))
        out[p, 1] = np.count_nonzero(d2 <= near2)
        out[p, 2] = np.count_nonzero((free_cell[row, col] != 0) & (d2 > far2))
        out[p, 3] = len(row)
    return out


def look_up(values: U16, table: U16) -> U16:
    """Return ``table[values]``.

    Args:
        values: any shape, uint16. table: (M,) uint16, longer than the largest value.
    """
    return np.asarray(table[values], dtype=np.uint16)


def refine_terms(
    points: F32,
    poses: F32,
    distance: U16,
    *,
    scale: float,
    centre: tuple[float, float],
    backward: bool,
) -> F64:
    """Return the normal equations of a robust point-to-wall fit, one row per pose.

    The unknown is a small motion (dx, dy, dyaw) of the reference frame about ``centre``, applied
    after the pose. The residual is the bilinear distance to the nearest wall, its weight Geman and
    McClure's 1 / (1 + (d / scale)^2)^2.

    Args:
        points: (N, 2) float32, cells.
        poses: (P, 4) float32 cos, sin, x, y (cells), points to field.
        distance: (H, W) uint16, to the nearest wall in 1/256 cell.
        scale: cells.
        centre: x and y in cells of the reference.
        backward: points belong to the reference and the field to the moving grid.

    Returns:
        (P, 10) float64: Hxx Hxy Hxt Hyy Hyt Htt, gx gy gt, sum of weights.
    """
    height, width = distance.shape
    cells = distance / 256.0
    out = np.zeros((len(poses), 10))
    for p, (cosine, sine, tx, ty) in enumerate(poses.astype(np.float64)):
        px, py = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        qx, qy = cosine * px - sine * py + tx, sine * px + cosine * py + ty
        col = np.floor(qx - 0.5).astype(np.int64)
        row = np.floor(qy - 0.5).astype(np.int64)
        inside = (col >= 0) & (row >= 0) & (col + 1 < width) & (row + 1 < height)
        px, py, qx, qy = px[inside], py[inside], qx[inside], qy[inside]
        col, row = col[inside], row[inside]
        u, v = qx - 0.5 - col, qy - 0.5 - row
        d00, d01 = cells[row, col], cells[row, col + 1]
        d10, d11 = cells[row + 1, col], cells[row + 1, col + 1]
        d = (1 - v) * ((1 - u) * d00 + u * d01) + v * ((1 - u) * d10 + u * d11)
        gx = (1 - v) * (d01 - d00) + v * (d11 - d10)
        gy = (1 - u) * (d10 - d00) + u * (d11 - d01)
        weight = (1.0 + (d * d) / (scale * scale)) ** -2.0
        ax, ay = qx - centre[0], qy - centre[1]
        if backward:
            gx, gy = -(cosine * gx + sine * gy), -(cosine * gy - sine * gx)
            ax, ay = px - centre[0], py - centre[1]
        gt = gy * ax - gx * ay
        terms = (gx * gx, gx * gy, gx * gt, gy * gy, gy * gt, gt * gt, gx * d, gy * d, gt * d)
        out[p] = [*(float(np.sum(weight * term)) for term in terms), float(np.sum(weight))]
    return out


class Votes(NamedTuple):
    """What a vote gives.

    Attributes:
        fused: (H, W) int8 in {-1, 0, 1}.
        agreement: (H, W) int8, share of the votes for the winner in percent, rounded half up;
            -1 without votes.
        dissent: (P, H, W) uint8, bit n % 8 of plane n // 8 set where input n voted otherwise
            than the winner; P is the number of inputs over 8, rounded up.
        phantom_cells: cells occupied in the fused grid and in no input.
    """

    fused: I8
    agreement: I8
    dissent: U8
    phantom_cells: int


def vote_majority(grids: Sequence[I8], *, unknown_votes: bool) -> Votes:
    """Let each cell be what most inputs say; any tie for first place is occupied.

    Args:
        grids: 1 to 32 of (H, W) int8 in {-1, 0, 1}.
        unknown_votes: unknown is a value like the others; otherwise it abstains, and a cell that
            all inputs leave unknown stays unknown.

    Source: [F16], the vote: two of three decide, three different values give 1.
    """
    return vote_weighted(grids, np.ones(len(grids), dtype=np.int32), unknown_votes=unknown_votes)


def vote_weighted(grids: Sequence[I8], weights: I32, *, unknown_votes: bool) -> Votes:
    """Let each cell be what carries most weight; any tie for first place is occupied.

    Args:
        grids: 1 to 32 of (H, W) int8 in {-1, 0, 1}.
        weights: (N,) int32, 1 to 255.
        unknown_votes: as in ``vote_majority``.
    """
    stack = np.stack(grids)
    amount = weights.astype(np.int32)[:, None, None]
    votes = np.stack([((stack == value) * amount).sum(axis=0) for value in (-1, 0, 1)])
    if not unknown_votes:
        votes[0] = 0
    winner = votes.argmax(axis=0) - 1
    winner[(votes == votes.max(axis=0)).sum(axis=0) > 1] = 1
    winner[votes.sum(axis=0) == 0] = -1
    outvoted = (stack != winner) & ((stack != -1) | unknown_votes)
    wall: npt.NDArray[np.bool_] = np.any(stack == 1, axis=0)
    return _votes(winner, votes, outvoted, wall)


def vote_log_odds(
    grids: Sequence[I8], odds: I32, *, occupied_percent: int, free_percent: int
) -> Votes:
    """Add the log-odds of the inputs; unknown adds nothing.

    An input votes occupied where its log-odds are positive and free where negative, with their
    size as weight. The cell is occupied where the sum reaches the log-odds of
    ``occupied_percent``, free where it is at most that of ``free_percent``. Between the two the
    evidence balances: a tie, occupied, where any input alone is occupied; else unknown.

    Args:
        grids: 1 to 32 of (H, W) int8, occupancy in percent or -1.
        odds: (101,) int32, fixed-point log-odds by percent.
        occupied_percent: an input at or above this is occupied.
        free_percent: below ``occupied_percent``.
    """
    stack = np.stack(grids)
    known = stack >= 0
    side = np.where(known, odds[stack.clip(0)], 0)
    free, occupied = (-side).clip(0).sum(axis=0), side.clip(0).sum(axis=0)
    wall: npt.NDArray[np.bool_] = np.any(stack >= occupied_percent, axis=0)
    total = occupied - free
    winner = np.where(wall, 1, -1)
    winner[total <= odds[free_percent]] = 0
    winner[total >= odds[occupied_percent]] = 1
    winner[~known.any(axis=0)] = -1
    outvoted = np.where(side > 0, winner != 1, (side < 0) & (winner != 0))
    return _votes(winner, np.stack([np.zeros_like(free), free, occupied]), outvoted, wall)


def _votes(
    winner: I64, votes: I32 | I64, outvoted: npt.NDArray[np.bool_], wall: npt.NDArray[np.bool_]
) -> Votes:
    """Return the outcome of a vote.

    Args:
        winner: (H, W) in {-1, 0, 1}.
        votes: (3, H, W), weight of the votes for unknown, free and occupied.
        outvoted: (N, H, W), input n voted otherwise.
        wall: (H, W), some input is occupied.
    """
    cast = votes.sum(axis=0)
    share = np.take_along_axis(votes, (winner + 1)[None], axis=0)[0]
    percent = (200 * share + cast) // np.maximum(2 * cast, 1)
    agreement = np.where(cast > 0, percent, -1).astype(np.int8)
    dissent = np.zeros((-(-len(outvoted) // 8), *winner.shape), dtype=np.uint8)
    for n, mask in enumerate(outvoted):
        dissent[n // 8] |= mask.astype(np.uint8) << np.uint8(n % 8)
    phantom = int(np.count_nonzero((winner == 1) & ~wall))
    return Votes(winner.astype(np.int8), agreement, dissent, phantom)


def ray_table(rays: F32) -> F32:
    """Return rays as the kernel reads them: with the reciprocals that a step multiplies by.

    Args:
        rays: (N, 4) float32: x and y in cells, cos and sin of the direction.

    Returns:
        (N, 6) float32; a cosine too small to divide by counts as 0, its reciprocal as infinite.
    """
    table = np.empty((len(rays), 6), dtype=np.float32)
    table[:, :4] = rays
    tiny = np.abs(table[:, 2:4]) < SMALLEST_COSINE
    table[:, 2:4][tiny] = 0.0
    table[:, 4:] = np.inf
    np.divide(np.float32(1.0), table[:, 2:4], out=table[:, 4:], where=~tiny)
    return table


def cast_rays(cells: U8, rays: F32, reach_cells: float) -> F32:
    """Follow rays through a grid to the first thing they meet, cell by cell.

    A ray that starts in a wall or in glass meets it at distance 0; one that starts off the grid
    may enter it; off the grid is open. A ray through a corner goes on to the next column first.

    Args:
        cells: (H, W) uint8: 0 open, 1 wall, 2 glass.
        rays: (N, 4) float32: x and y in cells (cell [r, c] covers [c, c + 1) x [r, r + 1)), cos
            and sin of the direction, a unit vector.
        reach_cells: rays end after this distance.

    Returns:
        (N, 4) float32: distance in cells to the first wall or glass, infinite for none; its class;
        the cosine between the ray and the normal of the cell edge where it was met (1 where the
        ray starts, 0 for none); distance to the first wall, any glass passed, infinite for none.

    Source: Amanatides and Woo, A fast voxel traversal algorithm for ray tracing, Eurographics 1987.
    """
    x, y, cosine, sine, per_x, per_y = ray_table(rays).T
    start, per = np.stack((x, y)), np.stack((per_x, per_y))
    step = np.sign(np.stack((cosine, sine))).astype(np.int64)
    faces = np.abs(np.stack((cosine, sine)))
    place = np.floor(start).astype(np.int64)
    size = np.array(cells.shape[::-1])[:, None]
    reach = np.float32(reach_cells)

    hits = np.tile(np.array([np.inf, 0.0, 0.0, np.inf], dtype=np.float32), (len(rays), 1))
    t = np.zeros(len(rays), dtype=np.float32)
    face = np.ones(len(rays), dtype=np.float32)
    going = np.flatnonzero(t <= reach)
    while going.size:
        at, steps = place[:, going], step[:, going]
        inside = ((at >= 0) & (at < size)).all(axis=0)
        leaving = (((steps <= 0) & (at < 0)) | ((steps >= 0) & (at >= size))).any(axis=0)
        met = np.zeros(going.size, dtype=np.uint8)
        met[inside] = cells[at[1, inside], at[0, inside]]

        new = (met != 0) & (hits[going, 1] == 0.0)
        hits[going[new], 0] = t[going[new]]
        hits[going[new], 1] = met[new]
        hits[going[new], 2] = face[going[new]]
        hits[going[met == 1], 3] = t[going[met == 1]]

        going = going[(met != 1) & ~leaving]
        ways = step[:, going] != 0
        ahead = (place[:, going] + (step[:, going] > 0)).astype(np.float32) - start[:, going]
        edges = np.full(ahead.shape, np.inf, dtype=np.float32)
        np.multiply(ahead, per[:, going], out=edges, where=ways)
        axis = (edges[0] > edges[1]).astype(np.int64)
        column = np.arange(going.size)
        t[going] = edges[axis, column]
        face[going] = faces[axis, going]
        place[axis, going] += step[axis, going]
        going = going[t[going] <= reach]
    return hits
