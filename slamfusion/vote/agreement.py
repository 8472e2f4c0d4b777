"""Weigh maps by how well their walls agree, overall and in windows of a few metres.

A wall cell of one map agrees if the other map has a wall within the tolerance. It counts if the
other map knows the cell, or has the same wall elsewhere (``walls``). A wall that the other map
draws elsewhere is an error of the map that draws it here, less what both have in common. A wall
that the other map does not have counts as an error of both, because two maps do not show which is
wrong.

The best map agrees most with all others. The reliability of another map is its agreement with the
best one, or the weakest link of a chain of maps from there. Independent voters that are right with
probability p are best weighed by the log-odds of p (Nitzan and Paroush, International Economic
Review 1982).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import (
    VOTE_ONE,
    WALL_FACE,
    WALL_FREE,
    WALL_NEAR,
    WALL_OCCUPIED,
    WALL_SIDES,
)
from slamfusion.geometry import F64, I64, U8, U16

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
