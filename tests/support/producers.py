"""A producer that believes its odometry, and scans for it: what runs a producer is tested so."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from slamfusion.config import LogConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.io.log import LogScan, ScanLog
from slamfusion.scan import LaserScan
from slamfusion.slam.common.mapper import Health, Series, Step
from slamfusion.trajectory import Trajectory

BEAMS = 720


class DeadReckoning:
    """A ``Mapper`` that marks hits where odometry says they are."""

    name = "dead-reckoning"

    def __init__(self, scores: dict[int, float] | None = None) -> None:
        """Match scores by number of the scan, from 0; the others are 0.8."""
        self.scores = scores or {}
        self.health = Health(mean_match_score=0.8)
        self.rows: list[tuple[float, float, float, float]] = []
        self.hit_counts: list[int] = []
        self.hits: list[np.ndarray] = []

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        pose = odometry or Pose2()
        self.health.scans += 1
        self.rows.append((scan.stamp_s, pose.x, pose.y, pose.yaw_rad))
        self.hit_counts.append(int(scan.is_hit().sum()))
        if not scan.is_hit().any():
            self.health.skips.add("nothing seen", self.health.scans)
            return Step(pose, used=False, match_score=None, reason="nothing seen")
        self.health.scans_used += 1
        self.hits.append(pose.transform(scan.points()))
        score = self.scores.get(self.health.scans - 1, 0.8)
        self.health.low_scores += score < 0.4
        return Step(pose, used=True, match_score=score)

    def trajectory(self) -> Trajectory:
        table = np.array(self.rows)
        return Trajectory(table[:, 0], table[:, 1:], self.name)

    def other_paths(self) -> tuple[Trajectory, ...]:
        """The same path, a metre and two metres beside."""
        table = np.array(self.rows)
        return tuple(
            Trajectory(table[:, 0], table[:, 1:] + (0.0, beside_m, 0.0), f"beside {beside_m:g} m")
            for beside_m in (1.0, 2.0)
        )

    def series(self) -> tuple[Series, ...]:
        """How many beams hit something."""
        stamps, counts = np.array(self.rows)[:, 0], np.array(self.hit_counts, dtype=np.float64)
        return (Series("hits", "beams", stamps, counts, limit=100.0),)

    def grid(self) -> OccupancyGrid:
        if not self.hits:
            raise SlamFusionError("no map")
        cells = np.floor(np.concatenate(self.hits) / 0.1).astype(np.int64)
        low = cells.min(axis=0)
        width, height = cells.max(axis=0) - low + 1
        grid = np.full((height, width), UNKNOWN, dtype=np.int8)
        grid[(cells - low)[:, 1], (cells - low)[:, 0]] = OCCUPIED
        grid[grid == UNKNOWN] = FREE
        return OccupancyGrid(grid, 0.1, Pose2(*(0.1 * low)), self.name)

    def memory_bytes(self) -> int:
        return 1000 * len(self.hits)


class ResumableReckoning(DeadReckoning):
    """The same, and ``Resumable``: its file is JSON."""

    last_stamp_s: float | None = None

    def feed(self, scan: LaserScan, odometry: Pose2 | None = None) -> Step:
        self.last_stamp_s = scan.stamp_s
        return super().feed(scan, odometry)

    def save_state(self, path: Path) -> None:
        hits = [part.tolist() for part in self.hits]
        state = {"rows": self.rows, "hits": hits, "hit_counts": self.hit_counts}
        path.write_text(json.dumps(state), encoding="utf-8")

    @classmethod
    def load_state(cls, path: Path) -> ResumableReckoning:
        state = json.loads(path.read_text(encoding="utf-8"))
        made = cls()
        made.rows = [tuple(row) for row in state["rows"]]
        made.hits = [np.array(part) for part in state["hits"]]
        made.hit_counts = state["hit_counts"]
        made.health.scans, made.health.scans_used = len(made.rows), len(made.hits)
        made.last_stamp_s = made.rows[-1][0]
        return made


class ListLog(ScanLog):
    """A ``ScanLog`` over scans in memory."""

    def __init__(self, scans: list[LogScan], path: str = "drive.log") -> None:
        super().__init__(path, LogConfig())
        self.records += [(item.line, item) for item in scans]

    def __iter__(self) -> Iterator[LogScan]:
        return self._scans()


def room_scan(pose: Pose2, stamp_s: float, half_m: float = 3.0) -> LaserScan:
    """What a laser that sees all around reads in a square room around the origin."""
    angles = -math.pi + 2.0 * math.pi / BEAMS * np.arange(BEAMS) + pose.yaw_rad
    cos, sin = np.cos(angles), np.sin(angles)
    with np.errstate(divide="ignore"):
        ways = [
            np.where(cos > 0, half_m - pose.x, -half_m - pose.x) / cos,
            np.where(sin > 0, half_m - pose.y, -half_m - pose.y) / sin,
        ]
    ranges = np.min(ways, axis=0).astype(np.float32)
    return LaserScan(stamp_s, ranges, -math.pi, 2.0 * math.pi / BEAMS, 0.05, 30.0)


def room_drive(count: int) -> list[LogScan]:
    """A slow drive along x in that room, 0.05 m a scan."""
    poses = [Pose2(0.05 * index - 0.5, 0.1, 0.02 * index) for index in range(count)]
    return [
        LogScan(room_scan(pose, 0.1 * index), pose, index + 1) for index, pose in enumerate(poses)
    ]


def unseeing(scans: Iterable[LogScan]) -> list[LogScan]:
    """The same scans, from which no beam comes back."""
    return [
        replace(item, scan=replace(item.scan, ranges=np.full_like(item.scan.ranges, np.inf)))
        for item in scans
    ]
