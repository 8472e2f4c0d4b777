"""Aligned grids on one lattice: warp them there, vote, and report the result of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from slamfusion.align.normalize import VotingGrid
from slamfusion.align.records import Bent, FusionResult, InputRecord
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_cells, fixed_poses
from slamfusion.compute.layout import FIXED_ONE, MOST_INPUTS, VOTE_ONE
from slamfusion.config import FusionConfig
from slamfusion.fusion.groups import Members
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, UNKNOWN, CellBox, OccupancyGrid, box_origin
from slamfusion.io.memory import check_memory
from slamfusion.vote.agreement import AGREEING, Trust, most_borne_out
from slamfusion.vote.boxes import hull, moved, overlap, padded, slices
from slamfusion.vote.lattice import Extent, Lattice
from slamfusion.vote.tiles import (
    SMALL_TILE,
    TILE,
    GridLayer,
    TileVoter,
    sum_counts,
    worst_place,
)

I8 = npt.NDArray[np.int8]

# Gives an input at the common resolution, by its name.
Lattices: TypeAlias = Callable[[str], VotingGrid]

# Bytes that a vote in memory holds for each fused cell: itself, its agreement, and a copy of both.
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

    names = tuple(group.alignments)
    box = fused_box(group, lambda name: normalized(name).extent, config)
    check_memory(
        VOTED_BYTES * box.area,
        f"a fused map of {box.width} x {box.height} cells",
        group.reference,
        "free memory, use a coarser cell, or fuse into a store tile by tile (-o OUT.zarr)",
    )
    lattice = base.extent.lattice
    whole = CellBox(0, 0, box.height, box.width)
    first = (box.row0, box.col0)
    voter = TileVoter(whole, config.vote, lattice.resolution, names, first)
    layers = {name: _layer(normalized(name), group, lattice, box, voter, device) for name in names}
    tiles = list(voter.tiles(TILE if len(names) <= MOST_INPUTS else SMALL_TILE))

    def shown(tile: CellBox) -> dict[str, npt.NDArray[Any]]:
        around = voter.around(tile)
        return {
            name: voter.prepare(around, layer.on)
            for name, layer in layers.items()
            if overlap(layer.box, around) is not None
        }

    kept = {tiles[0]: shown(tiles[0])} if len(tiles) == 1 else {}
    if voter.weighs:
        counts = [voter.count(tile, kept.get(tile) or shown(tile)) for tile in tiles]
        voter = voter.trusting(sum_counts(counts))
        parts = parts_of(group, voter.trust)
        if len(parts) > 1:
            deciding, apart = parts
            others = {**others, **contradicting(grids, deciding, apart)}
            own = [grid for grid in grids if grid.name in apart.alignments]
            other = vote_on_lattice(own, apart, lattices, {}, config, device)
            result = vote_on_lattice(grids, deciding, lattices, others, config, device)
            return replace(result, others=(*result.others, other))
    fused = np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
    agreement = np.full_like(fused, UNKNOWN)
    phantom_cells, worst = 0, []
    for tile in tiles:
        decided = voter.decide(tile, kept.get(tile) or shown(tile), device)
        if decided is None:
            continue
        window = slices(tile, 0, 0)
        fused[window], agreement[window] = decided.fused, decided.agreement
        phantom_cells += decided.phantom_cells
        worst.append(decided.worst)
        for name, is_outvoted in decided.outvoted():
            layers[name].note(tile, is_outvoted)
    origin = box_origin(lattice.origin, lattice.resolution, box)
    fused[fused == 1] = OCCUPIED
    # What is read-only is not copied once more.
    fused.flags.writeable = agreement.flags.writeable = False
    fused_grid = OccupancyGrid(fused, lattice.resolution, origin, "fused")
    bent = bent_maps(voter.trust, worst, Lattice(lattice.resolution, origin))
    records = [
        InputRecord(
            given,
            group.alignments[given.name],
            True,
            group.alignments[given.name].reason,
            layers[given.name],
        )
        if given.name in layers
        else others[given.name]
        for given in grids
    ]
    trust = voter.trust
    return FusionResult(
        reference=group.reference,
        inputs=tuple(records),
        fused=fused_grid,
        agreement=OccupancyGrid(agreement, lattice.resolution, origin, "agreement"),
        pairs=(),
        phantom_cells=phantom_cells,
        weights=weights_of(names, trust),
        wall_agreement=wall_agreement_of(trust),
        bent=bent,
        device=device.name,
        time_s=0.0,
    )


def parts_of(group: Members, trust: Trust | None) -> tuple[Members, ...]:
    """Return the group, or two: those that decide, and those that contradict them together."""
    apart = () if trust is None else second_opinion(trust)
    if not apart:
        return (group,)
    return group.part([name for name in group.alignments if name not in apart]), group.part(apart)


def contradicting(
    grids: Sequence[OccupancyGrid], first: Members, second: Members
) -> dict[str, InputRecord]:
    """Return the records of maps that contradict others and are fused apart from them."""
    reason = (
        f"agrees with {', '.join(second.alignments)} "
        f"and contradicts {', '.join(first.alignments)}; fused apart"
    )
    return {
        grid.name: InputRecord(grid, second.alignments[grid.name], False, reason)
        for grid in grids
        if grid.name in second.alignments
    }


def weights_of(names: Sequence[str], trust: Trust | None) -> dict[str, float]:
    """Return the weight of each voter, 0 to 1."""
    if trust is None:
        return dict.fromkeys(names, 1.0)
    return {name: float(trust.weights[trust.of(name)]) / VOTE_ONE for name in names}


def wall_agreement_of(trust: Trust | None) -> dict[str, float]:
    """Return the share of each voter's walls that agree with the others', 0 to 1."""
    return {} if trust is None else dict(zip(trust.names, trust.agreement.tolist(), strict=True))


def bent_maps(
    trust: Trust | None,
    worst: Sequence[Mapping[str, tuple[int, int, int]]],
    grid: Lattice,
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
        # Maps that share no walls do not disagree either.
        if share < AGREEING and missed > 0:
            corner = grid.corner(row, col)
            bent[name] = Bent(share, corner.x, corner.y)
    return bent


def second_opinion(trust: Trust) -> tuple[str, ...]:
    """Return the maps that agree with each other and contradict those that decide; may be none.

    Returns:
        Two or more of the maps without a vote.
    """
    decides = most_borne_out(trust.pairs)
    # A map that agrees with the deciding one on that one's walls only has thicker walls.
    mute = [
        n
        for n, weight in enumerate(trust.weights)
        if weight == 0 and trust.pairs[decides, n] < AGREEING
    ]
    if len(mute) < 2:
        return ()
    inside = trust.pairs[np.ix_(mute, mute)]
    best = most_borne_out(inside)
    if inside[best].max() < AGREEING:
        return ()
    return tuple(
        trust.names[n] for at, n in enumerate(mute) if at == best or inside[best, at] >= AGREEING
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
    return box


def own_box(
    extent: Extent, name: str, group: Members, lattice: Lattice, box: CellBox, voter: TileVoter
) -> CellBox | None:
    """Return the fused cells in which an input has a say; None: in none.

    Args:
        extent: where its cells lie.
        name: of the input.
        group: those that vote.
        lattice: of the reference.
        box: the fused cells, see ``fused_box``.
        voter: says whether unknown is a vote.

    Returns:
        Those that it may know, or all where unknown is a vote; counted as ``box`` is.
    """
    if voter.unknown_votes:
        return box
    return overlap(padded(extent.on(lattice, group.alignments[name].transform), 1), box)


def _layer(
    grid: VotingGrid,
    group: Members,
    lattice: Lattice,
    box: CellBox,
    voter: TileVoter,
    device: ComputeDevice,
) -> GridLayer:
    """Return an input on the fused lattice."""
    shape = (box.height, box.width)
    own = own_box(grid.extent, grid.name, group, lattice, box, voter)
    if own is None:
        return GridLayer(shape, CellBox(0, 0, 0, 0), np.zeros((0, 0), dtype=np.int8))
    transform = group.alignments[grid.name].transform
    cells = warp_onto(grid, grid.cells, transform, lattice, own, device)
    return GridLayer(shape, moved(own, -box.row0, -box.col0), cells)
