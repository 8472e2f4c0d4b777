"""``cover_stamps``: a path's pose at each scan, also where it has none of its own.

Other SLAMs write a pose for a keyframe only, and begin or end where they please. Between two poses
the odometry carries the first on, bent so that it arrives at the second; before the first and after
the last one, only as far as wheels are good for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.errors import TrajectoryError
from slamfusion.evidence.beams import JudgedScans
from slamfusion.geometry import blend_poses, compose_poses, invert_poses, travelled, wrap_angles
from slamfusion.trajectory import Trajectory, clock_advice

F64 = npt.NDArray[np.float64]
B8 = npt.NDArray[np.bool_]

# Odometry carries a path beyond its ends by at most this, metres and radians.
BEYOND_M, BEYOND_RAD = 1.0, 1.0
# Without odometry a path is interpolated between two poses this far apart in time, seconds.
BETWEEN_S = 1.0


@dataclass(frozen=True, eq=False)
class CoveredPath:
    """A path at the stamps of scans.

    Attributes:
        poses: (N, 3) float64, metres and radians, in the path's frame; NaN where it has none.
        is_own: (N,) bool, where the path itself has a pose for the scan.
        is_covered: (N,) bool, where there is a pose, its own or by odometry.
    """

    poses: F64
    is_own: B8
    is_covered: B8

    @property
    def own_share(self) -> float:
        """Share of the scans for which the path itself has a pose."""
        return float(self.is_own.mean())

    @property
    def covered_share(self) -> float:
        """Share of the scans for which there is a pose."""
        return float(self.is_covered.mean())


def cover_stamps(path: Trajectory, scans: JudgedScans) -> CoveredPath:
    """Return a path's pose at each scan.

    Args:
        path: at any stamps of the clock of the scans; may be sparse.
        scans: of the drive, with odometry or without.
    """
    count = len(scans)
    poses = np.full((count, 3), np.nan)
    if not len(path):
        nowhere = np.zeros(count, dtype=np.bool_)
        return CoveredPath(poses, nowhere, nowhere.copy())
    stamps_s = scans.stamps_s
    near, is_own = path.matches(stamps_s)
    poses[is_own] = path.poses[near[is_own]]
    after = np.searchsorted(path.stamps_s, stamps_s, side="right")
    before = np.maximum(after - 1, 0)
    is_between = (after > 0) & (after < len(path))
    after = np.minimum(after, len(path) - 1)
    gap = np.flatnonzero(~is_own)
    if scans.odometry is None:
        wide_s = path.stamps_s[after[gap]] - path.stamps_s[before[gap]]
        gap = gap[is_between[gap] & (wide_s <= BETWEEN_S)]
        poses[gap] = blend_poses(
            path.poses[before[gap]],
            path.poses[after[gap]],
            _shares(path.stamps_s, before[gap], after[gap], stamps_s[gap]),
        )
    else:
        there = _odometry_at(scans, path.stamps_s)
        onward = _carried(path.poses[before[gap]], there[before[gap]], scans.odometry[gap])
        backward = _carried(path.poses[after[gap]], there[after[gap]], scans.odometry[gap])
        share = _shares(path.stamps_s, before[gap], after[gap], stamps_s[gap])
        poses[gap] = blend_poses(onward, backward, share)
        beyond = gap[~is_between[gap] & _is_far(scans, path, gap)]
        poses[beyond] = np.nan
    return CoveredPath(poses, is_own, np.isfinite(poses[:, 0]))


def no_common_time(name: str, path: Trajectory, stamps_s: F64) -> TrajectoryError:
    """Return the error that a path has no pose at the time of any scan.

    Args:
        name: of the path.
        path: at least one pose.
        stamps_s: (N,) times of the scans, seconds, N at least 1.
    """
    return TrajectoryError(
        f"{name}: its poses are of {path.stamps_s[0]:.3f} to {path.stamps_s[-1]:.3f} s, the scans "
        f"of {stamps_s[0]:.3f} to {stamps_s[-1]:.3f} s; "
        f"{clock_advice(path.stamps_s, stamps_s)}give a path of this log"
    )


def _shares(
    stamps_s: F64, before: npt.NDArray[np.int64], after: npt.NDArray[np.int64], at_s: F64
) -> F64:
    """Return how far times are from one stamp to the next, 0 to 1; 0 where both are one."""
    wide_s = stamps_s[after] - stamps_s[before]
    passed = (at_s - stamps_s[before]) / np.where(wide_s > 0.0, wide_s, 1.0)
    return np.clip(np.where(wide_s > 0.0, passed, 0.0), 0.0, 1.0)


def _carried(poses: F64, odometry_there: F64, odometry_here: F64) -> F64:
    """Return poses carried on by the motion that the wheels tell from there to here."""
    return compose_poses(poses, compose_poses(invert_poses(odometry_there), odometry_here))


def _odometry_at(scans: JudgedScans, stamps_s: F64) -> F64:
    """Return the odometry of a drive at any times, (M, 3); beyond its ends, that of the end."""
    known = scans.odometry
    assert known is not None  # noqa: S101 - asked for with odometry only
    after = np.clip(np.searchsorted(scans.stamps_s, stamps_s), 1, len(scans) - 1)
    share = _shares(scans.stamps_s, after - 1, after, stamps_s)
    return blend_poses(known[after - 1], known[after], share)


def _is_far(scans: JudgedScans, path: Trajectory, at: npt.NDArray[np.int64]) -> B8:
    """Whether scans lie farther beyond the ends of a path than odometry may carry it."""
    known = scans.odometry
    assert known is not None  # noqa: S101 - asked for with odometry only
    travelled_m = travelled(known)
    turned_rad = np.concatenate(([0.0], np.cumsum(np.abs(wrap_angles(np.diff(known[:, 2]))))))
    far = np.zeros(len(at), dtype=np.bool_)
    for end_s, is_beyond in (
        (path.stamps_s[0], scans.stamps_s[at] < path.stamps_s[0]),
        (path.stamps_s[-1], scans.stamps_s[at] > path.stamps_s[-1]),
    ):
        way_m = np.abs(travelled_m[at] - np.interp(end_s, scans.stamps_s, travelled_m))
        turn_rad = np.abs(turned_rad[at] - np.interp(end_s, scans.stamps_s, turned_rad))
        # Where there are no scans nothing is known of the way.
        off_s = max(scans.stamps_s[0] - end_s, end_s - scans.stamps_s[-1])
        is_far = (way_m > BEYOND_M) | (turn_rad > BEYOND_RAD) | (off_s > BETWEEN_S)
        far |= is_beyond & is_far
    return far
