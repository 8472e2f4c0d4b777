"""The vote on one tile: what aligned maps show there, and their agreement, decide its cells.

Maps in memory, packed maps of a store and the layers of the live fusion are all decided here:
``prepare`` what each map shows on ``around(tile)``, ``count`` it for the trust in the maps, and
``decide``.

Maps are weighed by how well their walls agree, overall and in windows of a few metres. A wall cell
of one map agrees if the other map has a wall within the tolerance. It counts if the other map knows
the cell, or has the same wall elsewhere (``walls``). A wall that the other map draws elsewhere is
an error of the map that draws it here, less what both have in common. A wall that the other map
does not have counts as an error of both, because two maps do not show which is wrong.

The best map agrees most with all others. The reliability of another map is its agreement with the
best one, or the weakest link of a chain of maps from there. Independent voters that are right with
probability p are best weighed by the log-odds of p (Nitzan and Paroush, International Economic
Review 1982).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from typing import NamedTuple, get_args

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import (
    MOST_INPUTS,
    VOTE_ONE,
    WALL_FACE,
    WALL_FREE,
    WALL_NEAR,
    WALL_OCCUPIED,
    WALL_SIDES,
)
from slamfusion.config import VoteConfig, VoteMode
from slamfusion.errors import ConfigError, GridError
from slamfusion.geometry import B8, F64, I8, I64, U8, U16
from slamfusion.grid import UNKNOWN, CellBox
from slamfusion.vote.walls import codes_on, margin_cells, same_wall_cells

# Maps of one place that are not bent agree in at least this share of their walls.
AGREEING = 0.8
# The greatest reliability of a map, as a share of its walls.
SUREST = 0.999
# A map does not vote where the log-odds of its agreement are less than this share of the best's.
LEAST_WEIGHT = 0.1
# Levels of a weight above 0: a few cells more or less change no weight.
LEVELS = 15
# Shares are rounded to 1/200, for the same reason.
STEPS = 200
# Walls, in metres, that a map's agreement in all counts for in a window.
PRIOR_M = 2.0
# Ranks are shares in 1/1023, with six bits for the order of the maps below.
RANK_ONE, RANK_SHIFT = 1023, 6


class WallCounts(NamedTuple):
    """How the wall cells of each map compare with each other map, (N, N) or (N, N, H, W) integers.

    Attributes:
        seen: wall cells of map i that map j knows, or has elsewhere.
        met: of these, the ones with a wall of j within the tolerance.
        same: the ones that are wall cells of j.
        moved: those that j shows elsewhere: no wall of j is within the tolerance, but one that
            faces the same way is close by. What is behind the face of a solid wall j need not know.
    """

    seen: I64
    met: I64
    same: I64
    moved: I64

    @property
    def extra(self) -> I64:
        """Wall cells of map i where map j shows no wall."""
        return self.seen - self.met - self.moved

    def total(self) -> WallCounts:
        """Return the sum over all blocks."""
        return WallCounts(*(table.sum(axis=(2, 3)) for table in self))

    def part(self, blocks: tuple[slice, slice]) -> WallCounts:
        """Return a view of some rows and columns of blocks."""
        rows, cols = blocks
        return WallCounts(*(table[:, :, rows, cols] for table in self))


@dataclass(frozen=True, eq=False)
class Trust:
    """How far each map may be trusted, in the order of ``names``.

    Attributes:
        agreement: (N,) float64, the share of its walls that agree with the others', 0 to 1.
        weights: (N,) uint8, 0 (no vote) to ``VOTE_ONE``.
        precision: (N,) float64, the share of its wall cells that are wall cells of the others: of
            maps that agree alike, the one with the thinnest and steadiest walls has most.
        pairs: (N, N) float64, the share of map i's walls that map j bears out; 0.5 where they share
            no ground.
    """

    names: tuple[str, ...]
    agreement: F64
    weights: U8
    precision: F64
    pairs: F64

    def decides_like(self, other: Trust | None) -> bool:
        """Return whether the other trust, in the same maps, lets them vote alike."""
        return other is not None and all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("names", "agreement", "weights", "precision")
        )

    def part(self, names: Sequence[str]) -> Trust:
        """Return the trust in some of the maps."""
        at = [self.names.index(name) for name in names]
        return Trust(
            tuple(names),
            self.agreement[at],
            self.weights[at],
            self.precision[at],
            self.pairs[np.ix_(at, at)],
        )


def count_walls(codes: Sequence[U8], shift: int, phase: tuple[int, int] = (0, 0)) -> WallCounts:
    """Count agreeing wall cells in blocks of ``2**shift`` cells a side; (N, N, block rows, cols).

    ``codes`` are (H, W) uint8 of each map (``walls.wall_codes``); ``phase`` is the row and column
    of the first cell in its block.
    """
    (height, width), count = codes[0].shape, len(codes)
    shape = tuple(
        (side + first - 1 >> shift) + 1 for side, first in zip((height, width), phase, strict=True)
    )
    blocks = shape[0] * shape[1]
    tables = np.zeros((4, count, count, blocks), dtype=np.int64)
    for i, own in enumerate(codes):
        # NumPy searches booleans eight at a time; the view is one because WALL_OCCUPIED is 1.
        walls = np.flatnonzero((own & WALL_OCCUPIED).view(np.bool_))
        rows, cols = np.divmod(walls, width)
        block = (rows + phase[0] >> shift) * shape[1] + (cols + phase[1] >> shift)
        ways = own.take(walls) >> WALL_SIDES
        is_face = own.take(walls) & WALL_FACE != 0
        for j, other in enumerate(codes):
            if i == j:
                continue
            there = other.take(walls)
            is_met = there & WALL_NEAR != 0
            is_free = there & WALL_FREE != 0
            is_moved = ~is_met & (there >> WALL_SIDES & ways != 0) & (is_face | is_free)
            is_seen = is_met | is_moved | is_free
            is_same = there & WALL_OCCUPIED != 0
            for table, mask in zip(tables, (is_seen, is_met, is_same, is_moved), strict=True):
                table[i, j] = np.bincount(block[mask], minlength=blocks)
    return WallCounts(*tables.reshape(4, count, count, *shape))


def trust_of(names: Sequence[str], counts: WallCounts) -> Trust:
    """Return how far maps may be trusted, from the (N, N) counts of all their walls."""
    moved = (counts.moved + 0.5) / (counts.seen + 2.0)
    extra = (counts.extra + 0.5) / (counts.seen + 2.0)
    # Walls that both draw elsewhere are errors of both; a thick wall is one of the map that has it.
    both = np.sqrt(moved * moved.T)
    pairs = 1.0 - np.maximum(moved + extra, both + extra.T)
    np.fill_diagonal(pairs, 0.0)
    best = most_borne_out(pairs)
    agreement = np.zeros(len(names))
    agreement[best] = 1.0
    for _ in names[1:]:
        agreement = np.maximum(agreement, np.minimum(agreement, pairs).max(axis=1))
    agreement[best] = pairs[best].max() if len(names) > 1 else 1.0
    odds = _log_odds(agreement)
    weights = _levels(odds / odds.max()) if odds.max() > 0.0 else np.full(len(names), VOTE_ONE)
    amount = weights.astype(np.float64) * (1.0 - np.eye(len(names)))
    precision = (amount * (counts.same + 1.0)).sum(axis=1) / np.maximum(
        (amount * (counts.seen + 2.0)).sum(axis=1), 1.0
    )
    steps = np.rint(STEPS * np.array([agreement, precision])) / STEPS
    return Trust(tuple(names), steps[0], weights.astype(np.uint8), steps[1], pairs)


def most_borne_out(pairs: F64) -> int:
    """Return the map with the greatest sum of squares of (N, N) agreements with the others."""
    return int(np.argmax((pairs**2).sum(axis=1)))


def second_opinion(trust: Trust) -> tuple[str, ...]:
    """Return two or more maps without a vote that agree and contradict the others; may be none."""
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


def local_weights(counts: WallCounts, trust: Trust, resolution: float) -> tuple[U8, U16]:
    """Return what each map weighs in each block, and which is to draw the walls there.

    A map's agreement is counted in three by three blocks. Its overall agreement counts as two
    metres of wall.

    Args:
        counts: (N, N, H, W) of blocks.
        resolution: metres a cell.

    Returns:
        (N, H, W) uint8, weights from 0 to ``VOTE_ONE``; and (N, H, W) uint16, ranks: all different;
        the map with the highest, which is right and precise, draws a wall that it has.
    """
    count, prior = len(trust.names), PRIOR_M / resolution
    amount = trust.weights.astype(np.float64) / VOTE_ONE
    shape = counts.seen.shape[2:]
    odds, most = np.zeros((count, *shape)), np.zeros(shape)
    for j in range(count):
        seen, met, known = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        for i in range(count):
            if i != j and amount[i] > 0.0:
                there = _window(counts.seen[i, j] + counts.seen[j, i])
                seen += amount[i] * there
                met += amount[i] * _window(counts.met[i, j] + counts.met[j, i])
                known += amount[i] * (there > 0)
        others = np.maximum(known, 1e-9)
        odds[j] = _log_odds((met / others + prior * trust.agreement[j]) / (seen / others + prior))
        # Maps without a wall of this place do not show how reliable the best one is here.
        most = np.where(known > 0.0, np.maximum(most, odds[j]), most)
    relative = np.where(
        most > 0.0, np.minimum(1.0, odds / np.maximum(most, 1e-9)), amount[:, None, None]
    )
    weights = _levels(relative)
    steady = np.minimum(1.0, 2.0 * weights / VOTE_ONE)
    right = (trust.precision * trust.agreement)[:, None, None]
    ranks = np.rint(RANK_ONE * right * steady).astype(np.uint16)
    order = np.arange(count - 1, -1, -1, dtype=np.uint16)
    ranks = (ranks << np.uint16(RANK_SHIFT)) + order[:, None, None]
    return weights.astype(np.uint8), ranks


def disagreeing(counts: WallCounts, trust: Trust) -> Mapping[str, tuple[int, int, int]]:
    """Return where each map disagrees most: wall cells that do not agree, and the block."""
    missed = counts.seen - counts.met
    missed = (missed + missed.swapaxes(0, 1))[trust.weights > 0].sum(axis=0)
    found = {}
    for name, own in zip(trust.names, missed, strict=True):
        around = _window(own)
        row, col = np.unravel_index(int(np.argmax(around)), around.shape)
        found[name] = (int(around[row, col]), int(row), int(col))
    return found


def _log_odds(share: F64) -> F64:
    share = np.clip(share, 0.5, SUREST)
    return np.asarray(np.log(share / (1.0 - share)))


def _levels(relative: F64) -> F64:
    """Return shares of the greatest weight as weights; small ones as 0."""
    weights = np.rint(LEVELS * relative) * (VOTE_ONE // LEVELS)
    return np.where(relative < LEAST_WEIGHT, 0.0, weights)


def _window(blocks: npt.NDArray[np.integer | np.floating]) -> F64:
    """Return sums over three by three blocks; beyond the edge is nothing."""
    return np.asarray(
        cv2.boxFilter(
            blocks.astype(np.float64), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
    )


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
