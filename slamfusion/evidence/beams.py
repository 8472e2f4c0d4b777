"""``JudgedScans``: the scans, beams and chunks that paths are scored on, fixed once for all paths.

Nothing here depends on a path: chunks are equal numbers of consecutive scans, and hits are thinned
in the frame of their scan. ``cover_stamps`` gives a path a pose at each scan, since other SLAMs
write poses of keyframes only. Odometry interpolates between two poses, corrected to arrive at the
second, and extrapolates a short way before the first and after the last.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slamfusion.errors import LogError, TrajectoryError, counted
from slamfusion.geometry import (
    B8,
    F64,
    I64,
    Pose2,
    blend_poses,
    compose_poses,
    interpolate_poses,
    invert_poses,
    travelled,
    wrap_angles,
)
from slamfusion.io import LogScan
from slamfusion.trajectory import Trajectory, clock_advice

# Parts of a drive that are predicted by the others.
CHUNKS = 24
# The most judged and drawn hits; more change nothing.
MOST_HITS = 300_000
# Spacing of the judged hits of a scan, metres.
SPACING_M = 0.1
# Hits this near to each other, metres, and this many beams apart are on one surface.
BESIDE_M = 0.3
MOST_BESIDE = 4


@dataclass(frozen=True, eq=False)
class JudgedScans:
    """The scans of a drive as every path is scored on them.

    Attributes:
        stamps_s: (N,) float64, times of the scans, seconds, strictly rising.
        chunks: (N,) int64, the chunk of each scan, 0 to ``CHUNKS`` - 1, never falling.
        driven: the odometry at the stamps of these scans; None where a scan has none.
        lasers: (N, 2) float64, the laser of each scan in the robot's base frame, metres.
        hits: (B, 2) float64, ends of the judged beams in the robot's base frame, metres.
        facings_rad: (B,) float64, the direction that the surface faces that each hit, in the
            robot's base frame; see ``surface_facings``.
        hit_scans: (B,) int64, the scan of each, never falling.
    """

    stamps_s: F64
    chunks: I64
    driven: Trajectory | None
    lasers: F64
    hits: F64
    facings_rad: F64
    hit_scans: I64

    def __len__(self) -> int:
        return len(self.stamps_s)


@dataclass(frozen=True, eq=False)
class ScanHits:
    """The hits of one scan.

    Attributes:
        stamp_s: its time, seconds.
        laser: x and y of the laser in the robot's base frame, metres.
        odometry: pose of the base in the odometry frame; None without.
        ends: (B, 2) float64, all hits in the order of the beams, in the base frame, metres.
    """

    stamp_s: float
    laser: tuple[float, float]
    odometry: Pose2 | None
    ends: F64

    @cached_property
    def rows(self) -> F64:
        """Those that paths are scored on, (H, 3): x and y, metres, and the facing, radians.

        One of each ``SPACING_M`` of a surface: otherwise walls near the robot would dominate, while
        far ones determine its heading.
        """
        facings_rad = surface_facings(self.ends, self.laser)
        return np.column_stack((self.ends, facings_rad))[spaced(self.ends)]


def scan_hits(scans: Iterable[LogScan]) -> Iterator[ScanHits]:
    """Yield the hits of scans; those that hit nothing are left out."""
    for item in scans:
        ends, mount = item.scan.points(), item.scan.mount
        if len(ends):
            yield ScanHits(item.scan.stamp_s, (mount.x, mount.y), item.odometry, ends)


def judged_scans(scans: Iterable[LogScan]) -> JudgedScans:
    """Choose the hits of a log, in the order of time, on which paths are scored."""
    return judged_hits(scan_hits(scans))


def judged_hits(scans: Iterable[ScanHits], most_hits: int = MOST_HITS) -> JudgedScans:
    """Choose the hits on which paths of a drive are scored, at most ``most_hits``.

    If there are more, every second, fourth, ... hit of each scan is kept.

    Raises:
        LogError: fewer scans with a hit than there are chunks.
    """
    stamps, lasers, odometry = [], [], []
    kept: list[F64] = []
    count = 0
    step = 1
    for item in scans:
        stamps.append(item.stamp_s)
        lasers.append(item.laser)
        if (pose := item.odometry) is not None:
            odometry.append((pose.x, pose.y, pose.yaw_rad))
        kept.append(item.rows[len(kept) % step :: step])
        count += len(kept[-1])
        if count > most_hits:
            # The start varies by scan, so that a wider step keeps a subset.
            kept = [own[number % (2 * step) // step :: 2] for number, own in enumerate(kept)]
            step, count = 2 * step, sum(map(len, kept))
    if len(kept) < CHUNKS:
        raise LogError(
            f"{counted(len(kept), 'scan')} hit something, but paths are scored on at least "
            f"{CHUNKS}; give a longer log"
        )
    hits = np.concatenate(kept)
    stamps_s = np.array(stamps)
    driven = None
    if len(odometry) == len(kept):
        driven = Trajectory(stamps_s, np.array(odometry), "odometry")
    return JudgedScans(
        stamps_s=stamps_s,
        chunks=np.arange(len(kept), dtype=np.int64) * CHUNKS // len(kept),
        driven=driven,
        lasers=np.array(lasers),
        hits=hits[:, :2],
        facings_rad=hits[:, 2],
        hit_scans=np.repeat(np.arange(len(kept), dtype=np.int64), [len(own) for own in kept]),
    )


def spaced(points: F64) -> I64:
    """Return hits of one scan about ``SPACING_M`` apart, in the order of the beams.

    The middle hit of each stretch of that length is kept. The length of a surface is measured on
    means over neighbours: with the hits themselves, noise would decide which are kept, and turn a
    wall on the left against one on the right.

    ``points`` are (M, 2), in the order of the beams, metres.
    """
    count = len(points)
    number = np.arange(count)
    apart_m = np.hypot(*np.diff(points, axis=0).T)
    first = np.concatenate(([True], apart_m > BESIDE_M))
    surface = np.cumsum(first) - 1
    starts = np.flatnonzero(first)
    ends = np.append(starts[1:], count)
    reach = np.minimum(number - starts[surface], ends[surface] - 1 - number)
    reach = np.minimum(reach, MOST_BESIDE)
    sums = np.concatenate((np.zeros((1, 2)), np.cumsum(points, axis=0)))
    smooth = (sums[number + reach + 1] - sums[number - reach]) / (2 * reach + 1)[:, None]
    steps_m = np.where(first, 0.0, np.hypot(*np.diff(smooth, axis=0, prepend=smooth[:1]).T))
    along_m = np.cumsum(steps_m)
    along_m -= along_m[starts][surface]
    stretch = np.floor(along_m / SPACING_M).astype(np.int64)
    begins = np.flatnonzero(first | (np.diff(stretch, prepend=-1) != 0))
    # Of two middle hits, the first and the second in turn.
    both = begins + np.append(begins[1:], count) - 1
    return np.asarray((both + np.arange(len(both)) % 2) // 2, dtype=np.int64)


def surface_facings(points: F64, laser: tuple[float, float]) -> F64:
    """Return the direction that the surface at each hit faces, towards the laser, (M,) radians.

    The surface runs from the previous to the next hits within ``BESIDE_M``; a hit without such
    neighbours faces the laser. ``points`` are (M, 2), in the order of the beams, metres.
    """
    along = np.zeros((len(points), 2))
    for step in range(1, MOST_BESIDE + 1):
        away = points[step:] - points[:-step]
        away[np.hypot(away[:, 0], away[:, 1]) > BESIDE_M] = 0.0
        along[step:] += away
        along[:-step] += away
    to_laser = np.asarray(laser) - points
    normal = np.stack((-along[:, 1], along[:, 0]), axis=1)
    turned = (normal * to_laser).sum(axis=1) < 0.0
    normal[turned] *= -1.0
    alone = ~along.any(axis=1)
    normal[alone] = to_laser[alone]
    return np.asarray(np.arctan2(normal[:, 1], normal[:, 0]))


# Odometry extends a path beyond its ends by at most this, metres and radians.
BEYOND_M, BEYOND_RAD = 1.0, 1.0
# Without odometry a path is interpolated across gaps up to this, seconds.
BETWEEN_S = 1.0


def cover_stamps(path: Trajectory, scans: JudgedScans) -> tuple[F64, B8]:
    """Return a path's pose at each scan; the path may be sparse, on the clock of the scans.

    Returns:
        (N, 3) float64 poses in the path's frame, NaN where it has none and odometry gives none;
        and (N,) bool, where the path itself has a pose for the scan.
    """
    count = len(scans)
    poses = np.full((count, 3), np.nan)
    if not len(path):
        return poses, np.zeros(count, dtype=np.bool_)
    stamps_s = scans.stamps_s
    near, is_own = path.matches(stamps_s)
    poses[is_own] = path.poses[near[is_own]]
    after = np.searchsorted(path.stamps_s, stamps_s, side="right")
    is_between = (after > 0) & (after < len(path))
    gap = np.flatnonzero(~is_own)
    driven = path if scans.driven is None else scans.driven
    poses[gap] = carried_along(path, driven, stamps_s[gap])
    is_known = is_between[gap]
    if scans.driven is None:
        wide_s = np.diff(path.stamps_s, prepend=-np.inf, append=np.inf)
        is_known &= wide_s[after[gap]] <= BETWEEN_S
    else:
        is_known |= ~_is_far(driven, path, gap)
    poses[gap[~is_known]] = np.nan
    return poses, is_own


def no_common_time(name: str, path: Trajectory, stamps_s: F64) -> TrajectoryError:
    """Return the error that a path has no pose at the time of any scan."""
    return TrajectoryError(
        f"{name}: its poses are of {path.stamps_s[0]:.3f} to {path.stamps_s[-1]:.3f} s, the scans "
        f"of {stamps_s[0]:.3f} to {stamps_s[-1]:.3f} s; "
        f"{clock_advice(path.stamps_s, stamps_s)}give a path of this log"
    )


def carried_along(path: Trajectory, driven: Trajectory, at_s: F64) -> F64:
    """Return poses of a path at other times, (M, 3): carried by ``driven`` from those around them.

    Beyond an end they are carried from it.
    """
    after = np.searchsorted(path.stamps_s, at_s, side="right")
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(path) - 1)
    there, here = (
        interpolate_poses(times_s, driven.stamps_s, driven.poses)
        for times_s in (path.stamps_s, at_s)
    )
    wide_s = path.stamps_s[after] - path.stamps_s[before]
    share = (at_s - path.stamps_s[before]) / np.where(wide_s > 0.0, wide_s, np.inf)
    onward, backward = (
        compose_poses(path.poses[end], compose_poses(invert_poses(there[end]), here))
        for end in (before, after)
    )
    return blend_poses(onward, backward, share)


def _is_far(driven: Trajectory, path: Trajectory, at: I64) -> B8:
    """Whether scans lie farther beyond the ends of a path than odometry may extend it."""
    stamps_s, odometry = driven.stamps_s, driven.poses
    travelled_m = travelled(odometry)
    turned_rad = np.concatenate(([0.0], np.cumsum(np.abs(wrap_angles(np.diff(odometry[:, 2]))))))
    far = np.zeros(len(at), dtype=np.bool_)
    for end_s, is_beyond in (
        (path.stamps_s[0], stamps_s[at] < path.stamps_s[0]),
        (path.stamps_s[-1], stamps_s[at] > path.stamps_s[-1]),
    ):
        way_m = np.abs(travelled_m[at] - np.interp(end_s, stamps_s, travelled_m))
        turn_rad = np.abs(turned_rad[at] - np.interp(end_s, stamps_s, turned_rad))
        # Where there are no scans nothing is known of the way.
        off_s = max(stamps_s[0] - end_s, end_s - stamps_s[-1])
        is_far = (way_m > BEYOND_M) | (turn_rad > BEYOND_RAD) | (off_s > BETWEEN_S)
        far |= is_beyond & is_far
    return far
