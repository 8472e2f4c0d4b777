"""Search: what rigid motions of one grid onto another are worth, and how to refine the best.

``kernels/search.cl`` computes the same on an OpenCL device: whole numbers bit for bit,
``fit_motions`` in float32, which agrees to a stated tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from slamfusion.compute.arrays import ArrayDevice, DeviceArray, host
from slamfusion.compute.lattice import PointPlanes, cells_at, fixed_cells, narrow_motions, narrowed
from slamfusion.compute.layout import (
    CLIMBERS,
    DISTANCE_ONE,
    DISTANCE_UNSEEN,
    FIELD_ONE,
    FIXED_TO_CELL_SHIFT,
    FREE,
    NEIGHBOURS,
    SHIFT_LANES,
    SHIFT_POINTS,
    SHIFT_TILE,
    UNKNOWN,
)
from slamfusion.geometry import F64, I32, I64, U16

if TYPE_CHECKING:
    from slamfusion.compute.opencl import OpenCLDevice


class ShiftedSide(NamedTuple):
    """Walls of one map on coarse fields of the other, at every whole-cell shift, for K yaws.

    Attributes:
        fields: (K or 1, FH, FW) uint8 on the device, values 0..15.
        offsets: (K or 1, N) int32, ``row * FW + col`` of each point at the first shift.
        spans: (K, G, 4) int32 for each ``SHIFT_POINTS`` points the first and last row and the first
            and last column of the shifts at which any of them reads something else than ``base``;
            see ``shift_spans``.
        base: what is read elsewhere.
    """

    fields: DeviceArray[np.uint8]
    offsets: I32
    spans: I32
    base: int


class ScoredSide(NamedTuple):
    """Walls of one map on a field of the other.

    Attributes:
        points: of walls.
        motions: (4, P) whole numbers in Q30, points to field, as the columns of ``fixed_poses``;
            for ``neighbour_scores`` (6, P), with x and y in the field of a step along x.
        field: (H, W) uint8 on the device.
        base: worth of a point off the field.
    """

    points: PointPlanes
    motions: F64
    field: DeviceArray[np.uint8]
    base: int


class CountedSide(NamedTuple):
    """Walls of one map on the other.

    Attributes:
        points: (N, 2) int32 on the device, lattice positions, x and y in half cells.
        motions: (4, P) as of ``ScoredSide``.
        cells: (H, W) int8 on the device, in {-1, 0, 1}.
        distance2: (H, W) uint16 on the device, squared cells to the nearest wall.
    """

    points: DeviceArray[np.int32]
    motions: F64
    cells: DeviceArray[np.int8]
    distance2: DeviceArray[np.uint16]


class FitSide(NamedTuple):
    """Walls of one map on the distances of the other.

    Attributes:
        points: (N, 2) float32 on the device, cells.
        distance: (H, W) uint16 on the device, to the nearest wall in 1/256 cell; a point that reads
            a cell of ``DISTANCE_UNSEEN`` counts for nothing.
    """

    points: DeviceArray[np.float32]
    distance: DeviceArray[np.uint16]


# Points that one work item sums; the host adds the sums.
CHUNK_POINTS, CHUNK_SCORED = 64, 512
# Of a fit: times the sum of weights added to the matrix; the step, cells, that ends a round.
FIT_DAMPING, FIT_SETTLED = 1e-3, 0.02
# Of a neighbour along each axis, and along x and y of the ``NEIGHBOURS``.
STEPS = (0, -1, 1)
NEIGHBOUR_STEPS = [(x, y) for x in STEPS for y in STEPS]


def _shifted_sums(side: ShiftedSide, count: int, shape: tuple[int, int]) -> I32:
    """Return (K, H, W) the sum over points of the field at point plus shift, for every shift."""
    fields, (height, width) = host(side.fields), shape
    sums = np.full((count, *shape), side.base * side.offsets.shape[1], dtype=np.int32)
    for k in range(count):
        field = fields[k if len(fields) > 1 else 0]
        for n, offset in enumerate(side.offsets[k if len(side.offsets) > 1 else 0]):
            row, col = divmod(int(offset), field.shape[1])
            # The shifts, from and to, at which the point is read.
            r0, r1, c0, c1 = np.maximum(side.spans[k, n // SHIFT_POINTS] + (0, 1, 0, 1), 0)
            part = field[row : row + height, col : col + width][r0:r1, c0:c1]
            sums[k, r0:r1, c0:c1] += part.astype(np.int32) - side.base
    return sums


def _narrow_scores(side: ScoredSide, motions: F64, drop: int) -> I32:
    """Return (P,) the sum of the field over the points under moved motions (4, P), in 32 bits."""
    field, shift = host(side.field), FIXED_TO_CELL_SHIFT - drop
    out = np.zeros(motions.shape[1], dtype=np.int32)
    x2, y2 = host(side.points.planes)[:, : side.points.count].astype(np.int64)
    for p, (cos, sin, x, y) in enumerate(narrowed(motions, drop).T.astype(np.int64)):
        col, row = (cos * x2 - sin * y2 + x) >> shift, (sin * x2 + cos * y2 + y) >> shift
        out[p] = cells_at(field, row, col, side.base).sum(dtype=np.int64)
    return out


def _pose_counts(side: CountedSide, worths: U16, base: int, limits2: Sequence[int]) -> I64:
    """Return what one side meets; see ``SearchDevice.pose_counts``."""
    cells, distance2 = host(side.cells), host(side.distance2)
    height, width = cells.shape
    limits = np.array(limits2, dtype=np.int64)[:, None]
    out = np.zeros((side.motions.shape[1], 2 + 2 * len(limits2)), dtype=np.int64)
    x2, y2 = host(side.points).T.astype(np.int64)
    for p, pose in enumerate(side.motions.T.astype(np.int64)):
        row, col = fixed_cells(pose, x2, y2)
        inside = (row >= 0) & (col >= 0) & (row < height) & (col < width)
        at = row[inside], col[inside]
        is_near, is_free = distance2[at] <= limits, cells[at] == FREE
        worth = worths[distance2[at]].astype(np.int64)
        worth = base + (worth & 255) - is_free * (worth >> 8)
        away = base * (len(x2) - len(worth))
        out[p, :2] = np.clip(worth, 0, FIELD_ONE).sum() + away, np.sum(cells[at] != UNKNOWN)
        out[p, 2:] = [*is_near.sum(axis=1), *(~is_near & is_free).sum(axis=1)]
    return out


def _fitted(
    sides: tuple[FitSide, FitSide], motion: F64, scales: F64, iterations: int, pivot: F64
) -> tuple[float, float, float]:
    """Return how one motion (4,) moves; see ``SearchDevice.fit_motions``."""
    centre, reach = complex(*pivot[:2]), float(pivot[2])
    turned, at = complex(*motion[:2]), complex(*motion[2:]) - centre
    moved, turn = 0j, 0.0
    for scale in scales:
        for _ in range(iterations):
            rotation = np.exp(1j * turn)
            there = rotation * turned, rotation * at + centre + moved
            back = there[0].conjugate(), -there[0].conjugate() * there[1]
            matrix, gradient, weight = _side_terms(sides[0], *there, scale, pivot, backward=False)
            more = _side_terms(sides[1], *back, scale, pivot, backward=True)
            damping = FIT_DAMPING * max(1.0, weight + more[2])
            damped = matrix + more[0] + damping * np.eye(3)
            step = -np.linalg.solve(damped, gradient + more[1])
            step /= max(1.0, (math.hypot(*step[:2]) + abs(step[2])) / scale)
            moved = moved * np.exp(1j * step[2] / reach) + complex(*step[:2])
            turn += step[2] / reach
            if np.abs(step).max() < FIT_SETTLED:
                break
    return moved.real, moved.imag, turn


def _side_terms(
    side: FitSide, turned: complex, shift: complex, scale: float, pivot: F64, *, backward: bool
) -> tuple[F64, F64, float]:
    """Return matrix (3, 3), gradient (3,) and sum of weights of the points of one side."""
    points, distance = host(side.points).astype(np.float64) @ (1, 1j), host(side.distance)
    height, width = distance.shape
    cells = distance / float(DISTANCE_ONE)
    mapped = turned * points + shift
    col, row = (np.floor(part - 0.5).astype(np.int64) for part in (mapped.real, mapped.imag))
    inside = (col >= 0) & (row >= 0) & (col + 1 < width) & (row + 1 < height)
    at = row[inside], col[inside]
    corners = np.stack([distance[at[0] + i, at[1] + j] for i in (0, 1) for j in (0, 1)])
    inside[inside] = corners.max(axis=0, initial=0) < DISTANCE_UNSEEN
    points, mapped, col, row = (part[inside] for part in (points, mapped, col, row))
    u, v = mapped.real - 0.5 - col, mapped.imag - 0.5 - row
    d00, d01 = cells[row, col], cells[row, col + 1]
    d10, d11 = cells[row + 1, col], cells[row + 1, col + 1]
    d = (1 - v) * ((1 - u) * d00 + u * d01) + v * ((1 - u) * d10 + u * d11)
    slope = (1 - v) * (d01 - d00) + v * (d11 - d10) + 1j * ((1 - u) * (d10 - d00) + u * (d11 - d01))
    if backward:
        slope, mapped = -slope * turned.conjugate(), points
    arm = (mapped - complex(*pivot[:2])) / pivot[2]
    weight = (1.0 + (d / scale) ** 2) ** -2.0
    along = np.stack((slope.real, slope.imag, (slope * arm.conjugate()).imag))
    return (weight * along) @ along.T, along @ (weight * d), float(weight.sum())


def _scores(
    device: OpenCLDevice, kernel: str, shape: tuple[int, ...], sides: Sequence[ScoredSide]
) -> list[I32]:
    """Launch a kernel for each side, and return its (P, ...) scores."""
    started = []
    for points, motions, field, base in sides:
        moved, drop = narrow_motions(points, motions)
        n, chunks = moved.shape[1], -(-points.count // CHUNK_SCORED)
        partial = device.start_into(
            np.empty((chunks, n, *shape), np.int32), kernel, (chunks * n,), points.planes,
            points.count, points.planes.shape[1], device.upload(moved.astype(np.int64)), n, drop,
            FIXED_TO_CELL_SHIFT - drop, field, *field.shape, base, CHUNK_SCORED, chunks,
        )  # fmt: skip
        started.append(partial)
    # All are started before the first is waited for.
    return [sums().sum(axis=0, dtype=np.int32) for sums in started]


class SearchDevice(ArrayDevice):
    """A device that scores motions."""

    def best_shifts(
        self, ahead: ShiftedSide, back: ShiftedSide, shape: tuple[int, int]
    ) -> tuple[I32, I32]:
        """Return the best of each tile of whole-cell shifts, by the sum of both sides' points.

        Args:
            ahead, back: moving walls on the reference, and walls of the reference on the moving
                map, which moves the other way.
            shape: (H, W) shifts; every shift up to a multiple of ``SHIFT_LANES`` along a row is on
                the fields.

        Returns:
            values: (K, TY, TX) int32 by tiles of ``SHIFT_TILE`` a side, and places: same shape,
            ``i * W + j``; first of equals wins.
        """
        height, width = shape
        count = max(len(ahead.spans), len(back.spans))
        tiles_y, tiles_x = -(-height // SHIFT_TILE), -(-width // SHIFT_TILE)
        if self.opencl:
            given = []
            for fields, offsets, spans, base in (ahead, back):
                planes, field_height, field_width = fields.shape
                points = offsets.shape[1]
                given += [
                    fields, field_height * field_width if planes > 1 else 0, field_width,
                    self.upload(offsets), points if len(offsets) > 1 else 0, points,
                    self.upload(spans), base,
                ]  # fmt: skip
            best = self.opencl.empty((count, tiles_y, tiles_x), np.int32)
            where = self.opencl.empty((count, tiles_y, tiles_x), np.int32)
            self.opencl.launch(
                "best_shifts", (-(-width // SHIFT_LANES), tiles_y, count), *given, height, width,
                tiles_y, tiles_x, count, best, where,
            )  # fmt: skip
            return self.download(best), self.download(where)
        total = _shifted_sums(ahead, count, shape) + _shifted_sums(back, count, shape)
        tile = SHIFT_TILE
        margins = ((0, 0), (0, tiles_y * tile - height), (0, tiles_x * tile - width))
        tiles = np.pad(total, margins, constant_values=-1)
        tiles = tiles.reshape(count, tiles_y, tile, tiles_x, tile).swapaxes(2, 3)
        tiles = tiles.reshape(count, tiles_y, tiles_x, tile * tile)
        first = tiles.argmax(axis=3)
        row = np.arange(tiles_y)[:, None] * tile + first // tile
        places = row * width + np.arange(tiles_x) * tile + first % tile
        return tiles.max(axis=3), places.astype(np.int32)

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
        out = np.zeros(len(blocks), dtype=np.int32)
        for b, (group, row0, col0) in enumerate(blocks):
            row, col = starts[group, 0] + row0, starts[group, 1] + col0
            out[b] = cells_at(field, row, col, 0).sum(dtype=np.int32)
        return np.where(out > least, out, np.int32(-1))

    def pose_counts(
        self, *sides: CountedSide, worths: U16, base: int, limits2: Sequence[int] = ()
    ) -> list[I64]:
        """Return what the points of each side meet under each of its motions.

        Args:
            worths, base: the worth of a point, as of ``score_field``, or ``base`` off the map.
            limits2: up to ``LIMITS_MAX`` squared distances in cells.

        Returns:
            (P, 2 + 2 L) int64: worth, points on known cells, for each limit the points no farther
            from a wall, and for each limit the points in free space that are farther.
        """
        if not self.opencl:
            return [_pose_counts(side, worths, base, limits2) for side in sides]
        started, given = [], self.upload(np.array([*limits2, 0], dtype=np.int32))
        table = self.opencl.table(worths)
        for points, motions, cells, distance2 in sides:
            poses = motions.T.astype(np.int64)
            n, count = len(poses), points.shape[0]
            chunks = -(-count // CHUNK_POINTS)
            partial = self.opencl.start_into(
                np.empty((n, chunks, 2 + 2 * len(limits2)), np.int32), "pose_counts", (chunks, n),
                points, count, self.upload(poses), n, cells, distance2,
                *cells.shape, table, base, given, len(limits2), CHUNK_POINTS, chunks,
            )  # fmt: skip
            started.append(partial)
        return [np.asarray(part().sum(axis=1, dtype=np.int64)) for part in started]

    def pose_scores(self, *sides: ScoredSide) -> list[I32]:
        """Return of each side (P,) the sum of its field over its points under each of its motions.

        In 32 bits: see ``narrow_motions``.
        """
        if self.opencl:
            return _scores(self.opencl, "pose_scores", (), sides)
        return [_narrow_scores(side, *narrow_motions(side.points, side.motions)) for side in sides]

    def neighbour_scores(self, *sides: ScoredSide) -> list[I32]:
        """Return of each side (P, 9) the scores of its motions, shifted by ``NEIGHBOUR_STEPS``.

        As ``pose_scores`` of nine times as many motions, of which nine share a turn.
        """
        if self.opencl:
            return _scores(self.opencl, "neighbour_scores", (NEIGHBOURS,), sides)
        found = []
        for side in sides:
            (cos, sin, x, y, a, b), drop = narrow_motions(side.points, side.motions)
            stepped = (
                np.stack((cos, sin, x + i * a - j * b, y + i * b + j * a))
                for i, j in NEIGHBOUR_STEPS
            )
            found.append(np.stack([_narrow_scores(side, each, drop) for each in stepped], axis=1))
        return found

    def start_fit(
        self,
        forward: FitSide,
        backward: FitSide,
        motions: F64,
        scales: F64,
        iterations: int,
        pivot: tuple[float, float, float],
    ) -> Callable[[], F64]:
        """Start to move motions to the nearest best fit of both sides' points on the other's walls.

        The residual of a point is the bilinear distance to the nearest wall, its weight Geman and
        McClure's 1 / (1 + (d / scale)^2)^2. Each damped Gauss-Newton step is a small motion
        of the reference frame about the pivot, applied after the motion.

        Args:
            motions: (4, P) cos, sin, x, y (cells), moving points to the reference.
            scales: (R, P) of each round and motion, cells; no step is longer.
            iterations: steps of a round; one below ``FIT_SETTLED`` ends it.
            pivot: x and y in cells of the reference, and the radius at which a turn is counted.

        Returns:
            A function that waits for the fit, and returns (P, 3) float64: dx, dy (cells) and dyaw
            (rad) about the pivot, of all steps.
        """
        rounds, n = scales.shape
        if self.opencl:
            sides = [
                part
                for points, distance in (forward, backward)
                for part in (points, points.shape[0], distance, *distance.shape)
            ]
            given = [self.upload(part.astype(np.float32)) for part in (motions, scales)]
            started = self.opencl.start_into(
                np.empty((n, 3), np.float32), "fit_motions", (n * CLIMBERS,), *sides, n, *given,
                rounds, iterations, *pivot, FIT_DAMPING, FIT_SETTLED,
            )  # fmt: skip
            return lambda: started().astype(np.float64)
        moved = [
            _fitted((forward, backward), motion, widths, iterations, np.array(pivot))
            for motion, widths in zip(motions.T, scales.T, strict=True)
        ]
        return lambda: np.array(moved).reshape(n, 3)
