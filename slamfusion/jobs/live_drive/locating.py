"""``DriveLocator``: where the robot is now, by its newest scan on the walls of a solution."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from slamfusion.evidence.beams import CHUNKS, ScanHits, judged_hits
from slamfusion.evidence.patches import ScanMatch, WallMap
from slamfusion.evidence.path_frames import pose_distances
from slamfusion.geometry import (
    F64,
    Pose2,
    compose_poses,
    invert_poses,
    pose_of,
    row_of,
    wrap_angles,
)
from slamfusion.io.files import return_freed_memory
from slamfusion.jobs.live_drive.memory import LEAST_SCANS, DriveMemory
from slamfusion.jobs.live_drive.solution import CARRIED, DRIFT, DriveSolution
from slamfusion.jobs.outputs import FUSED
from slamfusion.trajectory import SAME_STAMP_S, Trajectory

# Deviations of the motion from one pose of an input to the next, metres and radians.
STEP: F64 = np.array((0.01, 0.01, 0.005))
# The last located scans are added to the walls each time this number of scans was located.
ADDED_SCANS = 10


class DriveLocator:
    """Carries the poses of the inputs into the fused frame, from any thread."""

    def __init__(self, memory: DriveMemory) -> None:
        """Start without a solution."""
        self._memory = memory
        self._solution: DriveSolution | None = None
        # The walls of the solution with those seen since; the last scans that have a pose, with
        # it, and the number of located ones; and by input the motion of its map frame into the
        # fused frame with the covariance of the pose that it gives.
        self._grown: WallMap | None = None
        self._located: list[tuple[ScanHits, F64]] = []
        self._added = 0
        self._corrections: dict[str, tuple[Pose2, F64]] = {}

    @property
    def solution(self) -> DriveSolution | None:
        """The one that was taken last; None before the first of this drive."""
        with self._memory.lock:
            own = self._solution
            return own if own is not None and own.generation == self._memory.generation else None

    def take(self, solution: DriveSolution) -> bool:
        """Locate poses by a solution from now on; return whether its drive is still this one."""
        return_freed_memory()
        path = solution.path
        with self._memory.lock:
            if solution.generation != self._memory.generation:
                return False
            before, self._solution = self.solution, solution
            # With the path and the walls of before, the inputs alone were judged again.
            is_same = before is not None and before.path is path and before.walls is solution.walls
            kept = self._corrections if is_same else {}
            self._corrections = {
                name: kept.get(name, (motion, CARRIED))
                for name, motion in solution.supported.items()
            }
            if not is_same:
                self._grown = solution.walls
                recent = self._memory.scans[-2 * LEAST_SCANS :]
                near, meets = path.matches(np.array([own.stamp_s for own in recent]))
                self._located = [(recent[at], path.poses[near[at]]) for at in np.flatnonzero(meets)]
        return True

    def locate(self, name: str, stamp_s: float, pose: Pose2) -> ScanMatch | None:
        """Return the fused-frame pose of a new pose in an input's map frame, or None.

        The pose is carried over as the last one was, or moves as another supported input or the
        odometry did since, whichever is nearest to the others: any of them may have jumped. From
        there its scan is matched to the walls of the solution and of later scans; if it does not
        fit, from the others. If the pose comes before its scan, the newest scan before it is
        matched. The covariance is that of the match and of the walls; without a match it grows with
        the way since the last one, and with how differently all moved since.
        """
        earlier = self._newest_with_scan(name, stamp_s)
        match = None if earlier is None else self.locate(name, *earlier)
        with self._memory.lock:
            solution, grown, last = self.solution, self._grown, self._corrections.get(name)
            recent = self._memory.scans[: -LEAST_SCANS - 1 : -1]
            scan = next((own for own in recent if abs(own.stamp_s - stamp_s) <= SAME_STAMP_S), None)
            if last is None or solution is None:
                return None
            motion, before = last
            carried, way_m, gaps = row_of(motion.compose(pose)), 0.0, np.empty((0, 3))
            if self._located:
                way_m = math.dist(carried[:2], self._located[-1][1][:2])
                gaps = self._gaps(name, stamp_s, scan, solution.supported)
        starts = carried + np.concatenate((np.zeros((1, 3)), gaps))
        off_m = pose_distances(starts[:, None], starts).sum(axis=1)
        starts = starts[np.argsort(off_m, kind="stable")]
        expected = pose_of(starts[0])
        covariance = before + np.diag(np.square(STEP + DRIFT * way_m))
        unsure = covariance + gaps.T @ gaps / max(1, len(gaps))
        if solution.walls is None or grown is None:
            return ScanMatch(expected, unsure, fits=False)
        tries = (grown.match([scan], start[None], covariance) for start in starts if scan)
        found = next((one for one in tries if one.fits), None)
        if scan is None or found is None:
            fits = match is not None and match.fits
            return ScanMatch(expected, unsure + grown.covariance, fits)
        covariance = found.covariance + grown.covariance
        added: list[tuple[ScanHits, F64]] = []
        with self._memory.lock:
            if self._corrections.get(name) is last:
                self._corrections[name] = found.pose.compose(pose.inverse()), found.covariance
                own = self._located
                if not own or scan.stamp_s > own[-1][0].stamp_s:
                    own.append((scan, row_of(found.pose)))
                    del own[: -2 * LEAST_SCANS]
                    self._added += 1
                    added = [] if self._added % ADDED_SCANS else own[-LEAST_SCANS:]
        if len(added) >= CHUNKS:  # no solution has seen a new room yet
            scans = judged_hits([one for one, _ in added])
            path = Trajectory(scans.stamps_s, np.array([row for _, row in added]), FUSED)
            seen = WallMap.of(scans, path, covariance)
            with self._memory.lock:
                if seen is not None and self.solution is solution:
                    self._grown = solution.walls.joined(seen)
        return replace(found, covariance=covariance)

    def longer_path(self) -> tuple[DriveSolution, Trajectory] | None:
        """Return the solution, and its path with the poses that were located since."""
        with self._memory.lock:
            solution, located = self.solution, [*self._located]
        if solution is None:
            return None
        path = solution.path
        later = [(one.stamp_s, *row) for one, row in located if one.stamp_s > path.stamps_s[-1]]
        rows = np.reshape(later, (-1, 4))
        stamps_s = np.concatenate((path.stamps_s, rows[:, 0]))
        return solution, Trajectory(stamps_s, np.concatenate((path.poses, rows[:, 1:])), FUSED)

    def _newest_with_scan(self, name: str, stamp_s: float) -> tuple[float, Pose2] | None:
        """Return an input's newest pose before a stamp at a scan that is not matched, or None."""
        memory = self._memory
        with memory.lock:
            since_s = self._located[-1][0].stamp_s if self._located else -np.inf
            for scan in memory.scans[: -LEAST_SCANS - 1 : -1]:
                if not since_s < scan.stamp_s < stamp_s - SAME_STAMP_S:
                    return None
                row = _row_at(memory.poses.get(name, []), scan.stamp_s)
                if row is not None:
                    return row[0], Pose2(*row[1:])
        return None

    def _gaps(self, name: str, stamp_s: float, scan: ScanHits | None, others: Iterable[str]) -> F64:
        """Return how far others and the odometry, (K, 3), moved from an input since a scan matched.

        At the newest stamp until ``stamp_s`` that both have, in the fused frame.
        """
        gaps, poses = np.empty((0, 3)), self._memory.poses
        last, row = self._located[-1]
        driven = [
            [one.stamp_s, *row_of(one.odometry)]
            for one in (last, scan)
            if one is not None and one.odometry is not None
        ]
        for theirs in (driven, *(poses.get(other, []) for other in others if other != name)):
            until_s = min(stamp_s, theirs[-1][0]) if theirs else last.stamp_s
            moves = [_motion(rows, last.stamp_s, until_s) for rows in (poses.get(name, []), theirs)]
            if until_s > last.stamp_s and all(move is not None for move in moves):
                ends = compose_poses(row, np.array(moves))
                gaps = np.concatenate((gaps, ends[1:] - ends[:1]))
        gaps[:, 2] = wrap_angles(gaps[:, 2])
        return gaps


def _row_at(rows: list[list[float]], stamp_s: float) -> list[float] | None:
    """Return the row of stamp, x, y and yaw that has a stamp; None without."""
    at = bisect_left(rows, [stamp_s - SAME_STAMP_S])
    return rows[at] if at < len(rows) and rows[at][0] <= stamp_s + SAME_STAMP_S else None


def _motion(rows: list[list[float]], from_s: float, until_s: float) -> F64 | None:
    """Return the motion, (3,), between two stamps of such rows."""
    first, last = _row_at(rows, from_s), _row_at(rows, until_s)
    if first is None or last is None:
        return None
    return compose_poses(invert_poses(first[1:]), last[1:])
