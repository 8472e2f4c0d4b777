"""The common part of all log readers: scans in the order of time, and counts of skipped ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TypedDict, TypeVar

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.deskew import Deskewer, Deskewing, Track
from slamfusion.errors import LogError
from slamfusion.geometry import F64, Pose2
from slamfusion.io.files import check_memory
from slamfusion.io.lines import text_lines
from slamfusion.io.stamps import StampGate
from slamfusion.scan import LaserScan
from slamfusion.trajectory import Trajectory

T = TypeVar("T")

# No robot is farther from the origin of its frame; beyond, sums of poses lose their centimetres.
FARTHEST_M = 1e9

# Largest distance in time to a known pose for interpolation, seconds.
REACH_S = 0.5
LINES_KEPT = 5
# Larger gaps and jumps between two scans give a warning.
GAP_S = 3600.0
JUMP_M = 50.0
# A scan further ahead, seconds, waits for two more to confirm its time. Lines of a log may be out
# of order by less.
AHEAD_S = 10.0

# Enough to find the duration of a sweep.
FIRST_SCANS = 500

# Stamp offset between scans of two lasers that have one stamp, seconds.
LASERS_APART_S = 1e-6

# Memory is checked each time the scans take this much more.
_CHECKED_BYTES = 1 << 26

BACK, EQUAL = "time goes back", "two scans of one stamp"
NO_SCAN = "angles or ranges that cannot be a scan"
BEFORE_ODOMETRY = "laser before odometry"
STRAY = "a time stamp far ahead of those before and after it"


@dataclass(frozen=True, eq=False)
class LogScan:
    """One scan of a log.

    Attributes:
        odometry: pose of the base in the odometry frame at the scan's time; None without odometry.
        line: line or message number in the source, from 1.
    """

    scan: LaserScan
    odometry: Pose2 | None
    line: int


class SkipJson(TypedDict):
    """Things of one kind that were left out or warned of."""

    reason: str
    """What was the matter."""
    count: int
    """How often."""
    first_lines: list[int]
    """Line, message or scan numbers of the first ones, from 1."""


@dataclass
class Skips:
    """What was left out (or warned of), by reason: the count and the first lines."""

    counts: dict[str, int] = field(default_factory=dict)
    lines: dict[str, list[int]] = field(default_factory=dict)

    def add(self, reason: str, line: int) -> None:
        """Count one thing at a line or message number."""
        self.counts[reason] = self.counts.get(reason, 0) + 1
        kept = self.lines.setdefault(reason, [])
        if len(kept) < LINES_KEPT:
            kept.append(line)

    @property
    def total(self) -> int:
        """Things counted."""
        return sum(self.counts.values())

    def sentences(self, what: str = "line") -> tuple[str, ...]:
        """Return one sentence per reason, with the first line (or scan) numbers."""
        return tuple(
            f"{count} x {reason} ({what} {', '.join(map(str, self.lines[reason]))}"
            f"{', ...' if count > len(self.lines[reason]) else ''})"
            for reason, count in sorted(self.counts.items())
        )

    def to_json(self) -> list[SkipJson]:
        """Return the counts for a JSON document."""
        return [
            {"reason": reason, "count": count, "first_lines": list(self.lines[reason])}
            for reason, count in sorted(self.counts.items())
        ]


class Continuity:
    """Passes scans whose time increases, deskewed and with the configured mount; counts the others.

    A scan after a pause of 10 s waits for two more to confirm its time (see ``StampGate``). Scans
    of different lasers with one stamp are set a microsecond apart. A gap of an hour or an odometry
    jump of 50 m is counted as a warning.

    Args:
        track: gives the odometry within a sweep; default: interpolated between two scans.
    """

    def __init__(
        self,
        skips: Skips,
        warnings: Skips,
        config: LogConfig = LogConfig(),
        track: Track | None = None,
    ) -> None:
        self.deskewer = Deskewer(config)
        self._track = track
        # The last two scans; ``_is_held``: the newest is not deskewed yet.
        self._last: LogScan | None = None
        self._before: LogScan | None = None
        self._is_held = False
        self._mounting = config.laser
        self._skips = skips
        self._warnings = warnings
        # Older scans are refused before the gate.
        self._gate: StampGate[LogScan] = StampGate(math.inf, ahead_s=AHEAD_S)
        self._stamp_s: float | None = None
        self._odometry: Pose2 | None = None
        # The lasers that had the last stamp.
        self._given_s: float | None = None
        self._mounts: list[Pose2] = []

    def passed(self, item: LogScan) -> Iterator[LogScan]:
        """Take the next scan, and yield those to be used."""
        item = self._later_by_laser(item)
        stamp_s, newest_s = item.scan.stamp_s, self._gate.newest_s
        if newest_s is not None and stamp_s <= newest_s:
            self._refuse(newest_s, item)
            return
        passed = self._gate.offer(stamp_s, item)
        for stray in passed.strays:
            self._skips.add(STRAY, stray.line)
        yield from self._noted(passed.items)

    def rest(self) -> Iterator[LogScan]:
        """Yield the scans that still wait at the end of the log."""
        yield from self._noted(self._gate.confirm().items)
        yield from self._deskewed(self._before, self._last)

    def _later_by_laser(self, item: LogScan) -> LogScan:
        """Return the scan with a stamp that no other laser has."""
        stamp_s, mount = item.scan.stamp_s, item.scan.mount
        if stamp_s != self._given_s:
            self._given_s, self._mounts = stamp_s, []
        elif mount not in self._mounts:
            later_s = stamp_s + LASERS_APART_S * len(self._mounts)
            item = replace(item, scan=replace(item.scan, stamp_s=later_s))
        self._mounts.append(mount)
        return item

    def _refuse(self, newest_s: float, item: LogScan) -> None:
        is_equal = item.scan.stamp_s == newest_s
        self._skips.add(EQUAL if is_equal else BACK, item.line)

    def _noted(self, items: tuple[LogScan, ...]) -> Iterator[LogScan]:
        for item in items:
            stamp_s, line = item.scan.stamp_s, item.line
            if self._stamp_s is not None and stamp_s <= self._stamp_s:
                self._refuse(self._stamp_s, item)
                continue
            if self._stamp_s is not None and stamp_s - self._stamp_s >= GAP_S:
                self._warnings.add("no scan for an hour or more", line)
            odometry, last = item.odometry, self._odometry
            if odometry is not None:
                if last is not None and math.hypot(odometry.x - last.x, odometry.y - last.y) >= (
                    JUMP_M
                ):
                    self._warnings.add(f"odometry jumps by {JUMP_M:g} m or more", line)
                self._odometry = odometry
            self._stamp_s = stamp_s
            item = replace(item, scan=item.scan.remounted(self._mounting))  # noqa: PLW2901
            self.deskewer.note(item.scan.stamp_s)
            yield from self._deskewed(self._last, item)
            self._before, self._last = self._last, item
            self._is_held = self.deskewer.is_skewed(item.scan)
            if not self._is_held:
                yield item

    def _deskewed(self, first: LogScan | None, second: LogScan | None) -> Iterator[LogScan]:
        """Yield the held scan, deskewed by the motion between two scans."""
        if not self._is_held or self._last is None:
            return
        self._is_held = False
        times = self.deskewer.times(self._last.scan)
        if self._track is None or self._last.odometry is None:
            poses = self._between(first, second, times)
        else:
            poses = self._track(times)
        yield replace(self._last, scan=self.deskewer.moved(self._last.scan, poses))

    def _between(self, first: LogScan | None, second: LogScan | None, times: F64) -> F64 | None:
        """Return poses (K, 3) at times from the odometry of two scans, or from matching them."""
        if first is None or second is None:
            return None
        span_s = second.scan.stamp_s - first.scan.stamp_s
        if span_s > 2.0 * REACH_S or len(times) == 1:
            return None
        if first.odometry is None or second.odometry is None:
            end = self.deskewer.matched(first.scan, second.scan)
        else:
            motion = first.odometry.inverse().compose(second.odometry)
            end = np.array((motion.x, motion.y, motion.yaw_rad))
        return None if end is None else np.outer((times - first.scan.stamp_s) / span_s, end)


def odometry_path(scans: Iterable[LogScan], name: str) -> Trajectory:
    """Return the odometry of the scans that have it."""
    rows = [
        (item.scan.stamp_s, pose.x, pose.y, pose.yaw_rad)
        for item in scans
        if (pose := item.odometry) is not None
    ]
    table = np.array(rows).reshape(-1, 4)
    return Trajectory(table[:, 0], table[:, 1:], name)


def deskewed_scans(scans: Iterable[LogScan]) -> Iterator[LogScan]:
    """Yield deskewed scans, as a log does."""
    continuity = Continuity(Skips(), Skips())
    for item in scans:
        yield from continuity.passed(item)
    yield from continuity.rest()


class _CutOffError(LogError):
    """A packed log ends early."""


class BadLineError(Exception):
    """A line that cannot be read; its text is the reason for the count."""


NOT_NUMBERS = "not numbers"
CUT_OFF_FILE = "the packed file ends early or is damaged; nothing after this was read"


def parsed_lines(
    path: Path, parse: Callable[[bytes], T | None]
) -> list[tuple[int, bytes, T | str]]:
    """Return number, first word and content (or the reason for a fault) of a text log's lines.

    Lines for which ``parse`` returns None are left out.
    """
    found: list[tuple[int, bytes, T | str]] = []
    number = kept_bytes = 0
    try:
        for number, line in text_lines(path, _CutOffError):
            try:
                own: T | str | None = parse(line)
            except BadLineError as error:
                own = str(error)
            if own is not None:
                found.append((number, line.split(None, 1)[0], own))
                kept_bytes += 2 * len(line)  # 8 bytes for a number of some 5 characters
            if kept_bytes > _CHECKED_BYTES:
                check_memory(kept_bytes, "keeping its scans", str(path), "free memory, or cut it")
                kept_bytes = 0
    except _CutOffError:
        found.append((number + 1, b"", CUT_OFF_FILE))
    return found


class ScanLog:
    """The scans of a log or bag; each iteration starts from the first one.

    A text log is parsed once, when it is opened; its scans stay in memory. Bags are read as a
    stream (``BagLog``).

    Attributes:
        records: line number and scan of every laser line, or why it has none.
        skips: what the last iteration has left out so far.
        warnings: gaps and jumps that the last iteration has let through so far.
        notes: sentences for the user.
        has_stamps: whether times are the log's own; else they are made from the scans' index.
        fraction_read: progress of the current iteration, 0 to 1.
        deskewing: the scans that the last iteration has deskewed so far.
    """

    def __init__(self, path: str | Path, config: LogConfig) -> None:
        self.path = Path(path)
        self.records: list[tuple[int, LogScan | str]] = []
        self.skips, self.warnings = Skips(), Skips()
        self.notes: list[str] = []
        self.has_stamps = True
        self.fraction_read = 0.0
        self.deskewing = Deskewing()
        self._config = config
        # The odometry within a sweep, if known better than from two scans.
        self._track: Track | None = None

    def __iter__(self) -> Iterator[LogScan]:
        """Yield the scans; stamps strictly increase.

        Raises:
            LogError: the file is damaged beyond a line.
        """
        self.skips, self.warnings, self.fraction_read = Skips(), Skips(), 0.0
        continuity = Continuity(self.skips, self.warnings, self._config, self._track)
        self.deskewing = continuity.deskewer.done
        for item in self._scans():
            yield from continuity.passed(item)
        yield from continuity.rest()
        self.fraction_read = 1.0

    def learn_sweep(self) -> None:
        """Find the duration of a sweep from the first scans, if they contradict the log's value."""
        deskewer = Deskewer(self._config)
        with suppress(LogError):  # reading the log raises it again
            for item in islice(self, FIRST_SCANS):
                deskewer.note(item.scan.stamp_s)
                if item.odometry is None or deskewer.learn(item.scan, item.odometry):
                    break
        self.skips, self.warnings, self.fraction_read = Skips(), Skips(), 0.0
        if deskewer.learned_s is not None:
            self._config = replace(self._config, sweep_s=deskewer.learned_s)
            self.notes.append(
                f"taken: a sweep lasts {deskewer.learned_s:.3f} s (0: all beams are of one time), "
                "unlike its time_increment; so the scans of turns fit the others; set --sweep-s "
                "where it is wrong"
            )

    def _scans(self) -> Iterator[LogScan]:
        for index, (line, found) in enumerate(self.records, start=1):
            self.fraction_read = index / len(self.records)
            if isinstance(found, str):
                self.skips.add(found, line)
            else:
                yield found


@dataclass(frozen=True)
class LogRecord:
    """What a log said of itself while it was read."""

    path: Path
    """Where it lies."""
    skipped: Skips
    """What was left out, by reason."""
    warnings: Skips
    """What was let through although it is odd, by reason."""
    notes: Sequence[str]
    """Sentences for the user."""
    has_stamps: bool
    """Whether times are the log's own; else they are made from the scans' index."""

    @classmethod
    def of(cls, log: ScanLog) -> LogRecord:
        """Return the record of a log's last iteration."""
        notes = (*log.notes, *log.deskewing.sentences())
        return cls(log.path, log.skips, log.warnings, notes, log.has_stamps)

    def faults(self) -> list[tuple[str, str]]:
        """Return what was left out and what is odd, each with its place; notes of unknown times."""
        faults = [("left out of the log", text) for text in self.skipped.sentences()]
        faults += [("odd in the log", text) for text in self.warnings.sentences()]
        return faults if self.has_stamps else [*faults, *(("the log", it) for it in self.notes)]
