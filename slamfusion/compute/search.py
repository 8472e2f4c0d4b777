"""Search: what rigid motions of one grid onto another are worth, and how to refine the best.

``kernels/search.cl`` computes the same on an OpenCL device: whole numbers bit for bit,
``refine_terms`` in float32, which agrees to a stated tolerance.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from slamfusion.compute.arrays import F32, F64, I32, I64, ArrayDevice, DeviceArray, host
from slamfusion.compute.lattice import fixed_cells, narrow_motions
from slamfusion.compute.layout import (
    COUNT_TERMS,
    DISTANCE_ONE,
    DISTANCE_UNSEEN,
    REFINE_TERMS,
    SHIFT_LANES,
    SHIFT_POINTS,
    SHIFT_ROWS,
    SHIFT_TILE,
    UNKNOWN,
)

if TYPE_CHECKING:
    from slamfusion.compute.opencl import OpenCLDevice


class ScoredSide(NamedTuple):
    """Walls of one map on a field of the other.

    Attributes:
        points: (N, 2) int32 lattice positions, x and y in half cells.
        poses: (P, 4) int64 fixed poses, points to field.
        field: (H, W) uint8 on the device.
        base: worth of a point off the field.
    """

    points: I32
    poses: I64
    field: DeviceArray[np.uint8]
    base: int


class FitSide(NamedTuple):
    """Walls of one map on the distances of the other.

    Attributes:
        points: (N, 2) float32 on the device, cells.
        poses: (P, 4) float32 cos, sin, x, y (cells), points to field.
        distance: (H, W) uint16 on the device, to the nearest wall in 1/256 cell; a point that reads
            a cell of ``DISTANCE_UNSEEN`` counts for nothing.
    """

    points: DeviceArray[np.float32]
    poses: F32
    distance: DeviceArray[np.uint16]


# Points, cells and rows that one work item sums; the host adds the sums.
CHUNK_POINTS = 64


CHUNK_SCORED = 512


CHUNK_CELLS = 4096


CHUNK_ROWS = 16


# Points that `pose_scores` moves at once; its rows of points start at multiples of it.
POINT_LANES = 8


def _half_open(spans: I32, point: int) -> tuple[int, int, int, int]:
    """Return the shifts, from and to, at which a point is read."""
    r0, r1, c0, c1 = (int(value) for value in spans[point // SHIFT_POINTS])
    return max(0, r0), max(0, r1 + 1), max(0, c0), max(0, c1 + 1)


def _pose_scores(side: ScoredSide) -> I64:
    """Return (P,) the sum of the field over the points under each pose of one side."""
    field = np.asarray(side.field)
    height, width = field.shape
    out = np.zeros(len(side.poses), dtype=np.int64)
    near, narrow, shift = narrow_motions(side.points, side.poses)
    x2, y2 = near[:, 0].astype(np.int64), near[:, 1].astype(np.int64)
    for p, (cos, sin, x, y) in enumerate(narrow.astype(np.int64)):
        col, row = (cos * x2 - sin * y2 + x) >> shift, (sin * x2 + cos * y2 + y) >> shift
        inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
        known = field[row[inside], col[inside]]
        out[p] = known.sum(dtype=np.int64) + side.base * (len(side.points) - len(known))
    return out


def _side_terms(side: FitSide, scales: F32, centre: tuple[float, float], *, backward: bool) -> F64:
    """Return the normal equations of the points of one side."""
    points, distance = np.asarray(side.points), np.asarray(side.distance)
    poses = side.poses
    height, width = distance.shape
    cells = distance / float(DISTANCE_ONE)
    out = np.zeros((len(poses), REFINE_TERMS))
    for p, (cosine, sine, tx, ty) in enumerate(poses.astype(np.float64)):
        scale = float(scales[p])
        px, py = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        qx, qy = cosine * px - sine * py + tx, sine * px + cosine * py + ty
        col = np.floor(qx - 0.5).astype(np.int64)
        row = np.floor(qy - 0.5).astype(np.int64)
        inside = (col >= 0) & (row >= 0) & (col + 1 < width) & (row + 1 < height)
        px, py, qx, qy = px[inside], py[inside], qx[inside], qy[inside]
        col, row = col[inside], row[inside]
        corners = np.stack([distance[row + i, col + j] for i in (0, 1) for j in (0, 1)])
        seen = corners.max(axis=0, initial=0) < DISTANCE_UNSEEN
        px, py, qx, qy = px[seen], py[seen], qx[seen], qy[seen]
        col, row = col[seen], row[seen]
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


def _start_scores(device: OpenCLDevice, side: ScoredSide) -> DeviceArray[np.int32]:
    """Start to score one side; return (chunks, P) sums, one row for each chunk of points."""
    count, n = len(side.points), len(side.poses)
    chunks = -(-count // CHUNK_SCORED)
    stride = -(-count // POINT_LANES) * POINT_LANES
    planes = np.zeros((2, stride), np.int32)
    near, narrow, shift = narrow_motions(side.points, side.poses)
    planes[:, :count] = near.T
    partial = device.empty((chunks, n), np.int32)
    device.launch(
        "pose_scores", (chunks * n,), device.upload(planes), count, stride, device.upload(narrow),
        n, shift, side.field, *side.field.shape, side.base, CHUNK_SCORED, chunks, partial,
    )  # fmt: skip
    return partial


class SearchDevice(ArrayDevice):
    """A device that scores motions."""

    def confusion(self, a: DeviceArray[np.int8], b: DeviceArray[np.int8]) -> I64:
        """Return (3, 3) int64 joint counts of two trinary grids; the index is value + 1."""
        if self.opencl:
            chunks = -(-a.size // CHUNK_CELLS)
            partial = self.opencl.empty((chunks, 9), np.int32)
            self.opencl.launch("confusion", (chunks,), a, b, a.size, CHUNK_CELLS, partial)
            return np.asarray(self.download(partial).sum(axis=0, dtype=np.int64)).reshape(3, 3)
        a, b = host(a), host(b)
        index = 3 * (a.astype(np.int64) + 1) + (b + 1)
        return np.bincount(index.ravel(), minlength=9).reshape(3, 3).astype(np.int64)

    def squared_error(
        self, a: DeviceArray[np.int8], b: DeviceArray[np.int8], poses: I64, stride: int
    ) -> I64:
        """Return the [F16] squared error of the moving grid under each pose.

        Args:
            a: (H, W) int8 reference in {-1, 0, 1}. b: (h, w) int8 moving; off it counts as unknown.
            poses: (P, 4) int64 fixed poses, reference lattice to moving lattice.
            stride: only every stride-th row and column of the reference counts.

        Returns:
            (P,) int64.
        """
        if self.opencl:
            chunks = -(-a.shape[0] // (stride * CHUNK_ROWS))
            partial = self.opencl.empty((len(poses), chunks), np.int32)
            self.opencl.launch(
                "squared_error", (chunks, len(poses)), a, *a.shape, b, *b.shape,
                self.upload(poses), len(poses), stride, CHUNK_ROWS, chunks, partial,
            )  # fmt: skip
            return np.asarray(self.download(partial).sum(axis=1, dtype=np.int64))
        a, b = host(a), host(b)
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
            other = np.full(own.shape, UNKNOWN, dtype=np.int64)
            other[inside] = b[row[inside], col[inside]]
            out[p] = np.sum((own - other) ** 2)
        return out

    def correlate(
        self,
        fields: DeviceArray[np.uint8],
        offsets: I32,
        shift_shape: tuple[int, int],
        spans: I32,
        base: int,
    ) -> DeviceArray[np.int32]:
        """Return the sum over points of the field at point plus shift, for every whole-cell shift.

        Args:
            fields: (K or 1, FH, FW) uint8, values 0..15.
            offsets: (K or 1, N) int32, ``row * FW + col`` of each point; every shift stays inside.
            shift_shape: (SH, SW), SW a multiple of ``SHIFT_LANES``.
            spans: (K, G, 4) int32 for each ``SHIFT_POINTS`` points the first and last row and the
                first and last column of the shifts at which any of them reads something else than
                ``base``; see ``shift_spans``.
            base: what is read elsewhere.

        Returns:
            (K, SH, SW) int32.
        """
        if self.opencl:
            planes, field_height, field_width = fields.shape
            count = max(planes, len(offsets))
            height, width = shift_shape
            sums = self.opencl.empty((count, height, width), np.int32)
            points = offsets.shape[1]
            field_stride = field_height * field_width if planes > 1 else 0
            offset_stride = points if len(offsets) > 1 else 0
            self.opencl.launch(
                "correlate", (width // SHIFT_LANES, -(-height // SHIFT_ROWS), count), fields,
                field_stride, field_width, self.upload(offsets), offset_stride, points,
                self.upload(spans), base, height, width, count, sums,
            )  # fmt: skip
            return sums
        fields = host(fields)
        count = max(len(fields), len(offsets))
        height, width = shift_shape
        scores = np.zeros((count, height, width), dtype=np.int32)
        field_width = fields.shape[2]
        for k in range(count):
            field = fields[k if len(fields) > 1 else 0]
            own = offsets[k if len(offsets) > 1 else 0]
            scores[k] = base * len(own)
            for n, offset in enumerate(own):
                row, col = divmod(int(offset), field_width)
                r0, r1, c0, c1 = _half_open(spans[k], n)
                part = field[row : row + height, col : col + width][r0:r1, c0:c1]
                scores[k, r0:r1, c0:c1] += part.astype(np.int32) - base
        return scores

    def bound_blocks(
        self,
        blocks: I32,
        starts: DeviceArray[np.int32],
        field: DeviceArray[np.uint8],
        least: int = -1,
    ) -> I32:
        """Return the sum over points of a pooled field at the block's first shift.

        Args:
            blocks: (B, 3) int32: yaw group, row and column of the first shift.
            starts: (G, 2, N) int32: rows, then columns of the points' windows for shift 0.
            field: (H, W) uint8; outside counts as 0.
            least: a sum at or below it is of no use.

        Returns:
            (B,) int32; -1 where the sum is of no use.
        """
        if self.opencl:
            return self.opencl.launch_into(
                np.empty(len(blocks), dtype=np.int32), "bound_blocks", (len(blocks),),
                self.opencl.wrap_host(blocks), len(blocks), starts, starts.shape[2], field,
                *field.shape, least,
            )  # fmt: skip
        starts, field = host(starts), host(field)
        height, width = field.shape
        out = np.zeros(len(blocks), dtype=np.int32)
        for b, (group, row0, col0) in enumerate(blocks):
            row, col = starts[group, 0] + row0, starts[group, 1] + col0
            inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
            out[b] = field[row[inside], col[inside]].sum(dtype=np.int32)
        return np.where(out > least, out, np.int32(-1))

    def tile_peaks(
        self, forward: DeviceArray[np.int32], backward: DeviceArray[np.int32], width: int
    ) -> tuple[I32, I32]:
        """Return the best of each tile of shifts of ``forward`` plus reversed ``backward``.

        Args:
            forward: (K, SH, SW) int32 from 0 to 2^26; only the first ``width`` columns count.
            backward: same shape, read at (SH - 1 - i, width - 1 - j).

        Returns:
            values: (K, TY, TX) int32 by tiles of ``SHIFT_TILE`` a side, and places: same shape,
            ``i * width + j``; first of equals wins.
        """
        if self.opencl:
            count, height, stride = forward.shape
            tiles_y, tiles_x = -(-height // SHIFT_TILE), -(-width // SHIFT_TILE)
            best = self.opencl.empty((count, tiles_y, tiles_x), np.int32)
            where = self.opencl.empty((count, tiles_y, tiles_x), np.int32)
            sizes = (height, width, stride, count, tiles_y, tiles_x)
            size = (-(-width // (2 * SHIFT_TILE)), tiles_y, count)
            self.opencl.launch("tile_peaks", size, forward, backward, *sizes, best, where)
            return self.download(best), self.download(where)
        forward, backward = host(forward), host(backward)
        tile = SHIFT_TILE
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
        self,
        points: I32,
        poses: I64,
        field: DeviceArray[np.uint8],
        distance2: DeviceArray[np.uint16],
        free_cell: DeviceArray[np.uint8],
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
        if self.opencl:
            count, n = len(points), len(poses)
            chunks = -(-count // CHUNK_POINTS)
            partial = self.opencl.empty((n, chunks, COUNT_TERMS), np.int32)
            height, width = field.shape
            sizes = (height, width, base, near2, far2, CHUNK_POINTS, chunks)
            self.opencl.launch(
                "pose_counts", (chunks, n), self.upload(points), count, self.upload(poses), n,
                field, distance2, free_cell, *sizes, partial,
            )  # fmt: skip
            return np.asarray(self.download(partial).sum(axis=1, dtype=np.int64))
        field, distance2, free_cell = host(field), host(distance2), host(free_cell)
        height, width = field.shape
        out = np.zeros((len(poses), COUNT_TERMS), dtype=np.int64)
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

    def pose_scores(self, *sides: ScoredSide) -> list[I64]:
        """Return of each side (P,) the sum of its field over its points under each of its poses.

        In 32 bits: see ``narrow_motions``.
        """
        if self.opencl:
            # All are started before the first is waited for.
            started = [_start_scores(self.opencl, side) for side in sides]
            return [np.asarray(self.download(sums).sum(axis=0, dtype=np.int64)) for sums in started]
        return [_pose_scores(side) for side in sides]

    def refine_terms(
        self, forward: FitSide, backward: FitSide, *, scales: F32, centre: tuple[float, float]
    ) -> F64:
        """Return the normal equations of a robust point-to-wall fit, one row per pose.

        The unknown is a small motion (dx, dy, dyaw) of the reference frame about ``centre``,
        applied after the pose. The residual is the bilinear distance to the nearest wall, its
        weight Geman and McClure's 1 / (1 + (d / scale)^2)^2.

        Args:
            scales: (P,) float32 of each pose, cells.
            centre: x and y in cells of the reference.

        Returns:
            (P, 10) float64, of both sides: Hxx Hxy Hxt Hyy Hyt Htt, gx gy gt, sum of weights.
        """
        if self.opencl:
            n = len(forward.poses)
            sides, chunks = [], []
            for side in (forward, backward):
                count = side.points.shape[0]
                poses = self.upload(side.poses)
                sides += [side.points, count, poses, side.distance, *side.distance.shape]
                chunks.append(-(-count // CHUNK_POINTS))
            partial = self.opencl.empty((sum(chunks), n, REFINE_TERMS), np.float32)
            self.opencl.launch(
                "refine_terms", (sum(chunks), n), *sides, n, self.upload(scales), *centre,
                CHUNK_POINTS, chunks[0], sum(chunks), partial,
            )  # fmt: skip
            parts = self.download(partial)
            ahead, back = parts[: chunks[0]], parts[chunks[0] :]
            return np.asarray(
                ahead.sum(axis=0, dtype=np.float64) + back.sum(axis=0, dtype=np.float64)
            )
        ahead = _side_terms(forward, scales, centre, backward=False)
        return ahead + _side_terms(backward, scales, centre, backward=True)
