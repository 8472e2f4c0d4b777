"""The NumPy twins of the vote kernels: each function defines the kernel of its name, exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import FREE, OCCUPIED, UNKNOWN
from slamfusion.compute.votes import Votes

__all__ = [
    "vote_log_odds",
    "vote_majority",
    "vote_weighted",
]

I8 = npt.NDArray[np.int8]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]


def vote_majority(grids: Sequence[I8], *, unknown_votes: bool) -> Votes:
    """Let each cell be what most inputs say; any tie for first place is occupied.

    Args:
        grids: 1 to 32 of (H, W) int8 in {-1, 0, 1}.
        unknown_votes: unknown is a value like the others; otherwise it abstains, and a cell that
            all inputs leave unknown stays unknown.

    Source: [F16], the vote: two of three decide, three different values give 1.
    """
    return vote_weighted(grids, np.ones(len(grids), dtype=np.int32), unknown_votes=unknown_votes)


def vote_weighted(grids: Sequence[I8], weights: I32, *, unknown_votes: bool) -> Votes:
    """Let each cell be what carries most weight; any tie for first place is occupied.

    Args:
        grids: 1 to 32 of (H, W) int8 in {-1, 0, 1}.
        weights: (N,) int32, 1 to 255.
        unknown_votes: as in ``vote_majority``.
    """
    stack = np.stack(grids)
    amount = weights.astype(np.int32)[:, None, None]
    votes = np.stack(
        [((stack == value) * amount).sum(axis=0) for value in (UNKNOWN, FREE, OCCUPIED)]
    )
    if not unknown_votes:
        votes[0] = 0
    winner = votes.argmax(axis=0) - 1
    winner[(votes == votes.max(axis=0)).sum(axis=0) > 1] = OCCUPIED
    winner[votes.sum(axis=0) == 0] = UNKNOWN
    outvoted = (stack != winner) & ((stack != UNKNOWN) | unknown_votes)
    wall: npt.NDArray[np.bool_] = np.any(stack == OCCUPIED, axis=0)
    return _votes(winner, votes, outvoted, wall)


def vote_log_odds(
    grids: Sequence[I8], odds: I32, *, occupied_percent: int, free_percent: int
) -> Votes:
    """Add the log-odds of the inputs; unknown adds nothing.

    An input votes occupied where its log-odds are positive and free where negative, with their
    size as weight. The cell is occupied where the sum reaches the log-odds of
    ``occupied_percent``, free where it is at most that of ``free_percent``. Between the two the
    evidence balances: a tie, occupied, where any input alone is occupied; else unknown.

    Args:
        grids: 1 to 32 of (H, W) int8, occupancy in percent or -1.
        odds: (101,) int32, fixed-point log-odds by percent.
        occupied_percent: an input at or above this is occupied.
        free_percent: below ``occupied_percent``.
    """
    stack = np.stack(grids)
    known = stack >= 0
    side = np.where(known, odds[stack.clip(0)], 0)
    free, occupied = (-side).clip(0).sum(axis=0), side.clip(0).sum(axis=0)
    wall: npt.NDArray[np.bool_] = np.any(stack >= occupied_percent, axis=0)
    total = occupied - free
    winner = np.where(wall, OCCUPIED, UNKNOWN)
    winner[total <= odds[free_percent]] = FREE
    winner[total >= odds[occupied_percent]] = OCCUPIED
    winner[~known.any(axis=0)] = UNKNOWN
    outvoted = np.where(side > 0, winner != OCCUPIED, (side < 0) & (winner != FREE))
    return _votes(winner, np.stack([np.zeros_like(free), free, occupied]), outvoted, wall)


def _votes(
    winner: I64, votes: I32 | I64, outvoted: npt.NDArray[np.bool_], wall: npt.NDArray[np.bool_]
) -> Votes:
    """Return the outcome of a vote.

    Args:
        winner: (H, W) in {-1, 0, 1}.
        votes: (3, H, W), weight of the votes for unknown, free and occupied.
        outvoted: (N, H, W), input n voted otherwise.
        wall: (H, W), some input is occupied.
    """
    cast = votes.sum(axis=0)
    share = np.take_along_axis(votes, (winner + 1)[None], axis=0)[0]
    percent = (200 * share + cast) // np.maximum(2 * cast, 1)
    agreement = np.where(cast > 0, percent, -1).astype(np.int8)
    dissent = np.zeros((-(-len(outvoted) // 8), *winner.shape), dtype=np.uint8)
    for n, mask in enumerate(outvoted):
        dissent[n // 8] |= mask.astype(np.uint8) << np.uint8(n % 8)
    phantom = int(np.count_nonzero((winner == OCCUPIED) & ~wall))
    return Votes(winner.astype(np.int8), agreement, dissent, phantom)
