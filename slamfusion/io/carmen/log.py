"""``CarmenLog``: the scans of a CARMEN log, after a first pass that finds what no line says alone.

The first pass finds whether the time stamps can be used, where the laser sits on the robot, and
which readings mean "nothing seen".
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.errors import LogError, ScanError
from slamfusion.geometry import F64, Pose2, wrap_angle
from slamfusion.grid import IDENTITY
from slamfusion.io.carmen.messages import (
    CARMEN_WORDS,
    FORWARD_STEPS_RAD,
    LASERS,
    NO_RETURN_PARAM,
    NO_SCAN,
    OFFSET_PARAM,
    OTHER_LASERS,
    TIME_INCREMENT_PARAM,
    Message,
    PoseRow,
    forward_angles,
    read_messages,
)
from slamfusion.io.lines import TextLines
from slamfusion.io.log import AHEAD_S, FARTHEST_M, LogScan, ScanLog, Skips
from slamfusion.io.scan_odometry import ScanOdometry
from slamfusion.io.stamps import StampGate
from slamfusion.scan import LaserScan

# Readings are counted in millimetres up to a kilometre: constant memory, however long the log.
_BINS_PER_M = 1000
_LIMIT_M = 1000.0
# No laser's longest range is shorter; a tidy room of equal readings must not look like one.
_SHORTEST_MAX_M = 3.5
# A value is repeated from this number of readings on that are at least this share of all ...
_REPEATED = ((10, 0.001), (3, 0.01))
# ... unless nearly every reading is that value: then there is nothing to tell it from.
_MOST = 0.95
# What SICK lasers write instead of a range: the last nine of 13 bits (in cm or mm), of 15 in mm.
_SICK_CODES_M = ((81.83, 81.91), (8.183, 8.191), (32.759, 32.767))
_SICK_REPEATED = 2
# A code stands out from the readings below it, and may have lesser codes beside it.
_STANDS_OUT = 10.0
_LESSER_SHARE = 0.01
_BAND = 0.95
_NEIGHBOURS = 0.85
# The codes of one laser scatter by this much once a log has scaled them.
_SLACK = 0.999
_TOP_BAND = 1.01


@dataclass(frozen=True)
class NoReturn:
    """What the readings of a log say about readings that saw nothing.

    Attributes:
        from_m: readings at or above this are no return; None where no value is repeated.
        code_m: the commonest value that stands for it; None likewise.
        largest_m: the largest finite reading, metres; 0 without any.
    """

    from_m: float | None
    code_m: float | None
    largest_m: float


class NoReturnFinder:
    """Find the value that a laser writes where nothing came back.

    The rule: going down from the longest readings, the first value that is often repeated (10
    readings and a thousandth of all, or 3 and a hundredth; two for the codes of SICK lasers), ten
    times as often as the values 5 to 15 % below it. Repeated values up to 5 % below belong to it
    when they have a hundredth of its readings. Everything from 0.1 % below the lowest of them on
    saw nothing. A largest reading that occurs once is a reading like any other.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(int(_LIMIT_M * _BINS_PER_M), dtype=np.int64)
        self._largest_m = 0.0

    def add(self, ranges_m: F64) -> None:
        """Count the readings of one scan, (N,) metres; NaN, infinity and 0 do not count."""
        usable = ranges_m[(ranges_m > 0.0) & (ranges_m < _LIMIT_M)]
        if usable.size:
            bins = np.rint(usable * _BINS_PER_M).astype(np.int64)
            np.add.at(self._counts, np.minimum(bins, len(self._counts) - 1), 1)
            self._largest_m = max(self._largest_m, float(usable.max()))

    def result(self) -> NoReturn:
        """Apply the rule to the readings so far."""
        counts = self._counts
        nothing = NoReturn(None, None, self._largest_m)
        total = int(counts.sum())
        repeated = np.flatnonzero(counts >= self._repeats_needed(total))
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
        # One code of a family may be rarer than what would do on its own.
        enough = max(_LESSER_SHARE * most, _STANDS_OUT * usual, _SICK_REPEATED)
        lowest = int(band[np.flatnonzero(counts[band] >= enough)[0]])
        return NoReturn(lowest * _SLACK / _BINS_PER_M, code / _BINS_PER_M, self._largest_m)

    def _repeats_needed(self, total: int) -> F64:
        """Return for each value how many readings make it a repeated one."""
        needed = min(max(least, share * total) for least, share in _REPEATED)
        result = np.full(len(self._counts), needed, dtype=np.float64)
        for low_m, high_m in _SICK_CODES_M:
            result[round(low_m * _BINS_PER_M) : round(high_m * _BINS_PER_M) + 1] = _SICK_REPEATED
        return result


# Stamps are broken when this share of the scans, and this number at least, is lost to them ...
_LOST_SHARE, _LOST_AT_LEAST = 0.05, 10
# ... or, in a short log, most of them.
_LOST_MOST, _LOST_FEW = 0.5, 3
# A laser sits still on its robot; logs of 6 significant digits let it move by their rounding.
_MOUNT_SPREAD_M, _MOUNT_SPREAD_SHARE, _MOUNT_SPREAD_RAD = 2e-3, 4e-6, 2e-3
# Below this a mount is the rounding of a laser that sits on the robot's origin.
_MOUNT_ZERO = 1e-9


@dataclass
class StampCheck:
    """How many scans would be lost if the stamps of a log were believed."""

    scans: int = 0
    lost: int = 0
    absent: int = 0
    are_zero: bool = True
    _gate: StampGate[float] = field(default_factory=lambda: StampGate(math.inf, ahead_s=AHEAD_S))

    def add(self, stamp_s: float | None) -> None:
        """Look at the stamp of the next scan, seconds; None: it has none."""
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
class MountEstimate:
    """Where the laser sits, from the two poses of every scan's line."""

    scans: int = 0
    first_yaw_rad: float = 0.0
    total: F64 = field(default_factory=lambda: np.zeros(3))
    low: F64 = field(default_factory=lambda: np.full(3, math.inf))
    high: F64 = field(default_factory=lambda: np.full(3, -math.inf))
    farthest_m: float = 0.0

    def add(self, robot: PoseRow, laser: PoseRow) -> None:
        """Look at the poses of robot and laser at the next scan, metres and radians."""
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
        """Return the mount, and notes where it is not simply what the lines say."""
        setting = f"{OFFSET_PARAM} {offset_m:g} m"
        if self.scans == 0:
            note = f"the lines have no laser pose; the laser sits by the setting {setting}"
            return Pose2(offset_m, 0.0, 0.0), [note] if offset_m else []
        spread = self.high - self.low
        allowed_m = _MOUNT_SPREAD_M + _MOUNT_SPREAD_SHARE * self.farthest_m
        if max(spread[0], spread[1]) > allowed_m or spread[2] > _MOUNT_SPREAD_RAD:
            note = (
                "the laser's pose on the robot changes by up to "
                f"{max(spread[0], spread[1]):.3g} m and {spread[2]:.3g} rad, so it is not where "
                f"the laser sits (a corrected log?); used instead: {setting}"
            )
            return Pose2(offset_m, 0.0, 0.0), [note]
        x, y, yaw_rad = self.total / self.scans
        yaw_rad = wrap_angle(yaw_rad + self.first_yaw_rad)
        if max(abs(x), abs(y), abs(yaw_rad)) < _MOUNT_ZERO:
            note = f"the setting {setting} is not used: in every line laser and robot have one pose"
            return IDENTITY, [note] if offset_m else []
        return Pose2(float(x), float(y), float(yaw_rad)), []


@dataclass
class Survey:
    """What a first pass over a log finds."""

    path: Path
    skips: Skips = field(default_factory=Skips)
    words: Counter[bytes] = field(default_factory=Counter)
    # Laser lines, those that cannot be read too.
    lasers: Counter[bytes] = field(default_factory=Counter)
    settings: dict[str, float] = field(default_factory=dict)
    stamps: StampCheck = field(default_factory=StampCheck)
    # The same for ROBOTLASER1 alone: newer loggers write each scan twice, also as FLASER.
    own_stamps: StampCheck = field(default_factory=StampCheck)
    twice: int = 0
    odd_beams: Counter[int] = field(default_factory=Counter)
    mount: MountEstimate = field(default_factory=MountEstimate)
    finder: NoReturnFinder = field(default_factory=NoReturnFinder)
    # The smallest range limit that ROBOTLASER1 lines state.
    own_limit_m: float = math.inf
    _last: tuple[bytes, float | None] = (b"", None)

    def add(self, message: Message) -> None:
        """Take in one scan."""
        self.words[message.kind] += 1
        self.stamps.add(message.stamp_s)
        if message.kind == b"ROBOTLASER1":
            self.own_stamps.add(message.stamp_s)
        elif len(message.ranges_m) not in FORWARD_STEPS_RAD:
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
            if key in {NO_RETURN_PARAM, OFFSET_PARAM, TIME_INCREMENT_PARAM}:
                with suppress(ValueError):
                    self.settings[key] = float(value)
        if not word.startswith(b"#"):
            self.words[word if word in CARMEN_WORDS else b"other lines"] += 1

    def kinds(self) -> frozenset[bytes]:
        """Return the laser lines to use: all, but no scan twice."""
        if self.has_scans_twice():
            return frozenset({b"ROBOTLASER1"})
        return frozenset(LASERS)

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
        value = self.settings.get(NO_RETURN_PARAM, math.nan)
        return value if value > 0.0 else None

    @property
    def time_increment_s(self) -> float:
        """The time from beam to beam in the log's own settings, seconds; 0: it says none."""
        value = self.settings.get(TIME_INCREMENT_PARAM, 0.0)
        return value if math.isfinite(value) else 0.0

    def offset_m(self) -> float:
        """Return how far ahead the laser sits by the log's settings."""
        value = self.settings.get(OFFSET_PARAM, 0.0)
        return value if math.isfinite(value) else 0.0

    def notes(self, config: LogConfig) -> list[str]:
        """Return what a user should know of time, angles and lines left out."""
        notes = []
        if self.stamp_trouble():
            notes.append(
                f"{self.stamp_trouble()}; used instead: the scan's index times "
                f"{config.index_period_s:g} s"
            )
        for beams, scans in sorted(self.odd_beams.items()):
            step_deg = math.degrees(forward_angles(beams)[1])
            notes.append(
                f"{scans} scans of {beams} beams do not say their angles; taken: 180 degrees "
                f"forward in steps of {step_deg:.4g} degrees"
            )
        if self.has_scans_twice():
            notes.append(f"the {self.words[b'FLASER']} FLASER lines repeat ROBOTLASER1; left out")
        for word, what in OTHER_LASERS.items():
            if self.words[word]:
                notes.append(f"{self.words[word]} {word.decode()} lines left out: {what}")
        return notes


def no_return_notes(survey: Survey, found: NoReturn, config: LogConfig) -> list[str]:
    """Say which readings saw nothing, where the log does not say it itself."""
    if config.no_return_m is not None or survey.said_no_return_m is not None:
        return []
    if survey.own_limit_m < (math.inf if found.from_m is None else found.from_m):
        return [f"readings from {survey.own_limit_m:g} m on are no return, as the lines say"]
    if found.from_m is None:
        return ["no reading is repeated, as lasers do without a return; all count as hits"]
    return [
        f"readings from {found.from_m:.2f} m on are no return (the log repeats {found.code_m:g} m)"
    ]


def take_survey(path: Path) -> Survey:
    """Read the whole log once."""
    survey = Survey(path)
    lines = TextLines(path)
    for _, message in read_messages(lines, survey.skips, survey.lasers, survey.add_other):
        survey.add(message)
    if survey.stamps.scans == 0:
        raise LogError(_no_laser(survey))
    return survey


def count_of(seen: Counter[bytes], words: Collection[bytes]) -> int:
    """Return how many lines begin with one of the words."""
    return sum(seen[word] for word in words)


def _no_laser(survey: Survey) -> str:
    wanted = "FLASER, ROBOTLASER1, LASER_READING or Laser lines"
    if survey.skips.total:
        reasons = "; ".join(survey.skips.sentences())
        return f"{survey.path}: no readable laser scan among its lines: {reasons}; fix the file"
    if not survey.words:
        return f"{survey.path}: wanted {wanted}, found no line at all; the log is empty"
    found = ", ".join(f"{count} {word.decode()}" for word, count in survey.words.most_common(5))
    return (
        f"{survey.path}: wanted {wanted}, found {found}; there is no laser in it, give a log that "
        "recorded one"
    )


_DEFAULT_CONFIG = LogConfig()

# Above every range of a log whose readings are all real.
_ABOVE_LARGEST = 1.001
_FALLBACK_RANGE_M = 100.0


class CarmenLog(ScanLog):
    """A CARMEN log, plain or gzip; each iteration reads from the start (see ``ScanLog``).

    Readings at or above the no-return value become +inf; 0 and negative readings become NaN. The
    odometry is the robot's pose in the scan's own line. ``line`` is the line in the file, from 1.

    Args:
        config: ``no_return_m`` overrides what is found; ``index_period_s`` is the time from scan
            to scan where stamps are broken or absent.
        odometry: taken instead of the poses in the log, by the number of the laser line; for a
            log whose own poses are the answer of a SLAM. Default: the log's own.

    Raises:
        LogError: there is no readable laser scan in the file, or the odometry is of another one.
    """

    def __init__(
        self,
        path: str | Path,
        config: LogConfig = _DEFAULT_CONFIG,
        odometry: ScanOdometry | None = None,
    ) -> None:
        super().__init__(path, config)
        self._odometry = odometry
        self._survey = take_survey(self.path)
        if odometry is not None:
            odometry.check_count(self.path, count_of(self._survey.lasers, self._survey.kinds()))
        self.has_stamps = not self._survey.stamp_trouble()
        self._mount, mount_notes = self._survey.mount.result(self._survey.offset_m())
        self._no_return = self._survey.finder.result()
        self.notes = [
            *self._survey.notes(config),
            *mount_notes,
            *no_return_notes(self._survey, self._no_return, config),
        ]
        del self._survey.finder  # 8 MB of counts: a log is sent to other processes
        if odometry is not None:
            self.notes.append(f"odometry is that of {odometry.path}, not the poses in the log")

    def __iter__(self) -> Iterator[LogScan]:
        continuity = self._begin()
        lines = TextLines(self.path)
        kinds = self._survey.kinds()
        index = 0
        seen: Counter[bytes] = Counter()
        for line, message in read_messages(lines, self.skips, seen):
            self.fraction_read = lines.fraction_read
            if message.kind not in kinds:
                continue
            odometry = Pose2(*message.robot)
            if self._odometry is not None:
                number = count_of(seen, kinds) - 1
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

    def _scan(self, message: Message, stamp_s: float) -> LaserScan:
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
            time_increment_s=self._survey.time_increment_s,
        )

    def _range_max_m(self, message: Message) -> float:
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
