"""``DriveMemory``: the scans of a drive, and where its inputs have the robot at them."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from slamfusion.evidence.beams import CHUNKS, ScanHits, carried_along, scan_hits
from slamfusion.evidence.patches import LEAST_HITS
from slamfusion.geometry import F64, Pose2
from slamfusion.io import LogScan
from slamfusion.trajectory import SAME_STAMP_S, Trajectory, nearest_stamps

# The window that is solved between two solutions of the whole drive, seconds and scans at least.
WINDOW_S, LEAST_SCANS = 20.0, 2 * CHUNKS
# Scans that are kept at most.
MOST_SCANS = 4000
# Three patches of wall determine a pose. With fewer hits the odometry does.
LEAST_SEEN = 3 * LEAST_HITS
# A stamp that goes back by more, seconds, is that of a new drive.
BACK_S = 1.0


class DriveMemory:
    """Keeps what a drive has shown, for any thread.

    Of more than ``MOST_SCANS`` scans every second one is dropped, except those of the window.

    Attributes:
        lock: held while several of the others are read.
        generation: counts the drives.
        scans: those with hits, in order.
        poses: by input the stamp, x, y and yaw of each pose, in its map frame.
        heard_s: stamps of the last scans, with those that were dropped.
        blind_s: stamps of the scans with too few hits for a pose.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.generation = 0
        self.scans: list[ScanHits] = []
        self.poses: dict[str, list[list[float]]] = {}
        self.heard_s: deque[float] = deque(maxlen=MOST_SCANS)
        self.blind_s: list[float] = []

    def add_scan(self, item: LogScan) -> None:
        """Take a scan, deskewed, with the odometry at its stamp if there is any."""
        hits = next(scan_hits([item]), None)
        is_blind = hits is None or len(hits.rows) < LEAST_SEEN
        with self.lock:
            self.heard_s.append(item.scan.stamp_s)
            if is_blind:
                self.blind_s.append(item.scan.stamp_s)
            if hits is None:
                return
            last = self.scans[-1] if self.scans else None
            if last is not None and hits.stamp_s <= last.stamp_s:
                if hits.stamp_s > last.stamp_s - BACK_S:
                    return
                self.forget()
            # Paths are scored with odometry at every scan, or with none.
            elif last is not None and (hits.odometry is None) != (last.odometry is None):
                if hits.odometry is None:
                    return
                self.scans.clear()
            self.scans.append(hits)
            if len(self.scans) > MOST_SCANS:
                self._thin_out()

    def add_pose(self, name: str, stamp_s: float, pose: Pose2) -> None:
        """Take where an input has the robot in its map frame at a stamp."""
        with self.lock:
            own = self.poses.setdefault(name, [])
            if own and stamp_s <= own[-1][0]:
                if stamp_s > own[-1][0] - BACK_S:
                    return
                own.clear()
            own.append([stamp_s, pose.x, pose.y, pose.yaw_rad])

    def set_path(self, name: str, path: Trajectory) -> None:
        """Take the path of an input as its map shows it now, in place of its poses of that time."""
        if not len(path):
            return
        with self.lock:
            own = np.array(self.poses.get(name, ())).reshape(-1, 4)
            scans_s = np.array([kept.stamp_s for kept in self.scans])
            self.poses[name] = _revised(own, path, scans_s).tolist()

    def remove(self, name: str) -> None:
        """Forget an input."""
        with self.lock:
            self.poses.pop(name, None)

    def forget(self) -> None:
        """Forget everything: a new drive starts, in a frame of its own."""
        with self.lock:
            self.generation += 1
            self.scans.clear()
            self.poses.clear()
            self.heard_s.clear()
            self.blind_s.clear()

    def _thin_out(self) -> None:
        """Drop every second scan before the window, and the poses that belong to none."""
        stamps_s = np.array([kept.stamp_s for kept in self.scans])
        old = int(np.searchsorted(stamps_s, stamps_s[-1] - WINDOW_S))
        old = max(min(old, len(stamps_s) - LEAST_SCANS), MOST_SCANS // 2)
        self.scans = self.scans[:old:2] + self.scans[old:]
        kept_s = np.array([kept.stamp_s for kept in self.scans])
        after = np.searchsorted(kept_s[:-1], self.blind_s)
        self.blind_s = np.unique(kept_s[after]).tolist()
        for name, own in self.poses.items():
            if own:
                nearest = nearest_stamps(np.array([row[0] for row in own]), kept_s)
                last = range(int(nearest[-1]) + 1, len(own))
                self.poses[name] = [own[at] for at in (*np.unique(nearest).tolist(), *last)]


def _revised(own: F64, path: Trajectory, scans_s: F64) -> F64:
    """Return an input's poses as its path has them now; rows of stamp, x, y and yaw, as ``own``.

    Where a long path leaves poses out, the input moved as it said before.
    """
    rows = np.column_stack((path.stamps_s, path.poses))
    is_newer = own[:, 0] > path.stamps_s[-1] + SAME_STAMP_S
    during = own[~is_newer & (own[:, 0] >= path.stamps_s[0] - SAME_STAMP_S)]
    before = Trajectory(during[:, 0], during[:, 1:])
    if len(before) and (is_told := before.matches(path.stamps_s)[1]).any():
        left_out_s = before.stamps_s[~path.matches(before.stamps_s)[1]]
        carried = carried_along(path.chosen(is_told), before, left_out_s)
        known_s = np.union1d(before.stamps_s, scans_s)
        near_s = known_s[nearest_stamps(known_s, path.stamps_s)]
        rows = rows[np.abs(near_s - path.stamps_s) <= SAME_STAMP_S]
        rows = np.concatenate((rows, np.column_stack((left_out_s, carried))))
        rows = rows[np.argsort(rows[:, 0])]
    return np.concatenate((rows, own[is_newer]))
