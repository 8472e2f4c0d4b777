"""Path consensus: at each scan the pose that most of the weight of several paths lies near.

Votes on poses come before votes on cells: paths that agree name the place, and a path that lies
elsewhere has no say, however far off it is. Each scan is decided on its own, so the answer may jump
where the majority changes; ``fused_path`` makes it continuous.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.evidence.path_frames import LaidPaths, geman_mcclure, pose_distances
from slamfusion.geometry import wrap_angles

F64 = npt.NDArray[np.float64]

# How far apart poses are that name one place, metres (and half of that in radians): at least what
# good paths differ by, at most what two rooms do.
LEAST_SCALE_M, MOST_SCALE_M = 0.03, 0.5
# What even a path that is not believed counts for where there is no other.
LEAST_BELIEF = 1e-6
# Rounds of the mean shift.
ROUNDS = 10


def consensus_poses(laid: LaidPaths) -> F64:
    """Return at each scan the pose that most of the weight lies near.

    Args:
        laid: at least one path; each scan has a pose of at least one.

    Returns:
        (N, 3) float64, metres and radians, yaw in [-pi, pi).
    """
    return find_modes(laid.poses, laid.weights, LEAST_SCALE_M, MOST_SCALE_M)


def find_modes(poses: F64, weights: F64, least_m: float, most_m: float) -> F64:
    """Return of several answers to each question the one that most of the weight lies near.

    Mean shift to a mode of the weighted density of the answers, from the one that is nearest to the
    weight of the others; the scale is the distance of that one from the nearest other one. Of two
    answers far apart the one of greater weight is followed, and of equal ones the first: the middle
    between two answers is none.

    Args:
        poses: (K, N, 3) K answers to each of N questions, poses or motions, metres and radians; NaN
            where there is none, but one of K is there.
        weights: (K, N) how much each is believed, 0 to 1.
        least_m, most_m: how far apart answers are that are one, in metres of ``pose_distances``.

    Returns:
        (N, 3) float64, yaw in [-pi, pi).

    Source: Comaniciu and Meer, Mean shift: a robust approach toward feature space analysis, PAMI
        24(5), 2002, with the kernel of Geman and McClure.
    """
    count, questions = poses.shape[:2]
    has = np.isfinite(poses[..., 0])
    believed = np.where(has, np.maximum(weights, LEAST_BELIEF), 0.0)
    apart = np.full((count, count, questions), np.inf)
    for a in range(count):
        for b in range(count):
            both = has[a] & has[b]
            apart[a, b, both] = pose_distances(poses[a, both], poses[b, both])
    nearest = np.where(np.eye(count, dtype=np.bool_)[:, :, None], np.inf, apart).min(axis=1)
    scales = np.clip(nearest, least_m, most_m)
    density = (believed[None] * geman_mcclure(apart / scales.min(axis=0))).sum(axis=1)
    start = np.where(has, density, -1.0).argmax(axis=0)
    every = np.arange(questions)
    mode, scale = poses[start, every], scales[start, every]
    for _ in range(ROUNDS):
        known = np.where(has[..., None], poses, mode)
        away = known - mode
        away[..., 2] = wrap_angles(away[..., 2])
        pull = believed * geman_mcclure(pose_distances(known, mode) / scale)
        mode = mode + (pull[..., None] * away).sum(axis=0) / pull.sum(axis=0)[:, None]
    mode[:, 2] = wrap_angles(mode[:, 2])
    return np.asarray(mode)
