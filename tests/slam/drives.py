"""Drives through a drawn L-shaped flat with two pillars, whose truth is known."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slamfusion.compute import NumpyDevice
from slamfusion.geometry import Pose2
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


def draw_flat() -> npt.NDArray[np.uint8]:
    """Return (H, W) classes, 1 wall: an L of 8 m by 6 m with thick outer walls."""
    cells = np.ones((140, 180), dtype=np.uint8)
    cells[10:60, 10:170] = 0
    cells[60:130, 10:80] = 0
    cells[35:39, 60:64] = 1
    cells[90:96, 40:44] = 1
    cells[20:30, 130:134] = 1
    return cells


def true_poses(count: int) -> list[Pose2]:
    """A way along the long side and around the corner, 0.06 m a step at most."""
    marks = np.array([(1.2, 1.0), (5.5, 1.0), (7.5, 2.2), (5.0, 2.4), (2.2, 2.4), (1.2, 4.0)])
    steps = np.hypot(*np.diff(marks, axis=0).T)
    along = np.linspace(0.0, min(steps.sum(), 0.06 * count), count)
    passed = np.concatenate(([0.0], np.cumsum(steps)))
    x, y = (np.interp(along, passed, marks[:, axis]) for axis in (0, 1))
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x))) if count > 1 else np.zeros(1)
    smooth = np.convolve(np.pad(yaw, 4, mode="edge"), np.ones(9) / 9.0, mode="valid")
    return [Pose2(*(float(v) for v in row)) for row in zip(x, y, smooth, strict=True)]


def scan_at(
    pose: Pose2, stamp_s: float, *, mount: Pose2 | None = None, clockwise: bool = False
) -> LaserScan:
    """What a laser of 270 degrees reads there."""
    return scans_at((pose,), (stamp_s,), mount or IDENTITY, clockwise)[0]


@functools.cache
def scans_at(
    poses: tuple[Pose2, ...],
    stamps_s: tuple[float, ...],
    mount: Pose2 = IDENTITY,
    clockwise: bool = False,
) -> tuple[LaserScan, ...]:
    """Return what it reads at several places; all their rays are cast at once."""
    first, step = math.radians(-135.0), math.radians(270.0) / (BEAMS - 1)
    if clockwise:
        first, step = -first, -step
    lasers = [pose.compose(mount) for pose in poses]
    angles = np.concatenate([first + step * np.arange(BEAMS) + laser.yaw_rad for laser in lasers])
    places = np.repeat([[laser.x, laser.y] for laser in lasers], BEAMS, axis=0) / CELL_M
    rays = np.column_stack((places, np.cos(angles), np.sin(angles))).astype(np.float32)
    ranges = NumpyDevice().cast_rays(draw_flat(), rays, REACH_M / CELL_M)[:, 0] * CELL_M
    return tuple(
        LaserScan(stamp_s, row, first, step, 0.02, REACH_M, mount)
        for stamp_s, row in zip(stamps_s, ranges.reshape(-1, BEAMS), strict=True)
    )


def drive(
    count: int = 100,
    *,
    start: Pose2 | None = None,
    turn_bias: float = 0.0,
    mount: Pose2 | None = None,
    clockwise: bool = False,
) -> tuple[list[LogScan], list[Pose2]]:
    """Return scans with odometry, and the true poses in the odometry's frame.

    Args:
        count: scans.
        start: the first odometry pose; default: the true one.
        turn_bias: radians that odometry turns too much with every step.
        mount: of the laser.
        clockwise: direction of the beams.
    """
    truth = true_poses(count)
    begin = start or truth[0]
    moved = begin.compose(truth[0].inverse())
    odometry = begin
    stamps_s = tuple(0.1 * index for index in range(count))
    read = scans_at(tuple(truth), stamps_s, mount or IDENTITY, clockwise)
    scans = []
    for index, (pose, scan) in enumerate(zip(truth, read, strict=True)):
        if index:
            step = truth[index - 1].inverse().compose(pose)
            odometry = odometry.compose(Pose2(step.x, step.y, step.yaw_rad + turn_bias))
        scans.append(LogScan(scan, odometry, index + 1))
    return scans, [moved.compose(pose) for pose in truth]


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
