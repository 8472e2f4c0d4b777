"""``Trajectory``: stamped poses, and lookup by time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from slamfusion.errors import TrajectoryError
from slamfusion.geometry import B8, F64, I64, Pose2, moved_poses

# Stamps with a smaller difference are equal, seconds: files round to milliseconds.
SAME_STAMP_S = 1e-3
# The unit nearest to a metre.
FOOT_M = 0.3048


def nearest_stamps(stamps_s: F64, wanted_s: npt.ArrayLike) -> I64:
    """Return the indices of the stamps (N,) (sorted, s) nearest to times; the earlier on a tie."""
    wanted = np.asarray(wanted_s, dtype=np.float64)
    last = len(stamps_s) - 1
    after = np.clip(np.searchsorted(stamps_s, wanted), 1, max(1, last))
    before = after - 1
    after = np.minimum(after, last)
    later_is_nearer = stamps_s[after] - wanted < wanted - stamps_s[before]
    return np.asarray(np.where(later_is_nearer, after, before), dtype=np.int64)


def clock_advice(own_s: F64, other_s: F64) -> str:
    """Return advice for two ranges of time (seconds, sorted) that do not meet; else empty."""
    if own_s[0] <= other_s[-1] and other_s[0] <= own_s[-1]:
        return ""
    apart_s = other_s[0] - own_s[0]
    return (
        f"two clocks, {abs(apart_s):.3f} s apart? use --time-offset {apart_s:.3f}, or "
        "--time-offset auto; else "
    )


def is_other_unit(scale: float) -> bool:
    """Return whether a scale, above 0, is nearer to that of a foot or another unit than to 1."""
    return abs(math.log(scale)) > -0.5 * math.log(FOOT_M)


def flag_runs(flags: B8) -> Iterator[slice]:
    """Yield the runs of set flags (N,) in order."""
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(np.int8), 0]))
    for start, stop in edges.reshape(-1, 2).tolist():
        yield slice(start, stop)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of one body over time; immutable.

    Attributes:
        stamps_s: (N,) float64, seconds, never decreasing.
        poses: (N, 3) float64, x and y in metres, yaw in radians; all in one frame.
        name: what tables and messages call it.

    Raises:
        TrajectoryError: shapes that do not fit, values that are not finite, time that goes back.
    """

    stamps_s: F64
    poses: F64
    name: str = "trajectory"

    def __post_init__(self) -> None:
        stamps = np.array(self.stamps_s, dtype=np.float64)
        poses = np.array(self.poses, dtype=np.float64).reshape(-1, 3)
        if stamps.ndim != 1 or len(stamps) != len(poses):
            message = f"{self.name}: {stamps.shape} stamps do not fit {poses.shape} poses"
            raise TrajectoryError(message)
        if not (np.isfinite(stamps).all() and np.isfinite(poses).all()):
            raise TrajectoryError(f"{self.name}: stamps and poses must be finite")
        if (np.diff(stamps) < 0.0).any():
            first = int(np.flatnonzero(np.diff(stamps) < 0.0)[0]) + 1
            message = f"{self.name}: time goes back at pose {first}; sort the poses by time"
            raise TrajectoryError(message)
        stamps.flags.writeable = False
        poses.flags.writeable = False
        vars(self).update(stamps_s=stamps, poses=poses)

    def __len__(self) -> int:
        return len(self.stamps_s)

    def later(self, seconds: float) -> Trajectory:
        """Return the same path, later by some seconds."""
        return replace(self, stamps_s=self.stamps_s + seconds)

    def at_most(self, most: int) -> Trajectory:
        """Return the same path with at most this number of poses.

        A quarter are the newest, the others are chosen evenly of the older, with the first: all
        chosen evenly, the newest poses of a long path would be far apart.
        """
        count, newest = len(self), most // 4
        if count <= most:
            return self
        older = np.linspace(0, count - newest - 1, most - newest).round().astype(np.int64)
        kept = np.concatenate((older, np.arange(count - newest, count)))
        return self.chosen(kept)

    def chosen(self, which: B8 | I64) -> Trajectory:
        """Return the same path with some of its poses, by (N,) bool or by indices."""
        return replace(self, stamps_s=self.stamps_s[which], poses=self.poses[which])

    def between(self, after_s: float, until_s: float) -> Trajectory:
        """Return the same path with the poses after one time and until another, seconds."""
        return self.chosen((self.stamps_s > after_s) & (self.stamps_s <= until_s))

    def moved(self, transform: Pose2) -> Trajectory:
        """Return the same path in another frame; ``transform`` maps points into it, metres."""
        return replace(self, poses=moved_poses(transform, self.poses))

    def mirrored(self) -> Trajectory:
        """Return the mirror image of the path, about the x axis of its frame."""
        return replace(self, poses=self.poses * (1.0, -1.0, -1.0))

    def pose(self, index: int) -> Pose2:
        """Return one pose."""
        return Pose2(*self.poses[index].tolist())

    def nearest(self, stamps_s: npt.ArrayLike) -> I64:
        """Return the index of the pose nearest to each time; TrajectoryError without poses."""
        if len(self) == 0:
            raise TrajectoryError(f"{self.name}: has no pose")
        return nearest_stamps(self.stamps_s, stamps_s)

    def matches(self, stamps_s: npt.ArrayLike, within_s: float = SAME_STAMP_S) -> tuple[I64, B8]:
        """Return the pose nearest in time for each time, and whether it is near enough.

        Args:
            stamps_s: any shape, seconds.

        Returns:
            Indices as in ``nearest``, and bool, both of the shape of the times.

        Raises:
            TrajectoryError: there is no pose.
        """
        wanted = np.asarray(stamps_s, dtype=np.float64)
        near = self.nearest(wanted)
        return near, np.abs(self.stamps_s[near] - wanted) <= within_s

    def path_length_m(self) -> float:
        """Return the sum of the straight distances between neighbouring poses."""
        steps = np.diff(self.poses[:, :2], axis=0)
        return float(np.hypot(steps[:, 0], steps[:, 1]).sum())
