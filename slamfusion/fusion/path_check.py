"""What the paths say of an alignment of maps: producers of one drive must have been together.

Walls alone can mislead: a place that looks the same turned round locks perfectly the wrong way. The
path that a producer found goes with its map, so laid into the fused frame all paths of one drive
must lie on each other. This takes no part in the search, and so is evidence of its own.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute import Backend
from slamfusion.config import FusionConfig
from slamfusion.errors import AlignmentError
from slamfusion.fusion.pipeline import fuse_grids
from slamfusion.fusion.records import FusionResult, InputRecord
from slamfusion.geometry import Pose2, compose_poses, wrap_angles
from slamfusion.grid import OccupancyGrid
from slamfusion.trajectory import Trajectory

__all__ = ["PathGap", "PathsApartError", "agreeing", "fuse_with_paths", "moved_path", "path_gaps"]

LEAST_FUSED = 2


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
    """How far two paths of one drive lie apart in one frame.

    Attributes:
        a, b: the producers.
        stamps_s: (N,) float64, of the poses of ``a``.
        gaps_m: (N,) float64, distance to the pose of ``b`` nearest in time.
        yaw_rad: median of the differences of the headings, 0 to pi.
    """

    a: str
    b: str
    stamps_s: npt.NDArray[np.float64]
    gaps_m: npt.NDArray[np.float64]
    yaw_rad: float

    @property
    def median_m(self) -> float:
        """Half of the time the paths are nearer than this."""
        return float(np.median(self.gaps_m))

    @property
    def max_m(self) -> float:
        """Where they are farthest apart."""
        return float(self.gaps_m.max())

    def to_json(self) -> dict[str, Any]:
        """Return the figures for a JSON document."""
        return {
            "a": self.a,
            "b": self.b,
            "median_m": self.median_m,
            "max_m": self.max_m,
            "start_m": float(self.gaps_m[0]),
            "median_yaw_rad": self.yaw_rad,
        }


def moved_path(path: Trajectory, transform: Pose2) -> Trajectory:
    """Return a path in another frame.

    Args:
        path: in its map's frame.
        transform: maps a point of that frame into the other, metres.
    """
    pose = (transform.x, transform.y, transform.yaw_rad)
    return Trajectory(path.stamps_s, compose_poses(pose, path.poses), path.name)


def path_gaps(paths: Mapping[str, Trajectory]) -> tuple[PathGap, ...]:
    """Return how far every two paths lie apart.

    Args:
        paths: by producer, all in one frame, at least one pose each.
    """
    gaps = []
    for (a, path), (b, other) in itertools.combinations(paths.items(), 2):
        near = other.poses[other.nearest(path.stamps_s)]
        apart = np.hypot(*(path.poses[:, :2] - near[:, :2]).T)
        turned = np.abs(wrap_angles(path.poses[:, 2] - near[:, 2]))
        gaps.append(PathGap(a, b, path.stamps_s, apart, float(np.median(turned))))
    return tuple(gaps)


def fuse_with_paths(
    grids: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    config: FusionConfig,
    limit_m: float,
    backend: Backend,
    progress: Callable[[str, int, int], None] | None = None,
) -> tuple[FusionResult, tuple[PathGap, ...]]:
    """Fuse maps; leave out a producer whose path then lies elsewhere than those of the others.

    Args:
        grids: see ``fuse_grids``.
        paths: those of them that producers of one drive made, by name: the paths found with them,
            each in its map's frame.
        config: see ``fuse_grids``.
        limit_m: two paths agree when their median gap is at most this, metres.
        backend: computes.
        progress: see ``fuse_grids``.

    Returns:
        The fusion, and the gaps between the paths of all producers whose walls fit, also of those
        that were left out for their paths.

    Raises:
        AlignmentError: fewer than two inputs fit; ``PathsApartError``: or are left for their paths.
    """
    result = fuse_grids(grids, config, backend, progress)
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
    again = fuse_grids([grid for grid in grids if grid.name not in reasons], config, backend)
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
    of two that disagree neither is known to be right, and both are out.

    Args:
        names: the producers, in order.
        gaps: between every two of them.
        limit_m: two paths agree when their median gap is at most this, metres.
    """
    median_m = {frozenset((gap.a, gap.b)): gap.median_m for gap in gaps}
    if len(names) < 2:
        return tuple(names), {}
    for size in range(len(names), 1, -1):
        found = []
        for members in itertools.combinations(names, size):
            inside = [median_m[frozenset(pair)] for pair in itertools.combinations(members, 2)]
            if max(inside) <= limit_m:
                found.append((sum(inside), members))
        if found:
            _, members = min(found, key=lambda item: item[0])
            return members, {
                name: _why(name, members, median_m) for name in names if name not in members
            }
    return (), {name: _why(name, names, median_m) for name in names}


def _why(name: str, others: Sequence[str], median_m: Mapping[frozenset[str], float]) -> str:
    """Say how far a producer's path lies from the others'."""
    apart = {other: median_m[frozenset((name, other))] for other in others if other != name}
    words = " and ".join(f"{gap:.2f} m from that of {other}" for other, gap in apart.items())
    return f"laid into the fused map its path lies {words} (median): one of them is wrong"
