"""``write_carmen``: scans as a CARMEN log."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from slamfusion.errors import LogError
from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY
from slamfusion.io.atomic import AtomicFiles, write_atomic
from slamfusion.io.carmen.messages import (
    FORWARD_STEPS_RAD,
    NO_RETURN_PARAM,
    TIME_INCREMENT_PARAM,
    forward_angles,
)
from slamfusion.io.lines import packed_by_name
from slamfusion.io.log import LogScan
from slamfusion.scan import LaserScan

_RANGE_DIGITS = 4
_RANGE_STEP_M = 10.0**-_RANGE_DIGITS
_HOST = "slamfusion"
_HEADER = (
    "# CARMEN log; lengths in metres, angles in radians\n"
    "# ODOM x y theta tv rv accel ipc_timestamp ipc_hostname logger_timestamp\n"
    "# FLASER n ranges x y theta odom_x odom_y odom_theta "
    "ipc_timestamp ipc_hostname logger_timestamp\n"
)


def write_carmen(
    path: str | Path, scans: Iterable[LogScan], *, files: AtomicFiles | None = None
) -> int:
    """Write scans as a CARMEN log; the same scans give the same bytes.

    A scan becomes a ``FLASER`` line when that says everything: 180, 181, 360 or 361 beams over
    180 degrees forward, a laser on the robot's origin, the range limit of the first scan. Any
    other becomes ``ROBOTLASER1``. +inf and over-range readings are written as the range limit
    (named in a ``PARAM`` line), NaN and -inf as 0. Another ``PARAM`` line has the time from beam to
    beam, where there is one. ``range_min_m`` has no place in the format.

    Args:
        path: the file; packed when its name ends in ``.gz``.
        scans: in the order of time, each with odometry.
        files: stage the file here, to appear together with others; default: write it now.

    Returns:
        How many scans were written.

    Raises:
        LogError: there is no scan, or one has no odometry.
        MapFileError: the file cannot be written.
    """
    target = Path(path)
    body = bytearray()
    last: LogScan | None = None
    first: LaserScan | None = None
    count = 0
    for scan in scans:
        if scan.odometry is None:
            message = (
                f"{target}: scan {count + 1} has no odometry, but every CARMEN line carries a "
                "pose; give the scans poses first"
            )
            raise LogError(message)
        if first is None:
            first = scan.scan
            body += _head(first).encode()
        body += _lines_of(scan, last, first).encode()
        last = scan
        count += 1
    if first is None:
        message = f"{target}: there is no scan to write; give at least one"
        raise LogError(message)
    write_atomic(target, packed_by_name(target, bytes(body)), files=files)
    return count


def _head(first: LaserScan) -> str:
    settings = {NO_RETURN_PARAM: first.range_max_m}
    if first.time_increment_s:
        settings[TIME_INCREMENT_PARAM] = first.time_increment_s
    lines = (f"PARAM {name} {value!r} nohost 0\n" for name, value in settings.items())
    return _HEADER + "".join(lines)


def _lines_of(logged: LogScan, last: LogScan | None, first: LaserScan) -> str:
    """Return the odometry line and the laser line of a scan."""
    scan, robot = logged.scan, logged.odometry or IDENTITY
    laser = robot.compose(scan.mount)
    end = f"{scan.stamp_s:.9f} {_HOST} {scan.stamp_s - first.stamp_s:.6f}\n"
    ranges = _range_texts(scan)
    speed_mps, turn_rps = _speeds(logged, last)
    odometry = f"ODOM {_pose_text(robot)} {speed_mps:.6f} {turn_rps:.6f} 0 {end}"
    if _is_forward(scan, first):
        # The robot's own numbers twice: no rounding may pull laser and robot apart.
        return (
            f"{odometry}FLASER {len(scan)} {ranges} {_pose_text(robot)} {_pose_text(robot)} {end}"
        )
    view_rad = scan.angle_increment_rad * (len(scan) - 1)
    return (
        f"{odometry}ROBOTLASER1 0 {scan.angle_min_rad:.12f} {view_rad:.12f} "
        f"{scan.angle_increment_rad:.12f} {scan.range_max_m!r} 0 0 {len(scan)} {ranges} 0 "
        f"{_pose_text(laser)} {_pose_text(robot)} {speed_mps:.6f} {turn_rps:.6f} 0 0 0 {end}"
    )


def _is_forward(scan: LaserScan, first: LaserScan) -> bool:
    """Whether a ``FLASER`` line says everything about the scan."""
    first_rad, step_rad = forward_angles(len(scan))
    return (
        len(scan) in FORWARD_STEPS_RAD
        and scan.mount == IDENTITY
        and scan.range_max_m == first.range_max_m
        and abs(scan.angle_min_rad - first_rad) < 1e-6
        and abs(scan.angle_increment_rad - step_rad) < 1e-8
    )


def _range_texts(scan: LaserScan) -> str:
    """Return the readings, each in the same number of decimals."""
    limit_m = scan.range_max_m
    ranges = scan.ranges.astype(np.float64)
    clear = scan.is_clear() | np.isposinf(ranges)
    hit = ranges > 0.0
    if math.isfinite(limit_m):
        # Rounding, also to float32, must not turn a hit just below the limit into a reading that
        # saw nothing, nor the other way round.
        below_m = (math.ceil(limit_m / _RANGE_STEP_M - 0.5) - 1) * _RANGE_STEP_M
        ranges = np.minimum(ranges, below_m)
        clear_text = f"{math.ceil(limit_m / _RANGE_STEP_M) * _RANGE_STEP_M:.{_RANGE_DIGITS}f}"
    else:
        clear_text = "inf"
    ranges = np.where(hit, np.maximum(ranges, _RANGE_STEP_M), 0.0)
    # One formatting of all is five times as fast as one of each.
    texts = np.where(clear, clear_text, f"%.{_RANGE_DIGITS}f").tolist()
    return " ".join(texts) % tuple(ranges[~clear].tolist())


def _speeds(logged: LogScan, last: LogScan | None) -> tuple[float, float]:
    """Return the mean speed forward (m/s) and turning (rad/s) since the last scan; 0 at first."""
    if last is None or last.odometry is None or logged.odometry is None:
        return 0.0, 0.0
    time_s = logged.scan.stamp_s - last.scan.stamp_s
    if time_s <= 0.0:
        return 0.0, 0.0
    motion = last.odometry.inverse().compose(logged.odometry)
    return motion.x / time_s, motion.yaw_rad / time_s


def _pose_text(pose: Pose2) -> str:
    return f"{pose.x:.9f} {pose.y:.9f} {pose.yaw_rad:.9f}"
