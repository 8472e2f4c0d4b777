"""Trajectory against truth: absolute error after alignment (ATE), and relative error (RPE).

Source: Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012 (both
errors); Umeyama, PAMI 13(4), 1991 (the alignment, here in the plane and without scale).
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field

import numpy as np
import scipy

from slamfusion.config import TrajectoryConfig
from slamfusion.errors import TrajectoryError, counted
from slamfusion.evaluation.statistics import ErrorStatistics
from slamfusion.geometry import (
    F64,
    I64,
    Pose2,
    compose_poses,
    fit_motion,
    interpolate_poses,
    invert_poses,
    moved_poses,
    travelled,
    wrap_angles,
)
from slamfusion.grid import IDENTITY
from slamfusion.json_values import POSE
from slamfusion.trajectory import Trajectory, clock_advice, is_other_unit

_LOG = logging.getLogger(__name__)

# Step of the compared motions, seconds, and window of the refinement.
STEP_S, WINDOW_S = 0.1, 1.0
# Two paths of one drive correlate by more at the right offset.
LEAST_CORRELATION = 0.5
# Share of places and turns that is left of paths that do not correlate; and the spread of a robot
# that stands still, metres.
_UNLIKE, STANDS_M = math.sqrt(1.0 - LEAST_CORRELATION**2), 0.1
# Signs of x, y and yaw of the images of a path.
_IMAGES = {"y and yaw": (1.0, -1.0, -1.0), "y": (1.0, -1.0, 1.0), "yaw": (1.0, 1.0, -1.0)}
# Differences of clocks, seconds: the nearest leaves a third of another one, or less.
_CLOCK = "on another clock (--time-offset auto)"
_SHIFTS_S = 0.1 * 2.0 ** np.arange(12)
# Stamps of the same scans differ by one offset and by rounding.
SAME_SCANS_S = 1e-3


def on_clock(path: Trajectory, reference: Trajectory | None, offset: str) -> Trajectory:
    """Return a path with its times on the clock of another path of the same drive.

    Args:
        offset: seconds to add to the times of ``path``, or ``auto``: found by the motion.

    Raises:
        TrajectoryError: ``auto`` without a reference, or with one that moves differently.
    """
    if offset != "auto":
        seconds = float(offset)
    elif reference is None:
        raise TrajectoryError(
            f"{path.name}: the log has no odometry to find the offset of the clocks by; give "
            "--time-offset in seconds"
        )
    else:
        seconds = clock_offset_s(path, reference)
    return path if seconds == 0.0 else path.later(seconds)


def clock_offset_s(path: Trajectory, reference: Trajectory) -> float:
    """Return the seconds to add to the times of a path to put it on the clock of another.

    Speeds and turn rates are correlated at every offset, then the best one is refined by the motion
    within windows of a second. The frames may differ.

    Raises:
        TrajectoryError: the paths do not move alike at any offset.
    """
    own, other = (_rates(item) for item in (path, reference))
    shorter = min(len(own), len(other))
    if shorter * STEP_S < 2.0 * WINDOW_S:
        raise _unlike(path, reference, "one of them is too short")
    ones = [np.ones(len(item)) for item in (own, other)]
    shared = scipy.signal.correlate(ones[1], ones[0], method="fft")
    match = np.sum(
        [scipy.signal.correlate(other[:, kind], own[:, kind], method="fft") for kind in (0, 1)],
        axis=0,
    )
    # A correlation over a longer time is more significant, by the root of its length.
    shared = np.maximum(np.rint(shared), 1.0)
    best = int(np.argmax(np.where(shared > 0.5 * shorter, match / np.sqrt(shared), -np.inf)))
    correlation = match[best] / shared[best]
    if correlation < LEAST_CORRELATION:
        raise _unlike(path, reference, f"correlation {correlation:.2f} at the best offset")
    lag_s = STEP_S * (best - (len(own) - 1))
    rough_s = float(reference.stamps_s[0] - path.stamps_s[0]) + lag_s
    begin_s = max(path.stamps_s[0], reference.stamps_s[0] - rough_s)
    end_s = min(path.stamps_s[-1], reference.stamps_s[-1] - rough_s) - WINDOW_S
    times_s = np.arange(begin_s, max(end_s, begin_s + STEP_S), STEP_S)
    wanted, there_s = _motion(path, times_s, WINDOW_S), times_s + rough_s
    found = scipy.optimize.minimize_scalar(
        lambda more_s: np.mean((_motion(reference, there_s + more_s, WINDOW_S) - wanted) ** 2),
        bounds=(-2.0 * STEP_S, 2.0 * STEP_S),
        method="bounded",
        options={"xatol": 1e-4},
    )
    offset_s = rough_s + float(found.x)
    stamps_s = path.stamps_s + offset_s
    apart = reference.stamps_s[reference.nearest(stamps_s)] - stamps_s
    left_s = float(np.median(apart))
    is_same_scans = np.percentile(np.abs(apart - left_s), 90.0) < SAME_SCANS_S
    return offset_s + left_s if is_same_scans else offset_s


def _motion(path: Trajectory, times_s: F64, span_s: float) -> F64:
    """Return the distance and turn of a path within a span after times, (N, 2) m and rad."""
    before, after = (
        interpolate_poses(at_s, path.stamps_s, path.poses) for at_s in (times_s, times_s + span_s)
    )
    change = after - before
    return np.stack((np.hypot(change[:, 0], change[:, 1]), change[:, 2]), axis=1)


def _rates(path: Trajectory) -> F64:
    """Return speeds and turn rates at each step, (N, 2), of mean 0 and joint deviation 1."""
    times_s = np.arange(path.stamps_s[0], path.stamps_s[-1] - STEP_S, STEP_S)
    rates = _motion(path, times_s, STEP_S)
    rates -= rates.mean(axis=0) if len(rates) else 0.0
    return np.asarray(rates / max(np.sqrt((rates**2).sum() / max(len(rates), 1)), 1e-9))


def _warn_of_better_fit(path: Trajectory, truth: Trajectory, own: I64, true: I64) -> None:
    """Warn of a path that fits the truth much better mirrored, scaled or later, or that never fits.

    own, true: (M,), indices of the poses that meet in time.
    """
    stamps_s, poses, wanted = path.stamps_s[own], path.poses[own], truth.poses[true]
    spread_m, wanted_m = (math.sqrt(item[:, :2].var(axis=0).sum()) for item in (poses, wanted))

    def errors_of(changed: F64) -> F64:
        apart = _apart(fit_motion(changed, wanted), changed, wanted)
        return np.asarray(np.maximum(np.sqrt(np.mean(apart**2, axis=1)), _ROUNDING))

    changes = [
        (f"with {negated} negated", "mirrored", poses * signs) for negated, signs in _IMAGES.items()
    ]
    scale = max(wanted_m, _ROUNDING) / max(spread_m, _ROUNDING)
    if is_other_unit(scale):
        scaled = poses * (scale, scale, 1.0)
        changes.append((f"multiplied by {scale:.4g}", "in another unit than metres", scaled))
    # Shifts of half the path or more would fit its ends, which are clamped.
    shifts_s = _SHIFTS_S[np.ptp(stamps_s) > 2.0 * _SHIFTS_S]
    for later_s in (*shifts_s, *-shifts_s):
        moved = interpolate_poses(stamps_s + later_s, path.stamps_s, path.poses)
        changes.append((f"about {later_s:.1f} s later", _CLOCK, moved))
    # The likeliest, with errors of place and heading of unknown sizes.
    how, what, changed = min(changes, key=lambda change: float(errors_of(change[2]).prod()))
    errors = errors_of(poses), errors_of(changed)
    seconds = np.ptp(stamps_s) / WINDOW_S
    # The 95 % interval of the difference of two correlations (Fisher, 1915).
    least = 1.96 * math.sqrt(2.0 / (seconds - 3.0)) if seconds > 3.0 else math.inf
    is_fit = 2.0 * errors[1][0] < wanted_m
    if is_fit and math.log(errors[0].prod() / errors[1].prod()) > max(least, math.log(2.0)):
        before, after = (f"{m:.4g} m and {math.degrees(rad):.3g} deg" for m, rad in errors)
        message = "%s is off %s by %s, but only by %s %s: is one of them %s?"
        _LOG.warning(message, path.name, truth.name, before, after, how, what)
        return
    turns, true_turns = (wrap_angles(np.diff(item[:, 2])) for item in (poses, wanted))
    is_unlike = np.std(turns - true_turns) > _UNLIKE * np.std(true_turns)
    if is_unlike and errors[0][0] > _UNLIKE * wanted_m > _UNLIKE * STANDS_M and least < math.inf:
        message = "%s is off %s by %.4g m, which itself spreads by %.4g m: are they of one drive?"
        _LOG.warning(message, path.name, truth.name, errors[0][0], wanted_m)


def _unlike(path: Trajectory, reference: Trajectory, why: str) -> TrajectoryError:
    return TrajectoryError(
        f"{path.name} and {reference.name} do not move alike at any offset of their clocks ({why});"
        " give paths of one drive, or --time-offset in seconds"
    )


_DEFAULT_CONFIG = TrajectoryConfig()

# Sums of equal steps may be slightly below a whole delta.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class TrajectoryAlignment:
    """What laid an estimated trajectory on the true one."""

    kind: str
    """How it was found: the setting trajectory.alignment."""
    transform: Pose2 = field(metadata=POSE)
    """Pose of the estimate's frame in the truth's."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrajectoryErrors:
    """Errors of a trajectory against the true one."""

    ate: ErrorStatistics
    """Absolute errors of place against the truth, metres."""
    ate_rotation_deg: ErrorStatistics
    """Absolute errors of heading against the truth, degrees."""
    rpe: ErrorStatistics | None
    """Relative errors of place, metres a pair; null where the path is too short for a pair."""
    rpe_rotation_deg: ErrorStatistics | None
    """Relative errors of heading, degrees a pair; null where there is no pair."""
    rpe_pairs: int
    """Pairs that the relative errors rest on."""
    rpe_delta: float
    """What a pair spans."""
    rpe_unit: str
    """Unit of what a pair spans: the setting trajectory.rpe_unit."""
    alignment: TrajectoryAlignment
    """What aligned the path with the truth."""
    poses: int
    """Poses of the path."""
    poses_matched: int
    """Poses of the path that met a true one in time."""
    covered_share: float = field(repr=False)
    """Share of the truth's time from the first pose that met one to the last."""
    tolerance_s: float
    """Poses further apart in time than this do not meet, seconds."""
    time_offset_s: float = field(repr=False)
    """Added to the times of the truth, seconds: the setting trajectory.time_offset."""
    name: str = field(repr=False)
    """The estimate."""
    truth: str = field(repr=False)
    """The true trajectory."""
    aligned: F64 = field(repr=False)
    """(M, 3), the estimate's matched poses in the frame of the truth."""
    stamps_s: F64 = field(repr=False)
    """(M,), their times."""
    translation_m: F64 = field(repr=False)
    """(M,), absolute error of each place."""
    rotation_rad: F64 = field(repr=False)
    """(M,), absolute error of each heading, 0 to pi."""
    relative_translation_m: F64 = field(repr=False)
    """(K,), error of the motion between the poses of each pair."""
    relative_rotation_rad: F64 = field(repr=False)
    """(K,), the same of the turn, 0 to pi."""
    relative_travelled_m: F64 = field(repr=False)
    """(K,), true path up to the end of each pair."""


def trajectory_errors(
    estimate: Trajectory, truth: Trajectory, config: TrajectoryConfig = _DEFAULT_CONFIG
) -> TrajectoryErrors:
    """Compare an estimate with the truth (poses of the same body).

    Args:
        config: tolerance, alignment, and the span of a pair of the relative error. Pairs follow
            each other without overlap from the first matched pose on; metres are counted along
            the truth.

    Raises:
        TrajectoryError: fewer than two poses meet in time.
    """
    began_s = truth.stamps_s[0]
    truth = on_clock(truth, estimate, config.time_offset)
    own, true = associate(estimate, truth, config.tolerance_s)
    if len(own) < 2:
        ranges = [
            f"{item.name} has {counted(len(item), 'pose')} from {item.stamps_s[0]:.3f} to "
            f"{item.stamps_s[-1]:.3f} s"
            for item in (estimate, truth)
        ]
        raise TrajectoryError(
            f"wanted at least two poses within {config.tolerance_s:g} s of a true one, found "
            f"{len(own)}; {'; '.join(ranges)}; {clock_advice(truth.stamps_s, estimate.stamps_s)}"
            "give trajectories of one run, or a larger --tolerance-s"
        )
    _warn_of_better_fit(estimate, truth, own, true)
    poses, true_poses = estimate.poses[own], truth.poses[true]
    motion = fit_motion(poses, true_poses) if config.alignment == "se2" else IDENTITY
    travelled_m = travelled(true_poses)
    stamps_s = estimate.stamps_s[own]

    # Absolute: of each pose alone.
    translation_m, rotation_rad = _apart(motion, poses, true_poses)

    # Relative: of the motion between two poses, independent of the frame.
    progress = {
        "frames": np.arange(len(own), dtype=np.float64),
        "m": travelled_m,
        "s": stamps_s - stamps_s[0],
    }[config.rpe_unit]
    first, second = _pairs(progress, config.rpe_delta)
    made = compose_poses(invert_poses(poses[first]), poses[second])
    wanted = compose_poses(invert_poses(true_poses[first]), true_poses[second])
    left = compose_poses(invert_poses(wanted), made)
    relative_m = np.hypot(left[:, 0], left[:, 1])
    relative_rad = np.abs(wrap_angles(left[:, 2]))
    return TrajectoryErrors(
        ate=ErrorStatistics.of(translation_m),
        ate_rotation_deg=ErrorStatistics.of(np.rad2deg(rotation_rad)),
        rpe=ErrorStatistics.of(relative_m) if len(left) else None,
        rpe_rotation_deg=ErrorStatistics.of(np.rad2deg(relative_rad)) if len(left) else None,
        rpe_pairs=len(left),
        rpe_delta=config.rpe_delta,
        rpe_unit=config.rpe_unit,
        alignment=TrajectoryAlignment(config.alignment, motion),
        poses=len(estimate),
        poses_matched=len(own),
        covered_share=float(np.ptp(truth.stamps_s[true]) / np.ptp(truth.stamps_s)),
        tolerance_s=config.tolerance_s,
        time_offset_s=float(truth.stamps_s[0] - began_s),
        name=estimate.name,
        truth=truth.name,
        aligned=moved_poses(motion, poses),
        stamps_s=stamps_s,
        translation_m=translation_m,
        rotation_rad=rotation_rad,
        relative_translation_m=relative_m,
        relative_rotation_rad=relative_rad,
        relative_travelled_m=travelled_m[second],
    )


def associate(first: Trajectory, second: Trajectory, tolerance_s: float) -> tuple[I64, I64]:
    """Return indices (M,) into both of poses that are each other's nearest in time."""
    there, is_near = second.matches(first.stamps_s, tolerance_s)
    apart_s = np.abs(second.stamps_s - first.stamps_s[first.nearest(second.stamps_s)])
    is_mutual = np.abs(first.stamps_s - second.stamps_s[there]) <= apart_s[there]
    own = np.flatnonzero(is_near & is_mutual)
    # Of poses that are equally near to one, such as those of one stamp, the first is the pair.
    paired, firsts = np.unique(there[own], return_index=True)
    return own[firsts], paired


def _apart(motion: Pose2, poses: F64, wanted: F64) -> F64:
    """Return the errors of place and heading of moved poses, (2, N) m and rad."""
    apart = moved_poses(motion, poses) - wanted
    return np.stack((np.hypot(apart[:, 0], apart[:, 1]), np.abs(wrap_angles(apart[:, 2]))))


def _pairs(progress: F64, delta: float) -> tuple[I64, I64]:
    """Return the ends of the pairs: each ends once at least ``delta`` was made since its start."""
    ends = [0]
    for index, value in enumerate(progress):
        if value - progress[ends[-1]] >= delta * (1.0 - _ROUNDING):
            ends.append(index)
    return np.array(ends[:-1], dtype=np.int64), np.array(ends[1:], dtype=np.int64)
