"""``KnownMotions``: the motion from one scan to the next where walls do not determine it.

Along a bare corridor a scan matcher has only the odometry, and shortens it, in each SLAM by another
amount. So distances between scans are those of the odometry itself. Its systematic errors (wheel
size, a turned base) are a calibration of two numbers that is estimated together with the poses:
walls determine it elsewhere in the drive. Headings remain the path's, since scans turn better than
wheels do.

The path replaces the odometry where their distances differ by more than a calibration explains
(wheels that slip or stand still, a robot that is carried), or where the walls move a scan away from
it.

Source: Borenstein and Feng, Measurement and correction of systematic odometry errors in mobile
robots, IEEE T-RA 12(6), 1996 (what odometry errs by); Censi, Franchi, Marchionni and Oriolo,
Simultaneous calibration of odometry and sensor parameters for mobile robots, IEEE T-RO 29(2), 2013
(found from the drive itself); Blake and Zisserman, Visual Reconstruction, 1987 (graduated
non-convexity).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamfusion.evidence.path_frames import geman_mcclure
from slamfusion.geometry import B8, F64, compose_poses, invert_poses, wrap_angles

# Deviations of the motion from one scan to the next, metres and radians.
STEP_M, STEP_RAD = 0.01, 0.005
# Deviation of a pose from its given place, which fixes the frame, metres and radians.
PLACE_M, PLACE_RAD = 1.0, 0.3
# Deviation of the calibration from that of the given path, share of a distance and radians.
CALIBRATION = 0.02
# Odometry and path are compared over this distance, metres.
WAY_M = 1.0
# Odometry errs if it differs by more than this share and this distance, metres: wheels slip or
# stand still; errors of a scan matcher are smaller.
OFF_SHARE, OFF_M = 0.2, 0.1
# Distance between a scan and its odometry at which odometry keeps a quarter of its weight, metres:
# three deviations of the motion. It starts at the second value, since a path that jumps would keep
# its jump, and is halved each round (graduated non-convexity).
HALF_WAY_M, FIRST_HALF_WAY_M = 0.03, 0.4
# Scales beyond these are not odometry in metres.
LEAST_SCALE, MOST_SCALE = 0.5, 2.0


@dataclass(frozen=True, eq=False)
class MotionEquations:
    """What the motions add to the normal equations of N poses and the calibration.

    Attributes:
        diagonal: (N, 3, 3) float64, blocks of the diagonal.
        beside: (N - 1, 3, 3) float64, those right of it.
        slope: (N, 3) float64, of the sum of squares, by the poses.
        border: (3 N, 2) float64, of the poses with the calibration.
        corner: (2, 2) float64, of the calibration.
        end: (2,) float64, the slope by the calibration.
    """

    diagonal: F64
    beside: F64
    slope: F64
    border: F64
    corner: F64
    end: F64


@dataclass(frozen=True, eq=False)
class KnownMotions:
    """The motions between the scans of a drive, by a path and by odometry.

    Attributes:
        given: (N, 3) float64, the poses of the path, metres and radians.
        of_path: (N - 1, 3) float64, its motions, each in the frame of the pose before it.
        of_wheels: (N - 1, 2) float64, the ways of the odometry in the same frames, metres.
        is_sound: (N - 1,) bool, where the odometry does not err grossly; nowhere without odometry.
        calibration: (2,) float64, cosine and sine times the scale of the path's distances over the
            odometry's; see ``turned``.
    """

    given: F64
    of_path: F64
    of_wheels: F64
    is_sound: B8
    calibration: F64

    @classmethod
    def of(cls, given: F64, odometry: F64 | None) -> KnownMotions:
        """Compare the odometry of a drive with its path: (N, 3) poses at the same scans, N >= 2."""
        of_path = compose_poses(invert_poses(given[:-1]), given[1:])
        nothing = cls(
            given,
            of_path,
            np.zeros((len(of_path), 2)),
            np.zeros(len(of_path), dtype=np.bool_),
            np.array((1.0, 0.0)),
        )
        if odometry is None:
            return nothing
        of_wheels = compose_poses(invert_poses(odometry[:-1]), odometry[1:])[:, :2]
        by_path = np.diff(given[:, :2], axis=0)
        # Both with the headings of the path, so that turns of the wheels do not count.
        by_wheels = turned(of_wheels, np.stack((np.cos(given[:-1, 2]), np.sin(given[:-1, 2]))).T)
        span = _span(by_path)
        path_m, wheels_m = (_over(steps, span) for steps in (by_path, by_wheels))
        calibration = _usual_calibration(path_m, wheels_m)
        if not LEAST_SCALE < math.hypot(*calibration) < MOST_SCALE:
            return nothing
        off_m = np.hypot(*(turned(wheels_m, calibration) - path_m).T)
        is_off = off_m > OFF_M + OFF_SHARE * np.hypot(*path_m.T)
        # A step is sound if all spans with it are.
        errs = np.convolve(is_off, np.ones(span))[: len(of_path)] > 0.0
        return cls(given, of_path, of_wheels, ~errs, calibration)

    def say(self, poses: F64, calibration: F64, number: int) -> F64:
        """Return the weight of the odometry in each motion, (N - 1,) 0 to 1."""
        if number == 0:
            return self.is_sound.astype(np.float64)
        found = compose_poses(invert_poses(poses[:-1]), poses[1:])[:, :2]
        off_m = np.hypot(*(found - turned(self.of_wheels, calibration)).T)
        scale_m = max(HALF_WAY_M, FIRST_HALF_WAY_M / 2.0**number)
        return np.asarray(self.is_sound * geman_mcclure(off_m / scale_m))

    def equations(self, poses: F64, calibration: F64, say: F64) -> MotionEquations:
        """Return the terms of the normal equations at the current poses and calibration."""
        count = len(poses)
        found = compose_poses(invert_poses(poses[:-1]), poses[1:])
        wheels = say[:, None] * self.of_wheels
        told = self.of_path.copy()
        told[:, :2] += turned(wheels, calibration) - say[:, None] * self.of_path[:, :2]
        off = found - told
        off[:, 2] = wrap_angles(off[:, 2])
        # Derivatives by the pose at the start, the one at the end, and the calibration.
        cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        first, second = np.zeros((2, count - 1, 3, 3))
        second[:, 0, 0], second[:, 0, 1] = cos, sin
        second[:, 1, 0], second[:, 1, 1] = -sin, cos
        second[:, 2, 2] = 1.0
        first[:] = -second
        first[:, 0, 2], first[:, 1, 2] = found[:, 1], -found[:, 0]
        third = np.zeros((count - 1, 3, 2))
        third[:, :2, 0] = -wheels
        third[:, 0, 1], third[:, 1, 1] = wheels[:, 1], -wheels[:, 0]
        sure = np.array((STEP_M, STEP_M, STEP_RAD)) ** -2.0
        by_first, by_second, by_third = (
            np.swapaxes(part, 1, 2) * sure for part in (first, second, third)
        )
        diagonal = np.zeros((count, 3, 3))
        diagonal[:-1] += by_first @ first
        diagonal[1:] += by_second @ second
        slope = np.zeros((count, 3))
        slope[:-1] += (by_first @ off[..., None])[..., 0]
        slope[1:] += (by_second @ off[..., None])[..., 0]
        border = np.zeros((count, 3, 2))
        border[:-1] += by_first @ third
        border[1:] += by_second @ third
        # Weak priors keep undetermined poses and calibration in place.
        held = np.array((PLACE_M, PLACE_M, PLACE_RAD)) ** -2.0
        away = poses - self.given
        away[:, 2] = wrap_angles(away[:, 2])
        diagonal += np.diag(held)
        kept = CALIBRATION**-2.0
        return MotionEquations(
            diagonal,
            by_first @ second,
            slope + held * away,
            border.reshape(3 * count, 2),
            (by_third @ third).sum(axis=0) + kept * np.eye(2),
            (by_third @ off[..., None]).sum(axis=0)[:, 0] + kept * (calibration - self.calibration),
        )


def turned(ways: F64, by: F64) -> F64:
    """Return (M, 2) vectors turned and scaled by (2,) or (M, 2) cosines and sines with a scale."""
    cos, sin = by[..., 0], by[..., 1]
    x, y = ways.T
    return np.stack((cos * x - sin * y, sin * x + cos * y), axis=1)


def _span(steps: F64) -> int:
    """Return the mean number of steps, (N - 1, 2), per ``WAY_M``."""
    mean_m = float(np.hypot(*steps.T).mean())
    return int(np.clip(math.ceil(WAY_M / max(mean_m, 1e-9)), 1, len(steps)))


def _over(steps: F64, span: int) -> F64:
    """Return the way over every span of steps, (N - span, 2)."""
    place = np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
    return np.asarray(place[span:] - place[:-span])


def _usual_calibration(path_m: F64, wheels_m: F64) -> F64:
    """Return the turn and scale that take most wheel distances to those of the path, (2,)."""
    squares = (wheels_m**2).sum(axis=1)
    long = squares > (0.25 * WAY_M) ** 2
    if not long.any():
        return np.zeros(2)
    a, b = wheels_m[long], path_m[long]
    along = (a * b).sum(axis=1) / squares[long]
    across = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / squares[long]
    return np.array((np.median(along), np.median(across)))
