"""``LaserScan``: one sweep of a planar laser.

Readings follow REP-117: a finite range inside the limits is a hit, +inf is no return up to the
longest range, -inf too close to measure, NaN a failed reading. Readers convert the no-return values
of their formats (0, 81.91) to +inf.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from slamfusion.config import YAW_MOST_RAD, LaserMounting
from slamfusion.errors import ScanError
from slamfusion.geometry import B8, F32, F64, Pose2, transform_points
from slamfusion.grid import IDENTITY


@lru_cache(maxsize=8)
def _directions(beams: int, first_rad: float, step_rad: float, yaw_rad: float) -> F64:
    """Return the unit vectors of a laser's beams in the base frame, (N, 2)."""
    angles = first_rad + step_rad * np.arange(beams, dtype=np.float64) + yaw_rad
    return np.stack((np.cos(angles), np.sin(angles)), axis=-1)


@dataclass(frozen=True, eq=False)
class LaserScan:
    """One sweep.

    Attributes:
        stamp_s: time of the first beam, seconds.
        ranges: (N,) float32, metres, in the order of the beams; may hold NaN and infinity.
        angle_min_rad: direction of the first beam in the laser's frame, counter-clockwise.
        angle_increment_rad: from one beam to the next; negative for a laser that turns clockwise.
        range_min_m: smaller readings are too close to be measured.
        range_max_m: readings at or above are no return.
        mount: pose of the laser in the robot's base frame; metres, radians.
        time_increment_s: time from one beam to the next, as logged; 0: unknown, or none.
        motion: (N, 3) float64, pose of the base at the time of each beam, relative to the stamp's;
            metres, radians. None: it stood still. See ``slamfusion.deskew``.

    Raises:
        ScanError: wrong shape, no beam, or a geometry that is not finite or beyond two turns.
    """

    stamp_s: float
    ranges: F32
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    mount: Pose2 = IDENTITY
    time_increment_s: float = 0.0
    motion: F64 | None = None

    def __post_init__(self) -> None:
        ranges = np.ascontiguousarray(self.ranges, dtype=np.float32)
        if ranges.ndim != 1 or ranges.size == 0:
            raise ScanError(f"a scan needs a row of at least one range, found shape {ranges.shape}")
        numbers = (self.stamp_s, self.angle_min_rad, self.angle_increment_rad)
        if not all(math.isfinite(value) for value in numbers):
            raise ScanError(f"stamp, first angle and angle step must be finite, found {numbers}")
        if ranges.size > 1 and self.angle_increment_rad == 0.0:
            raise ScanError(f"the angle between the {ranges.size} beams of a scan must not be 0")
        last_rad = self.angle_min_rad + self.angle_increment_rad * (ranges.size - 1)
        if max(abs(self.angle_min_rad), abs(last_rad)) > YAW_MOST_RAD:
            raise ScanError(
                "the angles of a scan must lie within two turns, found "
                f"{self.angle_min_rad:.3g} to {last_rad:.3g} rad (degrees?)"
            )
        if not 0.0 <= self.range_min_m < self.range_max_m:
            raise ScanError(
                f"range limits must satisfy 0 <= min < max, "
                f"found {self.range_min_m:g} and {self.range_max_m:g}"
            )
        if ranges is self.ranges:
            if not ranges.flags.writeable:
                return
            ranges = ranges.copy()
        ranges.flags.writeable = False
        object.__setattr__(self, "ranges", ranges)

    def __len__(self) -> int:
        return int(self.ranges.size)

    def angles(self) -> F64:
        """Return the direction of each beam in the laser's frame, (N,) radians."""
        steps = np.arange(len(self), dtype=np.float64)
        return np.asarray(self.angle_min_rad + self.angle_increment_rad * steps)

    def is_hit(self, usable_m: float = math.inf) -> B8:
        """Return which beams hit something below ``usable_m``, (N,)."""
        hit = (self.ranges >= self.range_min_m) & (self.ranges > 0.0)
        return np.asarray(hit & (self.ranges < min(self.range_max_m, usable_m)))

    def is_clear(self) -> B8:
        """Return which beams have no return up to ``range_max_m``, (N,): +inf or over-range."""
        return np.asarray(self.ranges >= self.range_max_m)

    def remounted(self, mounting: LaserMounting) -> LaserScan:
        """Return the scan of a laser that is mirrored (upside down) or looks backward."""
        if mounting == "mirrored":
            first, step = -self.angle_min_rad, -self.angle_increment_rad
            return replace(self, angle_min_rad=first, angle_increment_rad=step)
        if mounting == "backward":
            return replace(self, mount=self.mount.compose(Pose2(0.0, 0.0, math.pi)))
        return self

    def points(
        self, beams: B8 | None = None, ranges_m: npt.NDArray[np.floating] | None = None
    ) -> F64:
        """Return the ends of beams in the robot's base frame at the stamp, (M, 2) metres.

        Args:
            beams: (N,) bool; default: every hit.
            ranges_m: (N,) metres; default: the readings.
        """
        chosen = self.is_hit() if beams is None else beams
        mount, ranges = self.mount, self.ranges if ranges_m is None else ranges_m
        laser = len(self), self.angle_min_rad, self.angle_increment_rad, mount.yaw_rad
        # A third of the time of an index.
        ends = _directions(*laser).compress(chosen, axis=0)
        ends *= ranges.compress(chosen)[:, None]
        ends += mount.x, mount.y
        return ends if self.motion is None else transform_points(self.motion[chosen], ends)
