"""A vote on a lattice that does not fit into memory: tile by tile, each given away when decided.

Of each input the blocks of cells that lie under a tile travel packed, so that any process can
decide it (``fleet``). An input is laid on the tile alone, by the motion that would lay it on all of
its box: the cells are those of a vote in memory (``lattice_vote``), bit for bit.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_cells
from slamfusion.compute.layout import FIXED_ONE, MOST_INPUTS
from slamfusion.config import FusionConfig
from slamfusion.fleet import in_order
from slamfusion.fusion.groups import Members, Progress
from slamfusion.fusion.lattice_vote import Lattices, fused_box, own_box, warp_pose
from slamfusion.geometry import Pose2
from slamfusion.grid import UNKNOWN, CellBox, box_origin
from slamfusion.vote.agreement import WallCounts
from slamfusion.vote.boxes import moved, overlap, slices
from slamfusion.vote.lattice import Extent
from slamfusion.vote.tiles import (
    SMALL_TILE,
    TILE,
    DecidedTile,
    TileVoter,
    sum_counts,
    tiles_of,
    worst_place,
)

I8 = npt.NDArray[np.int8]
Result = TypeVar("Result")

# Cells on a side of the blocks in which inputs travel.
BLOCK = 512


@dataclass(frozen=True, eq=False)
class PackedBlocks:
    """Cells (H, W) int8 as they travel: in blocks, of which a tile needs some.

    Attributes:
        shape: rows and columns.
        blocks: ``BLOCK`` cells on a side, compressed, by row and column of blocks; of those that
            are not here all cells are unknown, or not needed.
    """

    shape: tuple[int, int]
    blocks: Mapping[tuple[int, int], bytes]

    @classmethod
    def of(cls, cells: I8) -> PackedBlocks:
        """Pack cells."""
        height, width = cells.shape
        blocks = {}
        for box in tiles_of(CellBox(0, 0, height, width), BLOCK):
            block = cells[slices(box, 0, 0)]
            if (block != UNKNOWN).any():
                packed = zlib.compress(block.tobytes(), 1)
                blocks[box.row0 // BLOCK, box.col0 // BLOCK] = packed
        return cls((height, width), blocks)

    def under(self, window: CellBox | None) -> PackedBlocks:
        """Return what holds the cells of a box; None: no cell."""
        if window is None:
            return replace(self, blocks={})
        rows = range(window.row0 // BLOCK, (window.row1 - 1) // BLOCK + 1)
        cols = range(window.col0 // BLOCK, (window.col1 - 1) // BLOCK + 1)
        wanted = itertools.product(rows, cols)
        return replace(self, blocks={at: self.blocks[at] for at in wanted if at in self.blocks})

    def unpack(self, window: CellBox) -> I8:
        """Return the cells of a box."""
        cells = np.full((window.height, window.width), UNKNOWN, dtype=np.int8)
        for (row, col), packed in self.under(window).blocks.items():
            row0, col0 = row * BLOCK, col * BLOCK
            row1, col1 = (
                min(at + BLOCK, end) for at, end in zip((row0, col0), self.shape, strict=True)
            )
            part = overlap(CellBox(row0, col0, row1, col1), window)
            if part is not None:
                block = np.frombuffer(zlib.decompress(packed), np.int8)
                block = block.reshape(row1 - row0, col1 - col0)
                cells[slices(part, window.row0, window.col0)] = block[slices(part, row0, col0)]
        return cells


@dataclass(frozen=True, eq=False)
class Voter:
    """An input that votes, packed.

    Attributes:
        name: of the input.
        cells: in {-1, 0, 1}.
        pose: see ``warp_pose``: of the cells that it may know.
        box: these, counted from the first fused cell; all of them where unknown is a vote.
    """

    name: str
    cells: PackedBlocks
    pose: npt.NDArray[np.int64]
    box: CellBox

    def under(self, wide: CellBox) -> Voter | None:
        """Return the input with what is laid on a box of the fused lattice; None: it is not."""
        part = overlap(self.box, wide)
        if part is None:
            return None
        window = self.window(part)
        return replace(self, cells=self.cells.under(window))

    def pose_of(self, part: CellBox) -> npt.NDArray[np.int64]:
        """Return the motion of a part of the box into the input."""
        row, col = part.row0 - self.box.row0, part.col0 - self.box.col0
        pose = self.pose.copy()
        # Positions are in half cells, and motions are linear: exact.
        pose[0, 2] += 2 * (pose[0, 0] * col - pose[0, 1] * row)
        pose[0, 3] += 2 * (pose[0, 1] * col + pose[0, 0] * row)
        return pose

    def window(self, part: CellBox) -> CellBox | None:
        """Return the cells of the input that lie under a part of the box; None without any."""
        height, width = self.cells.shape
        # Motions are linear, so what the corners read bounds what all others do.
        x2, y2 = (
            np.array([1, 2 * count - 1], dtype=np.int64) for count in (part.width, part.height)
        )
        row, col = fixed_cells(self.pose_of(part)[0], x2[np.newaxis], y2[:, np.newaxis])
        box = CellBox(int(row.min()), int(col.min()), int(row.max()) + 1, int(col.max()) + 1)
        return overlap(box, CellBox(0, 0, height, width))


@dataclass(frozen=True, eq=False)
class StoredVote:
    """A vote that is ready to be held, tile by tile.

    Attributes:
        voter: decides a tile.
        inputs: what votes.
        origin: of the first fused cell, in the reference's frame.
    """

    voter: TileVoter
    inputs: tuple[Voter, ...]
    origin: Pose2

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the fused map."""
        return self.voter.whole.height, self.voter.whole.width

    def trusting(
        self, device: ComputeDevice, executor: Executor | None, progress: Progress | None = None
    ) -> StoredVote:
        """Return the vote with the trust in its inputs; it looks at all of their walls.

        Args:
            device, executor, progress: see ``decide``.
        """
        if not self.voter.weighs:
            return self
        found = self._each(count_tile, "compare", device, executor, progress)
        return replace(self, voter=self.voter.trusting(sum_counts([counts for _, counts in found])))

    def decide(
        self, device: ComputeDevice, executor: Executor | None, progress: Progress | None = None
    ) -> Iterator[tuple[CellBox, DecidedTile]]:
        """Yield tiles of ``TILE`` cells on a side in which an input knows something.

        Args:
            device: computes, here or one like it elsewhere.
            executor: decides tiles; None: they are decided here.
            progress: told how many tiles are done.

        Raises:
            GridError: more inputs than a vote takes know one place.
        """
        for tile, decided in self._each(decide_tile, "vote", device, executor, progress):
            if decided is not None:
                yield tile, decided

    def _each(
        self,
        task: Callable[[TileVoter, CellBox, Sequence[Voter], ComputeDevice], Result],
        what: str,
        device: ComputeDevice,
        executor: Executor | None,
        progress: Progress | None,
    ) -> Iterator[tuple[CellBox, Result]]:
        """Yield what a task makes of each tile."""
        tiles = _along_a_curve(self.voter.tiles(TILE))
        calls = ((self.voter, tile, self._under(tile), device) for tile in tiles)
        for done, made in enumerate(in_order(executor, task, calls)):
            yield tiles[done], made
            if progress is not None:
                progress(what, done + 1, len(tiles))

    def _under(self, tile: CellBox) -> list[Voter]:
        """Return the inputs with what a tile needs of them."""
        here = (item.under(self.voter.reading(tile)) for item in self.inputs)
        return [item for item in here if item is not None]


def prepare_stored_vote(group: Members, lattices: Lattices, config: FusionConfig) -> StoredVote:
    """Pack the inputs of a vote, and find the cells that it decides.

    Args:
        group: those that vote.
        lattices: gives each of them at the common resolution; one is in memory at a time.
        config: settings of the vote.
    """
    extents: dict[str, Extent] = {}
    packed: dict[str, PackedBlocks] = {}
    for name in group.alignments:
        grid = lattices(name)
        extents[name], packed[name] = grid.extent, PackedBlocks.of(grid.cells)
    lattice = extents[group.reference].lattice
    box = fused_box(group, extents.__getitem__, config)
    whole = CellBox(0, 0, box.height, box.width)
    first = (box.row0, box.col0)
    voter = TileVoter(whole, config.vote, lattice.resolution, tuple(extents), first)
    inputs = []
    for name, cells in packed.items():
        own = own_box(extents[name], name, group, lattice, box, voter)
        if own is None:
            continue
        pose = warp_pose(extents[name].lattice, group.alignments[name].transform, lattice, own)
        inputs.append(Voter(name, cells, pose, moved(own, -box.row0, -box.col0)))
    return StoredVote(voter, tuple(inputs), box_origin(lattice.origin, lattice.resolution, box))


def _along_a_curve(tiles: Iterable[CellBox]) -> list[CellBox]:
    """Return tiles in an order in which those that follow each other are near (Morton's)."""

    def place(tile: CellBox) -> int:
        row, col = tile.row0 // TILE, tile.col0 // TILE
        bits = range(max(row, col).bit_length())
        return sum(((row >> n & 1) << (2 * n + 1)) | ((col >> n & 1) << (2 * n)) for n in bits)

    return sorted(tiles, key=place)


# --- where tiles are decided -----------------------------------------------------------------


def count_tile(
    voter: TileVoter, tile: CellBox, inputs: Sequence[Voter], device: ComputeDevice
) -> WallCounts:
    """Count how the walls of inputs agree in a tile; see ``TileVoter.count``."""
    return sum_counts(
        voter.count(part, _shown(voter, part, inputs, device)) for part in _parts(tile, inputs)
    )


def decide_tile(
    voter: TileVoter, tile: CellBox, inputs: Sequence[Voter], device: ComputeDevice
) -> DecidedTile | None:
    """Decide a tile; None where no input knows any cell of it."""
    fused = np.full((tile.height, tile.width), UNKNOWN, dtype=np.int8)
    agreement = np.full_like(fused, UNKNOWN)
    phantom_cells = 0
    worst: dict[str, tuple[int, int, int]] = {}
    is_known = False
    for part in _parts(tile, inputs):
        decided = voter.decide(part, _shown(voter, part, inputs, device), device)
        if decided is not None:
            window = slices(part, tile.row0, tile.col0)
            fused[window], agreement[window] = decided.fused, decided.agreement
            phantom_cells += decided.phantom_cells
            worst |= {
                name: worst_place([place, worst.get(name, place)])
                for name, place in decided.worst.items()
            }
            is_known = True
    return DecidedTile(fused, agreement, phantom_cells, worst=worst) if is_known else None


def _parts(tile: CellBox, inputs: Sequence[Voter]) -> Iterator[CellBox]:
    """Yield the tile, or smaller ones where not all inputs that know something may vote at once."""
    side = TILE if len(inputs) <= MOST_INPUTS else SMALL_TILE
    yield from tiles_of(tile, side)


def _shown(
    voter: TileVoter, tile: CellBox, inputs: Sequence[Voter], device: ComputeDevice
) -> dict[str, npt.NDArray[Any]]:
    """Return what those inputs show around a tile that may know a cell there."""
    around = voter.around(tile)

    def read(item: Voter, box: CellBox) -> I8:
        out = np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
        part = overlap(item.box, box)
        if part is not None:
            out[slices(part, box.row0, box.col0)] = _laid(item.cells, item, part, device)
        return out

    return {
        item.name: voter.prepare(around, partial(read, item))
        for item in inputs
        if overlap(item.box, around) is not None
    }


def _laid(packed: PackedBlocks, voter: Voter, part: CellBox, device: ComputeDevice) -> I8:
    """Return cells on a part of the box that they were to be laid on."""
    window = voter.window(part)
    if window is None:
        return np.full((part.height, part.width), UNKNOWN, dtype=np.int8)
    pose = voter.pose_of(part)
    pose[0, 2:] -= 2 * FIXED_ONE * np.array([window.col0, window.row0])
    cells = device.upload(packed.unpack(window))
    warped = device.warp(cells, pose, (part.height, part.width), UNKNOWN)
    return np.array(device.download(warped)[0])
