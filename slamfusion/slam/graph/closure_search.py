"""Loop closures: an old submap is searched for a new scan, and what is found is doubted.

A scan is searched near where it is expected, or over a whole window by branch and bound [H16c], or
over all of the submap where nothing is expected. What is found must fit about as well as scans
usually do, must not lie where the submap has seen nothing, must not be open along a corridor, and
where the window is wide there must be no other place that fits nearly as well. One that would move
the robot by more than a little waits until others say the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from slamfusion.compute.backend import Backend
from slamfusion.config import GraphConfig
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.slam.common.matcher import PoseHypothesis, ScanOnTiles, Spread, search_pose
from slamfusion.slam.common.response import response_information
from slamfusion.slam.graph.constraints import Constraint
from slamfusion.slam.graph.submap import UNSEEN_WALL, Submap
from slamfusion.slam.graph.window_search import WindowMatch, search_window

__all__ = ["ClosureSearch", "Found", "How", "Waiting", "WaitingRoom"]

F64 = npt.NDArray[np.float64]
# How a place was looked for: where the graph has the robot; where odometry has one that was lost;
# all over.
How = Literal["known", "odometry", "anywhere"]

# Beyond this drift the whole window is searched.
LOCAL_DRIFT_M = 0.8
# What is expected of the heading: radians, fixed and for a metre of drift.
TURN_RAD, TURN_RAD_PER_M = 0.05, 0.1
# Of a scan's hits so many may lie where the older submap has seen nothing; fewer where the robot
# may be anywhere.
MOST_UNSEEN = 0.6
MOST_UNSEEN_ANYWHERE = 0.3
# A closure must fit about as well as scans usually do.
USUAL_SHARE = 0.75
USUAL_SHARE_ANYWHERE = 0.85
# The window finds cells; what the fine search then finds fits better.
WINDOW_SHARE = 0.8
# Another place that fits this share as well makes a closure worth nothing; it is looked for this
# far beyond what is expected.
RIVAL_SHARE = 0.93
RIVAL_TIMES, RIVAL_M = 1.5, 0.5
# Where a scan is found no farther than this from where it was expected, nothing else is looked for
# unless the window is wide.
NEWS_M, NEWS_RAD = 0.2, 0.05
# Around the robot's places in a submap from where its walls can be seen too, metres.
AROUND_M = 1.0
# A closure that moves the robot by more is believed when others say the same.
SMALL_STEP_M, SMALL_STEP_RAD = 0.4, 0.1
AGREEMENT_M, AGREEMENT_RAD = 0.3, 0.05
PENDING_NODES = 12
# What it takes to believe closures that move the robot, by how it was looked for: nodes that agree,
# how far it has driven between them, and for how many nodes they wait. For those found anywhere see
# ``slamfusion.slam.graph.relocalization``.
TRUST: dict[str, tuple[int, float, int]] = {
    "known": (2, 0.0, 12),
    "odometry": (3, 0.8, 12),
}
# Where the robot may be by a jump between two scans.
JUMP_M, JUMP_RAD = 1.5, 0.8
# A bad match is where it is expected up to this.
EXPECTED_M, EXPECTED_RAD = 0.4, 0.12


@dataclass(frozen=True, eq=False)
class Found:
    """Where a scan lies in a submap.

    Attributes:
        pose: (3,) of the robot in the submap's frame, metres and radians.
        information: (3, 3) inverse covariance of it.
    """

    pose: F64
    information: F64


@dataclass(frozen=True, eq=False)
class _Window:
    """Poses that are searched.

    Attributes:
        centre: (3,) in the submap's frame, metres and radians.
        half_m: how far x and y reach from there.
        half_rad: how far the yaw does.
    """

    centre: F64
    half_m: float
    half_rad: float


class ClosureSearch:
    """Looks for scans in old submaps."""

    def __init__(self, config: GraphConfig, backend: Backend, rng: np.random.Generator) -> None:
        """Take the settings, the place of the maps, and where the search draws from."""
        self._config = config
        self._backend = backend
        self._rng = rng
        # A window search ends within a cell of the place: half of the climbs find it from there.
        climbers = max(1, config.matcher.climbers // 2)
        self._after_window = replace(config.matcher, climbers=climbers)

    def near(
        self, submap: Submap, points: F64, expected: F64, drift_m: float, usual: float
    ) -> Found | str:
        """Search where the robot is expected.

        Args:
            submap: an old one, finished.
            points: (P, 2) hits in the robot's frame, metres.
            expected: (3,) pose in the submap's frame.
            drift_m: how far off that may be.
            usual: what a match is worth lately.

        Returns:
            Where it lies, or why that is not known, in the words of the health record.
        """
        config = self._config
        least = max(config.loop_match_minimum_response, USUAL_SHARE * usual)
        turn = min(config.coarse_search_angle_offset, TURN_RAD + TURN_RAD_PER_M * drift_m)
        if drift_m <= LOCAL_DRIFT_M:
            guess = PoseHypothesis(expected, Spread(max(drift_m / 2.0, 0.15), turn / 2.0))
            found = self._fine(submap, points, guess, least, MOST_UNSEEN)
            if isinstance(found, Found) and _is_news(expected, found.pose):
                window = _Window(expected, RIVAL_TIMES * drift_m + RIVAL_M, turn)
                if self._rival(submap, points, window, found):
                    return "two places fit"
            return found
        most = config.loop_search_space_dimension / 2.0
        half_m = min(drift_m, most)
        wider = min(RIVAL_TIMES * half_m + RIVAL_M, most)
        windows = (_Window(expected, half_m, turn), _Window(expected, wider, turn))
        return self._only_place(submap, points, windows, least, MOST_UNSEEN)

    def anywhere(self, submap: Submap, points: F64, usual: float) -> Found | str:
        """Search all of a submap, for a robot that is lost; see ``near``."""
        least = max(self._config.loop_match_minimum_response, USUAL_SHARE_ANYWHERE * usual)
        middle = np.array([*(0.5 * (submap.low + submap.high)), 0.0])
        half_m = 0.5 * float((submap.high - submap.low).max()) + AROUND_M
        everything = _Window(middle, half_m, math.pi)
        return self._only_place(
            submap, points, (everything, everything), least, MOST_UNSEEN_ANYWHERE
        )

    def around(
        self, submap: Submap, points: F64, guess: F64, usual: float, *, by_odometry: bool
    ) -> tuple[F64, bool]:
        """Search the growing submap far around a guess for a robot that the tracker may have lost.

        Args:
            submap: the growing one.
            points: (P, 2) hits in the robot's frame, metres.
            guess: (3,) pose in the submap's frame.
            usual: what a match is worth lately.
            by_odometry: whether the guess is more than that the robot goes on as it went.

        Returns:
            A pose (3,), and whether it may be trusted: the scan fits there as usual and nowhere
            else nearly as well; or it fits badly, but best where it is expected: then the world
            has changed, not the place.
        """
        window = _Window(guess, JUMP_M, JUMP_RAD)
        best = self._searched(submap, points, window, 0.0)
        if best is None:
            return guess, False
        coarse = best.pose
        least = USUAL_SHARE_ANYWHERE * usual
        found = self._fine(submap, points, _around(coarse), least, MOST_UNSEEN, by_window=True)
        if isinstance(found, Found):
            if self._rival(submap, points, window, found):
                return guess, False
            return found.pose, True
        if not by_odometry:
            return coarse, False
        away = np.hypot(*(coarse - guess)[:2])
        turn = abs(wrap_angle(float(coarse[2] - guess[2])))
        return guess, bool(away <= EXPECTED_M and turn <= EXPECTED_RAD)

    def _only_place(
        self,
        submap: Submap,
        points: F64,
        windows: tuple[_Window, _Window],
        least: float,
        most_unseen: float,
    ) -> Found | str:
        """Search the first window, judge what is found, and look for a rival in the second."""
        best = self._searched(submap, points, windows[0], WINDOW_SHARE * least)
        if best is None:
            return "low response"
        found = self._fine(submap, points, _around(best.pose), least, most_unseen, by_window=True)
        if isinstance(found, Found) and self._rival(submap, points, windows[1], found):
            return "two places fit"
        return found

    def _fine(
        self,
        submap: Submap,
        points: F64,
        hypothesis: PoseHypothesis,
        least: float,
        most_unseen: float,
        *,
        by_window: bool = False,
    ) -> Found | str:
        """Search around a guess, of a window search or not, and judge what is found."""
        config = self._config
        scan = ScanOnTiles(self._backend, submap.walls(), points, config.matcher.beams)
        matcher = self._after_window if by_window else config.matcher
        match = search_pose(scan, [hypothesis], matcher, self._rng)
        unseen = scan.unseen_share(match.pose, UNSEEN_WALL)
        if unseen > most_unseen:
            return "little in common"
        if (match.score - unseen * UNSEEN_WALL / 255.0) / (1.0 - unseen) < least:
            return "low response"
        information = response_information(scan, match.pose)
        variance = float(np.linalg.eigvalsh(np.linalg.inv(information)[:2, :2]).max())
        if variance > config.loop_match_maximum_variance:
            return "place left open"
        return Found(match.pose, information)

    def _searched(
        self,
        submap: Submap,
        points: F64,
        window: _Window,
        least: float,
        beside: F64 | None = None,
    ) -> WindowMatch | None:
        """Return the best of a window, not ``beside`` a pose (3,); None where nothing fits."""
        every = -(-len(points) // self._config.matcher.beams)
        return search_window(
            self._backend,
            submap.pyramid(),
            points[::every],
            window.centre,
            half_m=window.half_m,
            half_rad=window.half_rad,
            resolution=self._config.resolution,
            least=least,
            beside=beside,
        )

    def _rival(self, submap: Submap, points: F64, window: _Window, found: Found) -> bool:
        """Return whether another place of a window fits nearly as well."""
        peak = _Window(found.pose, 2.0 * self._config.resolution, 0.02)
        own = self._searched(submap, points, peak, 0.0)
        if own is None:
            return True
        least = RIVAL_SHARE * own.score
        return self._searched(submap, points, window, least, found.pose) is not None


@dataclass(frozen=True, eq=False)
class Waiting:
    """A closure that is not believed yet.

    Attributes:
        edge: what it says.
        correction: what it would do to the robot's pose in the map frame.
        travelled_m: the robot's way up to it.
        how: it was looked for.
    """

    edge: Constraint
    correction: Pose2
    travelled_m: float
    how: How


class WaitingRoom:
    """Closures that wait for others to say the same.

    Attributes:
        pending: the ones of the last nodes.
    """

    def __init__(self) -> None:
        self.pending: list[Waiting] = []

    def confirmed(self, closure: Waiting, pose: Pose2) -> list[Waiting]:
        """Return the closures that may be believed now, this one among them; often none.

        Args:
            closure: a new one.
            pose: of its node in the map frame, before any correction.
        """
        number = closure.edge.end
        moved = closure.correction.compose(pose)
        self.pending = [c for c in self.pending if number - c.edge.end <= TRUST[c.how][2]]
        if closure.how == "known" and _is_small(pose, moved):
            return [closure]
        earlier = [c for c in self.pending if c.edge.end != number]
        agreeing = [c for c in earlier if _agree(c, moved, pose)]
        self.pending.append(closure)
        wanted, way_m, _ = TRUST[closure.how]
        nodes = {c.edge.end for c in agreeing}
        driven_m = closure.travelled_m - min((c.travelled_m for c in agreeing), default=math.inf)
        if len(nodes) + 1 < wanted or driven_m < way_m:
            return []
        if closure.how != "known" and len(earlier) - len(agreeing) >= len(nodes):
            return []
        self.pending = []
        return [closure, *agreeing]


def _is_news(expected: F64, found: F64) -> bool:
    """Return whether a scan lies elsewhere than the graph has it, poses (3,)."""
    away = found - expected
    return bool(np.hypot(away[0], away[1]) > NEWS_M or abs(wrap_angle(float(away[2]))) > NEWS_RAD)


def _around(coarse: F64) -> PoseHypothesis:
    """Return where the fine search looks around what a window has found."""
    return PoseHypothesis(coarse, Spread(0.1, 0.02))


def _is_small(pose: Pose2, moved: Pose2) -> bool:
    """Return whether a closure leaves the robot about where it was believed to be."""
    way = math.hypot(moved.x - pose.x, moved.y - pose.y)
    return way <= SMALL_STEP_M and abs(wrap_angle(moved.yaw_rad - pose.yaw_rad)) <= SMALL_STEP_RAD


def _agree(closure: Waiting, moved: Pose2, pose: Pose2) -> bool:
    """Return whether a closure would move the robot to the same place."""
    other = closure.correction.compose(pose)
    away = math.hypot(other.x - moved.x, other.y - moved.y)
    return away < AGREEMENT_M and abs(wrap_angle(other.yaw_rad - moved.yaw_rad)) < AGREEMENT_RAD
