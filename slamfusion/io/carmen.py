"""CARMEN logs, read as a stream of scans and written.

Besides CARMEN's own ``FLASER`` and ``ROBOTLASER1`` the reader knows two relatives: gmapping's
``LASER_READING`` and DP-SLAM's pairs of ``Odometry`` and ``Laser``. A first pass over the file
finds what its lines cannot say alone: whether the time stamps can be used, where the laser sits on
the robot, and which readings mean "nothing seen".

Source: the message formats are those of CARMEN, the Carnegie Mellon robot navigation toolkit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slamfusion.config import LogConfig
from slamfusion.errors import LogError, ScanError
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import IDENTITY
from slamfusion.io.atomic import AtomicFiles
from slamfusion.io.lines import TextLines, gzip_bytes
from slamfusion.io.log import AHEAD_S, FARTHEST_M, Continuity, LogScan, Skips
from slamfusion.io.no_return import NoReturn, NoReturnFinder
from slamfusion.io.scan_odometry import ScanOdometry
from slamfusion.io.stamps import StampGate
from slamfusion.scan import LaserScan

__all__ = ["CARMEN_WORDS", "CarmenLog", "write_carmen"]

_DEFAULT_CONFIG = LogConfig()

PoseRow = tuple[float, float, float]

# FLASER does not say its angles: 180 degrees forward, by convention in these steps.
_FORWARD_STEPS_RAD = {
    180: math.pi / 180.0,
    181: math.pi / 180.0,
    360: math.pi / 360.0,
    361: math.pi / 360.0,
}
# Our writer says in the log which readings saw nothing; other programs ignore unknown settings.
_NO_RETURN_PARAM = "slamfusion_no_return_m"
_OFFSET_PARAM = "robot_frontlaser_offset"
# Lines of further lasers: known, and left out.
_OTHER_LASERS = {
    b"RLASER": "the rear laser",
    b"ROBOTLASER2": "the second laser",
    b"RAWLASER1": "a laser without the robot's pose",
    b"RAWLASER2": "a laser without the robot's pose",
}
_LASERS = (b"FLASER", b"ROBOTLASER1", b"LASER_READING", b"Laser")
CARMEN_WORDS = frozenset(
    {*_LASERS, *_OTHER_LASERS, b"ODOM", b"PARAM", b"Odometry", b"NEFF", b"SYNC", b"TRUEPOS"}
    | {b"VERTEX2", b"EDGE2", b"ODO_UPDATE", b"SM_UPDATE", b"FRAME", b"RESAMPLE"}
)

# Stamps are broken when this share of at least so many scans would be lost to them ...
_LOST_SHARE, _LOST_AT_LEAST = 0.05, 10
# ... or, in a short log, most of them.
_LOST_MOST, _LOST_FEW = 0.5, 3
# A laser sits still on its robot; logs of 6 significant digits let it move by their rounding.
_MOUNT_SPREAD_M, _MOUNT_SPREAD_SHARE, _MOUNT_SPREAD_RAD = 2e-3, 4e-6, 2e-3
# Below this a mount is the rounding of a laser that sits on the robot's origin.
_MOUNT_ZERO = 1e-9
# No laser starts or steps by more than two turns.
_ANGLE_MAX_RAD = 4.0 * math.pi
# Above every range of a log whose readings are all real.
_ABOVE_LARGEST = 1.001
_FALLBACK_RANGE_M = 100.0

WRONG_COUNT = "wrong number of fields (a cut-off line?)"
NOT_NUMBERS = "not numbers"
NOT_FINITE = "pose or time not finite"
TOO_FAR = f"pose more than {FARTHEST_M:g} m away"
NO_POSE_YET = "laser before odometry"
NO_BEAMS = "scan without beams"
NO_SCAN = "angles or ranges that cannot be a scan"
CUT_OFF_FILE = "the packed file ends early or is damaged; nothing after this was read"


class _BadLineError(Exception):
    """A line that cannot be read; its text is the reason for the count."""


@dataclass(frozen=True)
class _Message:
    """One scan as its line says it; lengths in metres, angles in radians."""

    kind: bytes
    ranges_m: npt.NDArray[np.float64]
    first_rad: float
    step_rad: float
    robot: PoseRow
    laser: PoseRow | None = None
    stamp_s: float | None = None
    range_max_m: float = math.nan


class CarmenLog:
    """A CARMEN log, plain or gzip; each iteration starts anew (see ``ScanLog``).

    Readings at or above the no-return value become +inf; 0 and negative readings become NaN. The
    odometry is the robot's pose in the scan's own line. ``line`` is the line in the file, from 1.

    Args:
        path: the file.
        config: ``no_return_m`` overrides what is found; ``index_period_s`` is the time from scan
            to scan where stamps are broken or absent.
        odometry: taken instead of the poses in the log, by the number of the laser line; for a
            log whose own poses are the answer of a SLAM. Default: the log's own.

    Attributes:
        path, skips, warnings, notes, has_stamps, fraction_read: see ``ScanLog``.

    Raises:
        LogError: there is no readable laser scan in the file, or the odometry is of another one.
    """

    def __init__(
        self,
        path: str | Path,
        config: LogConfig = _DEFAULT_CONFIG,
        odometry: ScanOdometry | None = None,
    ) -> None:
        self.path = Path(path)
        self.skips = Skips()
        self.warnings = Skips()
        self.fraction_read = 0.0
        self._config = config
        self._odometry = odometry
        self._survey = _take_survey(self.path)
        if odometry is not None:
            odometry.check_count(self.path, self._survey.laser_lines())
        self.has_stamps = not self._survey.stamp_trouble()
        self._mount, mount_notes = self._survey.mount.result(self._survey.offset_m())
        self._no_return = self._survey.no_return()
        self.notes = [
            *self._survey.notes(config),
            *mount_notes,
            *_no_return_notes(self._survey, self._no_return, config),
        ]
        if odometry is not None:
            self.notes.append(f"odometry is that of {odometry.path}, not the poses in the log")

    def __iter__(self) -> Iterator[LogScan]:
        """Yield the scans; stamps strictly increase.

        Raises:
            LogError: the odometry was made for other scans.
        """
        self.skips, self.warnings = Skips(), Skips()
        continuity = Continuity(self.skips, self.warnings)
        lines = TextLines(self.path)
        kinds = self._survey.kinds()
        index = 0
        seen: Counter[bytes] = Counter()
        for line, message in _messages(lines, self.skips, seen):
            self.fraction_read = lines.fraction_read
            if message.kind not in kinds:
                continue
            odometry = Pose2(*message.robot)
            if self._odometry is not None:
                number = _count_of(seen, kinds) - 1
                odometry = self._odometry.pose(number, self.path, message.robot)
            stamp_s = message.stamp_s if self.has_stamps else index * self._config.index_period_s
            index += 1
            try:
                scan = self._scan(message, stamp_s or 0.0)
            except ScanError:
                self.skips.add(NO_SCAN, line)
                continue
            yield from continuity.passed(LogScan(scan, odometry, line))
        yield from continuity.rest()
        self.fraction_read = 1.0

    def _scan(self, message: _Message, stamp_s: float) -> LaserScan:
        """Return the sweep with the mount and the range limit of the whole log."""
        ranges = message.ranges_m
        limit_m = self._range_max_m(message)
        ranges[ranges <= 0.0] = np.nan
        ranges[ranges >= min(limit_m, FARTHEST_M)] = np.inf
        return LaserScan(
            stamp_s=stamp_s,
            ranges=ranges.astype(np.float32),
            angle_min_rad=message.first_rad,
            angle_increment_rad=message.step_rad,
            range_min_m=0.0,
            range_max_m=limit_m,
            mount=self._mount,
        )

    def _range_max_m(self, message: _Message) -> float:
        """Return from where on readings saw nothing: asked for, said by the log, or found."""
        if self._config.no_return_m is not None:
            return self._config.no_return_m
        own_m = message.range_max_m if message.range_max_m > 0.0 else math.inf
        if self._survey.said_no_return_m is not None:
            return own_m if message.range_max_m > 0.0 else self._survey.said_no_return_m
        if self._no_return.from_m is not None:
            return min(self._no_return.from_m, own_m)
        if own_m < math.inf:
            return own_m
        return self._no_return.largest_m * _ABOVE_LARGEST or _FALLBACK_RANGE_M


# --- lines to messages ---------------------------------------------------------------------------


def _messages(
    lines: TextLines,
    skips: Skips,
    seen: Counter[bytes],
    on_other: Callable[[bytes, bytes], None] | None = None,
) -> Iterator[tuple[int, _Message]]:
    """Yield line number and scan of every readable laser line; count the unreadable ones.

    Args:
        lines: of the log.
        skips: where unreadable lines are counted.
        seen: where laser lines are counted by their first word, unreadable ones too, each before
            its scan is yielded.
        on_other: told the first word and the line of everything that is no laser line.
    """
    pose: PoseRow | None = None
    number = 0
    for number, line in lines:
        word = (line.split(None, 1) or [b"#"])[0]
        parse = _PARSERS.get(word)
        seen[word] += word in _LASERS
        try:
            if parse is not None:
                yield number, parse(line.split())
            elif word == b"Odometry":
                pose = _odometry(line.split())
            elif word == b"Laser":
                yield number, _bare_laser(line.split(), pose)
            elif on_other is not None:
                on_other(word, line)
        except _BadLineError as error:
            skips.add(str(error), number)
    if lines.is_cut_off:
        skips.add(CUT_OFF_FILE, number + 1)


def _front_laser(fields: list[bytes]) -> _Message:
    """``FLASER n r.. x y theta odom_x odom_y odom_theta stamp host logger_stamp``."""
    ranges, rest = _readings(fields, 1, behind=9)
    laser, robot = _pose(rest[0:3]), _pose(rest[3:6])
    first_rad, step_rad = _forward(len(ranges))
    return _Message(b"FLASER", ranges, first_rad, step_rad, robot, laser, _finite(rest[6:7])[0])


def _robot_laser(fields: list[bytes]) -> _Message:
    """``ROBOTLASER1``: settings, ranges, remissions, laser pose, robot pose, speeds, stamps."""
    remissions_at = 9 + _count(fields, 8)
    behind = 15 + _count(fields, remissions_at)
    ranges, rest = _readings(fields, 8, behind)
    first_rad, view_rad, step_rad = _finite(fields[2:5])
    if step_rad == 0.0 and len(ranges) > 1:
        step_rad = view_rad / (len(ranges) - 1)
    if max(abs(first_rad), abs(step_rad)) > _ANGLE_MAX_RAD:
        raise _BadLineError(NO_SCAN)
    poses = rest[-14:-8]
    return _Message(
        b"ROBOTLASER1",
        ranges,
        first_rad,
        step_rad,
        robot=_pose(poses[3:6]),
        laser=_pose(poses[0:3]),
        stamp_s=_finite(rest[-3:-2])[0],
        range_max_m=float(_numbers(fields[5:6])[0]),
    )


def _laser_reading(fields: list[bytes]) -> _Message:
    """``LASER_READING n r.. x y theta stamp``."""
    ranges, rest = _readings(fields, 1, behind=4)
    first_rad, step_rad = _forward(len(ranges))
    return _Message(
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
        raise _BadLineError(WRONG_COUNT)
    return _pose(fields[1:4])


def _bare_laser(fields: list[bytes], pose: PoseRow | None) -> _Message:
    """``Laser n r..``, taken at the pose of the last ``Odometry`` line."""
    ranges, _ = _readings(fields, 1, behind=0)
    if pose is None:
        raise _BadLineError(NO_POSE_YET)
    first_rad, step_rad = _forward(len(ranges))
    return _Message(b"Laser", ranges, first_rad, step_rad, robot=pose)


_PARSERS: dict[bytes, Callable[[list[bytes]], _Message]] = {
    b"FLASER": _front_laser,
    b"ROBOTLASER1": _robot_laser,
    b"LASER_READING": _laser_reading,
}


def _readings(
    fields: list[bytes], count_at: int, behind: int
) -> tuple[npt.NDArray[np.float64], list[bytes]]:
    """Return the ranges after the field that counts them, and the ``behind`` fields after those."""
    count = _count(fields, count_at)
    first = count_at + 1
    if len(fields) != first + count + behind:
        raise _BadLineError(WRONG_COUNT)
    if count == 0:
        raise _BadLineError(NO_BEAMS)
    return _numbers(fields[first : first + count]), fields[first + count :]


def _count(fields: list[bytes], at: int) -> int:
    """Return a field that says how many fields follow."""
    if at >= len(fields):
        raise _BadLineError(WRONG_COUNT)
    if not fields[at].isdigit():
        raise _BadLineError(NOT_NUMBERS)
    return int(fields[at][:12])


def _numbers(fields: list[bytes]) -> npt.NDArray[np.float64]:
    try:
        return np.array(fields, dtype=np.float64)
    except ValueError:
        raise _BadLineError(NOT_NUMBERS) from None


def _finite(fields: list[bytes]) -> list[float]:
    try:
        values = [float(text) for text in fields]
    except ValueError:
        raise _BadLineError(NOT_NUMBERS) from None
    if not all(map(math.isfinite, values)):
        raise _BadLineError(NOT_FINITE)
    return values


def _pose(fields: list[bytes]) -> PoseRow:
    x, y, yaw_rad = _finite(fields)
    if max(abs(x), abs(y)) > FARTHEST_M:
        raise _BadLineError(TOO_FAR)
    return x, y, yaw_rad


def _forward(count: int) -> tuple[float, float]:
    """Return first angle and step of a laser that looks 180 degrees forward."""
    if count == 1:
        return 0.0, math.pi
    return -math.pi / 2.0, _FORWARD_STEPS_RAD.get(count, math.pi / (count - 1))


# --- the first pass ------------------------------------------------------------------------------


@dataclass
class _Stamps:
    """How many scans would be lost if the stamps of a log were believed."""

    scans: int = 0
    lost: int = 0
    absent: int = 0
    are_zero: bool = True
    _gate: StampGate[float] = field(default_factory=lambda: StampGate(math.inf, ahead_s=AHEAD_S))

    def add(self, stamp_s: float | None) -> None:
        self.scans += 1
        if stamp_s is None:
            self.absent += 1
            return
        self.are_zero &= stamp_s == 0.0
        newest_s = self._gate.newest_s
        if newest_s is not None and stamp_s <= newest_s:
            self.lost += 1
        else:
            self.lost += len(self._gate.offer(stamp_s, stamp_s).strays)

    def trouble(self) -> str:
        """Return why the stamps cannot be used; empty when they can."""
        if self.absent:
            return "the scans have no time stamps"
        if self.are_zero and self.scans > 1:
            return "all time stamps are 0"
        many = self.lost >= _LOST_AT_LEAST and self.lost > _LOST_SHARE * self.scans
        most = self.lost >= _LOST_FEW and self.lost > _LOST_MOST * self.scans
        if many or most:
            return (
                f"the time stamps are broken ({self.lost} of {self.scans} are not later than "
                "one before)"
            )
        return ""


@dataclass
class _Mount:
    """Where the laser sits, from the two poses of every scan's line."""

    scans: int = 0
    first_yaw_rad: float = 0.0
    total: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    low: npt.NDArray[np.float64] = field(default_factory=lambda: np.full(3, math.inf))
    high: npt.NDArray[np.float64] = field(default_factory=lambda: np.full(3, -math.inf))
    farthest_m: float = 0.0

    def add(self, robot: PoseRow, laser: PoseRow) -> None:
        relative = IDENTITY
        if robot != laser:
            relative = Pose2(*robot).inverse().compose(Pose2(*laser))
        if self.scans == 0:
            self.first_yaw_rad = relative.yaw_rad
        row = np.array((relative.x, relative.y, wrap_angle(relative.yaw_rad - self.first_yaw_rad)))
        self.scans += 1
        self.total += row
        self.low = np.minimum(self.low, row)
        self.high = np.maximum(self.high, row)
        self.farthest_m = max(self.farthest_m, abs(robot[0]), abs(robot[1]))

    def result(self, offset_m: float) -> tuple[Pose2, list[str]]:
        """Return the mount, and notes where it is not simply what the lines say.

        Args:
            offset_m: what the log's settings say: the laser is so far ahead of the robot's origin.
        """
        setting = f"{_OFFSET_PARAM} {offset_m:g} m"
        if self.scans == 0:
            note = f"the lines have no laser pose; the laser sits by the setting {setting}"
            return Pose2(offset_m, 0.0, 0.0), [note] if offset_m else []
        spread = self.high - self.low
        allowed_m = _MOUNT_SPREAD_M + _MOUNT_SPREAD_SHARE * self.farthest_m
        if max(spread[0], spread[1]) > allowed_m or spread[2] > _MOUNT_SPREAD_RAD:
            note = (
                "the laser's pose on the robot changes by up to "
                f"{max(spread[0], spread[1]):.3g} m and {spread[2]:.3g} rad, so it is not where "
                f"the laser sits (a corrected log?); taken instead: {setting}"
            )
            return Pose2(offset_m, 0.0, 0.0), [note]
        x, y, yaw_rad = self.total / self.scans
        yaw_rad = wrap_angle(yaw_rad + self.first_yaw_rad)
        if max(abs(x), abs(y), abs(yaw_rad)) < _MOUNT_ZERO:
            note = f"the setting {setting} is not used: in every line laser and robot have one pose"
            return IDENTITY, [note] if offset_m else []
        return Pose2(float(x), float(y), float(yaw_rad)), []


@dataclass
class _Survey:
    """What a first pass over a log finds."""

    path: Path
    skips: Skips = field(default_factory=Skips)
    words: Counter[bytes] = field(default_factory=Counter)
    # Laser lines, those that cannot be read too.
    lasers: Counter[bytes] = field(default_factory=Counter)
    settings: dict[str, float] = field(default_factory=dict)
    stamps: _Stamps = field(default_factory=_Stamps)
    # The same for ROBOTLASER1 alone: newer loggers write each scan twice, also as FLASER.
    own_stamps: _Stamps = field(default_factory=_Stamps)
    twice: int = 0
    odd_beams: Counter[int] = field(default_factory=Counter)
    mount: _Mount = field(default_factory=_Mount)
    finder: NoReturnFinder = field(default_factory=NoReturnFinder)
    # The smallest range limit that ROBOTLASER1 lines state.
    own_limit_m: float = math.inf
    _last: tuple[bytes, float | None] = (b"", None)

    def add(self, message: _Message) -> None:
        """Take in one scan."""
        self.words[message.kind] += 1
        self.stamps.add(message.stamp_s)
        if message.kind == b"ROBOTLASER1":
            self.own_stamps.add(message.stamp_s)
        elif len(message.ranges_m) not in _FORWARD_STEPS_RAD:
            self.odd_beams[len(message.ranges_m)] += 1
        now = (message.kind, message.stamp_s)
        self.twice += now[1] == self._last[1] and now[0] != self._last[0]
        self._last = now
        if message.laser is not None:
            self.mount.add(message.robot, message.laser)
        if message.range_max_m > 0.0:
            self.own_limit_m = min(self.own_limit_m, message.range_max_m)
        self.finder.add(message.ranges_m)

    def add_other(self, word: bytes, line: bytes) -> None:
        """Take in a line that is no scan."""
        if word == b"PARAM":
            name, value = (*line.split()[1:3], b"", b"")[:2]
            key = name.decode("ascii", "replace")
            if key in {_NO_RETURN_PARAM, _OFFSET_PARAM}:
                with suppress(ValueError):
                    self.settings[key] = float(value)
        if not word.startswith(b"#"):
            self.words[word if word in CARMEN_WORDS else b"other lines"] += 1

    def kinds(self) -> frozenset[bytes]:
        """Return the laser lines to use: all, but no scan twice."""
        if self.has_scans_twice():
            return frozenset({b"ROBOTLASER1"})
        return frozenset(_LASERS)

    def laser_lines(self) -> int:
        """Return how many laser lines are used, those that cannot be read too."""
        return _count_of(self.lasers, self.kinds())

    def has_scans_twice(self) -> bool:
        """Whether most scans stand in the log as FLASER and as ROBOTLASER1."""
        fewer = min(self.words[b"FLASER"], self.words[b"ROBOTLASER1"])
        return fewer > 0 and 2 * self.twice > fewer

    def stamp_trouble(self) -> str:
        """Return why the stamps cannot be used; empty when they can."""
        return (self.own_stamps if self.has_scans_twice() else self.stamps).trouble()

    @property
    def said_no_return_m(self) -> float | None:
        """The no-return value in the log's own settings, if any."""
        value = self.settings.get(_NO_RETURN_PARAM, math.nan)
        return value if value > 0.0 else None

    def offset_m(self) -> float:
        """Return how far ahead the laser sits by the log's settings."""
        value = self.settings.get(_OFFSET_PARAM, 0.0)
        return value if math.isfinite(value) else 0.0

    def no_return(self) -> NoReturn:
        """Return what the readings say."""
        return self.finder.result()

    def notes(self, config: LogConfig) -> list[str]:
        """Return what a user should know of time, angles and lines left out."""
        notes = []
        if self.stamp_trouble():
            notes.append(
                f"{self.stamp_trouble()}; used instead: the scan's index times "
                f"{config.index_period_s:g} s"
            )
        for beams, scans in sorted(self.odd_beams.items()):
            step_deg = math.degrees(_forward(beams)[1])
            notes.append(
                f"{scans} scans of {beams} beams do not say their angles; taken: 180 degrees "
                f"forward in steps of {step_deg:.4g} degrees"
            )
        if self.has_scans_twice():
            notes.append(f"the {self.words[b'FLASER']} FLASER lines repeat ROBOTLASER1; left out")
        for word, what in _OTHER_LASERS.items():
            if self.words[word]:
                notes.append(f"{self.words[word]} {word.decode()} lines left out: {what}")
        return notes


def _no_return_notes(survey: _Survey, found: NoReturn, config: LogConfig) -> list[str]:
    """Say which readings saw nothing, where the log does not say it itself."""
    if config.no_return_m is not None or survey.said_no_return_m is not None:
        return []
    if survey.own_limit_m < (math.inf if found.from_m is None else found.from_m):
        return [f"readings from {survey.own_limit_m:g} m on saw nothing, as the lines say"]
    if found.from_m is None:
        return ["no reading is repeated as lasers do that saw nothing; all count as hits"]
    return [
        f"readings from {found.from_m:.2f} m on saw nothing (the log repeats {found.code_m:g} m)"
    ]


def _take_survey(path: Path) -> _Survey:
    """Read the whole log once."""
    survey = _Survey(path)
    lines = TextLines(path)
    for _, message in _messages(lines, survey.skips, survey.lasers, survey.add_other):
        survey.add(message)
    if survey.stamps.scans == 0:
        raise LogError(_no_laser(survey))
    return survey


def _count_of(seen: Counter[bytes], words: Collection[bytes]) -> int:
    return sum(seen[word] for word in words)


def _no_laser(survey: _Survey) -> str:
    """Say in one line why there is nothing to read."""
    wanted = "FLASER, ROBOTLASER1, LASER_READING or Laser lines"
    if survey.skips.total:
        reasons = "; ".join(survey.skips.sentences())
        return f"{survey.path}: no readable laser scan among its lines: {reasons}; mend the file"
    if not survey.words:
        return f"{survey.path}: wanted {wanted}, found no line at all; the log is empty"
    found = ", ".join(f"{count} {word.decode()}" for word, count in survey.words.most_common(5))
    return (
        f"{survey.path}: wanted {wanted}, found {found}; there is no laser in it, give a log that "
        "recorded one"
    )


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


def write_carmen(
    path: str | Path, scans: Iterable[LogScan], *, files: AtomicFiles | None = None
) -> int:
    """Write scans as a CARMEN log; the same scans give the same bytes.

    A scan becomes a ``FLASER`` line when that says everything: 180, 181, 360 or 361 beams over
    180 degrees forward, a laser on the robot's origin, the range limit of the first scan. Any
    other becomes ``ROBOTLASER1``. +inf and over-range readings are written as the range limit
    (named in a ``PARAM`` line), NaN and -inf as 0. ``range_min_m`` has no place in the format.

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
    data = gzip_bytes(bytes(body)) if target.name.lower().endswith(".gz") else bytes(body)
    if files is not None:
        files.add(target, data)
    else:
        with AtomicFiles() as own:
            own.add(target, data)
    return count


def _head(first: LaserScan) -> str:
    return f"{_HEADER}PARAM {_NO_RETURN_PARAM} {first.range_max_m!r} nohost 0\n"


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
    first_rad, step_rad = _forward(len(scan))
    return (
        len(scan) in _FORWARD_STEPS_RAD
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
    return " ".join(
        clear_text if saw_nothing else f"{value:.{_RANGE_DIGITS}f}"
        for value, saw_nothing in zip(ranges.tolist(), clear.tolist(), strict=True)
    )


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
