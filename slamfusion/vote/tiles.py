"""The vote on one tile: what aligned maps show there decides its cells.

Maps in memory, packed maps of a store and the layers of the live fusion are all decided here:
``prepare`` what each map shows on ``around(tile)``, ``count`` it for the trust in the maps, and
``decide``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import astuple, dataclass, field, replace
from typing import get_args

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import MOST_INPUTS, VOTE_ONE
from slamfusion.config import VoteConfig, VoteMode
from slamfusion.errors import ConfigError, GridError
from slamfusion.geometry import B8, I8, U8
from slamfusion.grid import UNKNOWN, CellBox
from slamfusion.vote.agreement import (
    Trust,
    WallCounts,
    count_walls,
    disagreeing,
    local_weights,
    trust_of,
)
from slamfusion.vote.walls import codes_on, margin_cells, same_wall_cells

# Added to the cell of an input where it voted and was outvoted.
OUTVOTED = np.int8(4)
# Cells on a side that are decided at once; fewer if too many maps vote in one place.
TILE, SMALL_TILE = 2048, 256
# Maps are weighed in windows of three by three blocks of about this many metres.
BLOCK_M = 1.5


@dataclass(frozen=True, eq=False)
class GridLayer:
    """What one input shows on the fused lattice: cells of a box, nothing outside.

    Attributes:
        box: cells of it that the input may know, counted from the first; may be empty.
        codes: (h, w) int8 of the box, cells in {-1, 0, 1}, plus ``OUTVOTED`` where the input was
            outvoted.
    """

    shape: tuple[int, int]
    box: CellBox
    codes: I8

    @classmethod
    def of(cls, aligned: I8, dissent: B8) -> GridLayer:
        """Take what an input shows on all cells, and where it was outvoted; both (H, W)."""
        box = CellBox(0, 0, *aligned.shape)
        return cls(box.shape, box, aligned + OUTVOTED * dissent.view(np.int8))

    def inside(self, box: CellBox) -> GridLayer:
        """Return the layer on a box of its lattice, from whose first cell its own is counted."""
        own = self.box.overlap(box) or self.box
        codes = self.codes[own.slices(self.box)]
        return GridLayer(box.shape, own.moved(-box.row0, -box.col0), codes)

    def on(self, box: CellBox) -> I8:
        """Return its cells on a box of the lattice, unknown outside of its own."""
        cells = box.cut(self.codes, self.box, UNKNOWN)
        outvoted = (cells > 1).view(np.int8)
        outvoted *= OUTVOTED
        cells -= outvoted
        return cells

    def note(self, tile: CellBox, is_outvoted: B8) -> None:
        """Note where the input was outvoted in a tile; (h, w) of the tile."""
        own = self.box.overlap(tile)
        if own is not None:
            codes = self.codes[own.slices(self.box)]
            codes[is_outvoted[own.slices(tile)]] += OUTVOTED

    def aligned(self) -> I8:
        """Return what it shows on all cells, (H, W) int8 in {-1, 0, 1}."""
        return self.on(CellBox(0, 0, *self.shape))

    def dissent(self) -> B8:
        """Return where it was outvoted, (H, W) bool."""
        return CellBox(0, 0, *self.shape).cut(self.codes, self.box, UNKNOWN) > 1


@dataclass(frozen=True, eq=False)
class DecidedTile:
    """The outcome of the vote on a tile.

    Attributes:
        fused: (h, w) int8 in {-1, 0, 1}.
        agreement: (h, w) int8, share of the votes for the winner in percent, rounded half up; -1
            where no vote counts.
        phantom_cells: cells that are occupied here and in no input.
        names: the inputs that show something here.
        dissent: (planes, h, w) uint8, who was outvoted, see ``Votes``; None: that is not kept.
        worst: by name, the number of wall cells that disagree with the other maps in the window of
            a few metres with most of them, and the row and column of its middle.
    """

    fused: I8
    agreement: I8
    phantom_cells: int
    names: tuple[str, ...] = ()
    dissent: U8 | None = None
    worst: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)

    def outvoted(self) -> Iterator[tuple[str, B8]]:
        """Yield each input with where it was outvoted, (h, w) bool."""
        if self.dissent is not None:
            for n, name in enumerate(self.names):
                yield name, self.dissent[n // 8] & np.uint8(1 << n % 8) != 0


@dataclass(frozen=True)
class TileVoter:
    """A vote on one lattice: all that decides a tile, apart from what the inputs show there.

    Attributes:
        whole: the fused cells.
        resolution: metres a cell.
        first: lattice row and column of cell [0, 0], so that blocks do not move when the map grows.
        trust: in the voters; None: it has not been found, or the mode does not ask for it.
    """

    whole: CellBox
    config: VoteConfig
    resolution: float
    names: tuple[str, ...]
    first: tuple[int, int] = (0, 0)
    trust: Trust | None = None

    @property
    def weighs(self) -> bool:
        """Whether the maps have weights, which ``count`` and ``trusting`` find."""
        return self.config.mode == "consensus" and len(self.names) > 1

    @property
    def unknown_votes(self) -> bool:
        """Whether unknown is a value (True) or abstains.

        ``auto``: a value with exactly three voters; a tie for first place then needs three
        different cells, one of them occupied. With other numbers free and unknown alone could
        tie, and the tie would add a wall that no input has.
        """
        rule = self.config.unknown
        is_value = len(self.names) == 3 if rule == "auto" else rule == "value"
        return self.config.mode == "majority" and is_value

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each voter, 0 to 1."""
        if self.trust is None:
            return dict.fromkeys(self.names, 1.0)
        return dict(zip(self.names, (self.trust.weights / VOTE_ONE).tolist(), strict=True))

    @property
    def wall_agreement(self) -> dict[str, float]:
        """Share of each voter's walls that agree with the others', 0 to 1; empty without trust."""
        trust = self.trust
        return {} if trust is None else dict(zip(self.names, trust.agreement.tolist(), strict=True))

    @property
    def shift(self) -> int:
        """Blocks are this power of two cells on a side."""
        return max(0, round(math.log2(BLOCK_M / self.resolution)))

    def _in_blocks(self, box: CellBox) -> CellBox:
        """Return the rows and columns of blocks that hold a box."""
        row0, col0, row1, col1 = astuple(box.moved(*self.first))
        shift = self.shift
        return CellBox(
            row0 >> shift, col0 >> shift, (row1 - 1 >> shift) + 1, (col1 - 1 >> shift) + 1
        )

    def aligned(self, box: CellBox) -> CellBox:
        """Return the smallest box of whole blocks that holds a box, inside of the fused cells."""
        (row, col), shift = self.first, self.shift
        grown = CellBox(*(place << shift for place in astuple(self._in_blocks(box))))
        return grown.moved(-row, -col).overlap(self.whole) or box

    def around(self, tile: CellBox) -> CellBox:
        """Return the cells that decide a tile; with ``consensus`` its blocks and the next."""
        if not self.weighs:
            return tile
        reach = max(1 << self.shift, same_wall_cells(self.resolution))
        return self.aligned(tile.grown_inside(reach, self.whole))

    def reading(self, tile: CellBox) -> CellBox:
        """Return the cells of the inputs that have a say in a tile."""
        around = self.around(tile)
        if not self.weighs:
            return around
        return around.grown_inside(margin_cells(self.resolution), self.whole)

    def prepare(self, box: CellBox, read: Callable[[CellBox], I8]) -> I8 | U8:
        """Return the cells that ``read`` returns on a box, as the other functions take them."""
        if not self.weighs:
            return read(box)
        return codes_on(box, self.whole, self.resolution, read)

    def count(self, tile: CellBox, shown: Mapping[str, I8 | U8]) -> WallCounts:
        """Count how walls in a tile agree, (N, N) in the order of ``names``; see ``decide``."""
        count = len(self.names)
        total = WallCounts(*(np.zeros((count, count), dtype=np.int64) for _ in range(4)))
        if len(shown) > 1:
            at = np.ix_(*[[self.names.index(name) for name in shown]] * 2)
            wide = self.around(tile)
            part = tile.slices(wide)
            found = count_walls([codes[part].view(np.uint8) for codes in shown.values()], 31)
            for sums, own in zip(total, found.total(), strict=True):
                sums[at] = own
        return total

    def trusting(self, counts: WallCounts) -> TileVoter:
        """Return the vote with the trust that the counts of all tiles give."""
        return replace(self, trust=trust_of(self.names, counts))

    def decide(
        self,
        tile: CellBox,
        shown: Mapping[str, I8 | U8],
        device: ComputeDevice,
        counts: WallCounts | None = None,
    ) -> DecidedTile | None:
        """Decide the cells of a tile; None where no input shows anything.

        Args:
            tile: cells.
            shown: by name, prepared on ``around(tile)``, of those that know a cell there.
            counts: how their walls agree in each block of ``around(tile)``; None: they are counted.

        Raises:
            GridError: more inputs than a vote takes know one place.
        """
        if not shown:
            return None
        if len(shown) > MOST_INPUTS:
            raise GridError(f"a vote takes up to {MOST_INPUTS} grids, found {len(shown)}")
        wide = self.around(tile)
        worst: dict[str, tuple[int, int, int]] = {}
        if not self.weighs or self.trust is None:
            grids = [
                np.ascontiguousarray(own[tile.slices(wide)]).view(np.int8) for own in shown.values()
            ]
            votes = device.vote_majority(grids, unknown_votes=self.unknown_votes)
        else:
            trust = self.trust.part(list(shown))
            codes = [own.view(np.uint8) for own in shown.values()]
            counts = counts or count_walls(codes, self.shift, self.phase(wide))
            weights, ranks = local_weights(counts, trust, self.resolution)
            # Walls up to here affect a cell of the tile.
            reach = same_wall_cells(self.resolution)
            box = tile.grown_inside(reach, wide)
            inner = (slice(None), *self.blocks(box, wide))
            votes = device.vote_walls(
                [np.ascontiguousarray(c[box.slices(wide)]) for c in codes],
                np.ascontiguousarray(weights[inner]),
                np.ascontiguousarray(ranks[inner]),
                trust.weights,
                reach=reach,
                shift=self.shift,
                phase=self.phase(box),
            ).on(tile.slices(box))
            worst = self.worst(wide, counts, trust)
        return DecidedTile(
            votes.fused, votes.agreement, votes.phantom_cells, tuple(shown), votes.dissent, worst
        )

    def worst(
        self, box: CellBox, counts: WallCounts, trust: Trust
    ) -> dict[str, tuple[int, int, int]]:
        """Return where each map agrees least, by the counts; see ``DecidedTile``."""
        side, phase = 1 << self.shift, self.phase(box)
        row0, col0 = box.row0 - phase[0] + side // 2, box.col0 - phase[1] + side // 2
        return {
            name: (missed, row0 + row * side, col0 + col * side)
            for name, (missed, row, col) in disagreeing(counts, trust).items()
        }

    def blocks(self, box: CellBox, outer: CellBox) -> tuple[slice, slice]:
        """Return which rows and columns of the blocks of an outer box hold a box."""
        return self._in_blocks(box).slices(self._in_blocks(outer))

    def phase(self, box: CellBox) -> tuple[int, int]:
        """Return the row and column of the first cell of a box in its block."""
        mask = (1 << self.shift) - 1
        return (box.row0 + self.first[0]) & mask, (box.col0 + self.first[1]) & mask


def sum_counts(counts: Iterable[WallCounts]) -> WallCounts:
    """Return the sum of the counts of tiles."""
    return WallCounts(*(np.sum(tables, axis=0) for tables in zip(*counts, strict=True)))


def worst_place(places: Iterable[tuple[int, int, int]]) -> tuple[int, int, int]:
    """Return the place of tiles in which most wall cells disagree; the first one of equals."""
    return max(places, key=lambda place: (place[0], -place[1], -place[2]))


def check_votes(config: VoteConfig) -> None:
    """Refuse a mode in which maps do not vote.

    Raises:
        ConfigError: it is ``drawn``.
    """
    votes = get_args(VoteMode)
    if config.mode not in votes:
        raise ConfigError(
            f"mode {config.mode!r} draws the map from the scans of a log, and here are only maps; "
            f"use {' or '.join(votes)}, or pass the log to `slamfusion run`"
        )
