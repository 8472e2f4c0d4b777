"""Poses between the scans of an estimate: the nearest scan's pose, continued by raw odometry.

A producer uses some scans of a run; relations may refer to all. Odometry is accurate between scans.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import scipy

from slamfusion.errors import TrajectoryError
from slamfusion.evaluation.trajectory_error import associate
from slamfusion.geometry import (
    F64,
    I64,
    Pose2,
    compose_poses,
    fit_motion,
    invert_poses,
    moved_poses,
)
from slamfusion.grid import IDENTITY
from slamfusion.trajectory import Trajectory

# Scans tried as anchors, and scans that score each trial. The rounding of one heading displaces the
# far end of a path, so the search distance of the scores is larger.
_ANCHORS = 3
_JUDGES = 64
_ROUGHLY = 10.0
# Scan stamps may be seconds off; a row a minute away is another visit.
_WINDOW_S = 60.0
# Most iterations of the frame fit.
_FITS = 10
# Pairs worse than this times the median are rejected: the scan's row is missing.
_FIT_WITHIN = 4.0
# Breaks ties between rows of one stamp: below any clock's resolution, above rounding.
_TIE_S = 1e-9
# An odometry row this near, metres and radians, is a scan's own.
_EQUAL_M = 0.005


@dataclass(frozen=True, eq=False)
class DensePoses:
    """How poses at the relations' times were composed with odometry."""

    rows: int
    """Rows of the odometry that were given a pose."""
    rows_found_by: Literal["odometry", "stamp"]
    """How a pose's row was found: by the odometry of its scan, or by its stamp."""
    poses_used: int
    """Poses of the trajectory that have a row."""
    poses_without_row: int
    """Poses of the trajectory that have none."""
    trajectory: Trajectory = field(repr=False)
    """The poses, at the stamps of the odometry; at a scan whose own stamp agrees with its row's, at
    the scan's, which is the finer one."""


def match_odometry(scan_odometry: Trajectory, odometry: Trajectory) -> I64:
    """Find the row of an odometry file for each scan by its pose, not its stamp.

    Copies of one odometry may differ by a fixed motion, which is fitted, and by rounding. A robot
    that stands repeats its odometry: scans with one candidate give the order, and the others take
    the candidate nearest in it.

    Args:
        scan_odometry: raw odometry of the scans of a log; the stamps may be off by seconds.
        odometry: every row of the file, at least one.

    Returns:
        (N,) row for each scan; -1 if none matches.

    Raises:
        TrajectoryError: no scan has a row.
    """
    frame = _fit_frame(scan_odometry, odometry)
    tree = scipy.spatial.KDTree(_features(moved_poses(frame, odometry.poses)))
    near = tree.query_ball_point(_features(scan_odometry.poses), _EQUAL_M, return_sorted=True)
    candidates = [
        rows[np.abs(odometry.stamps_s[rows] - stamp_s) <= _WINDOW_S]
        for rows, stamp_s in zip(
            (np.array(found, dtype=np.int64) for found in near), scan_odometry.stamps_s, strict=True
        )
    ]
    sure = np.array([len(rows) == 1 for rows in candidates])
    if not any(len(rows) for rows in candidates):
        raise TrajectoryError(
            f"{odometry.name}: no row equals the odometry of a scan of {scan_odometry.name} to "
            f"{_EQUAL_M:g} m; give the odometry of the same run, or leave out --log"
        )
    turns = np.arange(len(candidates))
    if sure.any():
        known = [int(candidates[turn][0]) for turn in np.flatnonzero(sure)]
        expected = np.interp(turns, np.flatnonzero(sure), known)
    else:
        expected = odometry.nearest(scan_odometry.stamps_s).astype(np.float64)
    return np.array(
        [
            own[np.argmin(np.abs(own - turn))] if len(own) else -1
            for own, turn in zip(candidates, expected, strict=True)
        ],
        dtype=np.int64,
    )


def poses_by_odometry(
    estimate: Trajectory,
    scan_odometry: Trajectory | None,
    odometry: Trajectory,
    *,
    tolerance_s: float,
) -> DensePoses:
    """Return an estimate's poses at every row of an odometry file.

    The pose at a row is that of the nearest scan in rows (the earlier of two), composed with the
    odometry's motion from the scan's row. The row of an estimate's pose is found by the scan's own
    odometry if known, because its stamp may be inexact; else by its stamp.

    Args:
        estimate: poses at scans, in any frame.
        scan_odometry: raw odometry of the scans of the estimate's log; None if unknown.

    Raises:
        TrajectoryError: no pose of the estimate has a row.
    """
    if scan_odometry is None:
        used, rows = rows_by_stamp(estimate, odometry, tolerance_s)
        _refuse_none(used, estimate, odometry, tolerance_s)
    else:
        used, scans = associate(estimate, scan_odometry, tolerance_s)
        _refuse_none(used, estimate, scan_odometry, tolerance_s)
        rows = match_odometry(scan_odometry, odometry)[scans]
        used, rows = used[rows >= 0], rows[rows >= 0]
        _refuse_none(used, estimate, odometry, tolerance_s)
    by_row = np.argsort(rows, kind="stable")
    used, rows = used[by_row], rows[by_row]
    # The nearest scan of each row; of two the earlier.
    nearest = np.searchsorted(0.5 * (rows[1:] + rows[:-1]), np.arange(len(odometry)))
    increment = compose_poses(invert_poses(odometry.poses[rows[nearest]]), odometry.poses)
    poses = compose_poses(estimate.poses[used[nearest]], increment)
    stamps_s = _refined_stamps(odometry.stamps_s, rows, estimate.stamps_s[used], tolerance_s)
    by_time = np.argsort(stamps_s, kind="stable")
    return DensePoses(
        rows=len(stamps_s),
        rows_found_by="stamp" if scan_odometry is None else "odometry",
        poses_used=len(used),
        poses_without_row=len(estimate) - len(used),
        trajectory=Trajectory(stamps_s[by_time], poses[by_time], estimate.name),
    )


def rows_by_stamp(
    estimate: Trajectory, odometry: Trajectory, tolerance_s: float
) -> tuple[I64, I64]:
    """Return the poses of the estimate that have a row of (nearly) their stamp, and the rows.

    With rounded stamps several rows have one stamp. So the poses take one row each with the least
    sum of differences, where leaving a pose out costs the tolerance.
    """
    count = len(odometry)
    lows = np.searchsorted(odometry.stamps_s, estimate.stamps_s - tolerance_s, "left")
    highs = np.searchsorted(odometry.stamps_s, estimate.stamps_s + tolerance_s, "right")
    rows = np.concatenate([np.arange(*ends) for ends in zip(lows, highs, strict=True)])
    poses = np.repeat(np.arange(len(estimate)), highs - lows)
    nearest = odometry.nearest(estimate.stamps_s)
    costs = np.abs(odometry.stamps_s[rows] - estimate.stamps_s[poses])
    costs += _TIE_S * np.abs(rows - nearest[poses])
    # Each pose has an own column for being left out. Costs in such a matrix must not be 0.
    every = np.arange(len(estimate))
    left_out = np.full(len(estimate), tolerance_s + _TIE_S * count)
    matrix = scipy.sparse.csr_array(
        (
            1.0 + np.concatenate((costs, left_out)),
            (np.concatenate((poses, every)), np.concatenate((rows, count + every))),
        )
    )
    used, chosen = scipy.sparse.csgraph.min_weight_full_bipartite_matching(matrix)
    takes = chosen < count
    return used[takes].astype(np.int64), np.sort(chosen[takes]).astype(np.int64)


def _refined_stamps(stamps_s: F64, rows: I64, exact_s: F64, tolerance_s: float) -> F64:
    """Return the rows' stamps, replaced by the more exact ones of the scans if both agree."""
    agree = np.abs(stamps_s[rows] - exact_s) <= tolerance_s
    low, high = np.full(len(stamps_s), -np.inf), np.full(len(stamps_s), np.inf)
    low[rows[agree]] = exact_s[agree]
    high[rows[agree]] = exact_s[agree]
    low = np.maximum.accumulate(low)
    high = np.minimum.accumulate(high[::-1])[::-1]
    refined = np.clip(stamps_s, low, high)
    refined[rows[agree]] = exact_s[agree]
    return np.asarray(refined)


def _refuse_none(used: I64, estimate: Trajectory, other: Trajectory, tolerance_s: float) -> None:
    """Raise if no pose of the estimate belongs to the other file."""
    if len(used):
        return
    raise TrajectoryError(
        f"{estimate.name}: no pose belongs to one of {other.name} within {tolerance_s:g} s; the "
        f"first is from {estimate.stamps_s[0]:.3f} to {estimate.stamps_s[-1]:.3f} s, the other "
        f"from {other.stamps_s[0]:.3f} to {other.stamps_s[-1]:.3f} s; give the files of one run"
    )


def _fit_frame(scan_odometry: Trajectory, odometry: Trajectory) -> Pose2:
    """Return the rigid motion from the frame of ``odometry`` to that of ``scan_odometry``.

    A few scans are paired with every row of about their time; the pair wins under which the scans
    are nearest to rows, then nearest in time. Then each scan is paired with its nearest row, and
    the motion is fitted to the good pairs.
    """
    scans, rows = scan_odometry.poses, odometry.poses
    tree = scipy.spatial.KDTree(_features(rows))
    judges = scans[np.linspace(0, len(scans) - 1, min(len(scans), _JUDGES)).astype(int)]
    reach = _ROUGHLY * _EQUAL_M
    best = (math.inf, math.inf)
    frame = IDENTITY
    for anchor in np.unique(np.linspace(0, len(scans) - 1, _ANCHORS + 2).astype(int)[1:-1]):
        apart_s = np.abs(odometry.stamps_s - scan_odometry.stamps_s[anchor])
        near = np.flatnonzero(apart_s <= _WINDOW_S)
        frames = compose_poses(scans[anchor], invert_poses(rows[near]))
        moved = compose_poses(invert_poses(frames)[:, None], judges)
        distance = np.asarray(tree.query(_features(moved), distance_upper_bound=reach)[0])
        costs = np.minimum(distance, reach).sum(axis=1)
        for cost, row, candidate in zip(costs, near, frames, strict=True):
            if (float(cost), float(apart_s[row])) < best:
                best = (float(cost), float(apart_s[row]))
                frame = Pose2(*(float(value) for value in candidate))
    last: I64 = np.full(len(scans), -1, dtype=np.int64)
    for _ in range(_FITS):
        found = tree.query(_features(moved_poses(frame.inverse(), scans)))
        distance, nearest = np.asarray(found[0]), np.asarray(found[1], dtype=np.int64)
        if np.array_equal(nearest, last):
            break
        last = nearest
        good = distance <= _FIT_WITHIN * np.median(distance)
        frame = fit_motion(rows[nearest[good]], scans[good])
    return frame


def _features(poses: F64) -> F64:
    """Return poses as points whose distance adds metres and radians (small angles)."""
    yaw_rad = poses[..., 2:]
    return np.concatenate((poses[..., :2], np.cos(yaw_rad), np.sin(yaw_rad)), axis=-1)
