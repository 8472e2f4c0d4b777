"""The map of a graph's scans at the poses of today, redrawn only where poses moved.

Every cell counts its hits and all beams that cross it; see ``BeamCounts``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.compute.hit_counts import percent_of_counts
from slamfusion.config import GraphConfig
from slamfusion.geometry import F32, F64, Pose2
from slamfusion.grid import OccupancyGrid, known_box
from slamfusion.slam.common.beam_counts import BeamCounts, Beams
from slamfusion.slam.common.mapper import MapJob

# Parts of a cell, and of a radian, to which a pose is rounded: smaller motions are not redrawn.
PLACE_PARTS, YAW_PARTS = 8.0, 2048.0
# Scans that are counted at once: the memory does not grow with the drive.
PART = 256


@dataclass(frozen=True, eq=False)
class Node:
    """A scan in the graph, and the odometry of its pose if known.

    Attributes:
        ends: (B, 2) float32 hits in the robot's frame, metres.
        laser: (2,) float32, the laser in the robot's frame, metres.
        travelled_m: distance travelled up to here.
    """

    ends: F32
    laser: F32
    travelled_m: float
    odometry: Pose2 | None

    def points(self) -> F64:
        """Return the (B, 2) hits in the robot's frame, metres."""
        return self.ends.astype(np.float64)


class NodeMap:
    """Draws maps of one graph, one after another."""

    def __init__(self, config: GraphConfig, device: ComputeDevice) -> None:
        self._config = config
        self._counts = BeamCounts(device)
        # Poses in parts of a cell and of a radian, from the cell of the first node.
        self._drawn: F64 = np.zeros((0, 3))

    @property
    def memory_bytes(self) -> int:
        """Bytes of the map."""
        return self._counts.memory_bytes

    def draw(self, job: MapJob) -> OccupancyGrid:
        """Return the map of a graph that has grown or moved since the last call."""
        cell = self._config.resolution
        parts = np.array([PLACE_PARTS / cell, PLACE_PARTS / cell, YAW_PARTS])
        anchor = np.floor(job.poses[0, :2] / cell)
        wanted = np.rint((job.poses - (*(anchor * cell), 0.0)) * parts)
        drawn, self._drawn = self._drawn, wanted
        moved = np.flatnonzero((wanted[: len(drawn)] != drawn).any(axis=1))
        fresh = np.concatenate((moved, np.arange(len(drawn), len(wanted))))
        for chosen, poses, sign in ((moved, drawn, -1), (fresh, wanted, 1)):
            for first in range(0, len(chosen), PART):
                some = chosen[first : first + PART]
                beams = Beams.of([job.nodes[i] for i in some], poses[some] / parts, cell)
                ends = self._counts.place(beams) if sign > 0 else self._counts.ends(beams)
                self._counts.count(beams, ends, sign)
        rule = self._config.occupancy_threshold, self._config.min_pass_through
        percent, corner = self._counts.cells(
            lambda hits, visits: percent_of_counts(hits, visits, *rule), np.int8
        )
        # Cropped in whole cells: the origin does not depend on the window.
        box = known_box(percent)
        if box is not None:
            percent = percent[box.row0 : box.row1, box.col0 : box.col1]
            corner = corner + np.array((box.col0, box.row0))
        origin = Pose2(*(float(v) for v in (corner + anchor) * cell))
        return OccupancyGrid(percent, cell, origin, job.name)
