"""Aligned grids on one lattice: warp them there, vote, and say what became of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.compute.layout import MOST_INPUTS
from slamfusion.config import FusionConfig
from slamfusion.fusion.boxes import grown_inside, hull, overlap, padded, slices
from slamfusion.fusion.groups import Members
from slamfusion.fusion.normalize import NormalizedGrid, lattice_box
from slamfusion.fusion.records import OUTVOTED, FusionResult, InputRecord, VotedLayer, voted_cells
from slamfusion.fusion.vote import (
    agreement_weights,
    double_reach_cells,
    margin_cells,
    quantise_weights,
    unknown_votes,
    vote_grids,
    vote_reach_cells,
)
from slamfusion.geometry import Pose2
from slamfusion.grid import OCCUPIED, UNKNOWN, CellBox, OccupancyGrid

__all__ = ["Lattices", "vote_on_lattice", "warp_onto"]

I8 = npt.NDArray[np.int8]

# Gives an input at the common resolution, by its name.
Lattices: TypeAlias = Callable[[str], NormalizedGrid]

# Cells on a side that are voted on at once; fewer where so many maps vote that not all may vote in
# one place.
TILE, SMALL_TILE = 2048, 256


def warp_onto(
    grid: NormalizedGrid,
    cells: npt.NDArray[np.int8],
    transform: Pose2,
    lattice: OccupancyGrid,
    box: CellBox,
    device: ComputeDevice,
) -> npt.NDArray[np.int8]:
    """Return cells of one grid on the box of another's lattice, nearest cell, unknown outside.

    Args:
        grid: gives the origin and resolution of ``cells``.
        cells: (H, W) int8 on the grid's lattice.
        transform: maps the grid's map frame into the lattice's, metres.
        lattice: the grid whose lattice is the target.
        box: cells of that lattice; may reach beyond it.
        device: computes.
    """
    size = lattice.resolution
    into = grid.grid.origin.inverse().compose(transform.inverse()).compose(lattice.origin)
    corner = into.transform((box.col0 * size, box.row0 * size)) / size
    pose = fixed_poses((corner[0], corner[1], into.yaw_rad))
    shape = (box.height, box.width)
    warped = device.warp(device.upload(cells), pose, shape, UNKNOWN)
    return np.asarray(device.download(warped)[0])


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
    """
    base = lattices(group.reference)
    box = _fused_box(group, lattices, base, config)
    # Where unknown is a value an input votes also where it knows nothing.
    is_value = config.vote.mode in {"majority", "weighted"} and unknown_votes(
        config.vote.unknown, [1] * len(group.alignments)
    )
    layers = {
        name: _laid(lattices(name), pair.transform, base, box, config, device, is_whole=is_value)
        for name, pair in group.alignments.items()
    }
    ballot = _Ballot(layers, box, config, base.grid.resolution, device)
    for tile in _tiles(ballot.whole, TILE if len(layers) <= MOST_INPUTS else SMALL_TILE):
        ballot.vote_on(tile)
    frame = base.grid.origin.transform(np.array([box.col0, box.row0]) * base.grid.resolution)
    origin = Pose2(float(frame[0]), float(frame[1]), base.grid.origin.yaw_rad)
    cells = np.where(ballot.fused == 1, np.int8(OCCUPIED), ballot.fused)
    # What is read-only is not copied once more.
    cells.flags.writeable = ballot.agreement.flags.writeable = False
    records = []
    for given in grids:
        pair = group.alignments.get(given.name)
        if pair is None:
            records.append(others[given.name])
        else:
            layer = ballot.voted(given.name)
            records.append(InputRecord(given, pair, True, pair.reason, layer))
    return FusionResult(
        reference=group.reference,
        inputs=tuple(records),
        fused=OccupancyGrid(cells, base.grid.resolution, origin, "fused"),
        agreement=OccupancyGrid(ballot.agreement, base.grid.resolution, origin, "agreement"),
        pairs=(),
        phantom_cells=ballot.phantom_cells,
        weights=dict(zip(layers, ballot.weights, strict=True)),
        device=device.name,
        time_s=0.0,
    )


@dataclass(frozen=True, eq=False)
class _Laid:
    """An input on the fused lattice.

    Attributes:
        box: cells that it may know, counted from the first fused cell; may be empty.
        codes: (h, w) int8 of the box, in {-1, 0, 1}; outvoted where it is so far, see
            ``VotedLayer``.
        percents: the same in percent, where these vote.
    """

    box: CellBox
    codes: I8
    percents: I8 | None


class _Ballot:
    """A vote on one lattice: what was decided so far."""

    def __init__(
        self,
        layers: Mapping[str, _Laid],
        box: CellBox,
        config: FusionConfig,
        resolution: float,
        device: ComputeDevice,
    ) -> None:
        self.layers, self.config, self.device = layers, config, device
        self.whole = CellBox(0, 0, box.height, box.width)
        self.weights = [1.0] * len(layers)
        unknown = config.vote.unknown
        if config.vote.mode == "weighted":
            self.weights = agreement_weights(
                [self._on(layer, self.whole) for layer in layers.values()]
            )
            whole_weights = [int(weight) for weight in quantise_weights(self.weights)]
            unknown = "value" if unknown_votes(unknown, whole_weights) else "abstain"
        elif config.vote.mode == "majority":
            unknown = "value" if unknown_votes(unknown, [1] * len(layers)) else "abstain"
        self.vote = replace(config.vote, unknown=unknown)
        self.reach = vote_reach_cells(config.vote, resolution)
        self.double_reach = double_reach_cells(config.vote, resolution)
        self.fused = np.full((box.height, box.width), UNKNOWN, dtype=np.int8)
        self.agreement = np.full_like(self.fused, UNKNOWN)
        self.phantom_cells = 0

    def vote_on(self, tile: CellBox) -> None:
        """Decide the cells of a tile of the lattice."""
        wide = grown_inside(tile, self.reach, self.whole)
        here = [name for name in self.layers if self._has_a_say(name, wide)]
        if not here:
            return
        stack = [self._on(self.layers[name], wide) for name in here]
        weights = [w for name, w in zip(self.layers, self.weights, strict=True) if name in here]
        percents = None
        if self.vote.mode == "log-odds":
            percents = [self._on(self.layers[name], wide, in_percent=True) for name in here]
        if len(stack) == 1 < len(self.layers):
            # One that knows nothing here: a single voter is its own fusion, and has no backs.
            nothing = np.full_like(stack[0], UNKNOWN)
            stack.append(nothing)
            weights.append(weights[0])
            percents = None if percents is None else [*percents, nothing]
        voted = vote_grids(
            stack,
            self.vote,
            self.device,
            weights=weights,
            percents=percents,
            thresholds=self.config.normalize,
            reach_cells=self.double_reach,
        )
        window, part = slices(tile, 0, 0), slices(tile, wide.row0, wide.col0)
        self.fused[window] = voted.fused[part]
        self.agreement[window] = voted.agreement[part]
        if tile == self.whole:
            self.phantom_cells = voted.phantom_cells
        else:
            alone = (voted.fused[part] == 1) & (voted.agreement[part] >= 0)
            for cells in stack:
                alone &= cells[part] != 1
            self.phantom_cells += int(np.count_nonzero(alone))
        for index, name in enumerate(here):
            own = overlap(self.layers[name].box, tile)
            if own is None:
                continue
            box = self.layers[name].box
            bits = voted.dissent[slices(own, wide.row0, wide.col0)]
            is_outvoted = (bits >> np.array(index, bits.dtype)) & 1 != 0
            self.layers[name].codes[slices(own, box.row0, box.col0)][is_outvoted] += OUTVOTED

    def voted(self, name: str) -> VotedLayer:
        """Return what became of an input."""
        layer, shape = self.layers[name], (self.whole.height, self.whole.width)
        return VotedLayer(shape, layer.box, layer.codes)

    def _has_a_say(self, name: str, wide: CellBox) -> bool:
        if self.vote.mode == "weighted" and len(self.layers) <= MOST_INPUTS:
            return True  # weights are whole numbers of the largest
        return overlap(self.layers[name].box, wide) is not None

    def _on(self, layer: _Laid, wide: CellBox, *, in_percent: bool = False) -> I8:
        """Return an input's cells on a box of the lattice, unknown outside of its own."""
        cells = layer.percents if in_percent and layer.percents is not None else layer.codes
        own = overlap(layer.box, wide)
        out = np.full((wide.height, wide.width), UNKNOWN, dtype=np.int8)
        if own is not None:
            part = cells[slices(own, layer.box.row0, layer.box.col0)]
            out[slices(own, wide.row0, wide.col0)] = part if in_percent else voted_cells(part)
        return out


def _fused_box(
    group: Members, lattices: Lattices, base: NormalizedGrid, config: FusionConfig
) -> CellBox:
    """Return the fused cells, counted from the reference's first cell."""
    box = CellBox(0, 0, *base.shape)
    if config.vote.extent == "union":
        for name, pair in group.alignments.items():
            box = hull(box, lattice_box(lattices(name), pair.transform, base))
    return padded(box, margin_cells(config.vote, len(group.alignments)))


def _laid(
    grid: NormalizedGrid,
    transform: Pose2,
    base: NormalizedGrid,
    box: CellBox,
    config: FusionConfig,
    device: ComputeDevice,
    *,
    is_whole: bool,
) -> _Laid:
    """Lay an input on the fused lattice, on the cells that it may know or on all."""
    own = box if is_whole else overlap(padded(lattice_box(grid, transform, base), 1), box)
    if own is None:
        nothing = np.zeros((0, 0), dtype=np.int8)
        return _Laid(CellBox(0, 0, 0, 0), nothing, nothing)
    cells = warp_onto(grid, grid.cells, transform, base.grid, own, device)
    percents = None
    if config.vote.mode == "log-odds":
        percents = warp_onto(grid, grid.grid.cells, transform, base.grid, own, device)
    rows, cols = (
        (own.row0 - box.row0, own.row1 - box.row0),
        (own.col0 - box.col0, own.col1 - box.col0),
    )
    return _Laid(CellBox(rows[0], cols[0], rows[1], cols[1]), cells, percents)


def _tiles(whole: CellBox, side: int) -> Iterator[CellBox]:
    """Yield boxes of at most so many cells on a side that together are the whole."""
    for row in range(0, whole.height, side):
        for col in range(0, whole.width, side):
            rows, cols = min(row + side, whole.height), min(col + side, whole.width)
            yield CellBox(row, col, rows, cols)
