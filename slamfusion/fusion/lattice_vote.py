"""Aligned grids on one lattice: warp them there, vote, and say what became of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_cells, fixed_poses
from slamfusion.compute.layout import FIXED_ONE, MOST_INPUTS
from slamfusion.config import FusionConfig
from slamfusion.fusion.ballot import Ballot, Laid
from slamfusion.fusion.boxes import hull, moved, overlap, padded, slices
from slamfusion.fusion.groups import Members
from slamfusion.fusion.lattice import Extent, Lattice
from slamfusion.fusion.normalize import VotingGrid
from slamfusion.fusion.records import FusionResult, InputRecord, VotedLayer
from slamfusion.fusion.vote import agreement_weights, margin_cells, unknown_votes
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, UNKNOWN, CellBox, OccupancyGrid, box_origin
from slamfusion.io.memory import check_memory

__all__ = [
    "SMALL_TILE",
    "TILE",
    "Lattices",
    "fused_box",
    "own_box",
    "tiles_of",
    "vote_on_lattice",
    "warp_onto",
    "warp_pose",
]

I8 = npt.NDArray[np.int8]

# Gives an input at the common resolution, by its name.
Lattices: TypeAlias = Callable[[str], VotingGrid]

# Cells on a side that are voted on at once; fewer where so many maps vote that not all may vote in
# one place.
TILE, SMALL_TILE = 2048, 256
# What a vote in memory holds for each fused cell: itself, its agreement, and what is told of both.
VOTED_BYTES = 4


def warp_onto(
    grid: VotingGrid,
    cells: npt.NDArray[np.int8],
    transform: Pose2,
    lattice: Lattice,
    box: CellBox,
    device: ComputeDevice,
) -> npt.NDArray[np.int8]:
    """Return cells of one grid on the box of another's lattice, nearest cell, unknown outside.

    Args:
        grid: gives the lattice of ``cells``.
        cells: (H, W) int8 on the grid's lattice.
        transform: maps the grid's map frame into the lattice's, metres.
        lattice: the target.
        box: cells of it.
        device: computes.
    """
    pose = warp_pose(grid.extent.lattice, transform, lattice, box)
    if tuple(pose[0, :2]) == (FIXED_ONE, 0):
        # Nothing is turned: all cells move by as much as the first.
        first = np.ones(1, dtype=np.int64)
        (row,), (col,) = fixed_cells(pose[0], first, first)
        return _shifted(cells, int(row), int(col), box)
    warped = device.warp(device.upload(cells), pose, (box.height, box.width), UNKNOWN)
    return np.asarray(device.download(warped)[0])


def _shifted(cells: npt.NDArray[np.int8], row: int, col: int, box: CellBox) -> npt.NDArray[np.int8]:
    """Return as many cells as a box has, from a row and column on, unknown outside."""
    out = np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
    read = CellBox(row, col, row + box.height, col + box.width)
    known = overlap(read, CellBox(0, 0, *cells.shape))
    if known is not None:
        out[slices(known, row, col)] = cells[slices(known, 0, 0)]
    return out


def warp_pose(
    own: Lattice, transform: Pose2, lattice: Lattice, box: CellBox
) -> npt.NDArray[np.int64]:
    """Return the motion of a box of a lattice into a grid, (1, 4), see ``fixed_poses``.

    Args:
        own: of the grid.
        transform: maps the grid's map frame into the lattice's, metres.
        lattice: of the box, of the same resolution.
        box: cells of the lattice.
    """
    into = own.origin.inverse().compose(transform.inverse()).compose(lattice.origin)
    size = lattice.resolution
    corner = into.transform((box.col0 * size, box.row0 * size)) / size
    return fixed_poses((corner[0], corner[1], into.yaw_rad))


def vote_on_lattice(
    grids: Sequence[OccupancyGrid],
    group: Members,
    lattices: Lattices,
    others: Mapping[str, InputRecord],
    config: FusionConfig,
    device: ComputeDevice,
) -> FusionResult:
    """Warp the accepted grids onto the fused lattice, vote, and write the records.

    The vote goes tile by tile, of those that know something there: an input that abstains where it
    knows nothing changes nothing. So many maps may vote that lie apart, and large ones fit into
    memory. Tiles overlap as far as a cell has a say in what others become.

    Args:
        grids: all inputs, in order.
        group: those that vote.
        lattices: gives each of these at the common resolution.
        others: records of the inputs that do not vote, by name.
        config: settings of the vote.
        device: computes.

    Raises:
        GridError: more inputs than a vote takes know one place.
        MemoryBudgetError: the fused map is too large for the memory that is free.
    """
    base = lattices(group.reference)

    def normalized(name: str) -> VotingGrid:
        return base if name == group.reference else lattices(name)

    box = fused_box(group, lambda name: normalized(name).extent, config)
    check_memory(
        VOTED_BYTES * box.area,
        f"a fused map of {box.width} x {box.height} cells",
        group.reference,
        "free memory, use a coarser cell, or fuse into a store tile by tile (-o OUT.zarr)",
    )
    lattice = base.extent.lattice
    layers = {
        name: _laid(normalized(name), group, lattice, box, config, device)
        for name in group.alignments
    }
    whole = CellBox(0, 0, box.height, box.width)
    weights = dict.fromkeys(layers, 1.0)
    if config.vote.mode == "weighted":
        found = agreement_weights([layer.on(whole) for layer in layers.values()])
        weights = dict(zip(layers, found, strict=True))
    ballot = Ballot(whole, config, base.grid.resolution, weights)
    fused = np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
    agreement = np.full_like(fused, UNKNOWN)
    phantom_cells = 0
    for tile in tiles_of(whole, TILE if len(layers) <= MOST_INPUTS else SMALL_TILE):
        decided = ballot.decide(tile, layers, device)
        if decided is not None:
            window = slices(tile, 0, 0)
            fused[window], agreement[window] = decided.fused, decided.agreement
            phantom_cells += decided.phantom_cells
    origin = box_origin(lattice.origin, lattice.resolution, box)
    fused[fused == 1] = OCCUPIED
    # What is read-only is not copied once more.
    fused.flags.writeable = agreement.flags.writeable = False
    records = []
    for given in grids:
        pair = group.alignments.get(given.name)
        if pair is None:
            records.append(others[given.name])
        else:
            layer = layers[given.name]
            voted = VotedLayer(fused.shape, layer.box, layer.codes)
            records.append(InputRecord(given, pair, True, pair.reason, voted))
    return FusionResult(
        reference=group.reference,
        inputs=tuple(records),
        fused=OccupancyGrid(fused, base.grid.resolution, origin, "fused"),
        agreement=OccupancyGrid(agreement, base.grid.resolution, origin, "agreement"),
        pairs=(),
        phantom_cells=phantom_cells,
        weights=weights,
        device=device.name,
        time_s=0.0,
    )


def _unknown_is_a_vote(config: FusionConfig, voters: int) -> bool:
    """Say whether an input votes also where it knows nothing."""
    return config.vote.mode in {"majority", "weighted"} and unknown_votes(
        config.vote.unknown, [1] * voters
    )


def fused_box(group: Members, extent_of: Callable[[str], Extent], config: FusionConfig) -> CellBox:
    """Return the cells of the fused map, counted from the reference's first cell.

    Args:
        group: those that vote.
        extent_of: tells where an input's cells lie, by its name; asked of the reference alone where
            the fused map is no union.
        config: settings of the vote.
    """
    base = extent_of(group.reference)
    box = base.box
    if config.vote.extent == "union":
        for name, pair in group.alignments.items():
            box = hull(box, extent_of(name).on(base.lattice, pair.transform))
    return padded(box, margin_cells(config.vote, len(group.alignments)))


def own_box(
    extent: Extent, name: str, group: Members, lattice: Lattice, box: CellBox, config: FusionConfig
) -> CellBox | None:
    """Return the fused cells in which an input has a say; None: in none.

    Args:
        extent: where its cells lie.
        name: of the input.
        group: those that vote.
        lattice: of the reference.
        box: the fused cells, see ``fused_box``.
        config: settings of the vote.

    Returns:
        Those that it may know, or all where unknown is a vote; counted as ``box`` is.
    """
    if _unknown_is_a_vote(config, len(group.alignments)):
        return box
    return overlap(padded(extent.on(lattice, group.alignments[name].transform), 1), box)


def _laid(
    grid: VotingGrid,
    group: Members,
    lattice: Lattice,
    box: CellBox,
    config: FusionConfig,
    device: ComputeDevice,
) -> Laid:
    """Lay an input on the fused lattice."""
    own = own_box(grid.extent, grid.name, group, lattice, box, config)
    if own is None:
        nothing = np.zeros((0, 0), dtype=np.int8)
        return Laid(CellBox(0, 0, 0, 0), nothing, nothing)
    transform = group.alignments[grid.name].transform
    cells = warp_onto(grid, grid.cells, transform, lattice, own, device)
    percents = None
    if config.vote.mode == "log-odds":
        percents = warp_onto(grid, grid.grid.cells, transform, lattice, own, device)
    return Laid(moved(own, -box.row0, -box.col0), cells, percents)


def tiles_of(whole: CellBox, side: int) -> Iterator[CellBox]:
    """Yield boxes of at most so many cells on a side that together are the whole."""
    for row in range(whole.row0, whole.row1, side):
        for col in range(whole.col0, whole.col1, side):
            yield CellBox(row, col, min(row + side, whole.row1), min(col + side, whole.col1))
