"""``JudgedScans``: the scans, beams and chunks that paths are scored on, fixed once for all paths.

Nothing here depends on a path: chunks are equal numbers of scans in the order of time, and hits are
thinned by where the scan saw them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.errors import LogError
from slamfusion.io import LogScan
from slamfusion.trajectory import Trajectory

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

# Parts of a drive that are predicted by the others.
CHUNKS = 24
# Hits that are judged, and drawn, at most: they say as much as ten times as many.
MOST_HITS = 300_000
# Of the hits of a scan this near to each other one is judged, metres.
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
        odometry: (N, 3) float64, pose of the robot's base in the odometry frame at each scan,
            metres and radians; None where a scan has none.
        lasers: (N, 2) float64, the laser of each scan in the robot's base frame, metres.
        hits: (B, 2) float64, ends of the judged beams in the robot's base frame, metres.
        facings_rad: (B,) float64, the direction that the surface faces that each hit, in the
            robot's base frame; see ``surface_facings``.
        hit_scans: (B,) int64, the scan of each, never falling.
        hits_total: hits of the scans, judged or not.
    """

    stamps_s: F64
    chunks: I64
    odometry: F64 | None
    lasers: F64
    hits: F64
    facings_rad: F64
    hit_scans: I64
    hits_total: int

    def __len__(self) -> int:
        """Scans."""
        return len(self.stamps_s)

    def odometry_path(self) -> Trajectory | None:
        """Return the odometry as a path; None where there is none."""
        if self.odometry is None:
            return None
        return Trajectory(self.stamps_s, self.odometry, "odometry")


def judged_scans(scans: Iterable[LogScan], most_hits: int = MOST_HITS) -> JudgedScans:
    """Choose what paths of a drive are scored on.

    Of the hits of a scan that lie in one square of ``SPACING_M`` the first is kept: walls beside
    the robot get most of the beams, and those far away tell most of its heading. Where more than
    ``most_hits`` are left, every second one of each scan, every fourth, and so on.

    Args:
        scans: of a log, in the order of time.
        most_hits: that are judged at most.

    Raises:
        LogError: fewer scans with a hit than there are chunks.
    """
    stamps, lasers, odometry = [], [], []
    kept: list[F64] = []
    total = count = 0
    step = 1
    for item in scans:
        ends = item.scan.points()
        if not len(ends):
            continue
        total += len(ends)
        stamps.append(item.scan.stamp_s)
        lasers.append((item.scan.mount.x, item.scan.mount.y))
        pose = item.odometry
        odometry.append(None if pose is None else (pose.x, pose.y, pose.yaw_rad))
        rows = np.column_stack((ends, surface_facings(ends, lasers[-1])))
        kept.append(rows[spaced(ends)][len(kept) % step :: step])
        count += len(kept[-1])
        if count > most_hits:
            # Each scan begins elsewhere: what stays is what the wider step would have kept.
            kept = [own[number % (2 * step) // step :: 2] for number, own in enumerate(kept)]
            step, count = 2 * step, sum(map(len, kept))
    if len(kept) < CHUNKS:
        message = (
            f"{len(kept)} scans hit something, but paths are scored on at least {CHUNKS}; give "
            "a longer log"
        )
        raise LogError(message)
    known = [pose for pose in odometry if pose is not None]
    hits = np.concatenate(kept)
    return JudgedScans(
        stamps_s=np.array(stamps),
        chunks=np.arange(len(kept), dtype=np.int64) * CHUNKS // len(kept),
        odometry=np.array(known) if len(known) == len(kept) else None,
        lasers=np.array(lasers),
        hits=hits[:, :2],
        facings_rad=hits[:, 2],
        hit_scans=np.repeat(np.arange(len(kept), dtype=np.int64), [len(own) for own in kept]),
        hits_total=total,
    )


def spaced(points: F64) -> I64:
    """Return hits of one scan about ``SPACING_M`` apart, in the order of the beams.

    Each stretch of that length of a surface has the middle one of its hits. How long a surface is,
    is told by means over neighbours: were it told by the hits themselves, those that noise moves
    on would be the ones that are taken, and a wall on the left would be turned against one on the
    right.

    Args:
        points: (M, 2) float64, hits in the order of the beams, metres.
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
    # Of two in the middle the first and the second in turn.
    both = begins + np.append(begins[1:], count) - 1
    return np.asarray((both + np.arange(len(both)) % 2) // 2, dtype=np.int64)


def surface_facings(points: F64, laser: tuple[float, float]) -> F64:
    """Return the direction that the surface at each hit of one scan faces, towards the laser.

    The surface runs from the hits before to those after, as far as they lie within ``BESIDE_M``; a
    hit without such neighbours faces the laser.

    Args:
        points: (M, 2) float64, hits in the order of the beams, metres.
        laser: x and y of the laser in the same frame.

    Returns:
        (M,) radians in the frame of the points.
    """
    count = len(points)
    along = np.zeros((count, 2))
    for step in range(1, MOST_BESIDE + 1):
        if count <= step:
            break
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
