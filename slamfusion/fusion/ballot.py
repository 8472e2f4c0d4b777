"""The vote on one tile of a lattice, of the inputs that know something there.

An input that abstains where it knows nothing changes nothing. So many maps may vote that lie apart,
and large ones fit into memory. A tile is decided together with the cells around it that have a say
in what its own become.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import MOST_INPUTS
from slamfusion.config import FusionConfig, VoteConfig
from slamfusion.fusion.boxes import grown_inside, overlap, slices
from slamfusion.fusion.records import OUTVOTED, voted_cells
from slamfusion.fusion.vote import (
    double_reach_cells,
    quantise_weights,
    unknown_votes,
    vote_grids,
    vote_reach_cells,
)
from slamfusion.grid import UNKNOWN, CellBox

__all__ = ["Ballot", "DecidedTile", "Laid"]

I8 = npt.NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class Laid:
    """An input on the fused lattice.

    Attributes:
        box: cells that it may know, counted from the first fused cell; may be empty. All of the
            lattice where unknown is a vote.
        codes: (h, w) int8 of the box, in {-1, 0, 1}; outvoted where it is so far, see
            ``VotedLayer``.
        percents: the same in percent, where these vote.
    """

    box: CellBox
    codes: I8
    percents: I8 | None

    def on(self, wide: CellBox, *, in_percent: bool = False) -> I8:
        """Return its cells on a box of the lattice, unknown outside of its own."""
        cells = self.percents if in_percent and self.percents is not None else self.codes
        own = overlap(self.box, wide)
        out = np.full((wide.height, wide.width), UNKNOWN, dtype=np.int8)
        if own is not None:
            part = cells[slices(own, self.box.row0, self.box.col0)]
            out[slices(own, wide.row0, wide.col0)] = part if in_percent else voted_cells(part)
        return out


@dataclass(frozen=True, eq=False)
class DecidedTile:
    """What came of the vote on a tile.

    Attributes:
        fused: (h, w) int8 in {-1, 0, 1}.
        agreement: (h, w) int8, see ``VoteResult``.
        phantom_cells: see ``VoteResult``.
    """

    fused: I8
    agreement: I8
    phantom_cells: int


@dataclass(frozen=True)
class Ballot:
    """A vote on one lattice: all that decides a tile beside what inputs say there.

    Attributes:
        whole: the fused cells, from 0.
        config: settings of the fusion.
        resolution: metres a cell.
        weights: of each voter, by name; 1 each but in the mode ``weighted``.
    """

    whole: CellBox
    config: FusionConfig
    resolution: float
    weights: Mapping[str, float]

    @cached_property
    def vote(self) -> VoteConfig:
        """The settings of the vote, with what unknown means to all voters together."""
        mode, unknown = self.config.vote.mode, self.config.vote.unknown
        if mode in {"majority", "weighted"}:
            weights = [1] * len(self.weights)
            if mode == "weighted":
                weights = [int(weight) for weight in quantise_weights([*self.weights.values()])]
            unknown = "value" if unknown_votes(unknown, weights) else "abstain"
        return replace(self.config.vote, unknown=unknown)

    def around(self, tile: CellBox) -> CellBox:
        """Return a tile with the cells around it that have a say in what it becomes."""
        return grown_inside(tile, vote_reach_cells(self.config.vote, self.resolution), self.whole)

    def decide(
        self, tile: CellBox, layers: Mapping[str, Laid], device: ComputeDevice
    ) -> DecidedTile | None:
        """Decide the cells of a tile; None where no input knows any.

        Args:
            tile: of the lattice.
            layers: inputs, by name, all that may know a cell of the tile or around it. Where they
                are outvoted in the tile is noted in their codes.
            device: computes.

        Raises:
            GridError: more inputs than a vote takes know one place.
        """
        wide = self.around(tile)
        here = [name for name in layers if self._has_a_say(layers[name], wide)]
        if not here:
            return None
        stack = [layers[name].on(wide) for name in here]
        weights = [self.weights[name] for name in here]
        percents = None
        if self.vote.mode == "log-odds":
            percents = [layers[name].on(wide, in_percent=True) for name in here]
        if len(stack) == 1 < len(self.weights):
            # One that knows nothing here: a single voter is its own fusion, and has no backs.
            nothing = np.full_like(stack[0], UNKNOWN)
            stack.append(nothing)
            weights.append(weights[0])
            percents = None if percents is None else [*percents, nothing]
        voted = vote_grids(
            stack,
            self.vote,
            device,
            weights=weights,
            percents=percents,
            thresholds=self.config.normalize,
            reach_cells=double_reach_cells(self.config.vote, self.resolution),
        )
        part = slices(tile, wide.row0, wide.col0)
        phantom_cells = voted.phantom_cells
        if tile != self.whole:
            alone = (voted.fused[part] == 1) & (voted.agreement[part] >= 0)
            for cells in stack:
                alone &= cells[part] != 1
            phantom_cells = int(np.count_nonzero(alone))
        for index, name in enumerate(here):
            box = layers[name].box
            own = overlap(box, tile)
            if own is None:
                continue
            bits = voted.dissent[slices(own, wide.row0, wide.col0)]
            is_outvoted = (bits >> np.array(index, bits.dtype)) & 1 != 0
            layers[name].codes[slices(own, box.row0, box.col0)][is_outvoted] += OUTVOTED
        return DecidedTile(voted.fused[part], voted.agreement[part], phantom_cells)

    def _has_a_say(self, layer: Laid, wide: CellBox) -> bool:
        if self.vote.mode == "weighted" and len(self.weights) <= MOST_INPUTS:
            return True  # weights are whole numbers of the largest
        return overlap(layer.box, wide) is not None
