"""What the lines of a CARMEN log say: one message for each scan, and why a line is none.

Besides CARMEN's own ``FLASER`` and ``ROBOTLASER1`` these are two relatives: gmapping's
``LASER_READING`` and DP-SLAM's pairs of ``Odometry`` and ``Laser``.

Source: the message formats are those of CARMEN, the Carnegie Mellon robot navigation toolkit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamfusion.errors import LogError
from slamfusion.geometry import F64, Pose2
from slamfusion.grid import IDENTITY
from slamfusion.io.files import AtomicFiles, write_atomic
from slamfusion.io.lines import TextLines, packed_by_name
from slamfusion.io.log import FARTHEST_M, LogScan, Skips
from slamfusion.scan import LaserScan

PoseRow = tuple[float, float, float]

# FLASER does not say its angles: 180 degrees forward, by convention in these steps.
FORWARD_STEPS_RAD = {
    180: math.pi / 180.0,
    181: math.pi / 180.0,
    360: math.pi / 360.0,
    361: math.pi / 360.0,
}
# Our writer says in the log which readings saw nothing, and the time from beam to beam; other
# programs ignore unknown settings.
NO_RETURN_PARAM, TIME_INCREMENT_PARAM = "slamfusion_no_return_m", "slamfusion_time_increment_s"
OFFSET_PARAM = "robot_frontlaser_offset"
# Lines of further lasers: known, and left out.
OTHER_LASERS = {
    b"RLASER": "the rear laser",
    b"ROBOTLASER2": "the second laser",
    b"RAWLASER1": "a laser without the robot's pose",
    b"RAWLASER2": "a laser without the robot's pose",
}
LASERS = (b"FLASER", b"ROBOTLASER1", b"LASER_READING", b"Laser")
CARMEN_WORDS = frozenset(
    {*LASERS, *OTHER_LASERS, b"ODOM", b"PARAM", b"Odometry", b"NEFF", b"SYNC", b"TRUEPOS"}
    | {b"VERTEX2", b"EDGE2", b"ODO_UPDATE", b"SM_UPDATE", b"FRAME", b"RESAMPLE"}
)
# No laser starts or steps by more than two turns.
_ANGLE_MAX_RAD = 4.0 * math.pi

WRONG_COUNT = "wrong number of fields (a cut-off line?)"
NOT_NUMBERS = "not numbers"
NOT_FINITE = "pose or time not finite"
TOO_FAR = f"pose more than {FARTHEST_M:g} m away"
NO_POSE_YET = "laser before odometry"
NO_BEAMS = "scan without beams"
NO_SCAN = "angles or ranges that cannot be a scan"
CUT_OFF_FILE = "the packed file ends early or is damaged; nothing after this was read"


class BadLineError(Exception):
    """A line that cannot be read; its text is the reason for the count."""


@dataclass(frozen=True)
class Message:
    """One scan as its line says it; lengths in metres, angles in radians."""

    kind: bytes
    ranges_m: F64
    first_rad: float
    step_rad: float
    robot: PoseRow
    laser: PoseRow | None = None
    stamp_s: float | None = None
    range_max_m: float = math.nan


def read_messages(
    lines: TextLines,
    skips: Skips,
    seen: Counter[bytes],
    on_other: Callable[[bytes, bytes], None] | None = None,
) -> Iterator[tuple[int, Message]]:
    """Yield line number and scan of every readable laser line; count the unreadable ones.

    Args:
        seen: where laser lines are counted by their first word, unreadable ones too, each before
            its scan is yielded.
    """
    pose: PoseRow | None = None
    number = 0
    for number, line in lines:
        word = (line.split(None, 1) or [b"#"])[0]
        parse = _PARSERS.get(word)
        seen[word] += word in LASERS
        try:
            if parse is not None:
                yield number, parse(line.split())
            elif word == b"Odometry":
                pose = _odometry(line.split())
            elif word == b"Laser":
                yield number, _bare_laser(line.split(), pose)
            elif on_other is not None:
                on_other(word, line)
        except BadLineError as error:
            skips.add(str(error), number)
    if lines.is_cut_off:
        skips.add(CUT_OFF_FILE, number + 1)


def _front_laser(fields: list[bytes]) -> Message:
    """``FLASER n r.. x y theta odom_x odom_y odom_theta stamp host logger_stamp``."""
    ranges, rest = _readings(fields, 1, behind=9)
    laser, robot = _pose(rest[0:3]), _pose(rest[3:6])
    first_rad, step_rad = forward_angles(len(ranges))
    return Message(b"FLASER", ranges, first_rad, step_rad, robot, laser, _finite(rest[6:7])[0])


def _robot_laser(fields: list[bytes]) -> Message:
    """``ROBOTLASER1``: settings, ranges, remissions, laser pose, robot pose, speeds, stamps."""
    remissions_at = 9 + _count(fields, 8)
    behind = 15 + _count(fields, remissions_at)
    ranges, rest = _readings(fields, 8, behind)
    first_rad, view_rad, step_rad = _finite(fields[2:5])
    if step_rad == 0.0 and len(ranges) > 1:
        step_rad = view_rad / (len(ranges) - 1)
    if max(abs(first_rad), abs(step_rad)) > _ANGLE_MAX_RAD:
        raise BadLineError(NO_SCAN)
    poses = rest[-14:-8]
    return Message(
        b"ROBOTLASER1",
        ranges,
        first_rad,
        step_rad,
        robot=_pose(poses[3:6]),
        laser=_pose(poses[0:3]),
        stamp_s=_finite(rest[-3:-2])[0],
        range_max_m=float(_numbers(fields[5:6])[0]),
    )


def _laser_reading(fields: list[bytes]) -> Message:
    """``LASER_READING n r.. x y theta stamp``."""
    ranges, rest = _readings(fields, 1, behind=4)
    first_rad, step_rad = forward_angles(len(ranges))
    return Message(
        b"LASER_READING",
        ranges,
        first_rad,
        step_rad,
        robot=_pose(rest[0:3]),
        stamp_s=_finite(rest[3:4])[0],
    )


def _odometry(fields: list[bytes]) -> PoseRow:
    """``Odometry x y theta``."""
    if len(fields) != 4:
        raise BadLineError(WRONG_COUNT)
    return _pose(fields[1:4])


def _bare_laser(fields: list[bytes], pose: PoseRow | None) -> Message:
    """``Laser n r..``, taken at the pose of the last ``Odometry`` line."""
    ranges, _ = _readings(fields, 1, behind=0)
    if pose is None:
        raise BadLineError(NO_POSE_YET)
    first_rad, step_rad = forward_angles(len(ranges))
    return Message(b"Laser", ranges, first_rad, step_rad, robot=pose)


_PARSERS: dict[bytes, Callable[[list[bytes]], Message]] = {
    b"FLASER": _front_laser,
    b"ROBOTLASER1": _robot_laser,
    b"LASER_READING": _laser_reading,
}


def _readings(fields: list[bytes], count_at: int, behind: int) -> tuple[F64, list[bytes]]:
    """Return the ranges after the field that counts them, and the ``behind`` fields after those."""
    count = _count(fields, count_at)
    first = count_at + 1
    if len(fields) != first + count + behind:
        raise BadLineError(WRONG_COUNT)
    if count == 0:
        raise BadLineError(NO_BEAMS)
    return _numbers(fields[first : first + count]), fields[first + count :]


def _count(fields: list[bytes], at: int) -> int:
    if at >= len(fields):
        raise BadLineError(WRONG_COUNT)
    if not fields[at].isdigit():
        raise BadLineError(NOT_NUMBERS)
    return int(fields[at][:12])


def _numbers(fields: list[bytes]) -> F64:
    try:
        return np.array(fields, dtype=np.float64)
    except ValueError:
        raise BadLineError(NOT_NUMBERS) from None


def _finite(fields: list[bytes]) -> list[float]:
    try:
        values = [float(text) for text in fields]
    except ValueError:
        raise BadLineError(NOT_NUMBERS) from None
    if not all(map(math.isfinite, values)):
        raise BadLineError(NOT_FINITE)
    return values


def _pose(fields: list[bytes]) -> PoseRow:
    x, y, yaw_rad = _finite(fields)
    if max(abs(x), abs(y)) > FARTHEST_M:
        raise BadLineError(TOO_FAR)
    return x, y, yaw_rad


def forward_angles(count: int) -> tuple[float, float]:
    """Return first angle and step of a laser that looks 180 degrees forward."""
    if count == 1:
        return 0.0, math.pi
    return -math.pi / 2.0, FORWARD_STEPS_RAD.get(count, math.pi / (count - 1))


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
            raise LogError(
                f"{target}: scan {count + 1} has no odometry, but every CARMEN line carries a "
                "pose; give the scans poses first"
            )
        if first is None:
            first = scan.scan
            settings = {NO_RETURN_PARAM: first.range_max_m}
            if first.time_increment_s:
                settings[TIME_INCREMENT_PARAM] = first.time_increment_s
            params = (f"PARAM {name} {value!r} nohost 0\n" for name, value in settings.items())
            body += (_HEADER + "".join(params)).encode()
        body += _lines_of(scan, last, first).encode()
        last = scan
        count += 1
    if first is None:
        raise LogError(f"{target}: there is no scan to write; give at least one")
    write_atomic(target, packed_by_name(target, bytes(body)), files=files)
    return count


def _lines_of(logged: LogScan, last: LogScan | None, first: LaserScan) -> str:
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
