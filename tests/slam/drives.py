"""Drives through a drawn L-shaped flat with two pillars, whose truth is known."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from slamfusion.compute import NumpyDevice
from slamfusion.geometry import F64, U8, Pose2
from slamfusion.grid import IDENTITY
from slamfusion.io import write_carmen, write_tum
from slamfusion.io.log import LogScan
from slamfusion.scan import LaserScan
from slamfusion.trajectory import Trajectory

CELL_M = 0.05
BEAMS = 181
REACH_M = 8.0
# What a producer's health says of ``jumped``.
ONE_JUMP = [
    {"reason": "odometry jumped by more than 5 m: ignored", "count": 1, "first_lines": [31]}
]


def draw_flat() -> U8:
    """Return (H, W) classes, 1 wall: an L of 8 m by 6 m with thick outer walls."""
    cells = np.ones((140, 180), dtype=np.uint8)
    cells[10:60, 10:170] = 0
    cells[60:130, 10:80] = 0
    cells[35:39, 60:64] = 1
    cells[90:96, 40:44] = 1
    cells[20:30, 130:134] = 1
    return cells


def smoothed(values: F64) -> F64:
    """Return the mean of nine neighbours."""
    return np.convolve(np.pad(values, 4, mode="edge"), np.ones(9) / 9.0, mode="valid")


def true_poses(count: int) -> list[Pose2]:
    """A way along the long side and around the corner, 0.06 m a step at most."""
    marks = np.array([(1.2, 1.0), (5.5, 1.0), (7.5, 2.2), (5.0, 2.4), (2.2, 2.4), (1.2, 4.0)])
    steps = np.hypot(*np.diff(marks, axis=0).T)
    along = np.linspace(0.0, min(steps.sum(), 0.06 * count), count)
    passed = np.concatenate(([0.0], np.cumsum(steps)))
    x, y = (np.interp(along, passed, marks[:, axis]) for axis in (0, 1))
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x))) if count > 1 else np.zeros(1)
    return [Pose2(*(float(v) for v in row)) for row in zip(x, y, smoothed(yaw), strict=True)]


def read(
    cells: U8,
    poses: Sequence[Pose2],
    reach_m: float,
    *,
    noise_m: float = 0.01,
    beams: int = 121,
    mount: Pose2 = IDENTITY,
    clockwise: bool = False,
) -> list[LaserScan]:
    """Return what a laser of 270 degrees reads in a place that is drawn in cells."""
    first, step = math.radians(-135.0), math.radians(270.0) / (beams - 1)
    if clockwise:
        first, step = -first, -step
    lasers = [pose.compose(mount) for pose in poses]
    angles = np.concatenate([first + step * np.arange(beams) + laser.yaw_rad for laser in lasers])
    places = np.repeat([[laser.x, laser.y] for laser in lasers], beams, axis=0) / CELL_M
    rays = np.column_stack((places, np.cos(angles), np.sin(angles))).astype(np.float32)
    ranges = NumpyDevice().cast_rays(cells, rays, reach_m / CELL_M)[:, 0] * CELL_M
    noise = np.random.default_rng(0).normal(0.0, noise_m, ranges.shape)
    ranges = np.where(ranges < reach_m - 1e-3, ranges + noise, ranges).reshape(-1, beams)
    return [
        LaserScan(0.1 * index, row, first, step, 0.02, reach_m, mount)
        for index, row in enumerate(ranges)
    ]


@functools.cache
def scans_at(
    poses: tuple[Pose2, ...], mount: Pose2 | None = None, *, clockwise: bool = False
) -> list[LaserScan]:
    """Return what a laser reads in the flat, without noise."""
    return read(
        draw_flat(), poses, REACH_M, noise_m=0.0, beams=BEAMS, mount=mount or IDENTITY,
        clockwise=clockwise,
    )  # fmt: skip


def scan_at(pose: Pose2, stamp_s: float) -> LaserScan:
    """Return what it reads at one place."""
    return replace(scans_at((pose,))[0], stamp_s=stamp_s)


def log_of(
    scans: Sequence[LaserScan],
    truth: Sequence[Pose2],
    start: Pose2 | None = None,
    *,
    turn_bias: float = 0.0,
    longer: float = 1.0,
) -> list[LogScan]:
    """Return scans with an odometry that turns too much and goes too far with every step.

    It starts at ``start``, by default at the true pose.
    """
    odometry, log = start or truth[0], []
    for index, (scan, pose) in enumerate(zip(scans, truth, strict=True)):
        if index:
            step = truth[index - 1].inverse().compose(pose)
            odometry = odometry.compose(
                Pose2(longer * step.x, longer * step.y, step.yaw_rad + turn_bias)
            )
        log.append(LogScan(scan, odometry, index + 1))
    return log


def drive(
    count: int = 100,
    *,
    start: Pose2 | None = None,
    turn_bias: float = 0.0,
    mount: Pose2 | None = None,
    clockwise: bool = False,
) -> tuple[list[LogScan], list[Pose2]]:
    """Return scans of the flat with odometry, see ``log_of``, and the true poses in its frame."""
    truth = true_poses(count)
    scans = scans_at(tuple(truth), mount, clockwise=clockwise)
    moved = (start or truth[0]).compose(truth[0].inverse())
    log = log_of(scans, truth, start, turn_bias=turn_bias)
    return log, [moved.compose(pose) for pose in truth]


def stalled(scans: Sequence[LogScan]) -> list[LogScan]:
    """Return a drive whose odometry stands still from scan 61 to 65 and then catches up."""
    return [
        replace(item, odometry=scans[60].odometry) if 60 < index < 66 else item
        for index, item in enumerate(scans)
    ]


def jumped(scans: Sequence[LogScan]) -> list[LogScan]:
    """Return a drive whose odometry goes on elsewhere from scan 30, which is line 31: 50 m away."""
    away = Pose2(50.0, 0.0, 1.0)
    return [
        replace(item, odometry=away.compose(item.odometry or Pose2())) if index >= 30 else item
        for index, item in enumerate(scans)
    ]


def write_flat(folder: Path, count: int, log: str = "flat.log") -> None:
    """Write a drive with its true path, and one relation over all but its last scans."""
    scans, truth = drive(count)
    write_carmen(folder / log, scans)
    rows = np.array([(pose.x, pose.y, pose.yaw_rad) for pose in truth])
    write_tum(folder / "truth.tum", Trajectory(0.1 * np.arange(count), rows, "truth"))
    last = 10 * ((count - 2) // 10)
    motion = truth[0].inverse().compose(truth[last])
    line = f"0.0 {last / 10} {motion.x} {motion.y} 0 0 0 {motion.yaw_rad}\n"
    (folder / "flat.relations").write_text(line, encoding="utf-8")
