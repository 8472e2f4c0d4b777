"""The map of a graph's scans at the poses of today, redrawn only where poses moved.

Every cell counts its hits and all beams that cross it. Counts are whole numbers
and positions are rounded to a lattice that does not depend on the map's size, so a scan can be
subtracted and counted elsewhere: the map is bit for bit the same as one drawn from scratch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.hit_counts import BeamScan, halve_counts, percent_of_counts
from slamfusion.compute.layout import MOST_BEAMS
from slamfusion.config import GraphConfig
from slamfusion.geometry import F64, Pose2, corners
from slamfusion.grid import OccupancyGrid, known_box
from slamfusion.slam.common.mapper import MapJob
from slamfusion.slam.common.tile_map import SharedTileMaps

# Parts of a cell, and of a radian, to which a pose is rounded: smaller motions are not redrawn.
PLACE_PARTS, YAW_PARTS = 8.0, 2048.0
# Parts of a cell to which points are rounded, as in the kernel.
POINT_PARTS = 1024.0
# Distance from the window's corner, cells, within which float32 is exact.
EXACT_CELLS = 1 << 14


@dataclass(frozen=True, eq=False)
class Node:
    """A scan in the graph, and the odometry of its pose if known.

    Attributes:
        ends: (B, 2) float32 hits in the robot's frame, metres.
        laser: (2,) float32, the laser in the robot's frame, metres.
        travelled_m: distance travelled up to here.
    """

    ends: npt.NDArray[np.float32]
    laser: npt.NDArray[np.float32]
    travelled_m: float
    odometry: Pose2 | None

    def points(self) -> F64:
        """Return the (B, 2) hits in the robot's frame, metres."""
        return self.ends.astype(np.float64)


class NodeMap:
    """Draws maps of one graph, one after another."""

    def __init__(self, config: GraphConfig, device: ComputeDevice) -> None:
        self._config = config
        self._device = device
        self._maps = self._empty()
        # Poses in parts of a cell and of a radian, from the cell of the first node.
        self._drawn: F64 = np.zeros((0, 3))
        # Whether counts can be subtracted exactly.
        self._is_exact = True

    @property
    def memory_bytes(self) -> int:
        """Bytes of the map."""
        return self._maps.memory_bytes

    def draw(self, job: MapJob) -> OccupancyGrid:
        """Return the map of a graph that has grown or moved since the last call."""
        cell = self._config.resolution
        anchor = np.floor(job.poses[0, :2] / cell)
        wanted = np.rint(
            (job.poses - (*(anchor * cell), 0.0))
            * (PLACE_PARTS / cell, PLACE_PARTS / cell, YAW_PARTS)
        )
        known = len(self._drawn)
        moved = np.flatnonzero((wanted[:known] != self._drawn).any(axis=1))
        if len(moved) and not self._is_exact:
            self._maps, self._is_exact = self._empty(), True
            known, moved = 0, moved[:0]
        for index in moved.tolist():
            self._count(job.nodes[index], self._drawn[index], take_back=True)
        for index in (*moved.tolist(), *range(known, len(job.nodes))):
            self._count(job.nodes[index], wanted[index])
        self._drawn = wanted
        counts, first = self._maps.cells("counts", 0)
        percent = percent_of_counts(
            counts.astype(np.uint32),
            self._config.occupancy_threshold,
            self._config.min_pass_through,
        )
        # Cropped in whole cells: the origin does not depend on the window.
        box = known_box(percent)
        if box is not None:
            percent = percent[box.row0 : box.row1, box.col0 : box.col1]
            first = first + np.array((box.col0, box.row0))
        origin = Pose2(*(float(v) for v in (first + anchor) * cell))
        return OccupancyGrid(percent, cell, origin, job.name)

    def _empty(self) -> SharedTileMaps:
        return SharedTileMaps(self._device, 1, {"counts": np.uint32, "sums": np.uint32})

    def _count(self, node: Node, rounded: F64, *, take_back: bool = False) -> None:
        """Add a node's counts at a rounded pose (3,), or subtract them."""
        cell, maps = self._config.resolution, self._maps
        x, y, yaw = (float(v) for v in rounded / (PLACE_PARTS, PLACE_PARTS, YAW_PARTS))
        cos, sin = math.cos(yaw), math.sin(yaw)
        every = -(-len(node.ends) // MOST_BEAMS)
        places = np.vstack((node.laser[None], node.ends[::every])).astype(np.float64) / cell
        places = places @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
        places = np.rint(places * POINT_PARTS) / POINT_PARTS
        low, high = corners(places)
        maps.cover(low - 1.0, high + 1.0)
        inside = (places - maps.origin).astype(np.float32)
        self._is_exact = self._is_exact and float(inside.max()) < EXACT_CELLS
        here = np.array([[0.0, 0.0, 1.0, 0.0]], dtype=np.float32)
        beams = BeamScan(inside[1:], np.ones(len(inside) - 1, dtype=np.uint8), inside[0], here)
        pages = maps.page_tables
        maps.make_writable(self._device.touch_pages(pages, beams, 0).astype(np.bool_))
        pools = maps.pools
        if self._device.count_beams(
            pools["counts"], pools["sums"], maps.page_tables, beams, take_back=take_back
        ):
            halve_counts(self._device, pools)
            self._is_exact = False
