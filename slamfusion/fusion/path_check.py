"""Check alignments of maps by the paths: SLAMs of one drive must have been together.

Walls alone can mislead: a place that looks the same after a turn fits perfectly the wrong way. Each
SLAM has a path with its map, and in the fused frame all paths of one drive must coincide. The
search does not use the paths, so they are independent evidence.

Walls alone can also be ambiguous: bent maps with a narrow view fit in several ways. Then the best
fit of the paths aligns the maps. It is accepted if the walls, refined from there, match beyond
chance and the paths still agree: such a map is *placed by its path*.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from slamfusion.align.align import track_pair
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment, FusionResult, InputRecord, RunnerUp
from slamfusion.align.starts import Starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.errors import AlignmentError
from slamfusion.fusion.grouping import PATH_GAP
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.fusion.pipeline import fuse_grids
from slamfusion.geometry import F64, I64, Pose2, blend_poses, fit_motion, with_levers, wrap_angles
from slamfusion.grid import OccupancyGrid
from slamfusion.trajectory import Trajectory

# The pose of one path is compared with the other path at its time, interpolated between two poses
# no farther apart than this, or next to a pose, seconds: a path need not cover the whole drive, and
# at 1 m/s a pose a second ago is a metre away.
BETWEEN_S, BESIDE_S = 2.0, 0.1
# Without such times, poses up to this far apart in time are compared.
TOGETHER_S = 1.0
# A producer is left out if its path, in the fused map, is farther than this from the others'.
PATH_GAP_M = 1.0
# A SLAM that is lost on its way agrees with the others before: it is this many limits away for a
# quarter of the time, and the others are not.
LOST_LIMITS = 3.0
# If maps do not fit, that of a SLAM that closes loops is probably the least bent: it is taken if
# its score is more than this share of the best one's.
NEARLY = 0.9


class PathsApartError(AlignmentError):
    """The walls of maps fit, but the paths that were found with them do not.

    Attributes:
        gaps: between the paths (``PathGap``).
    """

    def __init__(self, message: str, pairs: tuple[Any, ...], gaps: tuple[PathGap, ...]) -> None:
        super().__init__(message, pairs)
        self.gaps = gaps


@dataclass(frozen=True, eq=False)
class PathGap:
    """How far two paths of one drive lie apart in one frame."""

    a: str
    """One producer."""
    b: str
    """The other producer."""
    median_m: float
    """Half of the time the paths are nearer than this, metres."""
    max_m: float
    """Where they are farthest apart, metres."""
    start_m: float
    """How far apart they begin, metres."""
    median_yaw_rad: float
    """Median of the differences of the headings, 0 to pi, radians."""
    stamps_s: F64 = field(repr=False)
    """(N,), of the poses of ``a`` at whose time it is known where ``b`` is."""
    gaps_m: F64 = field(repr=False)
    """(N,), distance to where ``b`` is then."""

    @property
    def late_m(self) -> float:
        """Three quarters of the time the paths are nearer than this."""
        return float(np.quantile(self.gaps_m, 0.75))

    def sentence(self) -> str:
        """Say how far the paths are apart over the drive."""
        return (
            f"{self.a} and {self.b} are {self.median_m:.2f} m apart over the drive (median; "
            f"{self.max_m:.2f} m at most)"
        )


def path_gaps(paths: Mapping[str, Trajectory]) -> tuple[PathGap, ...]:
    """Return how far every two paths, in one frame, are apart."""
    gaps = []
    for (a, path), (b, other) in itertools.combinations(paths.items(), 2):
        at, there = _together(path, other)
        apart = np.hypot(*(path.poses[at, :2] - there[:, :2]).T)
        turned = np.abs(wrap_angles(path.poses[at, 2] - there[:, 2]))
        figures = (np.median(apart), apart.max(), apart[0], np.median(turned))
        median_m, max_m, start_m, yaw_rad = map(float, figures)
        gaps.append(PathGap(a, b, median_m, max_m, start_m, yaw_rad, path.stamps_s[at], apart))
    return tuple(gaps)


def _together(path: Trajectory, other: Trajectory) -> tuple[I64, F64]:
    """Return indices of poses of a path, and the places of another at their times, (M, 3).

    See ``BETWEEN_S`` and ``BESIDE_S``; without such times the nearest pose within ``TOGETHER_S`` is
    used, else all poses.
    """
    stamps_s, known_s = path.stamps_s, other.stamps_s
    near, is_beside = other.matches(stamps_s, BESIDE_S)
    there = other.poses[near]
    after = np.searchsorted(known_s, stamps_s)
    is_between = (after > 0) & (after < len(other))
    after = np.clip(after, 1, max(1, len(other) - 1))
    wide_s = known_s[np.minimum(after, len(other) - 1)] - known_s[after - 1]
    between = np.flatnonzero(is_between & (wide_s > 0.0) & (wide_s <= BETWEEN_S))
    after = after[between]
    share = (stamps_s[between] - known_s[after - 1]) / wide_s[between]
    there[between] = blend_poses(other.poses[after - 1], other.poses[after], share)
    is_known = is_beside
    is_known[between] = True
    if not is_known.any():
        _, is_known = other.matches(stamps_s, TOGETHER_S)
    at = np.flatnonzero(is_known) if is_known.any() else np.arange(len(path))
    return at, there[at]


def fit_paths(moving: Trajectory, still: Trajectory) -> Pose2:
    """Return the transform from the frame of ``moving`` into that of ``still`` by their poses.

    Least squares of places and headings at equal times, as far as those are known.
    """
    at, there = _together(moving, still)
    return fit_motion(with_levers(moving.poses[at]), with_levers(there))


def place_by_path(pair: Alignment, maps: Pair, paths: Mapping[str, Trajectory]) -> Alignment:
    """Return an alignment, or the one by the paths if the walls are ambiguous.

    Args:
        pair: by the walls alone; accepted if the paths agree too (``PATH_GAP`` in its statistics).
        paths: by producer; a pair without both paths is returned unchanged.
    """
    if pair.reference not in paths or pair.moving not in paths:
        return pair
    still, moved = paths[pair.reference], paths[pair.moving]

    def gap_m(found: Alignment) -> float:
        laid = {pair.moving: moved.moved(found.transform), pair.reference: still}
        return path_gaps(laid)[0].median_m

    is_there = gap_m(pair) <= PATH_GAP_M
    if pair.accepted and is_there:
        return replace(pair, statistics=pair.statistics | {PATH_GAP: gap_m(pair)})
    found = track_pair(maps, pair.transform if is_there else fit_paths(moved, still))
    gap = gap_m(found)
    if not found.accepted or gap > PATH_GAP_M:
        return pair
    match, chance = found.statistics["wall_match"], found.statistics["chance"]
    runner_up = pair.runner_up
    if not is_there:
        runner_up = RunnerUp(pair.transform, pair.score, pair.score / found.score)
    return replace(
        found,
        reason=(
            f"placed by its path: {gap:.2f} m from the other's (median), "
            f"walls match {match:.0%} ({chance:.0%} by chance)"
        ),
        runner_up=runner_up,
        time_s=pair.time_s + found.time_s,
        statistics=found.statistics | {PATH_GAP: gap},
        yaw_profile=pair.yaw_profile,
    )


def fallback_map(
    grids: Sequence[OccupancyGrid], pairs: Sequence[Alignment], loop_closers: Collection[str] = ()
) -> OccupancyGrid:
    """Return the map whose walls the others fit best, for use if nothing can be fused.

    Args:
        loop_closers: names of grids of producers that close loops.

    Returns:
        The one with the greatest sum of scores, or the best of those that close loops if its
        sum is nearly as great; of equals the one that knows most cells.
    """
    scores = {
        grid.name: sum(pair.score for pair in pairs if grid.name in {pair.reference, pair.moving})
        for grid in grids
    }
    able = (name for name in loop_closers if name in scores)
    closing = max(able, key=scores.__getitem__, default="")
    if closing and scores[closing] > NEARLY * max(scores.values()):
        scores[closing] = math.inf
    return max(grids, key=lambda grid: (scores[grid.name], np.count_nonzero(grid.cells >= 0)))


def fuse_with_paths(
    grids: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    config: FusionConfig,
    device: ComputeDevice,
    progress: Callable[[str, float, int], None] | None = None,
    starts: Starts | None = None,
) -> tuple[FusionResult, tuple[PathGap, ...]]:
    """Fuse maps; leave out a producer whose path disagrees with the others.

    Maps with ambiguous walls are placed by their paths.

    Args:
        paths: of the grids that producers of one drive made, by name, each in its map's frame.

    Returns:
        The fusion, and the gaps between the paths of all producers whose walls fit, including those
        that were left out for their paths.

    Raises:
        AlignmentError: fewer than two inputs fit; ``PathsApartError``: or are left for their paths.
    """
    look = partial(place_by_path, paths=paths)
    result = fuse_grids(grids, config, device, progress, look, starts)
    placed = {
        record.name: paths[record.name].moved(record.alignment.transform)
        for record in result.accepted
        if record.name in paths and record.alignment is not None
    }
    gaps = path_gaps(placed)
    _, reasons = agreeing(tuple(placed), gaps)
    if not reasons:
        return result, gaps
    if len(result.accepted) - len(reasons) < LEAST_FUSED:
        words = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        message = f"the walls of the maps fit, but the paths do not, so nothing is fused ({words})"
        raise PathsApartError(message, result.pairs, gaps)
    rest = [grid for grid in grids if grid.name not in reasons]
    again = fuse_grids(rest, config, device, second_look=look, starts=starts)
    kept = {record.name: record for record in again.inputs}
    inputs = [
        kept[record.name]
        if record.name in kept
        else InputRecord(record.grid, record.alignment, False, reasons[record.name])
        for record in result.inputs
    ]
    time_s = result.time_s + again.time_s
    return replace(again, inputs=tuple(inputs), pairs=result.pairs, time_s=time_s), gaps


def agreeing(
    names: Sequence[str], gaps: Sequence[PathGap]
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the largest group of producers whose paths agree, and why others are left out.

    Of equally large groups the one with the least sum of gaps. A group has at least two members: of
    two that disagree neither is known to be right. A producer that was lost on its way, far from
    the others for a quarter of the time, is left out if two others are not.

    Args:
        names: the producers, in order.
    """
    found = {frozenset((gap.a, gap.b)): gap for gap in gaps}
    if len(names) < 2:
        return tuple(names), {}
    sizes = range(len(names), 1, -1)
    for late_limit_m, size in itertools.product((LOST_LIMITS * PATH_GAP_M, math.inf), sizes):
        agree = []
        for members in itertools.combinations(names, size):
            inside = [found[frozenset(pair)] for pair in itertools.combinations(members, 2)]
            if all(gap.median_m <= PATH_GAP_M and gap.late_m <= late_limit_m for gap in inside):
                agree.append((sum(gap.median_m for gap in inside), members))
        if agree:
            _, members = min(agree, key=lambda item: item[0])
            out = [name for name in names if name not in members]
            return members, {name: _why(name, members, found) for name in out}
    return (), {name: _why(name, names, found) for name in names}


def _why(name: str, others: Sequence[str], gaps: Mapping[frozenset[str], PathGap]) -> str:
    """Describe how far a producer's path is from the others'."""
    apart = {other: gaps[frozenset((name, other))] for other in others if other != name}
    words = " and ".join(
        f"{gap.median_m:.2f} m from that of {other}" for other, gap in apart.items()
    )
    late_m = min(gap.late_m for gap in apart.values())
    return (
        f"laid into the fused map its path lies {words} (median), more than {late_m:.2f} m for a "
        "quarter of the time: one of them is wrong"
    )
