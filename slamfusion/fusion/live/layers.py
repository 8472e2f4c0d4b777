"""``Layer``: the cells of one input on its own lattice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.align.normalize import pool_cells
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.compute.layout import FIXED_ONE
from slamfusion.config import NormalizeConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import UNKNOWN, CellBox, OccupancyGrid
from slamfusion.vote.boxes import overlap, padded, slices
from slamfusion.vote.lattice import SAME_RESOLUTION, Lattice

I8 = npt.NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class Layer:
    """Cells on a lattice of their own frame.

    Attributes:
        cells: (H, W) int8, -1 unknown, 0..100 percent.
        lattice: on which they lie.
        row, col: the lattice's indices of ``cells[0, 0]``.
    """

    cells: I8
    lattice: Lattice
    row: int = 0
    col: int = 0

    @property
    def box(self) -> CellBox:
        """The cells of the lattice that it covers."""
        height, width = self.cells.shape
        return CellBox(self.row, self.col, self.row + height, self.col + width)

    def window(self, box: CellBox) -> I8:
        """Return the cells of a box of the lattice; unknown outside of the layer."""
        common = overlap(box, self.box)
        if common == box:
            return self.cells[slices(box, self.row, self.col)]
        out = np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
        if common is not None:
            out[slices(common, box.row0, box.col0)] = self.cells[slices(common, self.row, self.col)]
        return out


def lay_out(
    grid: OccupancyGrid,
    lattice: Lattice | None,
    resolution: float,
    thresholds: NormalizeConfig,
    device: ComputeDevice,
) -> Layer:
    """Return a grid as a layer of cells of the given size.

    Args:
        grid: the map.
        lattice: where this input's cells lay before; None for a new input. A grid that lies on
            none of its cells starts a lattice of its own.
        resolution: metres per cell of the layer.
        thresholds: what makes a wall, where cells are joined.
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
        return Layer(grid.cells, fused, row, col)
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
    return Layer(np.ascontiguousarray(fine), fused, box.row0, box.col0)


def carry(
    layer: Layer, transform: Pose2, lattice: Lattice, box: CellBox, device: ComputeDevice
) -> I8:
    """Return a box of a lattice as a layer sees it, nearest cell, unknown outside.

    The motion is rounded once for cell [0, 0] of both lattices and then moved by whole cells: a
    cell gets the same answer whatever box it is asked with, and however the layer grew.

    Args:
        layer: the cells, of the lattice's resolution.
        transform: maps the layer's frame into the lattice's, metres.
        lattice: onto which.
        box: cells of the lattice; the answer is (height, width) int8.
    """
    away = transform.inverse()
    into = layer.lattice.origin.inverse().compose(away).compose(lattice.origin)
    size = lattice.resolution
    pose = fixed_poses((into.x / size, into.y / size, into.yaw_rad))[0]
    cos, sin = int(pose[0]), int(pose[1])
    source = layer.lattice.box_of(box, lattice, away)
    needed = overlap(padded(source, 2), layer.box)
    if needed is None:
        return np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
    pose[2] += 2 * (cos * box.col0 - sin * box.row0 - FIXED_ONE * needed.col0)
    pose[3] += 2 * (sin * box.col0 + cos * box.row0 - FIXED_ONE * needed.row0)
    cells = device.upload(np.ascontiguousarray(layer.window(needed)))
    warped = device.warp(cells, pose[None], (box.height, box.width), UNKNOWN)
    return np.asarray(device.download(warped)[0])
