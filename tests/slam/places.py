"""Drawn places for the graph SLAM, drives through them, and how a map of them is judged."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.geometry import F64, U8, Pose2, row_of, wrap_angle
from slamfusion.grid import OccupancyGrid
from slamfusion.io.log import LogScan
from slamfusion.json_values import plain
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.common.matcher import ScanOnTiles, information_of, response_hessian
from slamfusion.slam.graph.slam import GraphSlam
from slamfusion.slam.graph.submap import Submap
from slamfusion.trajectory import Trajectory
from tests.slam.drives import CELL_M, log_of, read, smoothed

S = TypeVar("S", bound=Mapper)
NO_LASER = np.zeros(2)


def feed(slam: S, scans: Iterable[LogScan]) -> S:
    for item in scans:
        slam.feed(item.scan, item.odometry)
    return slam


def run(device: ComputeDevice, scans: list[LogScan], seed: int = 0, **settings: Any) -> GraphSlam:
    return feed(GraphSlam(GraphConfig(**settings), device, seed), scans)


def away(path: Trajectory, truth: list[Pose2]) -> F64:
    """Return (N,) how far the poses are from the true ones, metres."""
    true = np.array([(pose.x, pose.y) for pose in truth])
    return np.asarray(np.hypot(*(path.poses[:, :2] - true).T))


def errors(slam: Mapper, truth: list[Pose2]) -> tuple[float, float]:
    """Return the greatest errors of place (m) and heading (rad)."""
    path = slam.trajectory()
    turned = [
        abs(wrap_angle(pose.yaw_rad - yaw))
        for pose, yaw in zip(truth, path.poses[:, 2].tolist(), strict=True)
    ]
    return float(away(path, truth).max()), max(turned)


def on_truth(grid: OccupancyGrid, truth: U8, moved: Pose2 | None = None) -> tuple[float, float]:
    """Return shares of walls: of the map's, near a true one; of the true ones in its box, found.

    Args:
        grid: the map.
        truth: (H, W) classes of cells of ``CELL_M``, 1 wall, from the truth's origin.
        moved: pose of the truth's origin in the map frame.
    """
    pad, reach = 60, 2
    rows, cols = np.nonzero(grid.cells >= 65)
    own = ((moved or Pose2()).inverse().transform(grid.cell_centres(rows, cols))) / CELL_M
    col, row = np.floor(own).astype(int).T + pad
    walls, found = np.pad(truth, pad), np.zeros_like(np.pad(truth, pad))
    found[row, col] = 1
    # Of thick walls only the faces can be seen.
    inner = np.min([np.roll(walls, step, axis) for axis in (0, 1) for step in (1, -1)], axis=0)
    faces = (walls == 1) & (inner == 0)
    faces &= np.pad(np.pad(np.ones(np.array(truth.shape) - 8, dtype=np.bool_), 4), pad)
    correct = near(walls, reach)[row, col].mean()
    return float(correct), float(near(found, reach)[faces].mean())


def near(cells: U8, reach: int) -> U8:
    """Return cells that have a 1 within a square around them."""
    shifts = range(-reach, reach + 1)
    return np.max(
        [np.roll(cells, (down, right), (0, 1)) for down in shifts for right in shifts], axis=0
    )


def everything(slam: Mapper) -> list[Any]:
    """Return what a SLAM shows to the outside, to the bit; of its clock nothing."""
    grid, path = slam.grid(), slam.trajectory()
    health: Any = plain(slam.health)
    health.get("graph", {}).pop("solve_s", None)
    return [
        (grid.cells.tobytes(), grid.cells.shape, grid.origin, grid.resolution),
        [(p.name, p.stamps_s.tobytes(), p.poses.tobytes()) for p in (path, *slam.other_paths())],
        json.dumps(health),
        [(s.name, s.stamps_s.tobytes(), s.values.tobytes()) for s in slam.series()],
        (getattr(slam, "last_stamp_s", None), slam.memory_bytes()),
    ]


def cells_of(metres: float) -> int:
    return round(metres / CELL_M)


def way_along(marks: list[tuple[float, float]], step_m: float = 0.2) -> list[Pose2]:
    """Return poses along a way with its corners rounded."""
    places = np.array(marks)
    passed = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))))
    at = np.arange(0.0, passed[-1], step_m)
    x, y = (smoothed(np.interp(at, passed, places[:, axis])) for axis in (0, 1))
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    return [Pose2(*(float(v) for v in row)) for row in zip(x, y, smoothed(yaw), strict=True)]


def odometry_error(log: list[LogScan], truth: list[Pose2]) -> float:
    """Return how far off the odometry is at worst."""
    pairs = [(item.odometry or Pose2(), pose) for item, pose in zip(log, truth, strict=True)]
    return max(math.hypot(a.x - b.x, a.y - b.y) for a, b in pairs)


def draw_ring() -> U8:
    """A ring corridor of 13 m by 8 m, 2 m wide, with pillars."""
    cells, rng = np.ones((cells_of(9.0), cells_of(14.0)), dtype=np.uint8), np.random.default_rng(4)
    cells[10:170, 10:270] = 0
    cells[50:130, 50:230] = 1
    for side in (cells[:, :50].T, cells[:, 230:].T[::-1], cells[:50], cells[130:][::-1]):
        at = 20
        while at < side.shape[1] - 30:
            wide, deep, gap = (int(value) for value in rng.integers((3, 2, 15), (12, 7, 40)))
            side[10 : 10 + deep, at : at + wide] = 1
            at += wide + gap
    return cells


def around(left: float, low: float, right: float, high: float) -> list[Pose2]:
    """Return a way twice around a rectangle, from the middle of its lower side."""
    corners = [(right, low), (right, high), (left, high), (left, low)]
    start = (0.5 * (left + right) - 1.5, low)
    return way_along([start, *corners, *corners, start], 0.25)


@functools.cache
def ring() -> tuple[list[LogScan], list[Pose2]]:
    """Twice around the ring with odometry that is soon metres off."""
    truth = around(1.5, 1.5, 12.5, 7.5)
    return log_of(read(draw_ring(), truth, 4.0), truth, turn_bias=0.02, longer=1.1), truth


def draw_regular_ring() -> U8:
    """A ring corridor of 12 m by 9 m, 2 m wide: at every metre of its walls the same pillar."""
    cells = np.ones((cells_of(10.0), cells_of(13.0)), dtype=np.uint8)
    cells[10:190, 10:250] = 0
    cells[50:150, 50:210] = 1
    for at in range(30, 246, 20):
        cells[10:14, at : at + 4] = cells[186:190, at : at + 4] = 1
    for at in range(30, 186, 20):
        cells[at : at + 4, 10:14] = cells[at : at + 4, 246:250] = 1
    return cells


def draw_two_rooms() -> U8:
    """Two rooms that are the same, 5 m apart, beside one corridor."""
    cells = np.ones((cells_of(8.0), cells_of(11.0)), dtype=np.uint8)
    cells[10:36, 10:210] = 0
    for left in (10, 110):
        cells[50:130, left : left + 80] = 0
        cells[92:100, left + 20 : left + 28] = 1
        cells[112:130, left + 58 : left + 66] = 1
        cells[36:50, left + 40 : left + 60] = 0
    return cells


def through_two_rooms() -> list[Pose2]:
    """Through one room, through the other in the same way, and back to the first."""
    inside = [(1.5, 3.3), (1.2, 5.6), (2.6, 5.5), (3.2, 4.0), (1.6, 3.2), (3.0, 3.2)]
    other = [(x + 5.0, y) for x, y in inside]
    first = [(2.9, 3.0), *inside, (3.0, 2.6), (3.0, 1.15)]
    second = [(8.0, 1.15), (8.0, 2.6), *other, (8.0, 2.6), (8.0, 1.15)]
    return way_along([*first, *second, (3.0, 1.15), (3.0, 2.6), *inside])


def draw_corridor() -> U8:
    """A corridor of 27 m by 2 m along x; after its first 3 m nothing tells the way along it."""
    cells = np.ones((60, 560), dtype=np.uint8)
    cells[10:50, 10:550] = 0
    cells[10:16, 20:30] = cells[44:50, 50:58] = 1
    return cells


@dataclass(frozen=True, eq=False)
class Place:
    """A submap of a drawn place, in the map frame, and where it lives."""

    device: ComputeDevice
    submap: Submap
    cells: U8

    def points(self, pose: Pose2, seed: int, noise_m: float) -> F64:
        """Return the hits of a noisy scan."""
        scan = self.scan(pose)
        noise = np.random.default_rng(seed).normal(0.0, noise_m, len(scan))
        return replace(scan, ranges=scan.ranges + noise.astype(np.float32)).points()

    @functools.cache  # noqa: B019 - a few places, each for a module
    def scan(self, pose: Pose2) -> LaserScan:
        """Return what the laser reads without noise."""
        return read(self.cells, [pose], 8.0, noise_m=0.0, beams=181)[0]

    def information(self, pose: Pose2, points: F64) -> F64:
        """Return (3, 3) what a match tells."""
        at = np.array([pose.x, pose.y, pose.yaw_rad])
        scan = ScanOnTiles(self.device, self.submap.walls(), points, 180)
        return information_of(response_hessian(scan, at))


def place_of(device: ComputeDevice, cells: U8, poses: list[Pose2]) -> Place:
    """Return a place that was seen from some poses."""
    submap = Submap(device, 0, CELL_M, 0.1)
    place = Place(device, submap, cells)
    for index, pose in enumerate(poses):
        submap.insert(place.points(pose, index, 0.015), NO_LASER, pose)
    return place


def false_closures(slam: GraphSlam, truth: list[Pose2]) -> list[tuple[float, float]]:
    """Return the stamps of accepted closures that contradict the truth."""
    at = dict(zip(slam.trajectory().stamps_s.tolist(), truth, strict=True))
    found = []
    for one in slam.closures():
        step = at[one.start_s].inverse().compose(at[one.end_s])
        x, y, turn = row_of(one.motion) - row_of(step)
        if one.weight > 0.5 and max(math.hypot(x, y), 5 * abs(wrap_angle(turn))) > 0.35:
            found.append((one.start_s, one.end_s))
    return found
