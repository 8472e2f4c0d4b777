"""``lay_paths``: paths of one drive at common stamps and in one frame, each with its weight.

A path that broke away near its end must not turn the others, nor its own right part: frames are
fitted robustly, and the weights of poses fall with their residuals.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from slamfusion.errors import TrajectoryError
from slamfusion.geometry import F64, Pose2, fit_motion, moved_poses, with_levers, wrap_angles
from slamfusion.trajectory import SAME_STAMP_S, Trajectory

# Distance that corresponds to a turn of one radian, metres: the range of most walls.
TURN_M = 2.0
# Standard deviation of normal errors over the median of their absolute values.
FROM_MEDIAN = 1.4826
# Least scale of a robust fit, metres: the difference of good paths.
LEAST_SCALE_M = 0.03
# The most rounds of reweighting, and the change at which a fit has settled, metres and radians.
MOST_FITS, SETTLED = 30, 1e-6


def lay_paths(
    paths: Mapping[str, Trajectory], weights: Mapping[str, float] | None = None
) -> tuple[F64, F64, F64]:
    """Move paths of one drive into the frame of the path that is closest to the others.

    Args:
        paths: K by name, each in its own frame.
        weights: 0 to 1, by name; default: 1.

    Returns:
        (N,) stamps, those of the path with most poses, seconds; (K, N, 3) poses, NaN where a path
        has none; and (K, N) weights, 0 where it has none.

    Raises:
        TrajectoryError: no path, or one without a pose or without common times.
    """
    if not paths:
        raise TrajectoryError("there is no path to fuse; give at least one")
    longest = max(paths.values(), key=len)
    stamps_s = longest.stamps_s
    poses = np.full((len(paths), len(stamps_s), 3), np.nan)
    trusted = np.zeros(poses.shape[:2])
    for row, (name, path) in enumerate(paths.items()):
        if not len(path):
            raise TrajectoryError(f"{name}: the path has no pose; leave it out")
        near, meets = path.matches(stamps_s)
        if not meets.any():
            raise TrajectoryError(
                f"{name}: no pose at the time of one of {longest.name} within {SAME_STAMP_S:g} s; "
                "give paths of the same scans"
            )
        poses[row, meets] = path.poses[near[meets]]
        trusted[row, meets] = (weights or {}).get(name, 1.0)
    return stamps_s, _in_one_frame(poses, trusted), trusted


def pose_distances(a: F64, b: F64) -> F64:
    """Return distances of (..., 3) poses, metres, with ``TURN_M`` per radian; NaN gives NaN."""
    apart = a - b
    turned = np.abs(wrap_angles(apart[..., 2]))
    return np.asarray(np.hypot(apart[..., 0], apart[..., 1]) + TURN_M * turned)


def geman_mcclure(distance: F64) -> F64:
    """Return the weight of Geman and McClure at a distance in its scale; 0 at infinity.

    Source: Geman and McClure, Statistical methods for tomographic image reconstruction, Bull. ISI
        52, 1987.
    """
    return np.asarray(1.0 / (1.0 + distance**2) ** 2)


def moved_onto(path: Trajectory, others: Iterable[Trajectory]) -> Trajectory:
    """Return a path moved so that most of it overlaps others in one frame, if any times meet."""
    moving, still = [np.empty((0, 3))], [np.empty((0, 3))]
    for other in others:
        near, meets = other.matches(path.stamps_s)
        moving.append(path.poses[meets])
        still.append(other.poses[near[meets]])
    if not sum(map(len, moving)):
        return path
    motion = fit_frame(np.concatenate(moving), np.concatenate(still))
    return path.moved(motion)


def fit_frame(moving: F64, still: F64, weights: F64 | None = None) -> Pose2:
    """Return the motion that takes most of one path, (N, 3) with N at least 1, onto another.

    Iteratively reweighted least squares of places and headings; the scale is the median of the
    residuals, so that the better half of the poses decides. ``weights`` (N,) limit each pose.
    """
    count = len(moving)
    trusted = np.ones(count) if weights is None else np.maximum(weights, 1e-6)
    a, b = with_levers(moving), with_levers(still)
    trusted = np.tile(trusted, 2)
    reweighted, motion = trusted, Pose2()
    for _ in range(MOST_FITS):
        before, motion = motion, fit_motion(a, b, reweighted)
        left = np.hypot(*(motion.transform(a[:, :2]) - b[:, :2]).T)
        scale = max(_weighted_median(left, trusted), LEAST_SCALE_M)
        reweighted = trusted * geman_mcclure(left / scale)
        step = before.inverse().compose(motion)
        if max(abs(step.x), abs(step.y), abs(step.yaw_rad)) < SETTLED:
            break
    return motion


def laid_onto(moving: F64, still: F64) -> F64:
    """Return one path aligned with another, (N, 3); see ``fit_frame``."""
    return moved_poses(fit_frame(moving, still), moving)


def _in_one_frame(poses: F64, weights: F64) -> F64:
    """Move (K, N, 3) poses onto the path that is closest to all, by the weights of each."""
    shares = weights.sum(axis=1) / max(float(weights.sum()), 1e-12)
    best, least = poses, math.inf
    for still in poses:
        laid, apart_m = [], 0.0
        for moving, trusted, share in zip(poses, weights, shares, strict=True):
            both = np.isfinite(moving[:, 0]) & np.isfinite(still[:, 0])
            if not both.any():
                apart_m = math.inf
                laid.append(moving)
                continue
            motion = fit_frame(moving[both], still[both], trusted[both])
            laid.append(moved_poses(motion, moving))
            left = pose_distances(laid[-1][both], still[both])
            apart_m += float(share) * float(np.median(left))
        if apart_m < least:
            best, least = np.stack(laid), apart_m
    if not math.isfinite(least):
        message = "no path shares a time with each of the others; give paths of the same scans"
        raise TrajectoryError(message)
    return best


def _weighted_median(values: F64, weights: F64) -> float:
    """Return the value that half of the weight lies at or below."""
    order = np.argsort(values, kind="stable")
    summed = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(summed, 0.5 * summed[-1])]])


# The greatest scale, metres (and half of that in radians): the distance between two rooms.
MOST_SCALE_M = 0.5
# Least weight of a path, for times without another.
LEAST_BELIEF = 1e-6
# Rounds of the mean shift.
ROUNDS = 10


def find_modes(
    poses: F64, weights: F64, least_m: float = LEAST_SCALE_M, most_m: float = MOST_SCALE_M
) -> F64:
    """Return for each of N questions the answer that most of the weight of K answers lies near.

    Mean shift to a mode of the weighted density, from the answer closest to the weight of the
    others; the scale is its distance from the nearest other one. Of two distant answers the one of
    greater weight is followed, of equal ones the first, never the middle.

    Args:
        poses: (K, N, 3) poses or motions, metres and radians; NaN where missing, at least one
            given.
        weights: (K, N), 0 to 1.

    Returns:
        (N, 3) float64, yaw in [-pi, pi).

    Source: Comaniciu and Meer, Mean shift: a robust approach toward feature space analysis, PAMI
        24(5), 2002, with the kernel of Geman and McClure.
    """
    count, questions = poses.shape[:2]
    has = np.isfinite(poses[..., 0])
    trusted = np.where(has, np.maximum(weights, LEAST_BELIEF), 0.0)
    apart = np.full((count, count, questions), np.inf)
    for a in range(count):
        for b in range(count):
            both = has[a] & has[b]
            apart[a, b, both] = pose_distances(poses[a, both], poses[b, both])
    nearest = np.where(np.eye(count, dtype=np.bool_)[:, :, None], np.inf, apart).min(axis=1)
    scales = np.clip(nearest, least_m, most_m)
    density = (trusted[None] * geman_mcclure(apart / scales.min(axis=0))).sum(axis=1)
    start = np.where(has, density, -1.0).argmax(axis=0)
    every = np.arange(questions)
    mode, scale = poses[start, every], scales[start, every]
    for _ in range(ROUNDS):
        known = np.where(has[..., None], poses, mode)
        away = known - mode
        away[..., 2] = wrap_angles(away[..., 2])
        pull = trusted * geman_mcclure(pose_distances(known, mode) / scale)
        mode = mode + (pull[..., None] * away).sum(axis=0) / pull.sum(axis=0)[:, None]
    mode[:, 2] = wrap_angles(mode[:, 2])
    return np.asarray(mode)
