"""Scans whose odometry is wrong or missing, and drives set one after the other."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2
from slamfusion.io.log import LogScan
from slamfusion.sim import Recording
from slamfusion.trajectory import Trajectory

# Of its motion, metres and radians in one sum, a robot under way makes at least so much a second.
UNDER_WAY_PER_S = 0.25


def without_odometry(scans: Sequence[LogScan]) -> tuple[LogScan, ...]:
    """Return scans of a log that has no odometry."""
    return tuple(replace(item, odometry=None) for item in scans)


def in_wrong_direction(
    scans: Sequence[LogScan], begins_s: Sequence[float], lasts_s: float
) -> tuple[LogScan, ...]:
    """Return scans whose odometry counts backwards for a while: each step there is undone.

    A step forward is reported as one backwards, a turn as one to the other side; before and after
    odometry is right.

    Args:
        scans: with odometry each.
        begins_s: times after which odometry is wrong.
        lasts_s: how long.
    """
    wrong: list[LogScan] = []
    pose = _odometry(scans[0])
    for number, item in enumerate(scans):
        if number:
            step = _odometry(scans[number - 1]).inverse().compose(_odometry(item))
            is_wrong = any(begin < item.scan.stamp_s <= begin + lasts_s for begin in begins_s)
            pose = pose.compose(step.inverse() if is_wrong else step)
        wrong.append(replace(item, odometry=pose))
    return tuple(wrong)


def moments_under_way(
    scans: Sequence[LogScan], count: int, lasts_s: float, rng: np.random.Generator
) -> list[float]:
    """Draw times from when on the robot is under way, one from each of ``count`` parts of a log.

    Args:
        scans: with odometry each.
        count: parts of equal duration.
        lasts_s: how long the robot must be under way.
        rng: draws one of the times in a part.

    Returns:
        (count,) seconds, rising, each at least ``lasts_s`` from the next.

    Raises:
        ValueError: the robot stands in a whole part.
    """
    stamps_s, moved = _motion(scans)
    ends = np.searchsorted(stamps_s, stamps_s + lasts_s, side="right") - 1
    is_under_way = moved[ends] - moved >= UNDER_WAY_PER_S * lasts_s
    edges = np.linspace(stamps_s[0], stamps_s[-1], count + 1)
    moments = []
    for begin, end in itertools.pairwise(edges):
        usable = is_under_way & (stamps_s >= begin) & (stamps_s <= end - 2.0 * lasts_s)
        moments.append(float(rng.choice(stamps_s[usable])))
    return moments


def joined(recordings: Sequence[Recording]) -> tuple[tuple[LogScan, ...], Trajectory]:
    """Set simulated drives one after the other; each begins where the one before ended.

    Args:
        recordings: with one laser.

    Returns:
        The scans, odometry going on from one drive to the next, and the true path.
    """
    scans: list[LogScan] = []
    stamps_s: list[npt.NDArray[np.float64]] = []
    shift_s = 0.0
    for recording in recordings:
        moved = Pose2()
        if scans:
            shift_s += 1.0 / recording.course.lidar.rate_hz
            moved = _odometry(scans[-1]).compose(_odometry(recording.scans[0]).inverse())
        stamps_s.append(shift_s + recording.truth.stamps_s)
        for item in recording.scans:
            scan = replace(item.scan, stamp_s=shift_s + item.scan.stamp_s)
            scans.append(LogScan(scan, moved.compose(_odometry(item)), len(scans) + 1))
        shift_s = float(stamps_s[-1][-1])
    poses = np.concatenate([recording.truth.poses for recording in recordings])
    return tuple(scans), Trajectory(np.concatenate(stamps_s), poses, "truth")


def _motion(
    scans: Sequence[LogScan],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the times, (N,) s, and the motion up to each, (N,) metres and radians in one sum."""
    moved = [0.0]
    for before, item in itertools.pairwise(scans):
        step = _odometry(before).inverse().compose(_odometry(item))
        moved.append(moved[-1] + math.hypot(step.x, step.y) + abs(step.yaw_rad))
    return np.array([item.scan.stamp_s for item in scans]), np.array(moved)


def _odometry(item: LogScan) -> Pose2:
    """Return the odometry of a scan.

    Raises:
        ValueError: it has none.
    """
    if item.odometry is None:
        message = f"scan {item.line} has no odometry"
        raise ValueError(message)
    return item.odometry
