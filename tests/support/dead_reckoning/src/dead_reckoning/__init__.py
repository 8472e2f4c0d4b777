"""Dead reckoning as a producer for SLAMfusion: scans are drawn where the odometry says they are.

What no beam passed is unknown, what a beam passed is free, where it ended is occupied.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.config import Checked, option
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.scan import LaserScan
from slamfusion.slam import Health, Step
from slamfusion.slam.common.mapper import Series
from slamfusion.slam.registry import Producer
from slamfusion.trajectory import Trajectory

__all__ = ["PRODUCER", "DeadReckoning", "DeadReckoningConfig"]

NAME = "dead_reckoning"
# Bytes that a kept hit takes: two numbers of float64.
HIT_BYTES = 16


@dataclass(frozen=True)
class DeadReckoningConfig(Checked):
    """Settings of dead reckoning."""

    resolution: float = option(0.05, "cell size of the map", unit="m", low=0.005, high=1.0)
    usable_range_m: float = option(
        30.0, "longer readings are not used", unit="m", low=0.1, high=1000.0
    )


class DeadReckoning:
    """A mapper that believes the odometry; without it the robot stands still."""

    name = NAME

    def __init__(self, config: DeadReckoningConfig, device: ComputeDevice, seed: int = 0) -> None:
        """Start without a map; nothing here needs the device or a draw."""
        del device, seed
        self._config = config
        self._health = Health()
        self._stamps_s: list[float] = []
        self._poses: list[tuple[float, float, float]] = []
        # Of each used scan: the laser's place and its hits, metres in the map frame.
        self._seen: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]] = []

    @property
    def health(self) -> Health:
        """The record so far."""
        return self._health

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        """Take the next scan."""
        last = Pose2(*self._poses[-1]) if self._poses else Pose2()
        pose = odometry or last
        self._stamps_s.append(scan.stamp_s)
        self._poses.append((pose.x, pose.y, pose.yaw_rad))
        self._health.scans += 1
        hits = scan.points(scan.is_hit(self._config.usable_range_m))
        if not len(hits):
            reason = "no reading within the usable range"
            self._health.skips.add(reason, self._health.scans)
            return Step(pose, used=False, match_score=None, reason=reason)
        self._health.scans_used += 1
        laser = pose.transform((scan.mount.x, scan.mount.y))
        self._seen.append((np.asarray(laser), pose.transform(hits)))
        return Step(pose, used=True, match_score=None)

    def trajectory(self) -> Trajectory:
        """Return the odometry."""
        return Trajectory(np.array(self._stamps_s), np.array(self._poses), self.name)

    def other_paths(self) -> tuple[Trajectory, ...]:
        """Return none."""
        return ()

    def series(self) -> tuple[Series, ...]:
        """Return none."""
        return ()

    def grid(self) -> OccupancyGrid:
        """Draw the map.

        Raises:
            SlamFusionError: no scan could be used.
        """
        if not self._seen:
            raise SlamFusionError(f"{self.name}: no scan could be used, so there is no map")
        cell = self._config.resolution
        points = np.concatenate([np.vstack((laser, hits)) for laser, hits in self._seen])
        low = np.floor(points.min(axis=0) / cell) - 1.0
        width, height = (np.floor(points.max(axis=0) / cell) - low + 2.0).astype(int).tolist()
        cells = np.full((height, width), UNKNOWN, dtype=np.int8)
        ends = []
        for laser, hits in self._seen:
            start = np.floor(laser / cell - low).astype(int).tolist()
            stops = np.floor(hits / cell - low).astype(int)
            for stop in stops.tolist():
                cv2.line(cells.view(np.uint8), start, stop, FREE)
            ends.append(stops)
        hit = np.concatenate(ends)
        cells[hit[:, 1], hit[:, 0]] = OCCUPIED
        x_m, y_m = (low * cell).tolist()
        return OccupancyGrid(cells, cell, Pose2(x_m, y_m), self.name)

    def memory_bytes(self) -> int:
        """Return the bytes of the hits that are kept."""
        return HIT_BYTES * sum(len(hits) for _, hits in self._seen)


def _beats(config: DeadReckoningConfig) -> float:
    """Return seconds between two published maps: drawing takes longer on finer cells."""
    return math.ceil(0.05 / config.resolution)


PRODUCER = Producer(
    name=NAME,
    summary="dead reckoning: scans drawn where the odometry says they are",
    config=DeadReckoningConfig(),
    make=DeadReckoning,
    cost=0.2,
    map_interval_s=_beats,
)
