"""A vote on a lattice that does not fit into memory: tile by tile, each given away when decided.

Of each input the blocks of cells that lie under a tile travel packed, so that any process can
decide it (``fleet``). An input is laid on the tile alone, by the motion that would lay it on all of
its box: the cells are those of a vote in memory (``lattice_vote``), bit for bit.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_cells
from slamfusion.compute.layout import FIXED_ONE, MOST_INPUTS
from slamfusion.config import FusionConfig
from slamfusion.errors import ConfigError
from slamfusion.fleet import Scheduler, Task
from slamfusion.fleet.packed import Kept, Packed, pack
from slamfusion.fleet.worker import worker_device
from slamfusion.fusion.ballot import Ballot, DecidedTile, Laid
from slamfusion.fusion.boxes import moved, overlap, slices
from slamfusion.fusion.groups import Members, Progress
from slamfusion.fusion.lattice import Extent
from slamfusion.fusion.lattice_vote import (
    SMALL_TILE,
    TILE,
    Lattices,
    fused_box,
    own_box,
    tiles_of,
    warp_pose,
)
from slamfusion.geometry import Pose2
from slamfusion.grid import UNKNOWN, CellBox, box_origin

__all__ = ["StoredVote", "Voter", "prepare_stored_vote"]

I8 = npt.NDArray[np.int8]

# Tiles for each of the scheduler's slots that are handed over or wait to be written.
AHEAD = 2
# Cells on a side of the blocks in which inputs travel.
BLOCK = 512
# Bytes of blocks that a process keeps unpacked: those under the tiles around the last one.
KEPT_BYTES = 1 << 26


@dataclass(frozen=True, eq=False)
class PackedBlocks:
    """Cells (H, W) int8 as they travel: in blocks, of which a tile needs some.

    Attributes:
        shape: rows and columns.
        blocks: ``BLOCK`` cells on a side, by row and column of blocks; of those that are not here
            all cells are unknown, or nobody asks for them.
    """

    shape: tuple[int, int]
    blocks: Mapping[tuple[int, int], Packed[I8]]

    @classmethod
    def of(cls, cells: I8) -> PackedBlocks:
        """Pack cells."""
        height, width = cells.shape
        blocks = {}
        for box in tiles_of(CellBox(0, 0, height, width), BLOCK):
            block = np.ascontiguousarray(cells[slices(box, 0, 0)])
            if (block != UNKNOWN).any():
                blocks[box.row0 // BLOCK, box.col0 // BLOCK] = pack(block)
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
            block = _KEPT.get(packed.key, packed.unpack)
            height, width = block.shape
            row0, col0 = row * BLOCK, col * BLOCK
            part = overlap(CellBox(row0, col0, row0 + height, col0 + width), window)
            if part is not None:
                cells[slices(part, window.row0, window.col0)] = block[slices(part, row0, col0)]
        _KEPT.shrink()
        return cells


@dataclass(frozen=True, eq=False)
class Voter:
    """An input that votes, packed.

    Attributes:
        name: of the input.
        cells: in {-1, 0, 1}.
        percents: the same in percent, where these vote.
        pose: see ``warp_pose``: of the cells that it may know.
        box: these, counted from the first fused cell; all of them where unknown is a vote.
    """

    name: str
    cells: PackedBlocks
    percents: PackedBlocks | None
    pose: npt.NDArray[np.int64]
    box: CellBox

    def under(self, wide: CellBox) -> Voter | None:
        """Return the input with what is laid on a box of the fused lattice; None: it is not."""
        part = overlap(self.box, wide)
        if part is None:
            return None
        window = self.window(part)
        percents = None if self.percents is None else self.percents.under(window)
        return replace(self, cells=self.cells.under(window), percents=percents)

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
        ballot: what decides a tile.
        voters: the inputs that vote.
        origin: of the first fused cell, in the reference's frame.
    """

    ballot: Ballot
    voters: tuple[Voter, ...]
    origin: Pose2

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the fused map."""
        return self.ballot.whole.height, self.ballot.whole.width

    def decide(
        self, scheduler: Scheduler, progress: Progress | None = None
    ) -> Iterator[tuple[CellBox, DecidedTile]]:
        """Yield tiles of ``TILE`` cells on a side in which an input knows something.

        Args:
            scheduler: decides them.
            progress: told how many tiles are done.

        Raises:
            FleetError: those that do the tasks are gone.
            GridError: more inputs than a vote takes know one place.
        """
        tiles = list(_along_a_curve(tiles_of(self.ballot.whole, TILE)))
        waiting: OrderedDict[CellBox, Task[DecidedTile | None]] = OrderedDict()
        rest = iter(tiles)
        for done in range(len(tiles)):
            for tile in rest:
                waiting[tile] = self._hand_over(tile, scheduler)
                if len(waiting) >= AHEAD * scheduler.slots:
                    break
            tile, task = waiting.popitem(last=False)
            decided = task.result()
            if decided is not None:
                yield tile, decided
            if progress is not None:
                progress("vote", done + 1, len(tiles))

    def _hand_over(self, tile: CellBox, scheduler: Scheduler) -> Task[DecidedTile | None]:
        wide = self.ballot.around(tile)
        laid = (item.under(wide) for item in self.voters)
        here = [item for item in laid if item is not None]
        return scheduler.submit(decide_tile, self.ballot, tile, here, scheduler.device)


def prepare_stored_vote(group: Members, lattices: Lattices, config: FusionConfig) -> StoredVote:
    """Pack the inputs of a vote, and find the cells that it decides.

    Args:
        group: those that vote.
        lattices: gives each of them at the common resolution; one is in memory at a time.
        config: settings of the vote.

    Raises:
        ConfigError: the mode weighs each input by all of its cells.
    """
    if config.vote.mode == "weighted":
        message = (
            "mode 'weighted' weighs maps by all of their cells, and tiles are decided alone; take "
            "majority, consensus or log-odds"
        )
        raise ConfigError(message)
    extents: dict[str, Extent] = {}
    packed: dict[str, tuple[PackedBlocks, PackedBlocks | None]] = {}
    for name in group.alignments:
        grid = lattices(name)
        percents = PackedBlocks.of(grid.grid.cells) if config.vote.mode == "log-odds" else None
        extents[name], packed[name] = grid.extent, (PackedBlocks.of(grid.cells), percents)
    lattice = extents[group.reference].lattice
    box = fused_box(group, extents.__getitem__, config)
    voters = []
    for name, (cells, percents) in packed.items():
        own = own_box(extents[name], name, group, lattice, box, config)
        if own is None:
            continue
        pose = warp_pose(extents[name].lattice, group.alignments[name].transform, lattice, own)
        voters.append(Voter(name, cells, percents, pose, moved(own, -box.row0, -box.col0)))
    whole = CellBox(0, 0, box.height, box.width)
    ballot = Ballot(whole, config, lattice.resolution, dict.fromkeys(extents, 1.0))
    origin = box_origin(lattice.origin, lattice.resolution, box)
    return StoredVote(ballot, tuple(voters), origin)


def _along_a_curve(tiles: Iterator[CellBox]) -> list[CellBox]:
    """Return tiles in an order in which those that follow each other are near (Morton's)."""

    def place(tile: CellBox) -> int:
        row, col = tile.row0 // TILE, tile.col0 // TILE
        bits = range(max(row, col).bit_length())
        return sum(((row >> n & 1) << (2 * n + 1)) | ((col >> n & 1) << (2 * n)) for n in bits)

    return sorted(tiles, key=place)


# --- where tiles are decided -----------------------------------------------------------------


def decide_tile(
    ballot: Ballot, tile: CellBox, voters: Sequence[Voter], device: str
) -> DecidedTile | None:
    """Decide a tile; None where no input knows any cell of it.

    Where more inputs than a vote takes know something in the tile, it is decided in smaller ones.
    """
    opened = worker_device(device)
    if len(voters) <= MOST_INPUTS:
        return ballot.decide(tile, _laid_on(ballot.around(tile), voters, opened), opened)
    fused = np.full((tile.height, tile.width), UNKNOWN, dtype=np.int8)
    agreement = np.full_like(fused, UNKNOWN)
    phantom_cells, is_known = 0, False
    for part in tiles_of(tile, SMALL_TILE):
        decided = ballot.decide(part, _laid_on(ballot.around(part), voters, opened), opened)
        if decided is not None:
            window = slices(part, tile.row0, tile.col0)
            fused[window], agreement[window] = decided.fused, decided.agreement
            phantom_cells += decided.phantom_cells
            is_known = True
    return DecidedTile(fused, agreement, phantom_cells) if is_known else None


def _laid_on(wide: CellBox, voters: Sequence[Voter], device: ComputeDevice) -> dict[str, Laid]:
    """Lay those inputs on a box of the fused lattice that may know a cell of it."""
    layers = {}
    for voter in voters:
        part = overlap(voter.box, wide)
        if part is None:
            continue
        codes = _laid(voter.cells, voter, part, device)
        percents = None
        if voter.percents is not None:
            percents = _laid(voter.percents, voter, part, device)
        layers[voter.name] = Laid(part, codes, percents)
    return layers


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


def _bytes_of(cells: I8) -> int:
    return cells.nbytes


# The blocks that were laid last, unpacked.
_KEPT: Kept[I8] = Kept(_bytes_of, KEPT_BYTES)
