"""CARMEN logs in and out.

Reads CARMEN's ``FLASER`` and ``ROBOTLASER1``, gmapping's ``LASER_READING`` and DP-SLAM's pairs of
``Odometry`` and ``Laser``. Whether the stamps are usable, the laser's mount and the no-return value
are found from the whole log.

Source: the message formats are those of CARMEN, the Carnegie Mellon robot navigation toolkit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.errors import LogError, ScanError, counted
from slamfusion.geometry import F64, Pose2, wrap_angle
from slamfusion.grid import IDENTITY
from slamfusion.io.files import write_atomic
from slamfusion.io.lines import packed_by_name
from slamfusion.io.log import (
    AHEAD_S,
    BEFORE_ODOMETRY,
    FARTHEST_M,
    NO_SCAN,
    NOT_NUMBERS,
    BadLineError,
    LogScan,
    ScanLog,
    Skips,
    parsed_lines,
)
from slamfusion.io.scan_odometry import PoseRow, read_scan_odometry
from slamfusion.io.stamps import StampGate
from slamfusion.scan import LaserScan

# FLASER has no angles: 180 degrees forward, by convention in these steps.
FORWARD_STEPS_RAD = {
    180: math.pi / 180.0,
    181: math.pi / 180.0,
    360: math.pi / 360.0,
    361: math.pi / 360.0,
}
# Our writer's settings: the no-return reading and the time between beams. Other programs ignore
# unknown settings.
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

WRONG_COUNT = "wrong number of fields (a cut-off line?)"
NOT_FINITE = "pose or time not finite"
TOO_FAR = f"pose more than {FARTHEST_M:g} m away"
NO_BEAMS = "scan without beams"

# Above every range of a log whose readings are all real.
_ABOVE_LARGEST = 1.001
_FALLBACK_RANGE_M = 100.0


class CarmenLog(ScanLog):
    """A CARMEN log, plain or gzip.

    Readings at or above the no-return value become +inf; 0 and negative readings become NaN.
    ``line`` is the line in the file, from 1.

    Args:
        config: ``no_return_m`` overrides what is found; ``index_period_s`` is the scan period if
            stamps are broken or absent.
        scan_odometry: a file that replaces the poses in the log (see ``read_scan_odometry``), for
            a log with SLAM poses. Default: the log's own.

    Raises:
        LogError: the file has no readable laser scan, or the odometry is of another log.
    """

    def __init__(
        self,
        path: str | Path,
        config: LogConfig = LogConfig(),
        scan_odometry: str | Path | None = None,
    ) -> None:
        super().__init__(path, config)
        parser = _Parser()
        lines = parsed_lines(self.path, parser.parse)
        messages = [found for _, _, found in lines if isinstance(found, Message)]
        if not messages:
            for number, _, fault in lines:
                self.skips.add(str(fault), number)
            raise LogError(_no_laser(self.path, parser.words, self.skips))
        is_twice = _has_scans_twice(messages, parser.words)
        kinds = {b"ROBOTLASER1"} if is_twice else set(LASERS)
        trouble = _stamp_trouble([one.stamp_s for one in messages if one.kind in kinds])
        self.has_stamps = not trouble
        if trouble:
            period = f"the scan's index times {config.index_period_s:g} s (--index-period-s)"
            self.notes.append(f"{trouble}; used instead: {period}")
        self.notes += _notes(messages, parser.words, is_twice=is_twice)
        self._mount = self._find_mount(messages, parser.settings.get(OFFSET_PARAM, 0.0))
        self._time_increment_s = parser.settings.get(TIME_INCREMENT_PARAM, 0.0)
        self._said_m = parser.settings.get(NO_RETURN_PARAM, 0.0)
        self._no_return = self._find_no_return(messages)
        logged = [
            found.robot if isinstance(found, Message) else None
            for _, word, found in lines
            if word in kinds
        ]
        poses = iter([None if robot is None else Pose2(*robot) for robot in logged])
        if scan_odometry is not None:
            poses = iter(read_scan_odometry(scan_odometry, self.path, logged))
            self.notes.append(f"odometry is that of {scan_odometry}, not the poses in the log")
        index = 0
        for number, word, found in lines:
            pose = next(poses) if word in kinds else None
            if isinstance(found, str):
                self.records.append((number, found))
            elif pose is not None:
                stamp_s = found.stamp_s if self.has_stamps else index * config.index_period_s
                index += 1
                self.records.append((number, self._scan(found, stamp_s or 0.0, pose, number)))

    def _scan(self, message: Message, stamp_s: float, pose: Pose2, line: int) -> LogScan | str:
        """Return the sweep with the mount and the range limit of the whole log."""
        ranges = message.ranges_m
        limit_m = self._limit_m(message)
        ranges[ranges <= 0.0] = np.nan
        ranges[ranges >= min(limit_m, FARTHEST_M)] = np.inf
        try:
            scan = LaserScan(
                stamp_s=stamp_s,
                ranges=ranges.astype(np.float32),
                angle_min_rad=message.first_rad,
                angle_increment_rad=message.step_rad,
                range_min_m=0.0,
                range_max_m=limit_m,
                mount=self._mount,
                time_increment_s=self._time_increment_s,
            )
        except ScanError:
            return NO_SCAN
        return LogScan(scan, pose, line)

    def _find_mount(self, messages: Sequence[Message], offset_m: float) -> Pose2:
        """Return the laser's mount from the two poses of every line; note why if it is unusable."""
        setting = f"{OFFSET_PARAM} {offset_m:g} m"
        ahead = Pose2(offset_m, 0.0, 0.0)
        posed = [(Pose2(*one.robot), Pose2(*one.laser)) for one in messages if one.laser]
        if not posed:
            if offset_m:
                note = f"the lines have no laser pose; the laser sits by the setting {setting}"
                self.notes.append(note)
            return ahead
        relative = [
            IDENTITY if robot == laser else robot.inverse().compose(laser) for robot, laser in posed
        ]
        first_rad = relative[0].yaw_rad
        rows = np.array([(own.x, own.y, wrap_angle(own.yaw_rad - first_rad)) for own in relative])
        spread = np.ptp(rows, axis=0)
        farthest_m = max(max(abs(robot.x), abs(robot.y)) for robot, _ in posed)
        allowed_m = _MOUNT_SPREAD_M + _MOUNT_SPREAD_SHARE * farthest_m
        if max(spread[0], spread[1]) > allowed_m or spread[2] > _MOUNT_SPREAD_RAD:
            self.notes.append(
                "the laser's pose on the robot changes by up to "
                f"{max(spread[0], spread[1]):.3g} m and {spread[2]:.3g} rad, so it is not where "
                f"the laser sits (a corrected log?); used instead: {setting}"
            )
            return ahead
        x, y, yaw_rad = (np.add.accumulate(rows)[-1] / len(rows)).tolist()
        yaw_rad = wrap_angle(yaw_rad + first_rad)
        if max(abs(x), abs(y), abs(yaw_rad)) < _MOUNT_ZERO:
            if offset_m:
                self.notes.append(
                    f"the setting {setting} is not used: in every line laser and robot have one "
                    "pose"
                )
            return IDENTITY
        return Pose2(x, y, yaw_rad)

    def _find_no_return(self, messages: Sequence[Message]) -> NoReturn:
        """Find the no-return value; note it if neither the user nor the log gives it."""
        found = find_no_return([message.ranges_m for message in messages])
        if self._config.no_return_m is not None or self._said_m > 0.0:
            return found
        own_m = min(
            (one.range_max_m for one in messages if one.range_max_m > 0.0), default=math.inf
        )
        if own_m < (math.inf if found.from_m is None else found.from_m):
            note = f"readings from {own_m:g} m on are no return, as the lines say"
        elif found.from_m is None:
            far = sum(np.count_nonzero(one.ranges_m >= _LIMIT_M) for one in messages)
            note = (
                "no reading is repeated, as lasers do without a return; all above 0 and below "
                f"{_LIMIT_M:g} m count as hits"
            )
            if 2 * far >= sum(len(one.ranges_m) for one in messages):
                note += "; most are longer: millimetres? wanted metres"
        else:
            note = (
                f"readings from {found.from_m:.2f} m on are no return (the log repeats "
                f"{found.code_m:g} m)"
            )
        self.notes.append(note)
        return found

    def _limit_m(self, message: Message) -> float:
        """Return the range from which readings are no return: by setting, by the log, or found."""
        if self._config.no_return_m is not None:
            return self._config.no_return_m
        own_m = message.range_max_m if message.range_max_m > 0.0 else math.inf
        found = self._no_return
        if self._said_m > 0.0:
            return own_m if message.range_max_m > 0.0 else self._said_m
        if found.from_m is not None:
            return min(found.from_m, own_m)
        if own_m < math.inf:
            return own_m
        return found.largest_m * _ABOVE_LARGEST or _FALLBACK_RANGE_M


# --- lines ---------------------------------------------------------------------------------------


class Message(NamedTuple):
    """One scan line; lengths in metres, angles in radians."""

    kind: bytes
    ranges_m: F64
    first_rad: float
    step_rad: float
    robot: PoseRow
    laser: PoseRow | None = None
    stamp_s: float | None = None
    range_max_m: float = math.nan


class _Parser:
    """Reads line by line; counts first words in ``words``, keeps settings in ``settings``."""

    def __init__(self) -> None:
        self.words: Counter[bytes] = Counter()
        self.settings: dict[str, float] = {}
        self._pose: PoseRow | None = None

    def parse(self, line: bytes) -> Message | None:
        """Return the scan of a laser line, else None."""
        word = (line.split(None, 1) or [b"#"])[0]
        message = None
        if word in LASERS:
            message = _robot_laser(line.split()) if word == b"ROBOTLASER1" else self._laser(line)
        elif word == b"Odometry":
            fields = line.split()
            if len(fields) != 4:
                raise BadLineError(WRONG_COUNT)
            self._pose = _pose(fields[1:4])
        elif word == b"PARAM":
            self._set(*(*line.split()[1:3], b"", b"")[:2])
        if not word.startswith(b"#"):
            self.words[word if word in CARMEN_WORDS else b"other lines"] += 1
        return message

    def _set(self, name: bytes, value: bytes) -> None:
        key = name.decode("ascii", "replace")
        if key in {NO_RETURN_PARAM, OFFSET_PARAM, TIME_INCREMENT_PARAM}:
            with suppress(ValueError):
                number = float(value)
                if math.isfinite(number) or (key == NO_RETURN_PARAM and number > 0.0):
                    self.settings[key] = number

    def _laser(self, line: bytes) -> Message:
        """Read a line without angles.

        ``FLASER n r.. x y theta odom_x odom_y odom_theta stamp host logger_stamp``,
        ``LASER_READING n r.. x y theta stamp``, or ``Laser n r..`` at the last ``Odometry``.
        """
        fields = line.split()
        ranges, rest = _readings(fields, 1, behind=_BEHIND[fields[0]])
        first_rad, step_rad = forward_angles(len(ranges))
        laser, robot, stamp_s = None, self._pose, None
        if fields[0] == b"FLASER":
            laser, robot, stamp_s = _pose(rest[0:3]), _pose(rest[3:6]), _finite(rest[6:7])[0]
        elif fields[0] == b"LASER_READING":
            robot, stamp_s = _pose(rest[0:3]), _finite(rest[3:4])[0]
        if robot is None:
            raise BadLineError(BEFORE_ODOMETRY)
        return Message(fields[0], ranges, first_rad, step_rad, robot, laser, stamp_s)


# Fields behind the ranges.
_BEHIND = {b"FLASER": 9, b"LASER_READING": 4, b"Laser": 0}


def _robot_laser(fields: list[bytes]) -> Message:
    """``ROBOTLASER1``: settings, ranges, remissions, laser pose, robot pose, speeds, stamps."""
    remissions_at = 9 + _count(fields, 8)
    behind = 15 + _count(fields, remissions_at)
    ranges, rest = _readings(fields, 8, behind)
    first_rad, view_rad, step_rad = _finite(fields[2:5])
    if step_rad == 0.0 and len(ranges) > 1:
        step_rad = view_rad / (len(ranges) - 1)
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


# --- the whole log -------------------------------------------------------------------------------


def _has_scans_twice(messages: Sequence[Message], words: Counter[bytes]) -> bool:
    """Whether most scans are logged twice, as FLASER and as ROBOTLASER1."""
    fewer = min(words[b"FLASER"], words[b"ROBOTLASER1"])
    twice = sum(
        one.stamp_s == other.stamp_s and one.kind != other.kind for one, other in pairwise(messages)
    )
    return fewer > 0 and 2 * twice > fewer


# Stamps are broken if this share of the scans, and at least this number, would be lost ...
_LOST_SHARE, _LOST_AT_LEAST = 0.05, 10
# ... or, in a short log, most of them.
_LOST_MOST, _LOST_FEW = 0.5, 3


def _stamp_trouble(stamps_s: Sequence[float | None]) -> str:
    """Return why the stamps of a log's scans cannot be used; empty when they can."""
    known_s = [stamp_s for stamp_s in stamps_s if stamp_s is not None]
    if len(known_s) < len(stamps_s):
        return "the scans have no time stamps"
    if not any(known_s) and len(known_s) > 1:
        return "all time stamps are 0"
    gate: StampGate[None] = StampGate(math.inf, ahead_s=AHEAD_S)
    lost = 0
    for stamp_s in known_s:
        if gate.newest_s is not None and stamp_s <= gate.newest_s:
            lost += 1
        else:
            lost += len(gate.offer(stamp_s, None).strays)
    many = lost >= _LOST_AT_LEAST and lost > _LOST_SHARE * len(known_s)
    most = lost >= _LOST_FEW and lost > _LOST_MOST * len(known_s)
    if many or most:
        return (
            f"the time stamps are broken ({lost} of {len(known_s)} are not later than one before)"
        )
    return ""


def _notes(messages: Sequence[Message], words: Counter[bytes], *, is_twice: bool) -> list[str]:
    """Return notes on assumed angles and lines left out."""
    counts = Counter(len(one.ranges_m) for one in messages if one.kind != b"ROBOTLASER1")
    notes = [
        f"{counted(scans, 'scan')} of {beams} beams without angles; taken: 180 degrees forward in "
        f"steps of {math.degrees(forward_angles(beams)[1]):.4g} degrees"
        for beams, scans in sorted(counts.items())
        if beams not in FORWARD_STEPS_RAD
    ]
    if is_twice:
        notes.append(f"the {words[b'FLASER']} FLASER lines repeat ROBOTLASER1; left out")
    return notes + [
        f"{words[word]} {word.decode()} lines left out: {what}"
        for word, what in OTHER_LASERS.items()
        if words[word]
    ]


# The laser is fixed to the robot; logs of 6 significant digits move it by their rounding.
_MOUNT_SPREAD_M, _MOUNT_SPREAD_SHARE, _MOUNT_SPREAD_RAD = 2e-3, 4e-6, 2e-3
# Below this a mount is the rounding of a laser that sits on the robot's origin.
_MOUNT_ZERO = 1e-9


def _no_laser(path: Path, words: Counter[bytes], skips: Skips) -> str:
    wanted = "FLASER, ROBOTLASER1, LASER_READING or Laser lines"
    if skips.total:
        reasons = "; ".join(skips.sentences())
        return f"{path}: no readable laser scan among its lines: {reasons}; fix the file"
    if not words:
        return f"{path}: wanted {wanted}, found no line at all; the log is empty"
    found = ", ".join(f"{count} {word.decode()}" for word, count in words.most_common(5))
    return (
        f"{path}: wanted {wanted}, found {found}; there is no laser in it, give a log that "
        "recorded one"
    )


# Readings are counted in millimetres up to a kilometre: constant memory, however long the log.
_BINS_PER_M = 1000
_LIMIT_M = 1000.0
# No laser's longest range is shorter; a room of equal readings must not look like one.
_SHORTEST_MAX_M = 3.5
# A value is repeated if at least this number of readings, and this share of all, have it ...
_REPEATED = ((10, 0.001), (3, 0.01))
# ... unless nearly every reading has it.
_MOST = 0.95
# What SICK lasers write instead of a range: the last nine of 13 bits (in cm or mm), of 15 in mm.
_SICK_CODES_M = ((81.83, 81.91), (8.183, 8.191), (32.759, 32.767))
_SICK_REPEATED = 2
# A code is this much more frequent than the readings below it; lesser codes may be near it.
_STANDS_OUT = 10.0
_LESSER_SHARE = 0.01
_BAND = 0.95
_NEIGHBOURS = 0.85
# The codes of one laser scatter by this much once a log has scaled them.
_SLACK = 0.999
_TOP_BAND = 1.01


class NoReturn(NamedTuple):
    """The no-return value of a log, metres.

    Attributes:
        from_m: readings at or above this are no return; None if no value is repeated.
        code_m: the most frequent no-return value; None likewise.
        largest_m: the largest finite reading; 0 without any.
    """

    from_m: float | None
    code_m: float | None
    largest_m: float


def find_no_return(scans: Iterable[F64]) -> NoReturn:
    """Find the value that a laser writes for no return.

    The longest value that is often repeated (10 readings and 0.1 %, or 3 and 1 %; two for the
    codes of SICK lasers) and ten times as frequent as the values 5 to 15 % below it. Repeated
    values up to 5 % below belong to it if they have 1 % of its readings. Everything from 0.1 %
    below the lowest of them is no return. A largest reading that occurs once is a normal reading.

    Args:
        scans: (N,) metres each; NaN, infinity and 0 do not count.
    """
    counts = np.zeros(int(_LIMIT_M * _BINS_PER_M), dtype=np.int64)
    largest_m = 0.0
    for ranges_m in scans:
        usable = ranges_m[(ranges_m > 0.0) & (ranges_m < _LIMIT_M)]
        if usable.size:
            bins = np.rint(usable * _BINS_PER_M).astype(np.int64)
            np.add.at(counts, np.minimum(bins, len(counts) - 1), 1)
            largest_m = max(largest_m, float(usable.max()))
    nothing = NoReturn(None, None, largest_m)
    total = int(counts.sum())
    needed = np.full(len(counts), min(max(least, share * total) for least, share in _REPEATED))
    for low_m, high_m in _SICK_CODES_M:
        needed[round(low_m * _BINS_PER_M) : round(high_m * _BINS_PER_M) + 1] = _SICK_REPEATED
    repeated = np.flatnonzero(counts >= needed)
    if not repeated.size or repeated[-1] < _SHORTEST_MAX_M * _BINS_PER_M:
        return nothing
    top = int(repeated[-1])
    band = np.arange(int(top * _BAND), min(int(top * _TOP_BAND) + 1, len(counts)))
    code = int(band[np.argmax(counts[band])])
    most = int(counts[code])
    below = counts[int(code * _NEIGHBOURS) : int(code * _BAND)]
    usual = below[below > 0].mean() if below.any() else 0.0
    beyond = int(counts[band[-1] + 1 :].sum())
    if most < _STANDS_OUT * usual or most > _MOST * total or beyond > most / _STANDS_OUT:
        return nothing
    # A lesser code may be rarer than the threshold.
    enough = max(_LESSER_SHARE * most, _STANDS_OUT * usual, _SICK_REPEATED)
    lowest = int(band[np.flatnonzero(counts[band] >= enough)[0]])
    return NoReturn(lowest * _SLACK / _BINS_PER_M, code / _BINS_PER_M, largest_m)


# --- writing -------------------------------------------------------------------------------------

_RANGE_DIGITS = 4
_RANGE_STEP_M = 10.0**-_RANGE_DIGITS
_HOST = "slamfusion"
_HEADER = (
    "# CARMEN log; lengths in metres, angles in radians\n"
    "# ODOM x y theta tv rv accel ipc_timestamp ipc_hostname logger_timestamp\n"
    "# FLASER n ranges x y theta odom_x odom_y odom_theta "
    "ipc_timestamp ipc_hostname logger_timestamp\n"
)


def write_carmen(path: str | Path, scans: Iterable[LogScan]) -> int:
    """Write scans as a CARMEN log; the same scans give the same bytes.

    A scan becomes a ``FLASER`` line if that can hold it: 180, 181, 360 or 361 beams over
    180 degrees forward, a laser on the robot's origin, the range limit of the first scan. Any
    other becomes ``ROBOTLASER1``. +inf and over-range readings are written as the range limit,
    NaN and -inf as 0. ``PARAM`` lines hold the limit and the time between beams. ``range_min_m``
    is not saved.

    Args:
        path: compressed if the name ends in ``.gz``.
        scans: in the order of time, each with odometry.

    Returns:
        The number of scans written.

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
    write_atomic(target, packed_by_name(target, bytes(body)))
    return count


def _lines_of(logged: LogScan, last: LogScan | None, first: LaserScan) -> str:
    scan, robot = logged.scan, logged.odometry or IDENTITY
    laser = robot.compose(scan.mount)
    # Mean forward (m/s) and turning (rad/s) speed since the last scan.
    speed_mps, turn_rps = 0.0, 0.0
    before = None if last is None or logged.odometry is None else last.odometry
    if before and last and (time_s := scan.stamp_s - last.scan.stamp_s) > 0.0:
        motion = before.inverse().compose(robot)
        speed_mps, turn_rps = motion.x / time_s, motion.yaw_rad / time_s
    end = f"{scan.stamp_s:.9f} {_HOST} {scan.stamp_s - first.stamp_s:.6f}\n"
    ranges = _range_texts(scan)
    odometry = f"ODOM {_pose_text(robot)} {speed_mps:.6f} {turn_rps:.6f} 0 {end}"
    if _is_forward(scan, first):
        # The robot's own numbers twice: rounding must not separate laser and robot.
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
    """Whether a ``FLASER`` line can hold the scan."""
    first_rad, step_rad = forward_angles(len(scan))
    return (
        len(scan) in FORWARD_STEPS_RAD
        and scan.mount == IDENTITY
        and scan.range_max_m == first.range_max_m
        and abs(scan.angle_min_rad - first_rad) < 1e-6
        and abs(scan.angle_increment_rad - step_rad) < 1e-8
    )


def _range_texts(scan: LaserScan) -> str:
    limit_m = scan.range_max_m
    ranges = scan.ranges.astype(np.float64)
    clear = scan.is_clear() | np.isposinf(ranges)
    hit = ranges > 0.0
    if math.isfinite(limit_m):
        # Rounding, also to float32, must not turn a hit just below the limit into a no-return
        # reading, or the reverse.
        below_m = (math.ceil(limit_m / _RANGE_STEP_M - 0.5) - 1) * _RANGE_STEP_M
        ranges = np.minimum(ranges, below_m)
        clear_text = f"{math.ceil(limit_m / _RANGE_STEP_M) * _RANGE_STEP_M:.{_RANGE_DIGITS}f}"
    else:
        clear_text = "inf"
    ranges = np.where(hit, np.maximum(ranges, _RANGE_STEP_M), 0.0)
    # Formatting all at once is five times as fast.
    texts = np.where(clear, clear_text, f"%.{_RANGE_DIGITS}f").tolist()
    return " ".join(texts) % tuple(ranges[~clear].tolist())


def _pose_text(pose: Pose2) -> str:
    return f"{pose.x:.9f} {pose.y:.9f} {pose.yaw_rad:.9f}"
