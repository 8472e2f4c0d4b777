"""``ParticleMaps``: a map for each particle, of cells that count hits and visits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.hit_counts import BeamScan, FieldRule
from slamfusion.compute.layout import MOST_BEAMS
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.slam.common.hit_cells import halve_counts, percent_of_counts
from slamfusion.slam.common.matcher import FieldMap, pose_table
from slamfusion.slam.common.shared_tiles import SharedTileMaps
from slamfusion.slam.common.state import Stateful
from slamfusion.slam.gmapping.beams import Beams

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

# Share of a cell's beams that ended in it from which on the matcher takes it for a wall; the
# published map asks for ``occ_thresh``.
MATCHER_SHARE = 0.1
# Entries of the score field's table by squared distance.
TABLE_STEPS = 256
# Beams of a scan that are mapped at most, what a cell can count at once: of more every second
# (third, ...) is.
MOST_MAPPED = MOST_BEAMS
# Share of ``memory_budget`` that the maps may hold before particles are resampled for it: a scan
# may still add as much as the rest.
BUDGET_SHARE = 0.8
BYTES_PER_MB = 1e6


class ParticleMaps(Stateful):
    """Maps of N particles on tiles that they share until one writes.

    Attributes:
        anchor: (2,) x and y in the map frame, metres, of the cells' lattice.
        tiles: counts of hits and visits, sums of the hits' places, and the score field.
    """

    STATE = ("anchor", "tiles")

    def __init__(self, config: Any, device: ComputeDevice, count: int) -> None:
        """Start empty.

        Args:
            config: a ``GmappingConfig`` with nothing left open.
            device: where the maps live.
            count: N.
        """
        self.anchor = np.zeros(2)
        pools = {"counts": np.uint32, "sums": np.uint32, "field": np.uint8}
        self.tiles = SharedTileMaps(device, count, pools)
        self._config = config
        self._device = device
        self._field_rule = self._make_field_rule()

    @property
    def field(self) -> DeviceArray[Any]:
        """Score field of all maps, on the device."""
        return self.tiles.pools["field"]

    @property
    def corner(self) -> F64:
        """Lower-left corner of the window in the map frame, (2,) x and y in cells."""
        return np.asarray(self.anchor / self._config.delta + self.tiles.origin)

    @property
    def is_over_budget(self) -> bool:
        """Whether the maps hold nearly all of ``memory_budget``, if there is one."""
        budget = BUDGET_SHARE * self._config.memory_budget * BYTES_PER_MB
        return bool(0.0 < budget < self.tiles.used_bytes)

    def begin_at(self, place: F64) -> None:
        """Lay the cells so that their lattice is the map frame's, near a place (2,), metres."""
        cell = self._config.delta
        self.anchor = np.floor(place / cell) * cell

    def walls(self, index: int) -> FieldMap:
        """Return one particle's map as the matcher sees it."""
        return FieldMap(self.field, self.tiles.page_table(index), self.corner, self._config.delta)

    def grid(self, index: int, name: str) -> OccupancyGrid:
        """Return one particle's map as it is published."""
        counts, first = self.tiles.cells("counts", index)
        cell = self._config.delta
        corner = self.anchor + first * cell
        origin = Pose2(float(corner[0]), float(corner[1]))
        percent = percent_of_counts(counts.astype(np.uint32), self._config.occ_thresh)
        grid = OccupancyGrid(percent, cell, origin, name)
        box = grid.known_box()
        return grid if box is None else grid.crop(box)

    def integrate(self, beams: Beams, poses: F64, alive: I64) -> None:
        """Integrate a scan into the maps of some particles.

        Args:
            beams: of the scan.
            poses: (N, 3) of all particles.
            alive: indices of those that write.
        """
        config, maps, device = self._config, self.tiles, self._device
        cell = config.delta
        every = -(-len(beams.ends) // MOST_MAPPED)
        ends, is_hit, laser = beams.ends[::every], beams.is_hit[::every], beams.laser
        reach = float(np.hypot(*np.vstack((ends, laser)).T).max()) / cell + config.kernelSize + 1.0
        at = (poses - (*self.anchor, 0.0))[alive] / (cell, cell, 1.0)
        maps.cover(at[:, :2].min(axis=0) - reach, at[:, :2].max(axis=0) + reach)
        table = pose_table(at, 1.0, maps.origin)
        scan = BeamScan(
            (ends / cell).astype(np.float32), is_hit, (laser / cell).astype(np.float32), table
        )
        pages = maps.page_tables_of(alive)
        written = np.zeros(maps.pages.shape, dtype=np.bool_)
        written[alive] = device.touch_pages(pages, scan, config.kernelSize)
        maps.make_writable(written)
        pages, pools = maps.page_tables_of(alive), maps.pools
        if device.count_beams(pools["counts"], pools["sums"], pages, scan):
            halve_counts(device, pools)
        device.settle_field(
            pools["counts"], pools["sums"], pools["field"], pages, scan, self._field_rule
        )

    def _make_field_rule(self) -> FieldRule:
        """Return how the score field follows from the counts."""
        config = self._config
        # No occupied cell within reach is farther than this, in (1/256 cell)^2.
        farthest = 2.0 * ((config.kernelSize + 0.5) * 256.0) ** 2
        shift = max(0, math.ceil(math.log2(farthest / TABLE_STEPS)))
        squared_m2 = np.arange(TABLE_STEPS) * 2.0**shift / 65536.0 * config.delta**2
        return FieldRule(
            table=np.rint(255.0 * np.exp(-squared_m2 / config.sigma)).astype(np.uint8),
            shift=shift,
            reach=config.kernelSize,
            occupied=round(MATCHER_SHARE * 65536),
            least_hits=1,
        )
