"""Scan matching: how well a scan's hits fall on the walls of a tiled map, at many poses.

``kernels/scan_match.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slamfusion.compute.arrays import ArrayDevice, DeviceArray, host
from slamfusion.compute.layout import (
    CLIMBERS,
    FIELD_ONE,
    FOUND_FLOATS,
    HIT_LANES,
    SIXTEENTHS,
    SIXTEENTHS_SHIFT,
    TABLE_LAST,
    TILE,
)
from slamfusion.compute.tiles import FieldWindow, move_points, tile_places
from slamfusion.geometry import F32, F64, I32, I64, U16

# A table of smooth values that changes none.
SAME: I32 = np.arange(TABLE_LAST + 1, dtype=np.int32)
# What moves points in a pose x, y, yaw, cos, sin.
_MOVED = [0, 1, 3, 4]


def _arguments(window: FieldWindow) -> tuple[Any, ...]:
    """Return a window as kernels take it."""
    height, width = window.cells.shape
    return window.cells, *window.first, width, height


def _blend(a: I64, b: I64, c: I64, d: I64, right: I64, up: I64) -> I64:
    """Return the value between cells a, b and c, d above them, by shares in sixteenths."""
    low, high = a * (SIXTEENTHS - right) + b * right, c * (SIXTEENTHS - right) + d * right
    blended: I64 = np.asarray(low * (SIXTEENTHS - up) + high * up, dtype=np.int64)
    return np.asarray(blended >> SIXTEENTHS_SHIFT)


def _split(east: F32, north: F32) -> tuple[I64, I64, I64, I64]:
    """Return row and column of the lower left of four cells around positions, and the shares."""
    east, north = east - np.float32(0.5), north - np.float32(0.5)
    col, row = east.astype(np.int64), north.astype(np.int64)
    right = ((east - col.astype(np.float32)) * np.float32(SIXTEENTHS)).astype(np.int64)
    up = ((north - row.astype(np.float32)) * np.float32(SIXTEENTHS)).astype(np.int64)
    return row, col, right, up


def _smooth_pairs(field: U16, pages: I32, points: F32, poses: F32) -> I64:
    """Return a map of pairs, (PH, PW) pages, under points (P, 2) at poses (N, 4), as _smooth."""
    row, col, right, up = _split(*move_points(points, poses))
    height, width = pages.shape
    row, col = np.clip(row, 0, height * TILE - 1), np.clip(col, 0, width * TILE - 1)
    tile, in_row, in_col = tile_places(pages[None], 0, row, col)
    first, second = (field[tile, in_row, in_col + i].astype(np.int64) for i in (0, 1))
    return _blend(first & 255, second & 255, first >> 8, second >> 8, right, up)


def _smooth(window: FieldWindow, east: F32, north: F32) -> I64:
    """Return the field at positions in cells, between cell centres bilinear in sixteenths."""
    row, col, right, up = _split(east, north)
    cells, first = host(window.cells), window.first
    height, width = cells.shape
    col, row = np.clip(col - first[0], 0, width - 2), np.clip(row - first[1], 0, height - 3)
    a, b, c, d = (cells[row + i, col + j].astype(np.int64) for i in (0, 1) for j in (0, 1))
    return _blend(a, b, c, d, right, up)


def _wide(window: FieldWindow, east: F32, north: F32, reach: int) -> I64:
    """Return the greatest of five cells: under each position, and four ``reach`` away."""
    cells, first = host(window.cells), window.first
    height, width = cells.shape
    col, row = east.astype(np.int64) - first[0], north.astype(np.int64) - first[1]
    around = [(0, 0), (-reach, -reach), (reach, -reach), (-reach, reach), (reach, reach)]
    found = [
        cells[np.clip(row + dy, 0, height - 2), np.clip(col + dx, 0, width - 1)]
        for dx, dy in around
    ]
    return np.asarray(np.max(found, axis=0), dtype=np.int64)


def _losses(poses: F32, hypotheses: F32) -> F32:
    """Return the weighted squared distances of poses x, y, yaw from hypotheses, and their loss."""
    away = poses[..., :3] - hypotheses[..., :3]
    squares = away * away * hypotheses[..., 3:6]
    return np.asarray(((squares[..., 0] + squares[..., 1]) + squares[..., 2]) + hypotheses[..., 6])


def _ways() -> I64:
    """Return (3) signs along x, y and yaw: stay, the axes, the diagonals."""
    axes = [np.roll((sign, 0, 0), axis) for axis in range(3) for sign in (1, -1)]
    diagonals = [(2 * (k & 1) - 1, (k & 2) - 1, (k & 4) // 2 - 1) for k in range(8)]
    return np.array([(0, 0, 0), *axes, *diagonals, (0, 0, 0)], dtype=np.int64)


def upload_hits(points: F32 | F64, device: ArrayDevice) -> DeviceArray[np.float32]:
    """Bring a scan's hits (P, 2), cells, in the robot's frame, to a device; see ``HIT_LANES``."""
    padded = np.zeros((-(-len(points) // HIT_LANES) * HIT_LANES, 2), dtype=np.float32)
    padded[: len(points)] = points
    return device.upload(padded)[: len(points)]


class ScanMatchDevice(ArrayDevice):
    """A device that matches scans.

    On the device stay the ``field``, wall values of all maps: (T, TILE, TILE) uint8, or pairs
    (T, TILE, PAIRS) uint16, see ``hit_counts``; the ``pages`` of one map (PH, PW) or of N maps
    (N, PH, PW), int32, whose border is empty; and the ``points`` of a scan, see ``upload_hits``.
    All else comes from the host.
    """

    def score_poses(
        self, window: FieldWindow, points: DeviceArray[np.float32], poses: F32, *, table: I32 = SAME
    ) -> I64:
        """Sum the smooth score field under a scan's points at each candidate pose.

        Args:
            poses: (N, 4) float32: x, y in cells of the pages, cos, sin.
            table: (256,) int32, what a value between cell centres, in sixteenths, counts.

        Returns:
            (N,) int64 sums.
        """
        if self.opencl:
            n = len(poses)
            sums = self.opencl.launch_into(
                np.empty(n, dtype=np.int32), "score_smooth", (n,), *_arguments(window), points,
                points.shape[0], self.opencl.wrap_host(poses), n, self.opencl.table(table),
            )  # fmt: skip
            return sums.astype(np.int64)
        east, north = move_points(host(points), poses)
        return np.asarray(table[_smooth(window, east, north)].sum(axis=1, dtype=np.int64))

    def search(
        self,
        window: FieldWindow,
        points: DeviceArray[np.float32],
        hypotheses: F32,
        poses: F32,
        steps: F32,
        *,
        reach: int,
    ) -> F32:
        """Look at poses, and climb from the best of them and from hypotheses.

        The first look takes every second point, those in the first half, and counts the greatest of
        five cells: the one under the point and four, ``reach`` cells away diagonally. A climb goes
        by rounds of random steps; every climber keeps to itself. In each round ``CLIMBERS`` steps
        are tried from the climber's best pose, and the best of the poses they lead to, the first of
        equals, is where its next round starts. What counts is the mean of the (smooth) score field,
        0 to 1, less the least over the hypotheses of the weighted squares of the distances from it
        plus its own loss.

        Args:
            hypotheses: (K, 7) float32: x, y, yaw, the weights of their squares, its own loss.
            poses: (K + N, 5) float32: x, y in cells of the pages, yaw, cos, sin; first those of the
                hypotheses, from which climbs start anyway.
            steps: (R, G, CLIMBERS, 5) float32: dx, dy, dyaw, cos and sin of dyaw. R at least 1,
                G at least K and at most K + N.

        Returns:
            (G, 6) float32: x, y, yaw, cos, sin and the value of where each climber ended.
        """
        first, second = -(-points.shape[0] // 2), points.shape[0]
        scales = [1.0 / (FIELD_ONE * count) for count in (first, second)]
        own, climbers = len(hypotheses), steps.shape[1]
        count = len(poses) - own
        if self.opencl:
            scan = *_arguments(window), points
            given = self.upload(hypotheses), own, self.upload(poses)
            looks = self.opencl.launch_new(
                (count,), np.float32, "look", (count,), *scan, first, *given, count, reach,
                scales[0],
            )  # fmt: skip
            return self.opencl.launch_into(
                np.empty((climbers, FOUND_FLOATS), dtype=np.float32), "climb",
                (climbers * CLIMBERS,), *scan, second, *given, looks, count, self.upload(steps),
                len(steps), scales[1],
            )  # fmt: skip

        def less_loss(sums: I64, scale: float, at: F32) -> F32:
            losses = _losses(at[..., None, :], hypotheses).min(axis=-1)
            return np.asarray(sums.astype(np.float32) * np.float32(scale) - losses)

        looked = poses[own:]
        sums = _wide(window, *move_points(host(points)[:first], looked[:, _MOVED]), reach)
        values = less_loss(sums.sum(axis=1), scales[0], looked)
        order = np.argsort(-values, kind="stable")[: climbers - own]
        best = np.concatenate((looked[order], poses[:own]))
        each = np.arange(climbers)
        for step in steps:
            x, y, yaw, cos, sin = (best[:, None, k] for k in range(5))
            turned = (
                cos * step[..., 3] - sin * step[..., 4],
                sin * step[..., 3] + cos * step[..., 4],
            )
            tried = np.stack(
                (x + step[..., 0], y + step[..., 1], yaw + step[..., 2], *turned), axis=-1
            )
            sums = self.score_poses(window, points, tried[..., _MOVED].reshape(-1, 4))
            values = less_loss(sums.reshape(tried.shape[:2]), scales[1], tried)
            winner = values.argmax(axis=1)
            best = tried[each, winner]
        return np.concatenate((best, values[each, winner, None]), axis=1)

    def climb_maps(
        self,
        field: DeviceArray[np.uint16],
        pages: DeviceArray[np.int32],
        points: DeviceArray[np.float32],
        hypotheses: F32,
        starts: F32,
        sizes: F32,
        *,
        tries: int,
        scale: float,
    ) -> F32:
        """Climb on each of many maps by steps along the axes and diagonals of (x, y, yaw).

        The best of a try's poses, the first of equals, is where the next one starts; where staying
        is best the next smaller step follows. What counts is as for ``search``, with one hypothesis
        a map.

        Args:
            hypotheses: (N, 7) float32, as for ``search``.
            starts: (N, 5) float32: x, y in cells of the window, yaw, cos, sin.
            sizes: (S, 4) float32: cells, radians, their cos and sin; largest first.
            tries: steps tried in all, at most; at least 1.

        Returns:
            (N, 6) float32: x, y, yaw, cos, sin and the value of where each climb ended.
        """
        if self.opencl:
            _, height, width = pages.shape
            return self.opencl.launch_into(
                np.empty((len(starts), FOUND_FLOATS), dtype=np.float32), "climb_maps",
                (len(starts) * CLIMBERS,), field, pages, width, height, points, points.shape[0],
                self.opencl.wrap_host(hypotheses), self.opencl.wrap_host(starts),
                self.opencl.wrap_host(sizes), len(sizes), tries, scale,
            )  # fmt: skip
        found = np.empty((len(starts), FOUND_FLOATS), dtype=np.float32)
        ways = _ways().astype(np.float32)
        for own, hypothesis, start, place in zip(
            host(pages), hypotheses, starts, found, strict=True
        ):
            best, at = start.copy(), 0
            for _ in range(tries):
                cells, radians, cos, sin = sizes[at]
                turn = ways[:, 2]
                dcos = np.where(turn == 0, np.float32(1.0), cos)
                dsin = turn * sin
                turned = best[3] * dcos - best[4] * dsin, best[4] * dcos + best[3] * dsin
                moved = best[:2] + ways[:, :2] * cells, best[2] + turn * radians
                tried = np.column_stack((*moved, *turned))
                found_values = _smooth_pairs(host(field), own, host(points), tried[:, _MOVED])
                losses = _losses(tried, hypothesis)
                values = found_values.sum(axis=1).astype(np.float32) * np.float32(scale) - losses
                winner = int(values.argmax())
                best, place[5] = tried[winner], values[winner]
                at += winner == 0
                if at >= len(sizes):
                    break
            place[:5] = best
        return found

    def score_maps(
        self,
        field: DeviceArray[np.uint16],
        pages: DeviceArray[np.int32],
        points: DeviceArray[np.float32],
        poses: F32,
        table: I32,
    ) -> I64:
        """Sum what a table makes of the smooth score field under the points, on each of many maps.

        Args:
            poses: (N, K, 4) float32: x, y in cells of the window, cos, sin.
            table: (256,) int32.

        Returns:
            (N, K) int64 sums.
        """
        if self.opencl:
            maps, each = poses.shape[:2]
            _, height, width = pages.shape
            whole = self.opencl.launch_into(
                np.empty((maps, each), dtype=np.int32), "score_maps", (maps * each,), field, pages,
                width, height, points, points.shape[0], self.opencl.wrap_host(poses), maps, each,
                self.opencl.wrap_host(table),
            )  # fmt: skip
            return whole.astype(np.int64)
        sums = np.empty(poses.shape[:2], dtype=np.int64)
        for own, at, out in zip(host(pages), poses, sums, strict=True):
            out[:] = table[_smooth_pairs(host(field), own, host(points), at)].sum(axis=1)
        return sums
