"""Paths on two clocks: how far the clocks are apart, found by the motion itself."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.errors import TrajectoryError
from slamfusion.geometry import interpolate_poses
from slamfusion.trajectory import Trajectory

F64 = npt.NDArray[np.float64]

# Motion is compared at steps of this length, seconds, and then over windows of this length.
STEP_S, WINDOW_S = 0.1, 1.0
# Two paths of one drive correlate by more at the right offset, and no others do.
LEAST_CORRELATION = 0.5
# Stamps of the same scans differ by one offset; files round them.
SAME_SCANS_S = 1e-3


def on_clock(path: Trajectory, reference: Trajectory | None, offset: str) -> Trajectory:
    """Return a path with its times on the clock of another path.

    Args:
        path: on a clock of its own.
        reference: of the same drive; None: there is none.
        offset: seconds to add to the times of ``path``, or ``auto``: found by the motion.

    Raises:
        TrajectoryError: ``auto``, and there is no reference, or it does not move as the path.
    """
    if offset != "auto":
        seconds = float(offset)
    elif reference is None:
        message = (
            f"{path.name}: the log has no odometry to find the offset of the clocks by; give "
            "--time-offset in seconds"
        )
        raise TrajectoryError(message)
    else:
        seconds = clock_offset_s(path, reference)
    return path if seconds == 0.0 else path.later(seconds)


def clock_offset_s(path: Trajectory, reference: Trajectory) -> float:
    """Return the seconds to add to the times of a path to put it on the clock of another.

    Speeds and turn rates of both are correlated at every offset, then the best one is refined by
    how far both move within windows of a second. Both paths may be in frames of their own.

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
    found = scipy.optimize.minimize_scalar(
        lambda change_s: _window_error(path, reference, rough_s + change_s),
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
    """Return how far a path drives and turns within a span after times, (N, 2) m and rad."""
    before, after = (
        interpolate_poses(at_s, path.stamps_s, path.poses) for at_s in (times_s, times_s + span_s)
    )
    change = after - before
    return np.stack((np.hypot(change[:, 0], change[:, 1]), change[:, 2]), axis=1)


def _rates(path: Trajectory) -> F64:
    """Return speeds and turn rates at each step, (N, 2), of mean 0, together of deviation 1."""
    times_s = np.arange(path.stamps_s[0], path.stamps_s[-1] - STEP_S, STEP_S)
    rates = _motion(path, times_s, STEP_S)
    rates -= rates.mean(axis=0) if len(rates) else 0.0
    return np.asarray(rates / max(np.sqrt((rates**2).sum() / max(len(rates), 1)), 1e-9))


def _window_error(path: Trajectory, reference: Trajectory, offset_s: float) -> float:
    """Return the mean squared difference of both paths' motions in windows at an offset."""
    begin_s = max(path.stamps_s[0], reference.stamps_s[0] - offset_s)
    end_s = min(path.stamps_s[-1], reference.stamps_s[-1] - offset_s) - WINDOW_S
    times_s = np.arange(begin_s, max(end_s, begin_s + STEP_S), STEP_S)
    own, other = _motion(path, times_s, WINDOW_S), _motion(reference, times_s + offset_s, WINDOW_S)
    return float(((own - other) ** 2).mean())


def _unlike(path: Trajectory, reference: Trajectory, why: str) -> TrajectoryError:
    return TrajectoryError(
        f"{path.name} and {reference.name} do not move alike at any offset of their clocks ({why});"
        " give paths of one drive, or --time-offset in seconds"
    )
