"""tinySLAM [H16]: one map, a Monte-Carlo matcher, and cells that average what they are told.

Each scan is matched against the whole map, starting from odometry, and then written into it. Two
maps are kept cell by cell: the valley, with the blur around every hit, in which the matcher finds
its way, and the published one, where a hit is one cell and what lies behind it stays unknown.

Sources: Steux and El Hamzaoui, tinySLAM, ICARCV 2010; Huletski, Kartashov and Krinkin, [H16].
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.cell_means import ScanRule
from slamfusion.compute.layout import (
    BEAM_ONE,
    MEAN_BITS,
    MEAN_HALF,
    MOST_OBSERVATIONS,
    QUALITY_SHIFT,
    UNSEEN,
    VALUE_ONE,
)
from slamfusion.config import CellModel, TinySlamConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import F64, I8, U32, Pose2, pose_of
from slamfusion.grid import UNKNOWN, OccupancyGrid
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import BLIND, Health, Series, Step
from slamfusion.slam.common.matcher import FieldMap, PoseHypothesis
from slamfusion.slam.common.state import Rows
from slamfusion.slam.common.tile_map import TileMap, known_part
from slamfusion.slam.common.tracking import Tracker
from slamfusion.trajectory import Trajectory

# Factor on the quality of a scan that the matcher moved far.
QUALITY_MOVED = 0.5
# Mean value, 0 to 1, from which a cell is published as occupied.
OCCUPIED_SHARE = 0.3
# Value, 0 to 1, of a cell that nothing is known of: as likely a wall as free.
UNKNOWN_VALUE = 0.5


def cell_value(model: CellModel, observations: Sequence[float], quality: float) -> float:
    """Return a cell's value, 0 to 1, after observations of one quality.

    ``base``, tinySLAM's own model, moves the value by a share, ``m <- (1 - q) m + q v``: what came
    last counts most. ``mean`` is the mean of ``0.5 + (v - 0.5) q``: the order does not matter, and
    an observation of low quality says little.

    Args:
        observations: 0 free to 1 occupied, in order.
        quality: q, 0 to 1.

    Source: [H16], the base and the modified cell.
    """
    value = UNKNOWN_VALUE
    for count, told in enumerate(observations, start=1):
        if model == "base":
            value = (1.0 - quality) * value + quality * told
        else:
            value += (UNKNOWN_VALUE + (told - UNKNOWN_VALUE) * quality - value) / count
    return value


def area_behind(offset_x: npt.ArrayLike, offset_y: npt.ArrayLike, angle_rad: npt.ArrayLike) -> F64:
    """Return the share of a cell that lies behind a hit: the wall's part of it.

    The wall is taken to stand at the hit, normal to the beam; what of the unit square is farther
    along the beam is wall. All arguments broadcast.

    Returns:
        float64 shares, 0 to 1: exact areas.

    Source: [H16], the dynamic occupancy estimator.
    """
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    # Along the beam a point of the square lies at x cos + y sin: the sum of two uniform spreads
    # of widths |cos| and |sin|. The area beyond a distance is the tail of that trapezium.
    distance = np.asarray(offset_x) * cos + np.asarray(offset_y) * sin
    long, short = np.maximum(np.abs(cos), np.abs(sin)), np.minimum(np.abs(cos), np.abs(sin))
    away = np.abs(distance)
    flat = 0.5 - away / long
    left = np.maximum(0.5 * (long + short) - away, 0.0)
    corner = left**2 / np.maximum(2.0 * long * short, np.finfo(np.float64).tiny)
    tail = np.where(away <= 0.5 * (long - short), flat, corner)
    return np.asarray(np.where(distance < 0.0, 1.0 - tail, tail), dtype=np.float64)


# Value, 0 to 1, of an observation by a beam that ends in a cell and by one that passes it: [H16],
# Table II.
OCCUPIED_VALUE, FREE_VALUE = 0.95, 0.01
# Default weight of an observation by cell model: the mean weighs by number, the base cell would
# otherwise follow the last beam alone.
DEFAULT_QUALITY = {"mean": 1.0, "base": 0.3}
# Occupied share of a hit's cell on average, by estimator: a hit lies anywhere in its cell.
HIT_SHARE = {"constant": 1.0, "area": 0.5}
# Share of the range from a passed cell's value to a wall's above which the matcher sees a wall:
# cells that a few beams grazed are none.
FLOOR_SHARE = 0.2
# Value of a passed cell in the matcher's map.
MATCHER_FREE_VALUE = 0.2
# Wall value, of 255, of an unknown cell: with 0 a scan into new space would be pulled back to
# where the robot has been.
UNSEEN_WALL = 20
# Distance of a match from its first hypothesis, in spreads, above which the scan weighs less: match
# or odometry is wrong more often there.
FAR_MOVED = 2.0
# Published percent at no wall, at the free limit, at the occupied one (those of the map servers),
# and at a sure wall.
PERCENTS = (0.0, 25.0, 65.0, 100.0)
# Share of ``OCCUPIED_SHARE`` at the free limit: cells in between are published as unclear.
FREE_SHARE = 0.5


class TinySlam:
    """tinySLAM behind the ``Mapper`` protocol."""

    name = "tinyslam"

    def __init__(self, config: TinySlamConfig, device: ComputeDevice, seed: int = 0) -> None:
        self.health = Health()
        self._config = config
        rng = np.random.default_rng(seed)
        self._tracker = Tracker(config.matcher, device, rng, self.health, doubts_young_map=True)
        self._map = TileMap(
            device,
            {
                "observed": (np.uint32, 0),
                "valley": (np.uint32, UNSEEN),
                "published": (np.uint32, UNSEEN),
                "field": (np.uint8, UNSEEN_WALL),
            },
        )
        self._rules = [_scan_rule(config, weight) for weight in (1.0, QUALITY_MOVED)]
        # Corner of a cell, (2,) metres, to which the map's cells are aligned.
        self._anchor = np.zeros(2)
        # Stamp and pose of each scan.
        self._path = Rows(4)
        self._mapped = 0

    # -- the protocol --------------------------------------------------------------------------

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        """Match a scan and integrate it into the map; see ``Mapper.feed``."""
        self.health.scans += 1
        hypotheses = self._tracker.hypotheses(scan.stamp_s, odometry)
        if self._tracker.pose is None:  # the lattice of cells is that of the map frame
            cell = self._config.resolution
            self._anchor = np.floor(hypotheses[0].pose[:2] / cell) * cell
        points = scan.points(scan.is_hit(self._config.usable_range_m))
        if len(points) == 0:
            self.health.skips.add(BLIND, self.health.scans)
            step = Step(pose_of(hypotheses[0].pose), used=False, match_score=None, reason=BLIND)
        else:
            step = self._use(scan, points, hypotheses)
        self._tracker.advance(step.pose_map_base, odometry, scan.stamp_s)
        pose = step.pose_map_base
        self._path.append(scan.stamp_s, pose.x, pose.y, pose.yaw_rad)
        return step

    def trajectory(self) -> Trajectory:
        """Return the pose at every scan, as it was found."""
        rows = self._path.array()
        return Trajectory(rows[:, 0], rows[:, 1:], self.name)

    def other_paths(self) -> tuple[Trajectory, ...]:
        """Return nothing: the method has one path."""
        return ()

    def series(self) -> tuple[Series, ...]:
        """Return nothing."""
        return ()

    def grid(self) -> OccupancyGrid:
        """Return the published map; see ``Mapper.grid``."""
        if not self._mapped:
            raise SlamFusionError(f"{self.name}: no scan could be used, so there is no map")
        percent, first = self._map.made(_percent, np.int8, ("published",))
        return known_part(percent, self._anchor, first, self._config.resolution, self.name)

    def memory_bytes(self) -> int:
        """Return the bytes of the map."""
        return self._map.memory_bytes

    # -- one scan ------------------------------------------------------------------------------

    def _use(self, scan: LaserScan, points: F64, hypotheses: list[PoseHypothesis]) -> Step:
        match = self._tracker.match(self._walls(), points, hypotheses) if self._mapped else None
        pose = pose_of(hypotheses[0].pose if match is None else match.pose)
        is_far = match is not None and match.moved > FAR_MOVED
        self._integrate(scan, points, pose, self._rules[is_far])
        self.health.scans_used += 1
        return Step(pose, used=True, match_score=None if match is None else match.score)

    def _walls(self) -> FieldMap:
        """Return the map as the matcher sees it."""
        cell, tiles = self._config.resolution, self._map
        corner = self._anchor / cell + tiles.origin
        return FieldMap(tiles.window, corner, cell)

    # -- the map -------------------------------------------------------------------------------

    def _integrate(self, scan: LaserScan, points: F64, pose: Pose2, rule: ScanRule) -> None:
        self._mapped += 1
        cell = self._config.resolution
        hits = (pose.transform(points) - self._anchor) / cell
        at = pose.compose(scan.mount)
        laser = (at.x - self._anchor[0]) / cell, (at.y - self._anchor[1]) / cell
        away = hits - laser
        ridge: F64 | int = round(OCCUPIED_VALUE * VALUE_ONE)
        if self._config.occupancy_estimator == "area":
            offset = hits - np.floor(hits) - 0.5
            angle = np.arctan2(away[:, 1], away[:, 0])
            share = area_behind(offset[:, 0], offset[:, 1], angle)
            told = FREE_VALUE + (OCCUPIED_VALUE - FREE_VALUE) * share
            ridge = np.rint(told * VALUE_ONE)
        length = np.hypot(away[:, 0], away[:, 1]) * BEAM_ONE
        self._map.write(hits, laser, rule, length, ridge)


def _scan_rule(config: TinySlamConfig, weight: float) -> ScanRule:
    """Return how a scan of a weight, 0 to 1, writes into the map."""
    quality = config.quality or DEFAULT_QUALITY[config.cell_model]
    # The expected value of a wall's cells.
    share = HIT_SHARE[config.occupancy_estimator]
    peak = FREE_VALUE + share * (OCCUPIED_VALUE - FREE_VALUE)
    floor = MATCHER_FREE_VALUE + FLOOR_SHARE * (peak - MATCHER_FREE_VALUE)
    return ScanRule(
        half_blur=round(0.5 * config.hole_width_m / config.resolution * BEAM_ONE),
        behind=(VALUE_ONE + 1) // 2,
        free=round(MATCHER_FREE_VALUE * VALUE_ONE),
        map_free=round(FREE_VALUE * VALUE_ONE),
        quality=round(weight * quality * (1 << QUALITY_SHIFT)),
        is_mean=config.cell_model == "mean",
        wall_floor=round(floor * (1 << MEAN_BITS)),
        wall_gain=round(255.0 / (peak - floor)),
    )


def _percent(states: U32) -> I8:
    """Return published states as occupancy in percent.

    The percent rises with the cell's mean: ``OCCUPIED_SHARE`` maps to 65 and half of it to 25, the
    limits of the map servers, so a wall that some beams grazed stays a wall.
    """
    percent = np.full(states.shape, UNKNOWN, dtype=np.int8)
    is_seen = states & MOST_OBSERVATIONS != 0
    mean = (states[is_seen] >> 12) / (2 * MEAN_HALF)
    limits = (0.0, FREE_SHARE * OCCUPIED_SHARE, OCCUPIED_SHARE, 1.0)
    percent[is_seen] = np.rint(np.interp(mean, limits, PERCENTS))
    return percent
