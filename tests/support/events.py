"""What may happen to a robot between two scans, and closures that are not what is true."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2, compose_poses, invert_poses, wrap_angles
from slamfusion.io.log import LogScan
from slamfusion.trajectory import Trajectory

# A closure that is off by more joins two places that are not one.
FALSE_M, FALSE_RAD = 0.5, 0.1
# Ties of neighbouring nodes are no loops.
LOOP_S = 5.0

Drive = tuple[tuple[LogScan, ...], Trajectory]


class ClosureLike(Protocol):
    """What a graph says of two scans; see ``slamfusion.slam.common.mapper.Closure``."""

    @property
    def start_s(self) -> float: ...
    @property
    def end_s(self) -> float: ...
    @property
    def motion(self) -> Pose2: ...
    @property
    def weight(self) -> float: ...


def with_pause(drive: Drive, first: int, pause_s: float) -> Drive:
    """Return a drive with nothing recorded for a while before one of its scans."""
    scans, truth = drive
    late = tuple(
        replace(item, scan=replace(item.scan, stamp_s=item.scan.stamp_s + pause_s))
        for item in scans[first:]
    )
    stamps_s = truth.stamps_s + np.where(np.arange(len(truth)) >= first, pause_s, 0.0)
    return scans[:first] + late, Trajectory(stamps_s, truth.poses, truth.name)


def begun_later(drive: Drive, first: int) -> Drive:
    """Return a drive without the scans before one; stamps and odometry stay as they are."""
    scans, truth = drive
    return scans[first:], Trajectory(truth.stamps_s[first:], truth.poses[first:], truth.name)


def with_odometry_set_to_zero(drive: Drive, first: int) -> Drive:
    """Return a drive whose odometry begins anew, at zero, with one of its scans."""
    scans, truth = drive
    start = scans[first].odometry
    if start is None:
        message = f"scan {scans[first].line} has no odometry"
        raise ValueError(message)
    again = tuple(
        replace(item, odometry=start.inverse().compose(pose))
        for item in scans[first:]
        if (pose := item.odometry)
    )
    return scans[:first] + again, truth


def closure_errors(closures: Sequence[ClosureLike], truth: Trajectory) -> npt.NDArray[np.float64]:
    """Return how far closures are from the truth, (N, 2): metres, radians.

    Args:
        closures: at stamps of the truth.
        truth: the true poses.

    Raises:
        ValueError: a closure has a stamp that the truth has not.
    """
    if not closures:
        return np.zeros((0, 2))
    stamps_s = np.array([(item.start_s, item.end_s) for item in closures])
    nearest = truth.nearest(stamps_s)
    if np.abs(truth.stamps_s[nearest] - stamps_s).max() > 1e-6:
        message = "a closure joins times at which the truth has no pose"
        raise ValueError(message)
    first, second = truth.poses[nearest[:, 0]], truth.poses[nearest[:, 1]]
    true = compose_poses(invert_poses(first), second)
    said = np.array([(m.x, m.y, m.yaw_rad) for m in (item.motion for item in closures)])
    left = compose_poses(invert_poses(true), said)
    return np.stack((np.hypot(left[:, 0], left[:, 1]), np.abs(wrap_angles(left[:, 2]))), axis=1)


def loops(closures: Iterable[ClosureLike]) -> list[ClosureLike]:
    """Return the closures that join two visits of a place, not two moments of one."""
    return [item for item in closures if abs(item.end_s - item.start_s) > LOOP_S]


def is_false(errors: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return which closures are false, (N,), from their errors (N, 2) in metres and radians."""
    return np.asarray((errors[:, 0] > FALSE_M) | (errors[:, 1] > FALSE_RAD))
