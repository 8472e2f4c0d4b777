"""``Layer``: the cells of one input on its own lattice, and ``Change``: what a new map changed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from slamfusion.align.decide import WALLS_MIN
from slamfusion.align.normalize import pool_cells
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.compute.layout import FIXED_ONE
from slamfusion.config import NormalizeConfig
from slamfusion.geometry import I8, Pose2
from slamfusion.grid import UNKNOWN, CellBox, OccupancyGrid, known_box
from slamfusion.vote.lattice import SAME_RESOLUTION, Lattice

# Share of the old walls.
STANDING_MIN = 0.4
# Cells in which nothing lies, that a box of changes may hold for each cell of the two maps.
SPARE_SHARE = 4
NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Layer:
    """Cells on a lattice of their own frame.

    Attributes:
        cells: (H, W) int8, -1 unknown, 0..100 percent.
        lattice: on which they lie.
        box: the cells of the lattice that they are.
        known: cells of the lattice that hold every known one; None: none.
        walls: wall cells.
    """

    cells: I8
    lattice: Lattice
    box: CellBox
    known: CellBox | None
    walls: int

    @classmethod
    def of(
        cls, cells: I8, lattice: Lattice, thresholds: NormalizeConfig, row: int = 0, col: int = 0
    ) -> Layer:
        """Measure cells whose first has these indices on the lattice."""
        own = known_box(cells)
        known = None if own is None else own.moved(row, col)
        walls = int(np.count_nonzero(cells >= math.ceil(thresholds.occupied_percent)))
        return cls(cells, lattice, CellBox(0, 0, *cells.shape).moved(row, col), known, walls)

    def window(self, box: CellBox) -> I8:
        """Return the cells of a box of the lattice; unknown outside of the layer."""
        if box.overlap(self.box) == box:
            return self.cells[box.slices(self.box)]
        return box.cut(self.cells, self.box, UNKNOWN)


def lay_out(
    grid: OccupancyGrid,
    lattice: Lattice | None,
    resolution: float,
    thresholds: NormalizeConfig,
    device: ComputeDevice,
) -> Layer:
    """Return a grid as a layer of cells of the given size.

    Args:
        lattice: where this input's cells lay before; None for a new input. A grid that lies on
            none of its cells starts a lattice of its own.
        resolution: metres per cell of the layer.
        device: resamples. The nearest cell, or where the layer is coarser any wall in a cell.
    """
    own = Lattice(grid.resolution, grid.origin)
    if lattice is not None:
        before = Lattice(grid.resolution, lattice.origin)
        own = before if before.cell_of(grid) is not None else own
    row, col = own.cell_of(grid) or (0, 0)
    fused = Lattice(resolution, own.origin)
    ratio = resolution / grid.resolution
    if abs(ratio - 1.0) < SAME_RESOLUTION:
        return Layer.of(grid.cells, fused, thresholds, row, col)
    parts = max(1, int(np.ceil(ratio - 1e-9)))
    box = fused.box_of(CellBox(row, col, row + grid.height, col + grid.width), own, Pose2())
    scale = round(ratio / parts * FIXED_ONE)
    shift_x = 2 * (scale * box.col0 * parts - FIXED_ONE * col)
    shift_y = 2 * (scale * box.row0 * parts - FIXED_ONE * row)
    poses = np.array([[scale, 0, shift_x, shift_y]], dtype=np.int64)
    shape = (box.height * parts, box.width * parts)
    fine = device.download(device.warp(device.upload(grid.cells), poses, shape, UNKNOWN))[0]
    if parts > 1:
        fine = pool_cells(fine.reshape(box.height, parts, box.width, parts), thresholds)
    return Layer.of(np.ascontiguousarray(fine), fused, thresholds, box.row0, box.col0)


def carry(
    layer: Layer, transform: Pose2, lattice: Lattice, box: CellBox, device: ComputeDevice
) -> I8:
    """Return a box of a lattice from a layer, (height, width) int8, unknown outside.

    The motion, in metres, is rounded once for cell [0, 0] of both lattices and then moved by whole
    cells: a cell does not depend on the requested box, nor on how the layer grew.
    """
    away = transform.inverse()
    into = layer.lattice.origin.inverse().compose(away).compose(lattice.origin)
    size = lattice.resolution
    pose = fixed_poses((into.x / size, into.y / size, into.yaw_rad))[0]
    cos, sin = int(pose[0]), int(pose[1])
    source = layer.lattice.box_of(box, lattice, away)
    needed = source.padded(2).overlap(layer.box)
    if needed is None:
        return np.full(box.shape, UNKNOWN, dtype=np.int8)
    pose[2] += 2 * (cos * box.col0 - sin * box.row0 - FIXED_ONE * needed.col0)
    pose[3] += 2 * (sin * box.col0 + cos * box.row0 - FIXED_ONE * needed.row0)
    cells = device.upload(np.ascontiguousarray(layer.window(needed)))
    warped = device.warp(cells, pose[None], box.shape, UNKNOWN)
    return np.asarray(device.download(warped)[0])


@dataclass(frozen=True)
class Change:
    """What a new map changed.

    Attributes:
        box: cells of the lattice that hold every cell that differs; None where none does.
        walls: cells that became or ceased to be a wall.
        standing: old wall cells with a wall within one cell.
        contradicted: old wall cells that are free now, no wall within one cell.
        before: all old wall cells.
    """

    box: CellBox | None
    walls: int
    standing: int
    contradicted: int
    before: int

    def is_steady(self, share: float) -> bool:
        """Whether enough old walls still stand that the map's frame did not move.

        ``share`` is of the walls that are wall or free now; a few that stand by chance do not count
        if most became unknown.
        """
        judged = self.standing + self.contradicted
        is_enough = self.standing >= max(WALLS_MIN, STANDING_MIN * self.before)
        return is_enough and self.standing >= share * judged


def compare(old: Layer, new: Layer, thresholds: NormalizeConfig, device: ComputeDevice) -> Change:
    """Compare two maps of one input; one on another lattice is resampled and counts as changed."""
    walls = old.walls
    occupied = math.ceil(thresholds.occupied_percent)
    box = old.box
    if new.lattice == old.lattice:
        box = old.box.hull(new.box)
        # Of maps 10 km apart the cells between them would take gigabytes.
        if box.area <= SPARE_SHARE * (old.box.area + new.box.area):
            differs = known_box((old.window(box) != new.window(box)).view(np.int8) - np.int8(1))
            if differs is None:
                return Change(None, 0, walls, 0, walls)
            box = differs.moved(box.row0, box.col0)
        near = box.padded(1)
        if near.area > SPARE_SHARE * (old.box.area + new.box.area):
            return Change(box, walls + new.walls, 0, 0, walls)  # nothing stands
        before, after = old.window(near), new.window(near)
    else:
        before, after = old.cells, carry(new, Pose2(), old.lattice, old.box, device)
    was, now = (before >= occupied).view(np.uint8), (after >= occupied).view(np.uint8)
    gone = (was != 0) & (cv2.dilate(now, NEIGHBOURS) == 0)
    free = (after >= 0) & (after <= thresholds.free_percent)
    return Change(
        box,
        int(np.count_nonzero(was != now)),
        walls - int(np.count_nonzero(gone)),
        int(np.count_nonzero(gone & free)),
        walls,
    )
