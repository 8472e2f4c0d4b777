"""Find a scan in an old submap, or the reason why it is not found.

A scan is searched near its expected place, over a whole window by branch and bound [H16c], or over
all of the submap. The result must fit about as well as scans do on average, must not lie where the
submap is unseen, must have no degenerate direction, and in a wide window must have no rival that
fits nearly as well.

The window search is exact. Its search set is every whole-cell shift within the window times yaw
steps that move the farthest hit by at most ``YAW_CELLS``. The bound of a block of shifts sums, for
each hit, the greatest cell that it can reach within the block; blocks with a bound below the best
pose are never opened.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import GraphConfig
from slamfusion.geometry import F64, I32, Pose2, row_of, wrap_angle, wrap_angles
from slamfusion.slam.common.matcher import (
    STARTS,
    PoseHypothesis,
    ScanOnTiles,
    information_of,
    response_hessian,
    search_pose,
    spread_of,
)
from slamfusion.slam.graph.submap import UNSEEN_WALL, Pyramid, Submap, seen_score

# Blocks that are opened together, to call the device less often.
BATCH = 256
# Distance, cells, by which a yaw step moves the farthest hit: the range of the likelihood around a
# wall.
YAW_CELLS = 2.0
# Differences, metres and radians, up to which two poses are one place: the peak of one response.
BESIDE_M, BESIDE_RAD = 0.5, 0.35
# The first shifts of the quarters of a block, by half of its side: yaw group, row, column.
QUARTERS: I32 = np.array([(0, 0, 0), (0, 0, 1), (0, 1, 0), (0, 1, 1)], dtype=np.int32)
# Least distance of the farthest hit, cells, for the yaw step.
LEAST_REACH_CELLS = 20.0


class Window(NamedTuple):
    """Poses to search in a submap's frame: centre (3,) and half-widths, metres and radians."""

    centre: F64
    half_m: float
    half_rad: float


class WindowMatch(NamedTuple):
    """The best pose (3,), metres and radians in the submap's frame, and its score, 0 to 1."""

    pose: F64
    score: float


def search_window(
    device: ComputeDevice,
    pyramid: Pyramid,
    points: F64,
    window: Window,
    resolution: float,
    least: float = 0.0,
    beside: F64 | None = None,
) -> WindowMatch | None:
    """Search a window for the pose at which a scan's hits lie on the greatest sum of the field.

    Args:
        points: (P, 2) hits in the robot's frame, metres; at least one.
        resolution: metres per cell.
        beside: (3,) a pose in the submap's frame; poses within ``BESIDE_M`` and ``BESIDE_RAD``
            of it are skipped.

    Returns:
        The best, with a fixed choice among equals; None if no score is above ``least``.
    """
    cells = points / resolution
    reach = max(float(np.hypot(cells[:, 0], cells[:, 1]).max()), LEAST_REACH_CELLS)
    yaw_count = int(np.ceil(window.half_rad * reach / YAW_CELLS))
    turns = np.arange(-yaw_count, yaw_count + 1) * (window.half_rad / max(1, yaw_count))
    yaws = window.centre[2] + turns
    half = int(np.ceil(window.half_m / resolution))
    start = window.centre[:2] / resolution - pyramid.corner - half
    cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x = start[0] + cos * cells[:, 0] - sin * cells[:, 1]
    y = start[1] + sin * cells[:, 0] + cos * cells[:, 1]
    starts = device.upload(np.floor(np.stack((y, x), axis=1)).astype(np.int32))
    span = 2 * half + 1

    # Sums are integers: the small term undoes the rounding of ``least``.
    best_sum = int(np.floor(least * 255.0 * len(points) + 1e-6))
    # The finest level alone where that is one call.
    coarsest = 0 if len(yaws) * span**2 > BATCH else len(pyramid.windows) - 1
    side = pyramid.windows[coarsest]
    firsts = -(-span // side)
    blocks = np.indices((len(yaws), firsts, firsts), dtype=np.int32).reshape(3, -1).T
    blocks = blocks * np.array([1, side, side], dtype=np.int32)
    # A stack of open blocks by level; the deepest level's highest bounds come first.
    queues = [(blocks, device.bound_blocks(blocks, starts, pyramid.fields[coarsest], best_sum))]
    best: I32 | None = None
    while queues:
        blocks, values = queues.pop()
        level = coarsest + len(queues)
        open_ones = values > best_sum
        blocks, values = blocks[open_ones], values[open_ones]
        if len(blocks) == 0:
            continue
        order = np.argsort(-values, kind="stable")
        if level == len(pyramid.windows) - 1:
            if beside is not None:
                place = (start + pyramid.corner + blocks[order][:, [2, 1]]) * resolution
                away = np.hypot(*(place - beside[:2]).T)
                turn = np.abs(wrap_angles(yaws[blocks[order, 0]] - beside[2]))
                order = order[(away >= BESIDE_M) | (turn >= BESIDE_RAD)]
            if len(order):
                best_sum, best = int(values[order[0]]), blocks[order[0]]
            continue
        chosen, rest = order[:BATCH], order[BATCH:]
        queues.append((blocks[rest], values[rest]))
        parts = QUARTERS * np.int32(pyramid.windows[level + 1])
        children = (blocks[chosen][:, None, :] + parts).reshape(-1, 3)
        children = children[(children[:, 1] < span) & (children[:, 2] < span)]
        bounds = device.bound_blocks(children, starts, pyramid.fields[level + 1], best_sum)
        queues.append((children, bounds))
    if best is None:
        return None
    place = (start + half + pyramid.corner) + (best[[2, 1]] - half)
    pose = np.array([*(place * resolution), yaws[best[0]]])
    return WindowMatch(pose, best_sum / (255.0 * len(points)))


# Why a scan is not found, in the published words of the health record.
LOW_RESPONSE = "low response"
LITTLE_IN_COMMON = "little in common"
DEGENERATE = "degenerate direction"
AMBIGUOUS = "two places fit"

# Least deviation of the matcher's search around the expected place, metres: three cells.
LEAST_SPREAD_M = 0.15
# Error of the expected heading: radians, fixed and for a metre of drift.
TURN_RAD, TURN_RAD_PER_M = 0.05, 0.1
# Share of the needed response for the window search: it finds whole cells only, and the fine search
# improves it.
WINDOW_SHARE = 0.8
# Window of a rival: factor on the closure's window, and metres added.
RIVAL_TIMES, RIVAL_M = 1.5, 0.5
# Half-width of the peak whose response rivals are compared with: cells and radians.
PEAK_CELLS, PEAK_RAD = 2.0, 0.02
# Difference between expected and found, metres and radians, below which no rival is searched unless
# the window is wide: the closure then changes little.
NEWS_M, NEWS_RAD = 0.2, 0.05
# Distance around the robot's places in a submap, metres, from which its walls can be seen too.
AROUND_M = 1.0
# Drift, metres, up to which the matcher's own search is used; above it a whole window is searched.
LOCAL_DRIFT_M = 0.8
# Response that a closure needs, as a share of the running mean score, and the share of a scan's
# hits that may be unseen in the older submap; a search without an expected place needs more.
MEAN_SHARE, MEAN_SHARE_ANYWHERE = 0.75, 0.85
MOST_UNSEEN, MOST_UNSEEN_ANYWHERE = 0.6, 0.3
# Half the angle of the widest window, radians.
MOST_TURN_RAD = 0.349
# Another place with this share of a closure's response makes it ambiguous.
RIVAL_SHARE = 0.93
# Half-width of the search if tracking may have failed, metres and radians. If a bad match is best
# within the second pair of the expected place, the world has changed, not the place.
SEARCH_M, SEARCH_RAD = 1.5, 0.8
EXPECTED_M, EXPECTED_RAD = 0.4, 0.12
# Standard deviations of the matcher's search around a window search's result: two cells, radians.
AFTER_WINDOW_M, AFTER_WINDOW_RAD = 0.1, 0.02


@dataclass(frozen=True, eq=False)
class Found:
    """Pose (3,) of the robot in a submap's frame, metres, radians, and (3, 3) information of it."""

    pose: F64
    information: F64


# Submaps whose dense fields are kept, up to 2 MB each.
MOST_DENSE = 32


class ClosureSearch:
    """Searches scans in old submaps."""

    def __init__(
        self, config: GraphConfig, device: ComputeDevice, rng: np.random.Generator
    ) -> None:
        self._config = config
        self._device = device
        self._rng = rng
        self._recent: dict[Submap, None] = {}

    def near(
        self, submap: Submap, points: F64, expected: F64, drift_m: float, mean_score: float
    ) -> Found | str:
        """Search where the robot is expected; return the pose or the reason for the health record.

        Args:
            points: (P, 2) hits in the robot's frame, metres.
            expected: (3,) pose in the submap's frame.
            mean_score: running mean score of the tracker, 0 to 1.
        """
        config = self._config
        least = max(config.loop_match_minimum_response, MEAN_SHARE * mean_score)
        turn = min(MOST_TURN_RAD, TURN_RAD + TURN_RAD_PER_M * drift_m)
        if drift_m <= LOCAL_DRIFT_M:
            spread = spread_of(max(drift_m / 2.0, LEAST_SPREAD_M), turn / 2.0)
            found = self._fine(submap, points, expected, least, MOST_UNSEEN, spread)
            if isinstance(found, str):
                return found
            away = found.pose - expected
            turned = abs(wrap_angle(float(away[2])))
            if np.hypot(away[0], away[1]) > NEWS_M or turned > NEWS_RAD:
                window = Window(expected, RIVAL_TIMES * drift_m + RIVAL_M, turn)
                if self._has_rival(submap, points, window, found):
                    return AMBIGUOUS
            return found
        most = config.loop_search_space_dimension / 2.0
        half_m = min(drift_m, most)
        wider = min(RIVAL_TIMES * half_m + RIVAL_M, most)
        windows = (Window(expected, half_m, turn), Window(expected, wider, turn))
        return self._only_place(submap, points, windows, least, MOST_UNSEEN)

    def anywhere(self, submap: Submap, points: F64, mean_score: float) -> Found | str:
        """Search all of a submap, for a kidnapped robot; see ``near``."""
        least = max(self._config.loop_match_minimum_response, MEAN_SHARE_ANYWHERE * mean_score)
        middle = np.array([*(0.5 * (submap.low + submap.high)), 0.0])
        half_m = 0.5 * float((submap.high - submap.low).max()) + AROUND_M
        everything = Window(middle, half_m, math.pi)
        windows = everything, everything
        return self._only_place(submap, points, windows, least, MOST_UNSEEN_ANYWHERE)

    def around(
        self, submap: Submap, points: F64, expected: F64, mean_score: float, *, by_odometry: bool
    ) -> tuple[F64, bool]:
        """Search the growing submap far around the expected pose (3,) after a bad match.

        Returns:
            A pose (3,), and whether it is certain: the scan fits there about as well as on
            average and nowhere else nearly as well; or it fits badly, but best at the expected
            pose: then the world has changed, not the place.
        """
        window = Window(expected, SEARCH_M, SEARCH_RAD)
        best = self._searched(submap, points, window, 0.0)
        if best is None:
            return expected, False
        coarse = best.pose
        least = MEAN_SHARE_ANYWHERE * mean_score
        found = self._fine(submap, points, coarse, least, MOST_UNSEEN)
        if isinstance(found, Found):
            if self._has_rival(submap, points, window, found):
                return expected, False
            return found.pose, True
        if not by_odometry:
            return coarse, False
        away = np.hypot(*(coarse - expected)[:2])
        turn = abs(wrap_angle(float(coarse[2] - expected[2])))
        return expected, bool(away <= EXPECTED_M and turn <= EXPECTED_RAD)

    def unseen_share(self, submap: Submap, points: F64, pose: Pose2) -> float:
        """Return the share of a scan's hits (P, 2) at a pose that a submap has not seen."""
        scan = ScanOnTiles(self._device, submap.walls(), points, self._config.matcher.beams)
        return scan.unseen_share(row_of(pose), UNSEEN_WALL)

    def _only_place(
        self,
        submap: Submap,
        points: F64,
        windows: tuple[Window, Window],
        least: float,
        most_unseen: float,
    ) -> Found | str:
        """Search the first window, check the result, and look for a rival in the second."""
        best = self._searched(submap, points, windows[0], WINDOW_SHARE * least)
        if best is None:
            return LOW_RESPONSE
        found = self._fine(submap, points, best.pose, least, most_unseen)
        if isinstance(found, Found) and self._has_rival(submap, points, windows[1], found):
            return AMBIGUOUS
        return found

    def _fine(
        self,
        submap: Submap,
        points: F64,
        start: F64,
        least: float,
        most_unseen: float,
        spread: F64 | None = None,
    ) -> Found | str:
        """Search around a pose (3,), without a spread a window search's, and check the result."""
        config = self._config
        walls = self._kept(submap).walls()
        scan = ScanOnTiles(self._device, walls, points, config.matcher.beams)
        climbs = STARTS
        if spread is None:  # a window search ends within a cell of the place: fewer climbs suffice
            climbs, spread = STARTS // 2, spread_of(AFTER_WINDOW_M, AFTER_WINDOW_RAD)
        match = search_pose(scan, [PoseHypothesis(start, spread)], self._rng, climbs=climbs)
        unseen = scan.unseen_share(match.pose, UNSEEN_WALL)
        if unseen > most_unseen:
            return LITTLE_IN_COMMON
        if seen_score(match.score, unseen) < least:
            return LOW_RESPONSE
        information = information_of(response_hessian(scan, match.pose))
        (xx, xy, _), (_, yy, _), _ = np.linalg.inv(information).tolist()
        variance = 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)
        if variance > config.loop_match_maximum_variance:
            return DEGENERATE
        return Found(match.pose, information)

    def _searched(
        self, submap: Submap, points: F64, window: Window, least: float, beside: F64 | None = None
    ) -> WindowMatch | None:
        """Return the best of a window away from ``beside`` (3,); None if nothing fits."""
        every = -(-len(points) // self._config.matcher.beams)
        cell, pyramid = self._config.resolution, self._kept(submap).pyramid()
        return search_window(self._device, pyramid, points[::every], window, cell, least, beside)

    def _kept(self, submap: Submap) -> Submap:
        """Return a submap; finished ones keep dense copies until enough others are searched."""
        if not submap.is_finished:
            return submap
        self._recent.pop(submap, None)
        self._recent[submap] = None
        if len(self._recent) > MOST_DENSE:
            oldest = next(iter(self._recent))
            del self._recent[oldest]
            oldest.forget_dense()
        return submap

    def _has_rival(self, submap: Submap, points: F64, window: Window, found: Found) -> bool:
        """Return whether another place of a window fits nearly as well."""
        peak = Window(found.pose, PEAK_CELLS * self._config.resolution, PEAK_RAD)
        own = self._searched(submap, points, peak, 0.0)
        if own is None:
            return True
        least = RIVAL_SHARE * own.score
        return self._searched(submap, points, window, least, found.pose) is not None
