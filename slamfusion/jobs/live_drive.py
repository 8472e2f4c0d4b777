"""``LiveDrive``: what the scans of a drive say of several SLAMs while it lasts, and one path.

The method is that of ``run``: predictive consistency scores the paths, and ``fuse_weighed_paths``
makes one path of all, along which all scans are aligned. An input is doubted if it has parted from
that path and the scans surely support the path more. The method is applied to the whole drive so
far now and then, and in between to the last ``WINDOW_S`` seconds, whose path continues that of the
whole drive.

The cost of a solution is bounded, and so is the memory. A solution of the whole drive takes
``MOST_SCANS`` scans and ``MOST_HITS`` hits at most. Of more scans every second one is dropped,
except those of the window, so that a longer drive is drawn and scored from fewer scans per metre.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.errors import SlamFusionError
from slamfusion.evidence import JudgedScans, PathEvidence, cover_stamps, judged_scans, score_paths
from slamfusion.evidence.beams import CHUNKS
from slamfusion.evidence.drawn_map import DrawnScan, draw_map, drawn_scans
from slamfusion.evidence.parting import path_spans
from slamfusion.evidence.path_frames import fit_onto
from slamfusion.fusion.live import Evidence
from slamfusion.fusion.path_check import moved_path
from slamfusion.geometry import Pose2, fit_motion, with_levers
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.jobs.fused_path import DrivePath, fuse_weighed_paths
from slamfusion.jobs.outputs import DRAWN, FUSED
from slamfusion.trajectory import SAME_STAMP_S, Trajectory, nearest_stamps
from slamfusion.vote.lattice import Lattice

# The window that is solved between two solutions of the whole drive, seconds.
WINDOW_S = 20.0
# Scans that are kept, and hits that are judged, at most.
MOST_SCANS, MOST_HITS = 4000, 60_000
# An input whose last pose is older than this, seconds, is left out: paths are scored on the scans
# for which each of them has a pose.
SILENT_S = 5.0
# An input maps these scans if at least this share of its poses has the stamp of one: another robot
# has scans of its own.
OF_SCANS = 0.5
# A pose of an input is carried into the fused frame as its poses of the last second were.
CORRECTED_S = 1.0
# A stamp that goes back by more, seconds, is that of a new drive.
BACK_S = 1.0


@dataclass(frozen=True, eq=False)
class DriveSolution:
    """What the scans say of a drive so far.

    Attributes:
        path: the fused path, at the scans that are kept, in the fused frame.
        corrections: by input, the motion of its map frame that carries its newest poses onto the
            path; metres and radians.
        doubted_since_s: by input that the scans contradict, since when: a stamp.
        lattice: of ``drawn``, in the fused frame.
        drawn: the map drawn from the scans at the path; None: it was not asked for.
    """

    path: Trajectory
    corrections: Mapping[str, Pose2]
    doubted_since_s: Mapping[str, float]
    lattice: Lattice
    drawn: OccupancyGrid | None = None

    @property
    def supported(self) -> Mapping[str, Pose2]:
        """The corrections of the inputs that the scans do not contradict."""
        doubted = self.doubted_since_s
        return {name: motion for name, motion in self.corrections.items() if name not in doubted}

    @property
    def evidence(self) -> Evidence:
        """What it means for a live fusion."""
        doubts = {
            name: f"the scans contradict its path since stamp {since_s:.1f} s"
            for name, since_s in self.doubted_since_s.items()
        }
        return Evidence(self.corrections, doubts, self.lattice, self.drawn)


class LiveDrive:
    """Keeps the scans and poses of a drive and solves it; ``solve`` is for one thread.

    What comes may come from any thread.
    """

    def __init__(self, device: ComputeDevice) -> None:
        """Start without scans; ``device`` is that of the thread of ``solve``."""
        self._device = device
        self._lock = threading.Lock()
        self._generation = 0
        self._scans: list[tuple[LogScan, DrawnScan]] = []
        self._poses: dict[str, list[tuple[float, Pose2]]] = {}
        self._solved = 0
        self._path: Trajectory | None = None
        self._lattice: Lattice | None = None
        # The stamp of the last scan that a solution of the whole drive has.
        self._whole_until_s = -np.inf
        self._doubted_since_s: Mapping[str, float] = {}

    # -- what comes, from any thread ---------------------------------------------------------------

    def add_scan(self, item: LogScan) -> None:
        """Take a scan, deskewed, with the odometry at its stamp if there is any."""
        drawn = drawn_scans([item])
        if not drawn:
            return
        with self._lock:
            if self._scans and item.scan.stamp_s <= self._scans[-1][1].stamp_s:
                if item.scan.stamp_s > self._scans[-1][1].stamp_s - BACK_S:
                    return
                self._forget()
            # Paths are scored with odometry at every scan, or with none.
            if self._scans and (item.odometry is None) != (self._scans[-1][0].odometry is None):
                if item.odometry is None:
                    return
                self._scans.clear()
            self._scans.append((item, drawn[0]))
            if len(self._scans) > MOST_SCANS:
                self._thin_out()

    def add_pose(self, name: str, stamp_s: float, pose: Pose2) -> None:
        """Take where an input has the robot in its map frame at a stamp."""
        with self._lock:
            own = self._poses.setdefault(name, [])
            if own and stamp_s <= own[-1][0]:
                if stamp_s > own[-1][0] - BACK_S:
                    return
                own.clear()
            own.append((stamp_s, pose))

    def set_path(self, name: str, path: Trajectory) -> None:
        """Take the path of an input as its map shows it now, in place of its poses of that time."""
        if not len(path):
            return
        with self._lock:
            newer = [own for own in self._poses.get(name, ()) if own[0] > path.stamps_s[-1]]
            rows = zip(path.stamps_s.tolist(), path.poses.tolist(), strict=True)
            self._poses[name] = [*((stamp_s, Pose2(*pose)) for stamp_s, pose in rows), *newer]

    def remove(self, name: str) -> None:
        """Forget an input."""
        with self._lock:
            self._poses.pop(name, None)

    def forget(self) -> None:
        """Forget everything: a new drive starts, in a frame of its own."""
        with self._lock:
            self._forget()

    def _forget(self) -> None:
        self._generation += 1
        self._scans.clear()
        self._poses.clear()

    def _thin_out(self) -> None:
        """Drop every second scan before the window, and the poses that belong to none."""
        stamps_s = np.array([drawn.stamp_s for _, drawn in self._scans])
        old = int(np.searchsorted(stamps_s, stamps_s[-1] - WINDOW_S))
        old = max(old, MOST_SCANS // 2)
        self._scans = self._scans[:old:2] + self._scans[old:]
        kept_s = np.array([drawn.stamp_s for _, drawn in self._scans])
        for name, own in self._poses.items():
            if own:
                nearest = nearest_stamps(np.array([stamp_s for stamp_s, _ in own]), kept_s)
                last = range(int(nearest[-1]) + 1, len(own))
                self._poses[name] = [own[at] for at in (*np.unique(nearest).tolist(), *last)]

    # -- in the thread of solutions ----------------------------------------------------------------

    def solve(
        self,
        *,
        is_whole: bool,
        lattice: Lattice | None = None,
        transforms: Mapping[str, Pose2] | None = None,
        resolution: float | None = None,
    ) -> DriveSolution | None:
        """Solve the drive so far; None while there are too few scans or poses for it.

        Args:
            is_whole: solve the whole drive, and not the window alone.
            lattice: of the fused frame; None while there is none, and the drive gives it.
            transforms: of the inputs that vote, map frame into the fused frame.
            resolution: draw the map, with cells of this many metres; None: do not.
        """
        with self._lock:
            generation = self._generation
            if self._solved != generation:
                self._solved = generation
                self._path, self._lattice, self._doubted_since_s = None, None, {}
            kept = list(self._scans)
            poses = {name: list(own) for name, own in self._poses.items()}
        if len(kept) < CHUNKS:
            return None
        newest_s = kept[-1][1].stamp_s
        is_whole = is_whole or self._path is None
        first_s = -np.inf if is_whole else newest_s - WINDOW_S
        scans = [item for item, drawn in kept if drawn.stamp_s >= first_s]
        if len(scans) < CHUNKS:
            return None
        judged = judged_scans(scans, MOST_HITS)
        paths = self._at_scans(judged, poses, newest_s)
        if not is_whole:
            right = {name: own for name, own in paths.items() if name not in self._doubted_since_s}
            paths = right or paths
        if not paths:
            return None
        try:
            found = _solved(judged, paths, self._device)
        except SlamFusionError:
            return None  # the paths have no scan in common yet
        if is_whole and found.refined is not None:
            self._doubted_since_s = _doubts(found.refined.evidence)
        self._place(found.trajectory, paths, lattice, transforms or {}, is_whole=is_whole)
        path = self._path
        assert path is not None  # noqa: S101  (just placed)
        own_lattice = self._lattice or Lattice(resolution or 0.05, Pose2())
        drawn = None
        if resolution is not None:
            self._lattice = own_lattice
            drawn = draw_map(
                [item for _, item in kept],
                path,
                self._device,
                resolution=own_lattice.resolution,
                origin=own_lattice.origin,
                name=DRAWN,
            )
        if self._generation != generation:
            return None  # it was forgotten meanwhile
        corrections = {name: _correction(own, path) for name, own in paths.items()}
        return DriveSolution(path, corrections, self._doubted_since_s, own_lattice, drawn)

    def _at_scans(
        self,
        judged: JudgedScans,
        poses: Mapping[str, Sequence[tuple[float, Pose2]]],
        newest_s: float,
    ) -> dict[str, Trajectory]:
        """Return the path of each input at the scans, if it maps them and is not silent."""
        paths = {}
        for name, own in poses.items():
            if not own or newest_s - own[-1][0] > SILENT_S:
                continue
            rows = np.array([(pose.x, pose.y, pose.yaw_rad) for _, pose in own])
            stamps_s = np.array([stamp_s for stamp_s, _ in own])
            during = stamps_s[stamps_s >= judged.stamps_s[0] - SAME_STAMP_S]
            near_s = judged.stamps_s[nearest_stamps(judged.stamps_s, during)]
            if np.mean(np.abs(near_s - during) <= SAME_STAMP_S) < OF_SCANS:
                continue
            covered = cover_stamps(Trajectory(stamps_s, rows, name), judged)
            if np.count_nonzero(covered.is_covered) >= CHUNKS:
                here = covered.is_covered
                paths[name] = Trajectory(judged.stamps_s[here], covered.poses[here], name)
        return paths

    def _place(
        self,
        found: Trajectory,
        paths: Mapping[str, Trajectory],
        lattice: Lattice | None,
        transforms: Mapping[str, Pose2],
        *,
        is_whole: bool,
    ) -> None:
        """Carry a path that was found into the fused frame, and put it in place of the last one."""
        before = self._path
        if lattice is not None and lattice != self._lattice:
            voters = [moved_path(paths[n], transforms[n]) for n in transforms if n in paths]
            if voters:
                self._lattice = lattice
                if before is not None:
                    motion = fit_onto(before, voters)
                    before = before if motion is None else moved_path(before, motion)
                else:
                    motion = fit_onto(found, voters)
                    found = found if motion is None else moved_path(found, motion)
        newest_s = float(found.stamps_s[-1])
        cut_s = -np.inf
        if before is not None:
            still = before
            if not is_whole:
                cut_s = max(self._whole_until_s, newest_s - 0.5 * WINDOW_S)
                still = _part(before, -np.inf, cut_s)
            motion = fit_onto(found, [still])
            found = found if motion is None else moved_path(found, motion)
            if not is_whole:
                first, rest = _part(before, -np.inf, cut_s), _part(found, cut_s, np.inf)
                stamps_s = np.concatenate((first.stamps_s, rest.stamps_s))
                found = Trajectory(stamps_s, np.concatenate((first.poses, rest.poses)), FUSED)
        if is_whole:
            self._whole_until_s = newest_s
        self._path = found


def _solved(
    judged: JudgedScans, paths: Mapping[str, Trajectory], device: ComputeDevice
) -> DrivePath:
    """Score paths on scans and make one of them, as ``run`` does."""
    evidence = score_paths(judged, paths, device)
    return fuse_weighed_paths(paths, evidence, device)


def _doubts(evidence: PathEvidence) -> dict[str, float]:
    """Return which inputs the scans contradict, by name, and since which stamp.

    Such an input has parted from the fused path, and the scans surely support that one more. Its
    map shows what it drew then for as long as its path says so.
    """
    found = {}
    for name in evidence.scores:
        if name != FUSED and evidence.compare(FUSED, name).verdict == "better":
            apart_s = [span.from_s for span in path_spans(evidence, name, FUSED) if not span.agrees]
            if apart_s:
                found[name] = float(evidence.scans.stamps_s[0]) + apart_s[0]
    return found


def _part(path: Trajectory, after_s: float, until_s: float) -> Trajectory:
    """Return the poses of a path after one time and until another."""
    here = (path.stamps_s > after_s) & (path.stamps_s <= until_s)
    return Trajectory(path.stamps_s[here], path.poses[here], path.name)


def _correction(own: Trajectory, path: Trajectory) -> Pose2:
    """Return the motion that carries the last poses of an input onto the path."""
    last = _part(own, own.stamps_s[-1] - CORRECTED_S, np.inf)
    near, meets = path.matches(last.stamps_s)
    if not meets.any():
        near, meets = path.nearest(last.stamps_s), np.ones(len(last), dtype=np.bool_)
    moving, still = last.poses[meets], path.poses[near[meets]]
    return fit_motion(with_levers(moving), with_levers(still))
