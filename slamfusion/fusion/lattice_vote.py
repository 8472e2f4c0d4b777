"""Resample aligned grids on one lattice and vote, tile by tile.

Only inputs that know something in a tile vote there, which lets large maps and many distant ones
fit into memory. Tiles overlap as far as a cell affects others.

The cells of each input are resampled once: as an array (``GridLayer``), or, if a vote does not fit
into memory, in compressed blocks (``PackedLayer``), which are sent to the process that decides the
tile (``fleet``).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from slamfusion.align.normalize import NormalizedGrid
from slamfusion.align.records import Bent, FusionResult, InputRecord
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_cells, fixed_poses
from slamfusion.compute.layout import FIXED_ONE, MOST_INPUTS
from slamfusion.config import FusionConfig
from slamfusion.fleet import in_order
from slamfusion.fusion.grouping import FusionSetup
from slamfusion.fusion.groups import Members
from slamfusion.geometry import I8, Pose2
from slamfusion.grid import OCCUPIED, UNKNOWN, CellBox, OccupancyGrid
from slamfusion.io.files import check_memory
from slamfusion.vote.lattice import Lattice
from slamfusion.vote.tiles import (
    AGREEING,
    SMALL_TILE,
    TILE,
    DecidedTile,
    GridLayer,
    TileVoter,
    Trust,
    WallCounts,
    second_opinion,
    sum_counts,
    worst_place,
)

Result = TypeVar("Result")

# Gives an input at the common resolution, by its name.
Lattices: TypeAlias = Callable[[str], NormalizedGrid]

# Bytes per fused cell of a vote in memory: cell and agreement, and a copy of both.
VOTED_BYTES = 4
# Side in cells of the blocks of packed inputs.
BLOCK = 512


@dataclass(frozen=True, eq=False)
class PackedLayer:
    """The cells of an input on the fused lattice, compressed to be sent to other processes.

    Attributes:
        box: cells that it may know, counted from the first fused cell.
        blocks: its cells in {-1, 0, 1}, ``BLOCK`` on a side, compressed, by row and column of
            blocks in the box; missing blocks are unknown or not needed.
    """

    box: CellBox
    blocks: Mapping[tuple[int, int], bytes]

    @classmethod
    def of(cls, box: CellBox, cells: I8) -> PackedLayer:
        """Pack the cells of a box."""
        blocks = {}
        for part in CellBox(0, 0, *cells.shape).tiles(BLOCK):
            block = cells[part.slices()]
            if (block != UNKNOWN).any():
                packed = zlib.compress(block.tobytes(), 1)
                blocks[part.row0 // BLOCK, part.col0 // BLOCK] = packed
        return cls(box, blocks)

    def inside(self, box: CellBox) -> PackedLayer:
        """Return the layer on a box of the lattice, from whose first cell its own is counted."""
        return replace(self, box=self.box.moved(-box.row0, -box.col0))

    def under(self, wide: CellBox) -> PackedLayer:
        """Return the layer with only the blocks on a box of the fused lattice."""
        return replace(self, blocks={at: self.blocks[at] for at, _ in self._meeting(wide)})

    def on(self, box: CellBox) -> I8:
        """Return its cells on a box of the fused lattice, unknown outside of its own."""
        out = np.full(box.shape, UNKNOWN, dtype=np.int8)
        for at, place in self._meeting(box):
            block = np.frombuffer(zlib.decompress(self.blocks[at]), np.int8)
            block = block.reshape(place.shape)
            part = place.overlap(box) or place
            out[part.slices(box)] = block[part.slices(place)]
        return out

    def _meeting(self, box: CellBox) -> Iterator[tuple[tuple[int, int], CellBox]]:
        """Yield each block that has cells of a box, with its own cells."""
        for row, col in self.blocks:
            square = CellBox(0, 0, BLOCK, BLOCK).moved(row * BLOCK, col * BLOCK)
            place = square.moved(self.box.row0, self.box.col0).overlap(self.box)
            if place is not None and place.overlap(box) is not None:
                yield (row, col), place


Layer: TypeAlias = GridLayer | PackedLayer


@dataclass(frozen=True, eq=False)
class LatticeVote:
    """The vote of a group, ready to run.

    Attributes:
        layers: by name of the input.
        lattice: from the first fused cell on, in the reference's frame.
        prepared: for a vote in memory with one tile, the prepared cells by name, see
            ``TileVoter.prepare``.
    """

    group: Members
    voter: TileVoter
    layers: Mapping[str, Layer]
    lattice: Lattice
    prepared: Mapping[str, npt.NDArray[Any]] | None = None

    def trusting(self, setup: FusionSetup) -> LatticeVote:
        """Return the vote with the trust in its inputs, from all of their walls."""
        if not self.voter.weighs:
            return self
        vote, whole = self, self.voter.whole
        is_small = max(whole.shape) <= TILE and len(self.layers) <= MOST_INPUTS
        if is_small and all(isinstance(layer, GridLayer) for layer in self.layers.values()):
            vote = replace(self, prepared=_shown(self.voter, whole, self.layers))
        found = vote.each(count_tile, "compare", setup)
        voter = self.voter.trusting(sum_counts([counts for _, counts in found]))
        return replace(vote, voter=voter)

    def each(
        self,
        task: Callable[[TileVoter, CellBox, Mapping[str, Any]], Result],
        what: str,
        setup: FusionSetup,
    ) -> Iterator[tuple[CellBox, Result]]:
        """Yield the result of a task for each tile of ``TILE`` cells on a side.

        Args:
            task: ``count_tile``; ``decide_tile`` or ``decide_parts`` with their device.
            what: name of the stage, for ``progress``.
        """
        tiles = list(self.voter.whole.tiles(TILE))
        calls = ((self.voter, tile, self.prepared or self._under(tile)) for tile in tiles)
        for done, made in enumerate(in_order(setup.executor, task, calls)):
            yield tiles[done], made
            if setup.progress is not None:
                setup.progress(what, done + 1, len(tiles))

    def _under(self, tile: CellBox) -> dict[str, Layer]:
        """Return the layers with the cells that a tile needs."""
        wide = self.voter.reading(tile)
        return {
            name: layer.under(wide) if isinstance(layer, PackedLayer) else layer
            for name, layer in self.layers.items()
            if self.voter.unknown_votes or layer.box.overlap(wide) is not None
        }

    def records(
        self, grids: Sequence[OccupancyGrid], others: Mapping[str, InputRecord]
    ) -> tuple[InputRecord, ...]:
        """Return the records of those that vote, and of others, in the order of the grids."""
        found = dict(others)
        for grid in grids:
            if grid.name in self.group.alignments:
                pair, layer = self.group.alignments[grid.name], self.layers.get(grid.name)
                own = layer if isinstance(layer, GridLayer) else None
                found[grid.name] = InputRecord(grid, pair, True, pair.reason, own)
        return tuple(found[grid.name] for grid in grids if grid.name in found)

    def outcome(
        self,
        inputs: tuple[InputRecord, ...],
        phantom_cells: int,
        worst: Sequence[Mapping[str, tuple[int, int, int]]],
        setup: FusionSetup,
    ) -> dict[str, Any]:
        """Return what a fusion in memory and one in a store have in common; see ``Fusion``."""
        config, trust, left_out = setup.config, self.voter.trust, {}
        if config.vote.extent != "union":
            left_out = {
                item.name: self.lattice.area_outside(
                    self.voter.whole, item.grid, item.alignment.transform, config.normalize
                )
                for item in inputs
                if item.accepted and item.alignment is not None
            }
        return {
            "reference": self.group.reference,
            "inputs": inputs,
            "phantom_cells": phantom_cells,
            "weights": self.voter.weights,
            "wall_agreement": self.voter.wall_agreement,
            "bent": bent_maps(trust, worst, self.lattice),
            "device": setup.device.name,
            "left_out_m2": {name: area for name, area in left_out.items() if area > 0.0},
        }

    def in_memory(
        self, grids: Sequence[OccupancyGrid], others: Mapping[str, InputRecord], setup: FusionSetup
    ) -> FusionResult:
        """Run the vote, and keep the fused map and the layers; see ``records``."""
        fused = np.full(self.voter.whole.shape, UNKNOWN, dtype=np.int8)
        agreement = np.full_like(fused, UNKNOWN)
        phantom_cells, worst = 0, []
        task = partial(decide_parts, device=setup.device)
        for _, decided_parts in self.each(task, "vote", setup):
            for part, decided in decided_parts:
                window = part.slices()
                fused[window], agreement[window] = decided.fused, decided.agreement
                phantom_cells += decided.phantom_cells
                worst.append(decided.worst)
                for name, is_outvoted in decided.outvoted():
                    layer = self.layers[name]
                    if isinstance(layer, GridLayer):
                        layer.note(part, is_outvoted)
        fused[fused == 1] = OCCUPIED
        # Read-only arrays are not copied again.
        fused.flags.writeable = agreement.flags.writeable = False
        inputs, lattice = self.records(grids, others), self.lattice
        return FusionResult(
            **self.outcome(inputs, phantom_cells, worst, setup),
            fused=OccupancyGrid(fused, lattice.resolution, lattice.origin, "fused"),
            agreement=OccupancyGrid(agreement, lattice.resolution, lattice.origin, "agreement"),
        )


def vote_in_memory(
    grids: Sequence[OccupancyGrid],
    groups: Sequence[Members],
    lattices: Lattices,
    others: Mapping[str, InputRecord],
    config: FusionConfig,
    device: ComputeDevice,
) -> FusionResult:
    """Let groups of aligned grids vote, and make the records.

    Args:
        grids: all inputs, in order.
        groups: of voters; the results of all but the first are its ``others``.
        others: records of the inputs that are not in the first group, by name.

    Raises:
        GridError: more inputs than a vote takes know one place.
        MemoryBudgetError: the fused map is too large for the memory that is free.
    """
    setup = FusionSetup(config, device)
    first, *more = prepare_votes(groups, lattices, setup)
    others = {**others, **contradicting(grids, groups[0], first, more)}
    result = first.in_memory(grids, others, setup)
    return replace(result, others=tuple(vote.in_memory(grids, {}, setup) for vote in more))


def prepare_votes(
    groups: Sequence[Members], lattices: Lattices, setup: FusionSetup
) -> list[LatticeVote]:
    """Resample the inputs of groups on their fused lattices, and find the trust in each.

    Returns:
        The vote of each group, or those of two parts of it that contradict each other.

    Raises:
        MemoryBudgetError: a fused map is too large for the memory that is free.
    """
    votes = []
    for group in groups:
        vote = _prepare(group, lattices, setup).trusting(setup)
        trust = vote.voter.trust
        apart = () if trust is None else second_opinion(trust)
        if apart:
            deciding = [name for name in group.alignments if name not in apart]
            parts = (group.part(deciding), group.part(apart))
            votes += prepare_votes(parts, lattices, setup)
        else:
            votes.append(vote)
    return votes


def _prepare(group: Members, lattices: Lattices, setup: FusionSetup) -> LatticeVote:
    """Prepare the vote of one group; see ``prepare_votes``."""
    config, is_stored = setup.config, setup.is_stored
    base = lattices(group.reference)
    lattice, box = base.lattice, base.box
    is_union = config.vote.extent == "union"
    laid: dict[str, Layer] = {}
    for name, pair in group.alignments.items():
        grid = base if name == group.reference else lattices(name)
        covered = grid.on(lattice, pair.transform)
        own = covered.padded(1)
        if is_union:
            box = box.hull(covered)
        else:
            own = own.overlap(box) or CellBox(box.row0, box.col0, box.row0, box.col0)
        cells = warp_onto(grid, pair.transform, lattice, own, setup.device)
        laid[name] = PackedLayer.of(own, cells) if is_stored else GridLayer(own.shape, own, cells)
    if not is_stored:
        check_memory(
            VOTED_BYTES * box.area,
            f"a fused map of {box.width} x {box.height} cells",
            group.reference,
            "free memory, use a coarser cell, or fuse into a store tile by tile (-o OUT.zarr)",
        )
    whole, first = CellBox(0, 0, *box.shape), (box.row0, box.col0)
    voter = TileVoter(whole, config.vote, lattice.resolution, tuple(laid), first)
    layers = {name: layer.inside(box) for name, layer in laid.items()}
    if voter.unknown_votes and not is_stored:
        layers = {
            name: GridLayer(whole.shape, whole, own.on(whole)) for name, own in layers.items()
        }
    return LatticeVote(group, voter, layers, Lattice(lattice.resolution, lattice.corner(*first)))


# --- where tiles are decided -----------------------------------------------------------------


def count_tile(voter: TileVoter, tile: CellBox, layers: Mapping[str, Any]) -> WallCounts:
    """Count how the walls of inputs agree in a tile; see ``TileVoter.count``."""
    return sum_counts(
        voter.count(part, _shown(voter, part, layers)) for part in _parts(tile, layers)
    )


def decide_parts(
    voter: TileVoter, tile: CellBox, layers: Mapping[str, Any], device: ComputeDevice
) -> list[tuple[CellBox, DecidedTile]]:
    """Decide a tile, in smaller ones where many inputs show something; empty where none does."""
    found = []
    for part in _parts(tile, layers):
        decided = voter.decide(part, _shown(voter, part, layers), device)
        if decided is not None:
            found.append((part, decided))
    return found


def decide_tile(
    voter: TileVoter, tile: CellBox, layers: Mapping[str, Any], device: ComputeDevice
) -> DecidedTile | None:
    """Decide a tile; None where no input knows any cell of it."""
    fused = np.full(tile.shape, UNKNOWN, dtype=np.int8)
    agreement = np.full_like(fused, UNKNOWN)
    phantom_cells, worst = 0, dict[str, tuple[int, int, int]]()
    parts = decide_parts(voter, tile, layers, device)
    for part, decided in parts:
        window = part.slices(tile)
        fused[window], agreement[window] = decided.fused, decided.agreement
        phantom_cells += decided.phantom_cells
        worst |= {
            name: worst_place([place, worst.get(name, place)])
            for name, place in decided.worst.items()
        }
    return DecidedTile(fused, agreement, phantom_cells, worst=worst) if parts else None


def _parts(tile: CellBox, layers: Mapping[str, Any]) -> Iterator[CellBox]:
    """Yield the tile, or smaller ones where not all inputs that know something may vote at once."""
    yield from tile.tiles(TILE if len(layers) <= MOST_INPUTS else SMALL_TILE)


def _shown(
    voter: TileVoter, tile: CellBox, layers: Mapping[str, Any]
) -> dict[str, npt.NDArray[Any]]:
    """Return the prepared cells of inputs that may know a cell of a tile."""
    around, found = voter.around(tile), dict[str, npt.NDArray[Any]]()
    for name, layer in layers.items():
        if isinstance(layer, np.ndarray):  # it was prepared before
            found[name] = layer
        elif voter.unknown_votes or layer.box.overlap(around) is not None:
            found[name] = voter.prepare(around, layer.on)
    return found


# --- on the fused lattice ---------------------------------------------------------------------


def warp_onto(
    grid: NormalizedGrid, transform: Pose2, lattice: Lattice, box: CellBox, device: ComputeDevice
) -> I8:
    """Return the cells of a grid on a box of another's lattice, nearest cell, unknown outside.

    Args:
        transform: maps the grid's map frame into the lattice's, metres.
        box: cells of it; may be empty.
    """
    if box.area == 0:
        return np.zeros(box.shape, dtype=np.int8)
    own = grid.lattice
    into = own.origin.inverse().compose(transform.inverse()).compose(lattice.origin)
    size = lattice.resolution
    corner = into.transform((box.col0 * size, box.row0 * size)) / size
    pose = fixed_poses((corner[0], corner[1], into.yaw_rad))
    if tuple(pose[0, :2]) == (FIXED_ONE, 0):
        # Without rotation all cells move by the same number of cells.
        first = np.ones(1, dtype=np.int64)
        (row,), (col,) = fixed_cells(pose[0], first, first)
        read = CellBox(int(row), int(col), int(row) + box.height, int(col) + box.width)
        return read.cut(grid.cells, grid.box, UNKNOWN)
    warped = device.warp(device.upload(grid.cells), pose, box.shape, UNKNOWN)
    return np.asarray(device.download(warped)[0])


def contradicting(
    grids: Sequence[OccupancyGrid],
    group: Members,
    first: LatticeVote,
    others: Sequence[LatticeVote],
) -> dict[str, InputRecord]:
    """Return the records of maps that contradict others of their group and are fused apart."""
    found: dict[str, InputRecord] = {}
    for vote in others:
        own = vote.group.alignments
        reason = (
            f"agrees with {', '.join(own)} "
            f"and contradicts {', '.join(first.group.alignments)}; fused apart"
        )
        found |= {
            grid.name: InputRecord(grid, own[grid.name], False, reason)
            for grid in grids
            if grid.name in own and grid.name in group.alignments
        }
    return found


def bent_maps(
    trust: Trust | None, worst: Sequence[Mapping[str, tuple[int, int, int]]], grid: Lattice
) -> dict[str, Bent]:
    """Return the maps whose walls do not agree with the others', and where they agree least.

    Args:
        trust: in the maps; None: nothing is known.
        worst: of each tile, see ``DecidedTile``.
        grid: lattice of the fused map, from its first cell on.
    """
    if trust is None:
        return {}
    bent = {}
    for name, share in zip(trust.names, trust.agreement.tolist(), strict=True):
        places = [tile[name] for tile in worst if name in tile]
        missed, row, col = worst_place([(0, 0, 0), *places])
        # Maps without common walls do not disagree.
        if share < AGREEING and missed > 0:
            corner = grid.corner(row, col)
            bent[name] = Bent(share, corner.x, corner.y)
    return bent
