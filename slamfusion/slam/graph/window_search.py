"""The best pose of a scan on a submap over a whole window, exactly: branch and bound [H16c].

The search set is every whole-cell shift within the window times yaw steps that move the farthest
hit by at most ``YAW_CELLS``. A block of shifts is bounded by reading, for each hit, the greatest
cell of the square that the hit can reach within the block; blocks whose bound is below the best
pose found are never opened.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import wrap_angles
from slamfusion.slam.graph.submap import Pyramid

F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]

# Blocks that are opened together: the device is asked few times.
BATCH = 256
# Distance, cells, by which a yaw step moves the farthest hit: the likelihood around a wall reaches
# about as far, so that a hit half a step off still counts.
YAW_CELLS = 2.0
# Differences, metres and radians, up to which two poses are one place: the peak of one response.
BESIDE_M, BESIDE_RAD = 0.5, 0.35
# Distance of the farthest hit, cells, that the yaw step is chosen for at least: hits at the robot's
# feet would leave a single step.
LEAST_REACH_CELLS = 20.0


@dataclass(frozen=True)
class WindowMatch:
    """The best pose of the search set.

    Attributes:
        pose: (3,) x, y in metres and yaw in radians, in the submap's frame.
        score: mean field under the hits, 0 to 1.
        opened: blocks that were bounded: what the search took.
    """

    pose: F64
    score: float
    opened: int


def search_window(
    device: ComputeDevice,
    pyramid: Pyramid,
    points: F64,
    centre: F64,
    *,
    half_m: float,
    half_rad: float,
    resolution: float,
    least: float = 0.0,
    beside: F64 | None = None,
) -> WindowMatch | None:
    """Search a window for the pose at which a scan's hits lie on the greatest sum of the field.

    Args:
        device: where the pyramid lives.
        pyramid: of the submap.
        points: (P, 2) hits in the robot's frame, metres; at least one.
        centre: (3,) middle of the window in the submap's frame.
        half_m: shifts along x and y reach so far, rounded up to whole cells.
        half_rad: so far reaches the yaw.
        resolution: metres per cell.
        least: a score that is of no use; nothing at or below it is looked for.
        beside: (3,) a pose in the submap's frame; what lies within ``BESIDE_M`` and
            ``BESIDE_RAD`` of it is passed over: is there another place that fits?

    Returns:
        The best; of equals one, always the same. None where nothing is above ``least``.
    """
    cells = points / resolution
    reach = max(float(np.hypot(cells[:, 0], cells[:, 1]).max()), LEAST_REACH_CELLS)
    yaw_count = int(np.ceil(half_rad * reach / YAW_CELLS))
    yaws = centre[2] + np.arange(-yaw_count, yaw_count + 1) * (half_rad / max(1, yaw_count))
    half = int(np.ceil(half_m / resolution))
    start = centre[:2] / resolution - pyramid.corner - half
    cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x = start[0] + cos * cells[:, 0] - sin * cells[:, 1]
    y = start[1] + sin * cells[:, 0] + cos * cells[:, 1]
    starts = np.floor(np.stack((y, x), axis=1)).astype(np.int32)
    handle = device.upload(starts)
    classes = np.zeros(len(points), dtype=np.uint8)
    span = 2 * half + 1

    # A sum is whole: what is added undoes the rounding of a score that was one.
    best_sum = int(np.floor(least * 255.0 * len(points) + 1e-6))

    def bounds(blocks: I32, level: int) -> npt.NDArray[np.int32]:
        field = pyramid.fields[level]
        return device.bound_blocks(blocks, handle, classes, field, 0, least=best_sum)

    window = pyramid.windows[0]
    firsts = -(-span // window)
    blocks = np.indices((len(yaws), firsts, firsts), dtype=np.int32).reshape(3, -1).T
    blocks = blocks * np.array([1, window, window], dtype=np.int32)
    values = bounds(blocks, 0)
    opened = len(blocks)
    # A stack of open blocks by level; the most promising of the deepest level come first.
    queues: list[tuple[I32, npt.NDArray[np.int32]]] = [(blocks, values)]
    best: I32 | None = None
    while queues:
        blocks, values = queues.pop()
        level = len(queues)
        open_ones = values > best_sum
        blocks, values = blocks[open_ones], values[open_ones]
        if len(blocks) == 0:
            continue
        order = np.argsort(-values, kind="stable")
        chosen, rest = order[:BATCH], order[BATCH:]
        if level == len(pyramid.windows) - 1:
            if beside is not None:
                place = (start + pyramid.corner + blocks[order][:, [2, 1]]) * resolution
                order = order[_is_elsewhere(place, yaws[blocks[order, 0]], beside)]
            if len(order):
                best_sum, best = int(values[order[0]]), blocks[order[0]]
            continue
        queues.append((blocks[rest], values[rest]))
        children = _children(blocks[chosen], pyramid.windows[level], pyramid.windows[level + 1])
        children = children[(children[:, 1] < span) & (children[:, 2] < span)]
        opened += len(children)
        queues.append((children, bounds(children, level + 1)))
    if best is None:
        return None
    place = (start + half + pyramid.corner) + (best[[2, 1]] - half)
    pose = np.array([*(place * resolution), yaws[best[0]]])
    return WindowMatch(pose, best_sum / (255.0 * len(points)), opened)


def _is_elsewhere(places: F64, yaws: F64, beside: F64) -> npt.NDArray[np.bool_]:
    """Return of places (N, 2) in metres and yaws (N,) whether they are not at a pose (3,)."""
    away = np.hypot(*(places - beside[:2]).T)
    return np.asarray((away >= BESIDE_M) | (np.abs(wrap_angles(yaws - beside[2])) >= BESIDE_RAD))


def _children(blocks: I32, window: int, part: int) -> I32:
    """Return the blocks of side ``part`` that make up blocks of side ``window``."""
    return np.asarray((blocks[:, None, :] + _offsets(window, part)).reshape(-1, 3))


@cache
def _offsets(window: int, part: int) -> I32:
    """Return the first shifts of the parts in a block, (K, 3): no yaw, rows, columns."""
    steps = np.arange(0, window, part, dtype=np.int32)
    rows, cols = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    return np.stack((np.zeros_like(rows), rows, cols), axis=-1)
