"""``TinySlamDat``: tinySLAM's own recordings, wheel ticks and a Hokuyo URG-04LX.

One scan a line, 707 numbers: time in microseconds, left and right wheel ticks (fields 2 and 3),
682 ranges in millimetres (fields 24 to 705).

Source: Steux and El Hamzaoui, tinySLAM, ICARCV 2010, whose recordings these are; the robot's
measures as BreezySLAM uses them; the laser's angles from the data sheet of the URG-04LX.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.errors import LogError
from slamfusion.geometry import F64, Pose2, wrap_angle
from slamfusion.io.log import FARTHEST_M, NOT_NUMBERS, BadLineError, LogScan, ScanLog, parsed_lines
from slamfusion.scan import LaserScan

FIELDS = 707
_BEAMS = slice(24, 706)
_METRES_PER_TICK = 2.0 * math.pi * 0.077 / 2000.0
_HALF_AXLE_M = 0.165
_MOUNT = Pose2(0.145, 0.0, 0.0)
# Data sheet: 1024 steps a turn; 44 to 725 are measured, 384 looks ahead.
_STEP_RAD = 2.0 * math.pi / 1024.0
_FIRST_RAD = (44 - 384) * _STEP_RAD
# The robot's body hides this number of beams at each side.
_HIDDEN = 70
_RANGE_MAX_M = 4.0
# Smaller readings are error codes (0: no return).
_RANGE_MIN_M = 0.02

WRONG_COUNT = f"not {FIELDS} fields (a cut-off line?)"
NOT_FINITE = "ticks or time not finite"
# Largest exact integer of a float64.
_COUNT_MAX = 2.0**53


class TinySlamDat(ScanLog):
    """A tinySLAM recording, plain or gzip.

    The odometry starts at (0, 0, 0) and follows the wheels along exact arcs. ``line`` is the line
    in the file, from 1.

    Raises:
        LogError: no line of the file is a scan.
    """

    def __init__(self, path: str | Path, config: LogConfig = LogConfig()) -> None:
        super().__init__(path, config)
        self.notes.append(f"{_HIDDEN} beams at each side are left out: the robot's body hides them")
        self._range_max_m = config.no_return_m or _RANGE_MAX_M
        lines = parsed_lines(self.path, _parsed)
        rows = [values for _, _, values in lines if not isinstance(values, str)]
        table = np.array([values[[0, 2, 3]] for values in rows]).reshape(-1, 3)
        stamps_s = table[:, 0] * 1e-6
        ways_m = np.diff(table[:, 1:], axis=0, prepend=table[:1, 1:]) * _METRES_PER_TICK
        pose, index = Pose2(), 0
        for number, _, values in lines:
            if isinstance(values, str):
                self.records.append((number, values))
                continue
            pose = drive_arc(pose, *ways_m[index].tolist())
            scan = self._scan(values[_BEAMS] * 1e-3, float(stamps_s[index]))
            self.records.append((number, LogScan(scan, pose, number)))
            index += 1
        if not rows:
            for number, fault in self.records:
                self.skips.add(str(fault), number)
            reasons = "; ".join(self.skips.sentences()) or "the file is empty"
            raise LogError(
                f"{self.path}: wanted lines of {FIELDS} numbers as tinySLAM records them, found "
                f"none: {reasons}; check the file"
            )

    def _scan(self, ranges_m: F64, stamp_s: float) -> LaserScan:
        """Return the sweep: 0 is +inf; error codes and hidden beams are NaN."""
        ranges = np.where((ranges_m == 0.0) | (ranges_m > FARTHEST_M), np.inf, ranges_m)
        ranges[ranges < _RANGE_MIN_M] = np.nan
        ranges[:_HIDDEN] = np.nan
        ranges[-_HIDDEN:] = np.nan
        return LaserScan(
            stamp_s=stamp_s,
            ranges=ranges.astype(np.float32),
            angle_min_rad=_FIRST_RAD,
            angle_increment_rad=_STEP_RAD,
            range_min_m=_RANGE_MIN_M,
            range_max_m=self._range_max_m,
            mount=_MOUNT,
        )


def _parsed(line: bytes) -> F64 | None:
    """Return the numbers of a line without the last, which may be damaged."""
    fields = line.split()
    if not fields or fields[0].startswith(b"#"):
        return None
    if len(fields) != FIELDS:
        raise BadLineError(WRONG_COUNT)
    try:
        values = np.array(fields[: FIELDS - 1], dtype=np.float64)
    except ValueError:
        raise BadLineError(NOT_NUMBERS) from None
    if not (np.abs(values[[0, 2, 3]]) < _COUNT_MAX).all():
        raise BadLineError(NOT_FINITE)
    return values


def drive_arc(start: Pose2, left_m: float, right_m: float) -> Pose2:
    """Return the pose after a circular arc (Siegwart and Nourbakhsh, section 5.2.4)."""
    turn_rad = (right_m - left_m) / (2.0 * _HALF_AXLE_M)
    way_m = 0.5 * (left_m + right_m)
    # The chord of the arc points along its middle heading; sin(x) / x is 1 on a straight line.
    half_rad = 0.5 * turn_rad
    chord_m = way_m * (math.sin(half_rad) / half_rad if abs(half_rad) > 1e-9 else 1.0)
    heading_rad = start.yaw_rad + half_rad
    return Pose2(
        start.x + chord_m * math.cos(heading_rad),
        start.y + chord_m * math.sin(heading_rad),
        wrap_angle(start.yaw_rad + turn_rad),
    )
