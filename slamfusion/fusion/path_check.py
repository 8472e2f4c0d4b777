"""What the paths say of an alignment of maps: producers of one drive must have been together.

Walls alone can mislead: a place that looks the same turned round locks perfectly the wrong way. The
path that a producer found goes with its map, so laid into the fused frame all paths of one drive
must lie on each other. This takes no part in the search, and so is evidence of its own.

And walls alone can say too little: bent maps of a narrow view fit in several ways, none of which
stands out. There the paths have the answer: poses of one moment belong together, so the best fit of
the paths lays one map on the other. It is believed where the walls, refined from there, meet beyond
chance and the paths still agree: such a map is *placed by its path*.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

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
from slamfusion.geometry import (
    Pose2,
    blend_poses,
    fit_motion,
    moved_poses,
    with_levers,
    wrap_angles,
)
from slamfusion.grid import OccupancyGrid
from slamfusion.trajectory import Trajectory

# Of two paths each pose of one is held against where the other was at its time, which is known
# between two of its poses that are no farther apart, or beside one, seconds: a path need not be
# told for the whole drive, and at 1 m/s the pose of a second ago is a metre away.
BETWEEN_S, BESIDE_S = 2.0, 0.1
# Where two paths have no such moment, poses up to this far apart in time are held together.
TOGETHER_S = 1.0
# A producer that is lost on its way is together with the others before: it is this many limits
# away for a quarter of the time, and the others are not.
LOST_LIMITS = 3.0
# Where maps do not fit, some are bent, that of a producer that closes loops least: it is taken if
# its score is more than this share of the best one's. In 8 drives through a corridor loop with a
# narrow view it was the right one in all, and the scores, within 6 % of each other, named it in 4.
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
    median_m: float = field(init=False)
    """Half of the time the paths are nearer than this, metres."""
    max_m: float = field(init=False)
    """Where they are farthest apart, metres."""
    start_m: float = field(init=False)
    """How far apart they begin, metres."""
    median_yaw_rad: float = field(init=False)
    """Median of the differences of the headings, 0 to pi, radians."""
    stamps_s: npt.NDArray[np.float64] = field(repr=False)
    """(N,), of the poses of ``a`` at whose time it is known where ``b`` is."""
    gaps_m: npt.NDArray[np.float64] = field(repr=False)
    """(N,), distance to where ``b`` is then."""
    yaws_rad: npt.NDArray[np.float64] = field(repr=False)
    """(N,), difference of the headings then, 0 to pi."""

    def __post_init__(self) -> None:
        gaps_m = self.gaps_m
        figures = {
            "median_m": float(np.median(gaps_m)),
            "max_m": float(gaps_m.max()),
            "start_m": float(gaps_m[0]),
            "median_yaw_rad": float(np.median(self.yaws_rad)),
        }
        for name, value in figures.items():
            object.__setattr__(self, name, value)

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


def moved_path(path: Trajectory, transform: Pose2) -> Trajectory:
    """Return a path in another frame.

    Args:
        path: in its map's frame.
        transform: maps a point of that frame into the other, metres.
    """
    return Trajectory(path.stamps_s, moved_poses(transform, path.poses), path.name)


def path_gaps(paths: Mapping[str, Trajectory]) -> tuple[PathGap, ...]:
    """Return how far every two paths lie apart.

    Args:
        paths: by producer, all in one frame, at least one pose each.
    """
    gaps = []
    for (a, path), (b, other) in itertools.combinations(paths.items(), 2):
        at, there = _together(path, other)
        apart = np.hypot(*(path.poses[at, :2] - there[:, :2]).T)
        turned = np.abs(wrap_angles(path.poses[at, 2] - there[:, 2]))
        gaps.append(PathGap(a, b, path.stamps_s[at], apart, turned))
    return tuple(gaps)


def _together(
    path: Trajectory, other: Trajectory
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return poses of a path, as indices, and where another path was at their times, (M, 3).

    That is known as ``BETWEEN_S`` and ``BESIDE_S`` say; where it never is, the pose nearest in time
    counts within ``TOGETHER_S``, and of all where there are none.
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
    """Return the transform under which the poses of two paths lie on each other best.

    Args:
        moving, still: paths of one drive, at least one pose each; each pose of ``moving`` goes with
            where ``still`` was at its time, as far as that is known.

    Returns:
        Maps a point of the frame of ``moving`` into that of ``still``: least squares of places and
        headings.
    """
    at, there = _together(moving, still)
    return fit_motion(with_levers(moving.poses[at]), with_levers(there))


def place_by_path(
    pair: Alignment, maps: Pair, paths: Mapping[str, Trajectory], limit_m: float
) -> Alignment:
    """Return an alignment as it is, or the one that the paths give where the walls leave it open.

    Args:
        pair: what the walls alone say; believed where it is accepted and the paths agree, which
            its statistics then say (``PATH_GAP``).
        maps: its maps.
        paths: by producer; a pair of which one has none stays as it is.
        limit_m: two paths agree when their median gap is at most this, metres.
    """
    if pair.reference not in paths or pair.moving not in paths:
        return pair
    still, moved = paths[pair.reference], paths[pair.moving]

    def gap_m(found: Alignment) -> float:
        laid = {pair.moving: moved_path(moved, found.transform), pair.reference: still}
        return path_gaps(laid)[0].median_m

    is_there = gap_m(pair) <= limit_m
    if pair.accepted and is_there:
        return replace(pair, statistics=pair.statistics | {PATH_GAP: gap_m(pair)})
    found = track_pair(maps, pair.transform if is_there else fit_paths(moved, still))
    gap = gap_m(found)
    if not found.accepted or gap > limit_m:
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
    """Return the fallback map where nothing can be fused: whose walls the others' fit best.

    Args:
        grids: at least one.
        pairs: every pair that was aligned, believed or not.
        loop_closers: names of grids of producers that close loops.

    Returns:
        The one with the greatest sum of scores, or the best of those that close loops where its
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
    limit_m: float,
    device: ComputeDevice,
    progress: Callable[[str, float, int], None] | None = None,
    starts: Starts | None = None,
) -> tuple[FusionResult, tuple[PathGap, ...]]:
    """Fuse maps; leave out a producer whose path then lies elsewhere than those of the others.

    Maps that the walls alone leave open are placed by their paths.

    Args:
        grids: see ``fuse_grids``.
        paths: those of them that producers of one drive made, by name: the paths found with them,
            each in its map's frame.
        config: see ``fuse_grids``.
        limit_m: two paths agree when their median gap is at most this, metres.
        progress, starts: see ``fuse_grids``.

    Returns:
        The fusion, and the gaps between the paths of all producers whose walls fit, also of those
        that were left out for their paths.

    Raises:
        AlignmentError: fewer than two inputs fit; ``PathsApartError``: or are left for their paths.
    """

    def look(pair: Alignment, maps: Pair) -> Alignment:
        return place_by_path(pair, maps, paths, limit_m)

    result = fuse_grids(grids, config, device, progress, look, starts)
    placed = {
        record.name: moved_path(paths[record.name], record.alignment.transform)
        for record in result.accepted
        if record.name in paths and record.alignment is not None
    }
    gaps = path_gaps(placed)
    _, reasons = agreeing(tuple(placed), gaps, limit_m)
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
    names: Sequence[str], gaps: Sequence[PathGap], limit_m: float
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the largest group of producers whose paths agree, and why each other one is out.

    Of equally large groups the one whose gaps sum to the least. A group has at least two members:
    of two that disagree neither is known to be right, and both are out. One that was lost on its
    way, and is far from the others for a quarter of the time, is out where two others are not.

    Args:
        names: the producers, in order.
        gaps: between every two of them.
        limit_m: two paths agree when their median gap is at most this, metres.
    """
    found = {frozenset((gap.a, gap.b)): gap for gap in gaps}
    if len(names) < 2:
        return tuple(names), {}
    for late_limit_m in (LOST_LIMITS * limit_m, math.inf):
        members = _largest_group(names, found, limit_m, late_limit_m)
        if members:
            out = [name for name in names if name not in members]
            return members, {name: _why(name, members, found) for name in out}
    return (), {name: _why(name, names, found) for name in names}


def _largest_group(
    names: Sequence[str],
    gaps: Mapping[frozenset[str], PathGap],
    limit_m: float,
    late_limit_m: float,
) -> tuple[str, ...]:
    """Return the largest group of which every two agree, of equals the closest; may be empty."""
    for size in range(len(names), 1, -1):
        found = []
        for members in itertools.combinations(names, size):
            inside = [gaps[frozenset(pair)] for pair in itertools.combinations(members, 2)]
            if all(gap.median_m <= limit_m and gap.late_m <= late_limit_m for gap in inside):
                found.append((sum(gap.median_m for gap in inside), members))
        if found:
            return min(found, key=lambda item: item[0])[1]
    return ()


def _why(name: str, others: Sequence[str], gaps: Mapping[frozenset[str], PathGap]) -> str:
    """Say how far a producer's path lies from the others'."""
    apart = {other: gaps[frozenset((name, other))] for other in others if other != name}
    words = " and ".join(
        f"{gap.median_m:.2f} m from that of {other}" for other, gap in apart.items()
    )
    late_m = min(gap.late_m for gap in apart.values())
    return (
        f"laid into the fused map its path lies {words} (median), more than {late_m:.2f} m for a "
        "quarter of the time: one of them is wrong"
    )
