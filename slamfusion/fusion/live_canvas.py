"""The fused canvas: one lattice that never moves, a layer for each input, and the vote.

A layer keeps an input's occupancy as the lattice sees it, so that a new map costs what it changed:
the changed cells are carried over and voted on again, everything else stays as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.compute.layout import FIXED_ONE
from slamfusion.config import FusionConfig, NormalizeConfig
from slamfusion.fusion.normalize import pool_cells
from slamfusion.fusion.pipeline import agreement_weights
from slamfusion.fusion.vote import double_reach_cells, vote_grids, vote_reach_cells
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid, trinary_cells
from slamfusion.io.memory import check_memory

__all__ = [
    "Canvas",
    "Lattice",
    "Sheet",
    "carry",
    "hull",
    "joined",
    "lay_out",
    "overlap",
    "padded",
    "slices",
]

I8 = npt.NDArray[np.int8]

# Layers, results and copies of a canvas cell, in bytes.
CANVAS_BYTES = 6
# Origins this near to a whole number of cells apart lie on one lattice.
SAME_PHASE = 1e-3
SAME_YAW_RAD = 1e-6
SAME_RESOLUTION = 1e-4
# Cells between two boxes that are sooner voted on again than left out.
SPARE_CELLS = 1 << 16
# A canvas of this many cells or more shrinks where this share of them would do.
SHRUNK_CELLS, SHRUNK_SHARE = 1 << 22, 0.25


@dataclass(frozen=True)
class Lattice:
    """Where the cells of a grid may lie; cell [0, 0] and all others, also of negative indices.

    Attributes:
        resolution: metres per cell.
        origin: pose of the lower-left corner of cell [0, 0] in its frame; metres, radians.
    """

    resolution: float
    origin: Pose2

    def corner(self, row: int, col: int) -> Pose2:
        """Return the pose of the lower-left corner of a cell in the lattice's frame."""
        if row == 0 and col == 0:
            return self.origin
        x, y = self.origin.transform((col * self.resolution, row * self.resolution))
        return Pose2(float(x), float(y), self.origin.yaw_rad)

    def cell_of(self, grid: OccupancyGrid) -> tuple[int, int] | None:
        """Return the row and column of a grid's first cell, or None when it lies on none."""
        if abs(grid.resolution / self.resolution - 1.0) > SAME_RESOLUTION:
            return None
        own = self.origin.inverse().compose(grid.origin)
        cells = np.array((own.y, own.x)) / self.resolution
        whole = np.rint(cells)
        if abs(own.yaw_rad) > SAME_YAW_RAD or np.abs(cells - whole).max() > SAME_PHASE:
            return None
        return int(whole[0]), int(whole[1])

    def box_of(self, box: CellBox, other: Lattice, transform: Pose2) -> CellBox:
        """Return the cells of this lattice that hold a box of another's.

        Args:
            box: cells of ``other``.
            other: a lattice of another frame.
            transform: maps ``other``'s frame into this one's, metres.
        """
        rows, cols = (box.row0, box.row1), (box.col0, box.col1)
        corners = np.array([(x, y) for x in cols for y in rows], dtype=np.float64)
        mapped = transform.transform(other.origin.transform(corners * other.resolution))
        own = self.origin.inverse().transform(mapped) / self.resolution
        low = np.floor(own.min(axis=0) + 1e-6).astype(int)
        high = np.ceil(own.max(axis=0) - 1e-6).astype(int)
        return CellBox(int(low[1]), int(low[0]), int(high[1]), int(high[0]))


@dataclass(frozen=True, eq=False)
class Sheet:
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
        """Return the cells of a box of the lattice; unknown outside of the sheet."""
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
) -> Sheet:
    """Return a grid as a sheet of cells of the given size.

    Args:
        grid: the map.
        lattice: where this input's cells lay before; None for a new input. A grid that lies on
            none of its cells starts a lattice of its own.
        resolution: metres per cell of the sheet.
        thresholds: what makes a wall, where cells are joined.
        device: resamples. The nearest cell, or where the sheet is coarser any wall in a cell.
    """
    own = Lattice(grid.resolution, grid.origin)
    if lattice is not None:
        before = Lattice(grid.resolution, lattice.origin)
        own = before if before.cell_of(grid) is not None else own
    row, col = own.cell_of(grid) or (0, 0)
    fused = Lattice(resolution, own.origin)
    ratio = resolution / grid.resolution
    if abs(ratio - 1.0) < SAME_RESOLUTION:
        return Sheet(grid.cells, fused, row, col)
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
    return Sheet(np.ascontiguousarray(fine), fused, box.row0, box.col0)


def carry(
    sheet: Sheet, transform: Pose2, lattice: Lattice, box: CellBox, device: ComputeDevice
) -> I8:
    """Return a box of a lattice as a sheet sees it, nearest cell, unknown outside.

    The motion is rounded once for cell [0, 0] of both lattices and then moved by whole cells: a
    cell gets the same answer whatever box it is asked with, and however the sheet grew.

    Args:
        sheet: the cells, of the lattice's resolution.
        transform: maps the sheet's frame into the lattice's, metres.
        lattice: onto which.
        box: cells of the lattice; the answer is (height, width) int8.
        device: resamples.
    """
    away = transform.inverse()
    into = sheet.lattice.origin.inverse().compose(away).compose(lattice.origin)
    size = lattice.resolution
    pose = fixed_poses((into.x / size, into.y / size, into.yaw_rad))[0]
    cos, sin = int(pose[0]), int(pose[1])
    source = sheet.lattice.box_of(box, lattice, away)
    needed = overlap(padded(source, 2), sheet.box)
    if needed is None:
        return np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
    pose[2] += 2 * (cos * box.col0 - sin * box.row0 - FIXED_ONE * needed.col0)
    pose[3] += 2 * (sin * box.col0 + cos * box.row0 - FIXED_ONE * needed.row0)
    cells = device.upload(np.ascontiguousarray(sheet.window(needed)))
    warped = device.warp(cells, pose[None], (box.height, box.width), UNKNOWN)
    return np.asarray(device.download(warped)[0])


class Canvas:
    """The fused cells, and what every input says of them.

    The canvas grows by whole cells of its lattice and never moves. It shrinks only where four times
    fewer cells would do, so that an input which leaves for a while does not change the size of what
    is published, and one that lay far away gives the memory back.

    Attributes:
        lattice: of the fused frame.
        box: cells of the lattice that are kept; None before the first ``grow``.
        phantom_cells: occupied in the fused cells, occupied in no layer that voted.
    """

    def __init__(self, lattice: Lattice, config: FusionConfig, device: ComputeDevice) -> None:
        """Start without cells; ``config`` gives the vote and its thresholds."""
        self.lattice = lattice
        self.box: CellBox | None = None
        self.phantom_cells = 0
        self._config = config
        self._device = device
        self._layers: dict[str, I8] = {}
        self._covered: dict[str, CellBox] = {}
        self._fused = np.zeros((0, 0), dtype=np.int8)
        self._agreement = self._fused
        self._trinary = trinary_cells(
            np.arange(256, dtype=np.uint8).view(np.int8), config.normalize
        ).view(np.uint8)

    def grow(self, box: CellBox, name: str) -> CellBox | None:
        """Make room for a box of the lattice; return the whole canvas where it grew.

        Args:
            box: cells of the lattice.
            name: the input that needs them.

        Raises:
            MemoryBudgetError: the grown canvas would not fit; nothing was changed.
        """
        if self.box is not None and hull(self.box, box) == self.box:
            return None
        grown = box if self.box is None else hull(self.box, box)
        room = grown.area * (CANVAS_BYTES + len(self._layers))
        check_memory(room, f"a fused map of {grown.height} x {grown.width} cells", name)
        self._fused = self._moved(self._fused, grown)
        self._agreement = self._moved(self._agreement, grown)
        self._layers = {name: self._moved(cells, grown) for name, cells in self._layers.items()}
        self.box = grown
        return grown

    def shrink(self, box: CellBox) -> CellBox | None:
        """Give back the memory of cells that nobody needs; return the whole canvas where it shrank.

        Args:
            box: cells of the lattice that the voters need.
        """
        if self.box is None or self.box.area < SHRUNK_CELLS:
            return None
        if box.area > SHRUNK_SHARE * self.box.area or hull(self.box, box) != self.box:
            return None
        self._fused = self._cut(self._fused, box)
        self._agreement = self._cut(self._agreement, box)
        self._layers = {name: self._cut(cells, box) for name, cells in self._layers.items()}
        kept = {name: overlap(covered, box) for name, covered in self._covered.items()}
        self._covered = {name: part for name, part in kept.items() if part is not None}
        self.box = box
        return box

    def _cut(self, cells: I8, box: CellBox) -> I8:
        whole = self.box
        if whole is None:
            return cells
        return cells[slices(box, whole.row0, whole.col0)].copy()

    def restore(self, box: CellBox, fused: I8, agreement: I8) -> None:
        """Begin with the cells of an earlier canvas of this lattice, which no layer is under yet.

        Args:
            box: cells of the lattice; those of the arrays.
            fused: (H, W) int8, cells -1, 0, 100, as ``grids`` gives them.
            agreement: (H, W) int8, 0..100, -1 without votes.
        """
        classes = np.array([UNKNOWN] * 256, dtype=np.int8)
        classes[FREE], classes[OCCUPIED] = 0, 1
        self._fused = np.asarray(cv2.LUT(fused.view(np.uint8), classes.view(np.uint8))).view(
            np.int8
        )
        self._agreement = agreement.copy()
        self.box = box

    def _moved(self, cells: I8, grown: CellBox) -> I8:
        out = np.full((grown.height, grown.width), UNKNOWN, dtype=np.int8)
        if self.box is not None:
            out[slices(self.box, grown.row0, grown.col0)] = cells
        return out

    def lay(
        self, name: str, sheet: Sheet, known: CellBox, transform: Pose2, changed: CellBox | None
    ) -> CellBox | None:
        """Carry an input's cells onto its layer; return the cells of the lattice that it touched.

        Args:
            name: the input.
            sheet: all of its cells.
            known: cells of the sheet's lattice that hold every known one.
            transform: maps the sheet's frame into the fused frame, metres.
            changed: cells of the sheet's lattice that differ from what was laid here before with
                the same transform and lattice; None for all.
        """
        box = self.box
        if box is None:
            message = "grow the canvas before anything is laid on it"
            raise ValueError(message)
        before = self._covered.get(name)
        if name not in self._layers:
            self._layers[name] = np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
        layer = self._layers[name]
        now = overlap(self.lattice.box_of(known, sheet.lattice, transform), box)
        if changed is None:
            target = now
            if before is not None:
                layer[slices(before, box.row0, box.col0)] = UNKNOWN
            touched = now if before is None or now is None else hull(before, now)
            touched = touched or before
        else:
            near = self.lattice.box_of(changed, sheet.lattice, transform)
            target = touched = overlap(padded(near, 1), box)
        self._covered.pop(name, None)
        if now is not None:
            self._covered[name] = now if before is None or changed is None else hull(before, now)
        if target is not None:
            layer[slices(target, box.row0, box.col0)] = carry(
                sheet, transform, self.lattice, target, self._device
            )
        return touched

    def lift(self, name: str) -> CellBox | None:
        """Take an input's layer away; return the cells that it had covered."""
        self._layers.pop(name, None)
        return self._covered.pop(name, None)

    def vote(self, names: Sequence[str], box: CellBox) -> CellBox:
        """Let the layers of some inputs vote again on a box of the lattice.

        Args:
            names: the voters, one or more, in order; each has a layer.
            box: cells of the lattice, inside the canvas. Weighted votes take the whole canvas,
                since the weights follow from all of it.

        Returns:
            The cells that were voted on.
        """
        whole = self.box
        if whole is None:
            message = "grow the canvas before its cells are voted on"
            raise ValueError(message)
        config = self._config.vote
        if config.mode == "weighted":
            box = whole
        # A wall decides what its neighbours become, and theirs are needed to say what it is.
        reach = vote_reach_cells(config, self.lattice.resolution)
        box, seen = (_grown(box, cells, whole) for cells in (reach, 2 * reach))
        window = slices(seen, whole.row0, whole.col0)
        percents = [np.ascontiguousarray(self._layers[name][window]) for name in names]
        aligned = [self._classes(cells) for cells in percents]
        weights = agreement_weights(aligned) if config.mode == "weighted" else None
        voted = vote_grids(
            aligned,
            config,
            self._device,
            weights=weights,
            percents=percents if config.mode == "log-odds" else None,
            thresholds=self._config.normalize,
            reach_cells=double_reach_cells(config, self.lattice.resolution),
        )
        window, part = slices(box, whole.row0, whole.col0), slices(box, seen.row0, seen.col0)
        self._fused[window] = voted.fused[part]
        self._agreement[window] = voted.agreement[part]
        if box == whole:
            self.phantom_cells = voted.phantom_cells
        elif voted.phantom_cells or self.phantom_cells:
            self.phantom_cells = self._count_phantoms(names)
        return box

    def _classes(self, cells: I8) -> I8:
        return np.asarray(cv2.LUT(cells.view(np.uint8), self._trinary)).view(np.int8)

    def _count_phantoms(self, names: Sequence[str]) -> int:
        """Count the fused walls of the whole canvas that were voted for and that no voter has."""
        alone = (self._fused == 1) & (self._agreement >= 0)
        for name in names:
            alone &= self._classes(self._layers[name]) != 1
        return int(np.count_nonzero(alone))

    def grids(self) -> tuple[OccupancyGrid, OccupancyGrid]:
        """Return the fused map (cells -1, 0, 100) and the agreement (0..100, -1 without votes)."""
        if self.box is None:
            message = "a canvas without cells is no map"
            raise ValueError(message)
        values = np.array([FREE, OCCUPIED] + [UNKNOWN] * 254, dtype=np.int8).view(np.uint8)
        cells = np.asarray(cv2.LUT(self._fused.view(np.uint8), values)).view(np.int8)
        agreement = self._agreement.copy()
        for array in (cells, agreement):
            array.flags.writeable = False
        origin = self.lattice.corner(self.box.row0, self.box.col0)
        size = self.lattice.resolution
        return (
            OccupancyGrid(cells, size, origin, "fused"),
            OccupancyGrid(agreement, size, origin, "agreement"),
        )


def hull(a: CellBox, b: CellBox) -> CellBox:
    """Return the smallest box that holds both."""
    return CellBox(
        min(a.row0, b.row0), min(a.col0, b.col0), max(a.row1, b.row1), max(a.col1, b.col1)
    )


def joined(boxes: Sequence[CellBox]) -> list[CellBox]:
    """Return boxes that hold all the cells of some, joined where hardly any cell lies between."""
    out: list[CellBox] = []
    for box in boxes:
        grown = box
        # A box that took another in may reach a third one.
        while True:
            near = [
                other
                for other in out
                if hull(grown, other).area <= grown.area + other.area + SPARE_CELLS
            ]
            if not near:
                break
            for other in near:
                out.remove(other)
                grown = hull(grown, other)
        out.append(grown)
    return out


def overlap(a: CellBox, b: CellBox) -> CellBox | None:
    """Return the cells of both boxes, None without any."""
    box = CellBox(
        max(a.row0, b.row0), max(a.col0, b.col0), min(a.row1, b.row1), min(a.col1, b.col1)
    )
    return box if box.row1 > box.row0 and box.col1 > box.col0 else None


def padded(box: CellBox, cells: int) -> CellBox:
    """Return the box with so many cells more on every side."""
    return CellBox(box.row0 - cells, box.col0 - cells, box.row1 + cells, box.col1 + cells)


def slices(box: CellBox, row0: int, col0: int) -> tuple[slice, slice]:
    """Return the indices of a box in an array whose first cell is (row0, col0)."""
    return (
        slice(box.row0 - row0, box.row1 - row0),
        slice(box.col0 - col0, box.col1 - col0),
    )


def _grown(box: CellBox, cells: int, whole: CellBox) -> CellBox:
    """Return a box with so many cells more on each side, inside another one."""
    return CellBox(
        max(box.row0 - cells, whole.row0),
        max(box.col0 - cells, whole.col0),
        min(box.row1 + cells, whole.row1),
        min(box.col1 + cells, whole.col1),
    )
