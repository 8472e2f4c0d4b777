"""Compare a producer's path with the raw odometry: a wrong sensor makes the two contradict.

A laser that is mounted differently from the robot's transforms gives a map that looks right, since
all producers see the same scans; only the robot's own motion shows it. Both paths are cut
into steps of about half a metre or half a radian, and the turn, the direction as seen from the
robot, and the length of each step are compared. A mirrored laser turns the other way, one that
looks back drives the other way, one that is rotated by some degrees drives askew.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from slamfusion.geometry import F64, compose_poses, invert_poses, travelled, wrap_angles
from slamfusion.trajectory import Trajectory, flag_runs, is_other_unit

# Distance of the path, metres, at constant odometry: more than the noise of scan matching, less
# than the distance that a dead encoder misses on a drive.
DRIVEN_M = 1.0
# Least motion between two odometry poses of a moving robot, metres or radians.
STANDS = 1e-9

# A step ends where either path has moved this far, metres plus radians.
STEP = 0.5
# Least turn or length of a step that is compared: radians, metres.
TURNING_RAD, DRIVING_M = 0.2, 0.2
# Least number of steps of a kind for a judgement.
LEAST_STEPS = 10
# Steps agree if they differ from their median by no more, as a share of the step and, of turns, of
# the shorter one.
SPREAD = 0.4
# Least share of the steps that must agree.
TOGETHER = 0.5
# Least deviations that are reported: angle of the laser's mount, and scale of the odometry.
OFFSET_RAD, SCALE = math.radians(5.0), 0.1
# Turns poses with yaws in degrees into such in radians.
DEGREES = (1.0, 1.0, math.pi / 180.0)
# Least angle at which the laser looks back.
BACKWARD_RAD = math.radians(150.0)
_UNLIKE = (
    "the path {} unlike the odometry ({:.0%} of the {} agree): one of them is of another robot or "
    "drive, or tracking was lost; look at the map"
)


@dataclass(frozen=True)
class OdometryFit:
    """How a path moves compared with the odometry; None if there is too little motion.

    Attributes:
        turn: the path's turns over the odometry's, median of the steps: 1 if they agree, -1 if
            one of them is mirrored.
        offset_rad: median angle from the odometry's direction of travel to the path's, both seen
            from the robot.
        length: the path's length over the odometry's, median.
        turns_together: share of the turning steps that are near the median.
        drives_together: share of the driving steps that are near the median offset and length.
    """

    turn: float | None
    offset_rad: float | None
    length: float | None
    turns_together: float
    drives_together: float


def fit_odometry(
    odometry: Trajectory, path: Trajectory, *, newest: int | None = None
) -> OdometryFit:
    """Compare the steps of a path with those of raw odometry.

    newest: number of turning and of driving steps that are compared, the last ones; None: all.
    """
    steps = _steps(odometry, path)
    turning = np.flatnonzero(np.abs(steps[:, 0, 2]) >= TURNING_RAD)
    moving = np.flatnonzero(np.hypot(steps[..., 0], steps[..., 1]).max(axis=1) >= DRIVING_M)
    if newest is not None:
        turning, moving = turning[-newest:], moving[-newest:]
    turn, turns_together = None, 0.0
    if len(turning) >= LEAST_STEPS:
        ratios = steps[turning, 1, 2] / steps[turning, 0, 2]
        turn = float(np.median(ratios))
        turns_together = float((np.abs(ratios - turn) <= SPREAD * min(1.0, abs(turn))).mean())
    if len(moving) < LEAST_STEPS:
        return OdometryFit(turn, None, None, turns_together, 0.0)
    steps = steps[moving]
    lengths = np.hypot(steps[..., 0], steps[..., 1])
    driving = lengths.min(axis=1) >= DRIVING_M
    if not driving.any():
        length = float(lengths[:, 1].sum() / max(lengths[:, 0].sum(), STANDS))
        return OdometryFit(turn, None, length, turns_together, 0.0)
    # On an arc the robot drives where it looks half-way.
    angles = np.arctan2(steps[driving, :, 1], steps[driving, :, 0]) - 0.5 * steps[driving, :, 2]
    askew = wrap_angles(angles[:, 1] - angles[:, 0])
    # The median of angles, seen from their mean direction.
    mean = math.atan2(float(np.sin(askew).mean()), float(np.cos(askew).mean()))
    offset = float(wrap_angles(mean + np.median(wrap_angles(askew - mean))))
    ratios = lengths[driving, 1] / lengths[driving, 0]
    length = float(np.median(ratios))
    is_near = (np.abs(wrap_angles(askew - offset)) <= SPREAD) & (
        np.abs(ratios - length) <= SPREAD * length
    )
    return OdometryFit(
        turn, offset, length, turns_together, np.count_nonzero(is_near) / len(moving)
    )


def _steps(odometry: Trajectory, path: Trajectory) -> F64:
    """Return steps of the odometry and of the path from one scan to a later one, (N, 2, 3)."""
    at, is_known = path.matches(odometry.stamps_s)
    both = np.stack((odometry.poses[is_known], path.poses[at[is_known]]), axis=1)
    single = np.diff(both, axis=0)
    turned = np.abs(wrap_angles(single[..., 2]))
    moved = (np.hypot(single[..., 0], single[..., 1]) + turned).max(axis=1)
    whole = np.floor(np.cumsum(moved) / STEP)
    ends = np.flatnonzero(np.diff(whole, prepend=0.0) > 0) + 1
    starts = np.r_[0, ends[:-1]] if len(ends) else ends
    return compose_poses(invert_poses(both[starts]), both[ends])


def contradictions(
    odometry: Trajectory, path: Trajectory, *, newest: int | None = None
) -> Iterator[str]:
    """Yield a sentence for each way in which raw odometry and a path contradict each other.

    newest: see ``fit_odometry``; odometry that has driven as many steps is not frozen any more.
    """
    began_s = float(path.stamps_s[0])
    span = frozen_span(odometry, path, math.inf if newest is None else newest * STEP)
    if span is not None:
        yield (
            f"the odometry stands still from {span[0] - began_s:.0f} s to "
            f"{span[1] - began_s:.0f} s, where the scans say that the robot drives: a dead "
            "encoder or topic; give other odometry, or none"
        )
        return
    fit = fit_odometry(odometry, path, newest=newest)
    if fit.turn is not None and not _turns_alike(fit):
        radians = replace(odometry, poses=odometry.poses * DEGREES)
        if _turns_alike(fit_odometry(radians, path, newest=newest)):
            yield "the yaw of the odometry is in degrees: give it in radians"
            return
    length = fit.length or 1.0
    if is_other_unit(length):
        yield (
            f"the path moves {length:.4g} times as far as the odometry: is one of them in another "
            "unit than metres, or of another drive?"
        )
        return
    if fit.turn is not None and fit.turns_together < TOGETHER:
        yield _UNLIKE.format("turns", fit.turns_together, "turns")
        return
    # A wrong wheel radius changes turns as much as lengths.
    turn = 1.0 if fit.turn is None else fit.turn
    if turn > 0.0 and min(abs(turn / usual - 1.0) for usual in (1.0, length)) > SCALE:
        yield (
            f"the path turns {turn:.2f} times as far as the odometry: check the distance "
            "between the wheels that the odometry assumes"
        )
    if _drives_unlike(fit):
        yield _UNLIKE.format("drives", fit.drives_together, "steps")
        return
    faults = list(_laser_faults(fit))
    yield from faults
    if not faults and abs(length - 1.0) > SCALE:
        yield (
            f"the path is {length:.2f} times as long as the odometry: check the wheel radius "
            "that the odometry assumes"
        )


def _turns_alike(fit: OdometryFit) -> bool:
    return fit.turn is not None and abs(fit.turn - 1.0) <= SCALE and fit.turns_together >= TOGETHER


def _drives_unlike(fit: OdometryFit) -> bool:
    return fit.length is not None and (fit.offset_rad is None or fit.drives_together < TOGETHER)


def laser_fault(odometry: Trajectory | None, path: Trajectory | None) -> str | None:
    """Describe a laser that is mounted differently from the log; None if the paths show none."""
    if odometry is None or path is None:
        return None
    fit = fit_odometry(odometry, path)
    # Of a robot that drives sideways, only the mirror image drives like the odometry.
    if _drives_unlike(fit) and _drives_unlike(fit_odometry(odometry, path.mirrored())):
        return None
    return "; ".join(_laser_faults(fit)) or None


def _laser_faults(fit: OdometryFit) -> Iterator[str]:
    """Yield a sentence for each way in which the laser's mount contradicts the log."""
    if fit.turn is not None and fit.turn < -SPREAD and fit.turns_together >= TOGETHER:
        yield (
            f"the path turns against the odometry (slope {fit.turn:+.2f}): the laser is mounted "
            "upside down or turns the other way, and the map is mirrored; use --laser mirrored, "
            "or leave it out if you have set it (nodes: laser:=mirrored)"
        )
    if fit.offset_rad is None or fit.drives_together < TOGETHER:
        return
    offset_deg = math.degrees(fit.offset_rad)
    if abs(fit.offset_rad) >= BACKWARD_RAD:
        yield (
            f"the path drives against the odometry ({abs(offset_deg):.0f} degrees): the laser "
            "looks back, and the map and path are turned by half; use --laser backward, or "
            "leave it out if you have set it (nodes: laser:=backward)"
        )
    elif abs(fit.offset_rad) > OFFSET_RAD:
        yield (
            f"the path drives {offset_deg:+.0f} degrees away from where the odometry goes: the "
            f"laser is mounted turned by {-offset_deg:+.0f} degrees against its transform; correct "
            "the transform"
        )


def frozen_span(
    odometry: Trajectory, path: Trajectory, driven_m: float = math.inf
) -> tuple[float, float] | None:
    """Return (from, to) in seconds of the longest time in which only raw odometry stands still.

    driven_m: the most that it has driven since.
    """
    odometer_m = travelled(odometry.poses)
    stands = np.asarray((np.abs(np.diff(odometry.poses, axis=0)) < STANDS).all(axis=1))
    longest: tuple[float, float] | None = None
    for here in flag_runs(stands):
        from_s, to_s = float(odometry.stamps_s[here.start]), float(odometry.stamps_s[here.stop])
        if odometer_m[-1] - odometer_m[here.stop] > driven_m:
            continue
        if longest is not None and to_s - from_s <= longest[1] - longest[0]:
            continue
        during = (path.stamps_s >= from_s) & (path.stamps_s <= to_s)
        places = path.poses[during, :2]
        if len(places) and np.hypot(*(places - places[0]).T).max() > DRIVEN_M:
            longest = from_s, to_s
    return longest
