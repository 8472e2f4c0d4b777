"""``DriveSolver``: scores the inputs of a drive so far, and makes one path and one map of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, TypeAlias, get_args

import numpy as np
import scipy

from slamfusion.compute import ComputeDevice
from slamfusion.errors import SlamFusionError
from slamfusion.evidence import beams
from slamfusion.evidence.beams import CHUNKS, JudgedScans, ScanHits, cover_stamps, judged_hits
from slamfusion.evidence.drawn_map import MapDrawer
from slamfusion.evidence.fused_path import visits
from slamfusion.evidence.patches import WallMap
from slamfusion.evidence.path_frames import moved_onto
from slamfusion.evidence.predictive import PathEvidence, score_paths
from slamfusion.geometry import F64, Pose2, fit_motion, pose_of, with_levers
from slamfusion.grid import OccupancyGrid
from slamfusion.io.files import return_freed_memory
from slamfusion.jobs.fused_path import fuse_weighed_paths
from slamfusion.jobs.live_drive.locating import DriveLocator
from slamfusion.jobs.live_drive.memory import LEAST_SCANS, WINDOW_S, DriveMemory
from slamfusion.jobs.live_drive.solution import CARRIED, DRIFT, DriveSolution, Judgement
from slamfusion.jobs.outputs import DRAWN, FUSED
from slamfusion.trajectory import SAME_STAMP_S, Trajectory, nearest_stamps
from slamfusion.vote.lattice import Lattice

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


# Hits that are judged while scans come, at most.
MOST_HITS = 60_000
# An input whose last pose is older than this, seconds, is left out: paths are scored on the scans
# for which each of them has a pose.
SILENT_S = 5.0
# An input maps these scans if at least this share of its poses has the stamp of one: another robot
# has scans of its own.
OF_SCANS = 0.5
# A pose of an input is carried into the fused frame as its poses of the last second were.
CORRECTED_S = 1.0


class DriveSolver:
    """Solves the drive so far, in one thread."""

    def __init__(self, memory: DriveMemory, locator: DriveLocator, device: ComputeDevice) -> None:
        """Start without a solution; ``device`` is that of the thread."""
        self._memory, self._locator, self._device = memory, locator, device
        self._drawer: MapDrawer | None = None
        # The stamp of the last scan that a solution of the whole drive has.
        self._whole_until_s = -np.inf

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
        memory = self._memory
        with memory.lock:
            generation, last = memory.generation, self._locator.solution
            kept = list(memory.scans)
            poses = {name: np.array(own) for name, own in memory.poses.items() if own}
            heard_s, blind_s = np.unique(memory.heard_s), np.array(memory.blind_s)
        if len(kept) < CHUNKS:
            return None
        scans = judged_hits(kept, beams.MOST_HITS if depth == "final" else MOST_HITS)
        paths = self._at_scans(scans, poses, heard_s)
        before = last if depth == "window" else None
        evidence, judgement = None, Judgement() if before is None else before.judgement
        try:
            if depth == "judged":
                return self._judged_again(scans, paths)
            if before is None:
                fused, evidence = _solved(scans, paths, self._device)
            elif (window := self._continued(before, kept, paths)) is not None:
                fused = window
            else:
                return None
            path, known = self._placed(
                fused, last, kept, paths, lattice, transforms or {}, is_whole=before is None
            )
            if before is None:
                evidence = evidence or score_paths(scans, {**paths, FUSED: path}, self._device)
                judgement = Judgement.of(evidence)
        except SlamFusionError:
            return None  # the paths have no scan in common yet
        if before is None:
            return_freed_memory()  # half of what all scans took lies in holes by now
        own_lattice = known or Lattice(resolution or 0.05, Pose2())
        drawn = None if resolution is None else self._drawn(kept, path, own_lattice)
        nearest_first = sorted(paths, key=lambda name: judgement.gaps_m.get(name, np.inf))
        corrections = {name: _correction(paths[name], path) for name in nearest_first}
        covariance = judgement.disagreement + np.eye(3) * (DRIFT * _blind_m(path, blind_s)) ** 2
        return DriveSolution(
            path,
            corrections,
            judgement,
            depth == "final",
            own_lattice,
            drawn,
            WallMap.of(scans, path, covariance),
            generation,
        )

    def _judged_again(
        self, scans: JudgedScans, paths: Mapping[str, Trajectory]
    ) -> DriveSolution | None:
        """Return the last solution with new doubts and conditions; its path goes on as located."""
        found = self._locator.longer_path()
        if found is None:
            return None
        solution, path = found
        judgement = Judgement.of(score_paths(scans, {**paths, FUSED: path}, self._device))
        return replace(solution, judgement=judgement)

    def _drawn(self, kept: Sequence[ScanHits], path: Trajectory, lattice: Lattice) -> OccupancyGrid:
        """Draw the map along a path; scans at the poses of the last map are not drawn again."""
        if self._drawer is None or self._drawer.lattice != lattice:
            self._drawer = MapDrawer(self._device, lattice)
        return self._drawer.draw(kept, path, DRAWN)

    def _continued(
        self, solution: DriveSolution, kept: Sequence[ScanHits], paths: Mapping[str, Trajectory]
    ) -> Trajectory | None:
        """Solve the last seconds, and what was not solved yet, by the inputs that are right."""
        stamps_s = [one.stamp_s for one in kept[-LEAST_SCANS:]]
        solved_s = float(solution.path.stamps_s[-1])
        first_s = min(stamps_s[0], stamps_s[-1] - WINDOW_S, solved_s - 0.5 * WINDOW_S)
        hits = [one for one in kept if one.stamp_s >= first_s]
        last = {name: own.between(first_s - SAME_STAMP_S, np.inf) for name, own in paths.items()}
        last = {name: own for name, own in last.items() if len(own) >= CHUNKS}
        doubts = solution.judgement.doubts
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

    def _placed(
        self,
        found: Trajectory,
        last: DriveSolution | None,
        kept: Sequence[ScanHits],
        paths: Mapping[str, Trajectory],
        lattice: Lattice | None,
        transforms: Mapping[str, Pose2],
        *,
        is_whole: bool,
    ) -> tuple[Trajectory, Lattice | None]:
        """Return a path that was found, in the fused frame, and the lattice of that frame.

        That of a window is returned behind the path of the last solution.
        """
        before, known = (None, None) if last is None else (last.path, last.lattice)
        if lattice is not None and lattice != known:
            voters = [paths[n].moved(transforms[n]) for n in transforms if n in paths]
            if voters:
                known = lattice
                if before is not None:
                    before = moved_onto(before, voters)
                else:
                    found = moved_onto(found, voters)
        newest_s = float(found.stamps_s[-1])
        if is_whole or before is None:
            self._whole_until_s = newest_s
            return found if before is None else moved_onto(found, [before]), known
        until_s = min(float(before.stamps_s[-1]), newest_s - 0.5 * WINDOW_S)
        cut_s = max(self._whole_until_s, until_s)
        first = before.between(-np.inf, cut_s)
        rest = _onto_walls(moved_onto(found, [first]), first, kept).between(cut_s, np.inf)
        stamps_s = np.concatenate((first.stamps_s, rest.stamps_s))
        return Trajectory(stamps_s, np.concatenate((first.poses, rest.poses)), FUSED), known


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
    poses = path.poses[near[some]]
    walls = WallMap.of(judged_hits(earlier, MOST_HITS), first, CARRIED)
    found = walls and walls.match([kept[at] for at in some], poses, CARRIED)
    if not found or not found.fits:
        return path
    return path.moved(found.pose.compose(pose_of(poses[-1]).inverse()))


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


def _correction(own: Trajectory, path: Trajectory) -> Pose2:
    """Return the motion that carries the last poses of an input onto the path."""
    last = own.between(own.stamps_s[-1] - CORRECTED_S, np.inf)
    near, meets = path.matches(last.stamps_s)
    if not meets.any():
        near, meets = path.nearest(last.stamps_s), np.ones(len(last), dtype=np.bool_)
    moving, still = last.poses[meets], path.poses[near[meets]]
    return fit_motion(with_levers(moving), with_levers(still))
