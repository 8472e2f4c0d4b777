"""``LiveDrive``: score the paths of several SLAMs during the drive, and fuse them into one path.

The method is that of ``run``: predictive consistency scores the paths, ``fuse_weighed_paths`` fuses
them, and all scans are aligned along the result. The whole drive is solved from time to time, and
in between its last ``WINDOW_S`` seconds, which continue the last solution (``Pace``). More often,
since it takes a third of the time, the inputs are judged, by the scans that were located since.
When the scans stop, the drive is solved with all hits that ``run`` scores, which gives the answer
of ``run``.

A solution takes at most ``MOST_SCANS`` scans and ``MOST_HITS`` hits, which bounds time and memory.
Of more scans every second one is dropped, except those of the window.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias, get_args

import numpy as np
import scipy

from slamfusion.compute import ComputeDevice
from slamfusion.errors import SlamFusionError
from slamfusion.evidence import beams
from slamfusion.evidence.beams import (
    CHUNKS,
    JudgedScans,
    ScanHits,
    carried_along,
    cover_stamps,
    judged_hits,
    scan_hits,
)
from slamfusion.evidence.conditions import Condition, drive_conditions
from slamfusion.evidence.drawn_map import MapDrawer
from slamfusion.evidence.fused_path import visits
from slamfusion.evidence.parting import parted, path_gap_m, path_gaps
from slamfusion.evidence.patches import LEAST_HITS, ScanMatch, WallMap
from slamfusion.evidence.path_frames import moved_onto, pose_distances
from slamfusion.evidence.predictive import SURE, PathEvidence, score_paths
from slamfusion.evidence.recommendation import LEAST_DIFFERENCE
from slamfusion.fusion.live import Evidence
from slamfusion.geometry import (
    B8,
    F64,
    Pose2,
    compose_poses,
    fit_motion,
    invert_poses,
    moved_poses,
    pose_of,
    row_of,
    with_levers,
    wrap_angles,
)
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.io.files import return_freed_memory
from slamfusion.jobs.fused_path import fuse_weighed_paths
from slamfusion.jobs.outputs import DRAWN, FUSED
from slamfusion.trajectory import SAME_STAMP_S, Trajectory, nearest_stamps
from slamfusion.vote.lattice import Lattice

# The window that is solved between two solutions of the whole drive, seconds and scans at least.
WINDOW_S, LEAST_SCANS = 20.0, 2 * CHUNKS
# Scans that are kept, and hits that are judged while scans come, at most.
MOST_SCANS, MOST_HITS = 4000, 60_000
# A path is aligned with the fused one by each of this number of parts of the drive in turn.
PARTS = 4
# An input whose last pose is older than this, seconds, is left out: paths are scored on the scans
# for which each of them has a pose.
SILENT_S = 5.0
# An input maps these scans if at least this share of its poses has the stamp of one: another robot
# has scans of its own.
OF_SCANS = 0.5
# A pose of an input is carried into the fused frame as its poses of the last second were.
CORRECTED_S = 1.0
# Deviations of a pose that is carried so, and of the motion from one pose of an input to the next,
# metres and radians.
CORRECTION_M, CORRECTION_RAD = 0.05, 0.02
STEP_M, STEP_RAD = 0.01, 0.005
# Three patches of wall determine a pose. With fewer hits the odometry does: deviation of a way by
# it, share of the way, and of the turn, radians per metre.
LEAST_SEEN, DRIFT = 3 * LEAST_HITS, 0.1
# The last located scans are added to the walls each time this number of scans was located.
ADDED_SCANS = 10
# A stamp that goes back by more, seconds, is that of a new drive.
BACK_S = 1.0
# After each solution: a rest of this many times its duration, and at least this number of seconds.
# Together at most 10 % of a core: in between the pose goes by scans that match what was solved, so
# new places need new solutions.
RESTS: Mapping[Depth, tuple[float, float]] = {
    "judged": (29.0, 2.0),
    "window": (24.0, 2.0),
    "whole": (39.0, 10.0),
}
# Seconds that solutions may take before they rest: the first ones of a drive are short and urgent.
AHEAD_S = 1.0
# Without a scan for so long, seconds, the drive is solved with all hits.
STILL_S = 2.0

# What is done: the inputs are compared with the scans again; the last seconds of the drive are
# solved; all of it is, and the inputs are compared; or so with all hits.
Depth: TypeAlias = Literal["judged", "window", "whole", "final"]
DEPTHS: tuple[Depth, ...] = get_args(Depth)


class Pace:
    """Says when a drive is solved, and how much of it; for one thread, on any clock in seconds."""

    def __init__(self) -> None:
        """Let the whole drive be solved first."""
        self._scans = 0
        self._seen: dict[Depth, int] = dict.fromkeys(DEPTHS, 0)
        self._due_s: dict[Depth, float] = dict.fromkeys(DEPTHS, -np.inf)
        # When all solutions so far have rested.
        self._rested_s: dict[Depth, float] = {}

    def due(self, now_s: float, scans: int) -> Depth | None:
        """Return what is due after this number of scans, or None."""
        if scans != self._scans:
            self._scans = scans
            self._due_s["final"] = now_s + STILL_S
        for depth in reversed(DEPTHS):
            if now_s >= self._due_s[depth] and self._seen[depth] != scans:
                return depth
        return None

    def done(self, depth: Depth, began_s: float, done_s: float) -> None:
        """Take note of a solution, of what ``due`` said last."""
        done = DEPTHS[: DEPTHS.index(depth) + 1] if depth in {"whole", "final"} else (depth,)
        self._seen |= dict.fromkeys(done, self._scans)
        kind: Depth = "whole" if depth == "final" else depth
        rest, least_s = RESTS[kind]
        rested_s = max(self._rested_s.get(kind, done_s), done_s) + rest * (done_s - began_s)
        self._rested_s[kind] = rested_s
        self._due_s[kind] = max(done_s + least_s, rested_s - rest * AHEAD_S)


@dataclass(frozen=True, eq=False)
class Judgement:
    """What the scans say of the inputs.

    Attributes:
        doubts: bent inputs that the scans contradict, and why.
        conditions: problems of the drive, in words.
        gaps_m: by input, how far its last pose is from the fused path.
        disagreement: mean square, (3, 3), of how far inputs end from the fused path.
    """

    doubts: Mapping[str, str] = field(default_factory=dict)
    conditions: Mapping[Condition, str] = field(default_factory=dict)
    gaps_m: Mapping[str, float] = field(default_factory=dict)
    disagreement: F64 = field(default_factory=lambda: np.zeros((3, 3)))

    @classmethod
    def of(cls, evidence: PathEvidence) -> Judgement:
        """Judge inputs by evidence for them and the fused path."""
        contradicted = _contradicted(evidence)
        return cls(
            _doubts(evidence, contradicted),
            drive_conditions(evidence, FUSED),
            {n: path_gap_m(evidence, n, FUSED)[-1] for n in evidence.scores if n != FUSED},
            _disagreement(evidence, contradicted),
        )


@dataclass(frozen=True, eq=False)
class DriveSolution:
    """A solution of the drive so far.

    Attributes:
        path: the fused path, at the scans that are kept, in the fused frame.
        evidence: ``transforms`` carry the newest poses of the inputs onto the path; the input
            whose last pose is nearest to it is first.
        conditions: problems of the drive, in words.
        is_final: whether it is the answer of ``run``.
        walls: seen by the scans along the path; new scans are matched to them.
        generation: counts the drives; a solution of one that was forgotten is not taken.
    """

    path: Trajectory
    evidence: Evidence
    conditions: Mapping[Condition, str]
    is_final: bool
    walls: WallMap | None
    generation: int

    @property
    def supported(self) -> Mapping[str, Pose2]:
        """The transforms of the inputs that the scans do not contradict."""
        motions, doubts = self.evidence.transforms, self.evidence.doubts
        return {name: motion for name, motion in motions.items() if name not in doubts}


class LiveDrive:
    """Keeps scans and poses from any thread and solves the drive; ``solve`` is for one thread.

    Attributes:
        solution: the one that was taken last; None before the first.
    """

    def __init__(self, device: ComputeDevice) -> None:
        """Start without scans; ``device`` is that of the thread of ``solve``."""
        self._device = device
        self._lock = threading.RLock()
        self._generation = 0
        self.solution: DriveSolution | None = None
        self._scans: list[ScanHits] = []
        # By input: stamp, x, y and yaw of each pose.
        self._poses: dict[str, list[list[float]]] = {}
        # Stamps of the last scans, with those that are dropped.
        self._heard_s: deque[float] = deque(maxlen=MOST_SCANS)
        # Stamps of the scans with too few hits for a pose.
        self._blind_s: list[float] = []
        self._solved = 0
        self._path: Trajectory | None = None
        self._lattice: Lattice | None = None
        self._drawer: MapDrawer | None = None
        # The stamp of the last scan that a solution of the whole drive has.
        self._whole_until_s = -np.inf
        self._judgement = Judgement()
        # The walls of the solution with those seen since; the last scans that have a pose, with
        # it, and the number of located ones; and by input the motion of its map frame into the
        # fused frame with the covariance of the pose that it gives.
        self._grown: WallMap | None = None
        self._located: list[tuple[ScanHits, F64]] = []
        self._added = 0
        self._corrections: dict[str, tuple[Pose2, F64]] = {}

    # -- what comes, from any thread ---------------------------------------------------------------

    def add_scan(self, item: LogScan) -> None:
        """Take a scan, deskewed, with the odometry at its stamp if there is any."""
        hits = next(scan_hits([item]), None)
        is_blind = hits is None or len(hits.rows) < LEAST_SEEN
        with self._lock:
            self._heard_s.append(item.scan.stamp_s)
            if is_blind:
                self._blind_s.append(item.scan.stamp_s)
            if hits is None:
                return
            last = self._scans[-1] if self._scans else None
            if last is not None and hits.stamp_s <= last.stamp_s:
                if hits.stamp_s > last.stamp_s - BACK_S:
                    return
                self.forget()
            # Paths are scored with odometry at every scan, or with none.
            elif last is not None and (hits.odometry is None) != (last.odometry is None):
                if hits.odometry is None:
                    return
                self._scans.clear()
            self._scans.append(hits)
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
            own.append([stamp_s, pose.x, pose.y, pose.yaw_rad])

    def set_path(self, name: str, path: Trajectory) -> None:
        """Take the path of an input as its map shows it now, in place of its poses of that time."""
        if not len(path):
            return
        with self._lock:
            own = np.array(self._poses.get(name, ())).reshape(-1, 4)
            scans_s = np.array([kept.stamp_s for kept in self._scans])
            self._poses[name] = _revised(own, path, scans_s).tolist()

    def remove(self, name: str) -> None:
        """Forget an input."""
        with self._lock:
            self._poses.pop(name, None)

    def forget(self) -> None:
        """Forget everything: a new drive starts, in a frame of its own."""
        with self._lock:
            self._generation += 1
            self._scans.clear()
            self._poses.clear()
            self._heard_s.clear()
            self._blind_s.clear()
            self.solution = self._grown = None
            self._located, self._corrections = [], {}

    # -- where the robot is, from any thread -------------------------------------------------------

    def take(self, solution: DriveSolution) -> bool:
        """Locate poses by a solution from now on; return whether its drive is still this one."""
        return_freed_memory()
        path = solution.path
        with self._lock:
            if solution.generation != self._generation:
                return False
            before, self.solution = self.solution, solution
            # With the path and the walls of before, the inputs alone were judged again.
            is_same = before is not None and before.path is path and before.walls is solution.walls
            kept = self._corrections if is_same else {}
            first = _variances(CORRECTION_M, CORRECTION_RAD)
            self._corrections = {
                name: kept.get(name, (motion, first)) for name, motion in solution.supported.items()
            }
            if not is_same:
                self._grown = solution.walls
                recent = self._scans[-2 * LEAST_SCANS :]
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
        with self._lock:
            solution, grown, last = self.solution, self._grown, self._corrections.get(name)
            recent = self._scans[: -LEAST_SCANS - 1 : -1]
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
        covariance = before + _variances(STEP_M + DRIFT * way_m, STEP_RAD + DRIFT * way_m)
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
        with self._lock:
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
            with self._lock:
                if seen is not None and self.solution is solution:
                    self._grown = solution.walls.joined(seen)
        return replace(found, covariance=covariance)

    def _newest_with_scan(self, name: str, stamp_s: float) -> tuple[float, Pose2] | None:
        """Return an input's newest pose before a stamp at a scan that is not matched, or None."""
        with self._lock:
            since_s = self._located[-1][0].stamp_s if self._located else -np.inf
            for scan in self._scans[: -LEAST_SCANS - 1 : -1]:
                if not since_s < scan.stamp_s < stamp_s - SAME_STAMP_S:
                    return None
                row = _row_at(self._poses.get(name, []), scan.stamp_s)
                if row is not None:
                    return row[0], Pose2(*row[1:])
        return None

    def _gaps(self, name: str, stamp_s: float, scan: ScanHits | None, others: Iterable[str]) -> F64:
        """Return how far others and the odometry, (K, 3), moved from an input since a scan matched.

        At the newest stamp until ``stamp_s`` that both have, in the fused frame.
        """
        gaps, ours = np.empty((0, 3)), self._poses.get(name, [])
        last, row = self._located[-1]
        driven = [
            [one.stamp_s, *row_of(one.odometry)]
            for one in (last, scan)
            if one is not None and one.odometry is not None
        ]
        for theirs in (driven, *(self._poses.get(other, []) for other in others if other != name)):
            until_s = min(stamp_s, theirs[-1][0]) if theirs else last.stamp_s
            moves = [_motion(rows, last.stamp_s, until_s) for rows in (ours, theirs)]
            if until_s > last.stamp_s and all(move is not None for move in moves):
                ends = compose_poses(row, np.array(moves))
                gaps = np.concatenate((gaps, ends[1:] - ends[:1]))
        gaps[:, 2] = wrap_angles(gaps[:, 2])
        return gaps

    def _thin_out(self) -> None:
        """Drop every second scan before the window, and the poses that belong to none."""
        stamps_s = np.array([kept.stamp_s for kept in self._scans])
        old = int(np.searchsorted(stamps_s, stamps_s[-1] - WINDOW_S))
        old = max(min(old, len(stamps_s) - LEAST_SCANS), MOST_SCANS // 2)
        self._scans = self._scans[:old:2] + self._scans[old:]
        kept_s = np.array([kept.stamp_s for kept in self._scans])
        after = np.searchsorted(kept_s[:-1], self._blind_s)
        self._blind_s = np.unique(kept_s[after]).tolist()
        for name, own in self._poses.items():
            if own:
                nearest = nearest_stamps(np.array([row[0] for row in own]), kept_s)
                last = range(int(nearest[-1]) + 1, len(own))
                self._poses[name] = [own[at] for at in (*np.unique(nearest).tolist(), *last)]

    # -- in the thread of solutions ----------------------------------------------------------------

    def solve(
        self,
        depth: Depth,
        *,
        lattice: Lattice | None = None,
        transforms: Mapping[str, Pose2] | None = None,
        resolution: float | None = None,
    ) -> DriveSolution | None:
        """Solve the drive so far; None while there are too few scans or poses.

        Args:
            depth: the first solution is of the whole drive in any case; a window has the doubts and
                conditions of before, and ``judged`` is the last solution with new ones.
            lattice: of the fused frame; None: the drive gives it.
            transforms: of the inputs that vote, map frame into the fused frame.
            resolution: metres per cell of the drawn map; None: no map.
        """
        with self._lock:
            generation = self._generation
            if self._solved != generation:
                self._solved = generation
                self._path, self._lattice, self._drawer = None, None, None
                self._judgement = Judgement()
            kept = list(self._scans)
            poses = {name: np.array(own) for name, own in self._poses.items() if own}
            heard_s, blind_s = np.unique(self._heard_s), np.array(self._blind_s)
        if len(kept) < CHUNKS:
            return None
        scans = judged_hits(kept, beams.MOST_HITS if depth == "final" else MOST_HITS)
        paths = self._at_scans(scans, poses, heard_s)
        evidence, last = None, self._path if depth == "window" else None
        try:
            if depth == "judged":
                return self._judged_again(scans, paths)
            if last is None:
                fused, evidence = _solved(scans, paths, self._device)
            elif (window := self._continued(last, kept, paths)) is not None:
                fused = window
            else:
                return None
            path = self._place(fused, kept, paths, lattice, transforms or {}, is_whole=last is None)
            if last is None:
                evidence = evidence or score_paths(scans, {**paths, FUSED: path}, self._device)
                self._judgement = Judgement.of(evidence)
        except SlamFusionError:
            return None  # the paths have no scan in common yet
        if last is None:
            return_freed_memory()  # half of what all scans took lies in holes by now
        own_lattice = self._lattice or Lattice(resolution or 0.05, Pose2())
        drawn = None if resolution is None else self._drawn(kept, path, own_lattice)
        judgement = self._judgement
        nearest_first = sorted(paths, key=lambda name: judgement.gaps_m.get(name, np.inf))
        corrections = {name: _correction(paths[name], path) for name in nearest_first}
        drift = DRIFT * _blind_m(path, blind_s)
        covariance = judgement.disagreement + _variances(drift, drift)
        return DriveSolution(
            path,
            Evidence(corrections, judgement.doubts, own_lattice, drawn),
            judgement.conditions,
            depth == "final",
            WallMap.of(scans, path, covariance),
            generation,
        )

    def _judged_again(
        self, scans: JudgedScans, paths: Mapping[str, Trajectory]
    ) -> DriveSolution | None:
        """Return the last solution with new doubts and conditions; its path goes on as located."""
        with self._lock:
            solution, located = self.solution, [*self._located]
        if solution is None:
            return None
        path = solution.path
        later = [(one.stamp_s, *row) for one, row in located if one.stamp_s > path.stamps_s[-1]]
        rows = np.reshape(later, (-1, 4))
        stamps_s = np.concatenate((path.stamps_s, rows[:, 0]))
        longer = Trajectory(stamps_s, np.concatenate((path.poses, rows[:, 1:])), FUSED)
        evidence = score_paths(scans, {**paths, FUSED: longer}, self._device)
        self._judgement = judgement = Judgement.of(evidence)
        return replace(
            solution,
            evidence=replace(solution.evidence, doubts=judgement.doubts),
            conditions=judgement.conditions,
        )

    def _drawn(self, kept: Sequence[ScanHits], path: Trajectory, lattice: Lattice) -> OccupancyGrid:
        """Draw the map along a path; scans at the poses of the last map are not drawn again."""
        self._lattice = lattice
        if self._drawer is None or self._drawer.lattice != lattice:
            self._drawer = MapDrawer(self._device, lattice)
        return self._drawer.draw(kept, path, DRAWN)

    def _continued(
        self, path: Trajectory, kept: Sequence[ScanHits], paths: Mapping[str, Trajectory]
    ) -> Trajectory | None:
        """Solve the last seconds, and what was not solved yet, by the inputs that are right."""
        stamps_s = [one.stamp_s for one in kept[-LEAST_SCANS:]]
        solved_s = float(path.stamps_s[-1])
        first_s = min(stamps_s[0], stamps_s[-1] - WINDOW_S, solved_s - 0.5 * WINDOW_S)
        hits = [one for one in kept if one.stamp_s >= first_s]
        last = {name: _part(own, first_s - SAME_STAMP_S, np.inf) for name, own in paths.items()}
        last = {name: own for name, own in last.items() if len(own) >= CHUNKS}
        doubts = self._judgement.doubts
        right = {name: own for name, own in last.items() if name not in doubts}
        if len(hits) < CHUNKS or not last:
            return None
        return _solved(judged_hits(hits, MOST_HITS), right or last, self._device)[0]

    def _at_scans(
        self, judged: JudgedScans, poses: Mapping[str, F64], heard_s: F64
    ) -> dict[str, Trajectory]:
        """Return the path of each input at the scans, if it maps them and is not silent."""
        paths = {}
        for name, own in poses.items():
            stamps_s = own[:, 0]
            if judged.stamps_s[-1] - stamps_s[-1] > SILENT_S:
                continue
            during = stamps_s[stamps_s >= heard_s[0] - SAME_STAMP_S]
            near_s = heard_s[nearest_stamps(heard_s, during)]
            if np.mean(np.abs(near_s - during) <= SAME_STAMP_S) < OF_SCANS:
                continue
            own_path = Trajectory(stamps_s, own[:, 1:], name)
            at_scans, is_own = cover_stamps(own_path, judged)
            here = np.isfinite(at_scans[:, 0])
            if is_own.all():
                paths[name] = own_path  # with its poses at scans that hit nothing
            elif np.count_nonzero(here) >= CHUNKS:
                paths[name] = Trajectory(judged.stamps_s[here], at_scans[here], name)
        return paths

    def _place(
        self,
        found: Trajectory,
        kept: Sequence[ScanHits],
        paths: Mapping[str, Trajectory],
        lattice: Lattice | None,
        transforms: Mapping[str, Pose2],
        *,
        is_whole: bool,
    ) -> Trajectory:
        """Carry a path that was found into the fused frame, and put it in place of the last one."""
        before = self._path
        if lattice is not None and lattice != self._lattice:
            voters = [paths[n].moved(transforms[n]) for n in transforms if n in paths]
            if voters:
                self._lattice = lattice
                if before is not None:
                    before = moved_onto(before, voters)
                else:
                    found = moved_onto(found, voters)
        newest_s = float(found.stamps_s[-1])
        if is_whole or before is None:
            self._whole_until_s = newest_s
            self._path = found if before is None else moved_onto(found, [before])
        else:
            until_s = min(float(before.stamps_s[-1]), newest_s - 0.5 * WINDOW_S)
            cut_s = max(self._whole_until_s, until_s)
            first = _part(before, -np.inf, cut_s)
            rest = _part(_onto_walls(moved_onto(found, [first]), first, kept), cut_s, np.inf)
            stamps_s = np.concatenate((first.stamps_s, rest.stamps_s))
            self._path = Trajectory(stamps_s, np.concatenate((first.poses, rest.poses)), FUSED)
        return self._path


def _solved(
    judged: JudgedScans, paths: Mapping[str, Trajectory], device: ComputeDevice
) -> tuple[Trajectory, PathEvidence | None]:
    """Score paths on scans and make one of them, as ``run`` does."""
    evidence = score_paths(judged, paths, device)
    fused, with_fused = fuse_weighed_paths(paths, evidence)
    return fused.trajectory, with_fused


def _onto_walls(path: Trajectory, first: Trajectory, kept: Sequence[ScanHits]) -> Trajectory:
    """Move the path of a window so that its scans fit the walls that earlier ones show.

    Placed by the stamps in common with the path before it alone, each window would add its error.
    """
    earlier = [one for one in kept if one.stamp_s < path.stamps_s[0]]
    if len(earlier) < CHUNKS:
        return path
    near, meets = path.matches(np.array([one.stamp_s for one in kept]))
    some = np.flatnonzero(meets)[:: max(1, np.count_nonzero(meets) // CHUNKS)]
    poses, expected = path.poses[near[some]], _variances(CORRECTION_M, CORRECTION_RAD)
    walls = WallMap.of(judged_hits(earlier, MOST_HITS), first, expected)
    found = walls and walls.match([kept[at] for at in some], poses, expected)
    if not found or not found.fits:
        return path
    return path.moved(found.pose.compose(pose_of(poses[-1]).inverse()))


def _contradicted(evidence: PathEvidence, by: str = FUSED) -> list[str]:
    """Return the inputs that the scans surely support less than the path ``by``."""
    names = []
    for name in evidence.scores:
        found = None if name in {FUSED, by} else evidence.compare(by, name)
        if found and found.difference > LEAST_DIFFERENCE and found.p_value < SURE:
            names.append(name)
    return names


def _doubts(evidence: PathEvidence, contradicted: Sequence[str]) -> dict[str, str]:
    """Return bent, contradicted inputs and why.

    If all leave the fused path, none confirms it, and only those are returned that the scans surely
    support less than the best input.
    """
    found = {}
    for name in contradicted:
        bent = _bent_at(evidence, name)
        if bent.any():
            since_s = evidence.scans.stamps_s[evidence.is_judged][np.argmax(bent)]
            found[name] = f"the scans contradict its path since stamp {since_s:.1f} s"
    if not found or len(found) < len(evidence.scores) - 1:
        return found
    best = max(found, key=lambda name: evidence.scores[name].consistency)
    return {name: found[name] for name in _contradicted(evidence, best)}


def _bent_at(evidence: PathEvidence, name: str) -> B8:
    """Return at which judged scans a path has parted from the fused one, (M,) bool.

    It is aligned by the first part of the drive that shows it: aligned by most of its poses, a path
    that turns away slowly would part late.
    """
    judged = evidence.is_judged
    moving, still = (evidence.scores[one].poses[judged] for one in (name, FUSED))
    stamps_s = evidence.scans.stamps_s[judged]
    bent = np.zeros(len(still), dtype=np.bool_)
    for part in np.array_split(np.arange(len(still)), PARTS):
        if len(part) and not bent.any():
            motion = fit_motion(with_levers(moving[part]), with_levers(still[part]))
            gap_m = np.hypot(*(moved_poses(motion, moving)[:, :2] - still[:, :2]).T)
            bent = parted(gap_m, stamps_s)
    return bent


def _disagreement(evidence: PathEvidence, contradicted: Sequence[str]) -> F64:
    """Return the mean square, (3, 3), of how far inputs end from the fused path.

    Only of inputs that the scans support as well: the path of the others is known to be wrong. If
    they contradict all, no input confirms the fused path, and all count.
    """
    inputs = [name for name in evidence.scores if name != FUSED]
    names = [name for name in inputs if name not in contradicted] or inputs
    gaps = np.array([path_gaps(evidence, name, FUSED)[-1] for name in names])
    return np.asarray(gaps.T @ gaps / len(gaps))


def _blind_m(path: Trajectory, blind_s: F64) -> float:
    """Return how far the last pose of a path is from the first by scans with too few hits, metres.

    That is the least such way along the path and from one visit of a place to another.
    """
    count, steps = len(path), np.unique(np.searchsorted(path.stamps_s, blind_s))
    steps = steps[(steps > 0) & (steps < count)]
    if not len(steps):
        return 0.0
    ways_m = np.full(count, 1e-9)  # an edge of length 0 would be none
    ways_m[steps] += np.hypot(*(path.poses[steps] - path.poses[steps - 1])[:, :2].T)
    first, second = visits(path.poses)
    ends = np.arange(count - 1)
    starts, ends = np.concatenate((ends, first)), np.concatenate((ends + 1, second))
    ways_m = np.concatenate((ways_m[1:], np.full(len(first), 1e-9)))
    graph = scipy.sparse.csr_matrix((ways_m, (starts, ends)), shape=(count, count))
    from_first = np.zeros(1, dtype=np.int64)
    return float(scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=from_first)[0, -1])


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
        carried = carried_along(_chosen(path, is_told), before, left_out_s)
        known_s = np.union1d(before.stamps_s, scans_s)
        near_s = known_s[nearest_stamps(known_s, path.stamps_s)]
        rows = rows[np.abs(near_s - path.stamps_s) <= SAME_STAMP_S]
        rows = np.concatenate((rows, np.column_stack((left_out_s, carried))))
        rows = rows[np.argsort(rows[:, 0])]
    return np.concatenate((rows, own[is_newer]))


def _part(path: Trajectory, after_s: float, until_s: float) -> Trajectory:
    """Return the poses of a path after one time and until another."""
    return _chosen(path, (path.stamps_s > after_s) & (path.stamps_s <= until_s))


def _chosen(path: Trajectory, which: B8) -> Trajectory:
    """Return some poses of a path, by (N,) bool."""
    return replace(path, stamps_s=path.stamps_s[which], poses=path.poses[which])


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


def _variances(place_m: float, turn_rad: float) -> F64:
    return np.diag((place_m**2, place_m**2, turn_rad**2))


def _correction(own: Trajectory, path: Trajectory) -> Pose2:
    """Return the motion that carries the last poses of an input onto the path."""
    last = _part(own, own.stamps_s[-1] - CORRECTED_S, np.inf)
    near, meets = path.matches(last.stamps_s)
    if not meets.any():
        near, meets = path.nearest(last.stamps_s), np.ones(len(last), dtype=np.bool_)
    moving, still = last.poses[meets], path.poses[near[meets]]
    return fit_motion(with_levers(moving), with_levers(still))
