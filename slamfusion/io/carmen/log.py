"""``CarmenLog``: a CARMEN log as a stream of scans."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.deskew import Deskewing
from slamfusion.errors import ScanError
from slamfusion.geometry import Pose2
from slamfusion.io.carmen.messages import NO_SCAN, Message, read_messages
from slamfusion.io.carmen.survey import count_of, no_return_notes, take_survey
from slamfusion.io.lines import TextLines
from slamfusion.io.log import FARTHEST_M, Continuity, LogScan, Skips
from slamfusion.io.scan_odometry import ScanOdometry
from slamfusion.scan import LaserScan

_DEFAULT_CONFIG = LogConfig()

# Above every range of a log whose readings are all real.
_ABOVE_LARGEST = 1.001
_FALLBACK_RANGE_M = 100.0


class CarmenLog:
    """A CARMEN log, plain or gzip; each iteration reads from the start (see ``ScanLog``).

    Readings at or above the no-return value become +inf; 0 and negative readings become NaN. The
    odometry is the robot's pose in the scan's own line. ``line`` is the line in the file, from 1.

    Args:
        path: the file.
        config: ``no_return_m`` overrides what is found; ``index_period_s`` is the time from scan
            to scan where stamps are broken or absent.
        odometry: taken instead of the poses in the log, by the number of the laser line; for a
            log whose own poses are the answer of a SLAM. Default: the log's own.

    Attributes:
        path, skips, warnings, notes, has_stamps, fraction_read, deskewing: see ``ScanLog``.

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
        self.deskewing = Deskewing()
        self._config = config
        self._odometry = odometry
        self._survey = take_survey(self.path)
        if odometry is not None:
            odometry.check_count(self.path, self._survey.laser_lines())
        self.has_stamps = not self._survey.stamp_trouble()
        self._mount, mount_notes = self._survey.mount.result(self._survey.offset_m())
        self._no_return = self._survey.no_return()
        self.notes = [
            *self._survey.notes(config),
            *mount_notes,
            *no_return_notes(self._survey, self._no_return, config),
        ]
        if odometry is not None:
            self.notes.append(f"odometry is that of {odometry.path}, not the poses in the log")

    def __iter__(self) -> Iterator[LogScan]:
        """Yield the scans; stamps strictly increase.

        Raises:
            LogError: the odometry was made for other scans.
        """
        self.skips, self.warnings = Skips(), Skips()
        continuity = Continuity(self.skips, self.warnings, self._config)
        self.deskewing = continuity.deskewer.done
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
