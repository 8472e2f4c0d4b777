"""The NumPy twins of the vote kernels: each function defines the kernel of its name, exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    VOTE_ONE,
    WALL_FREE,
    WALL_NEAR,
    WALL_OCCUPIED,
    WALL_SIDES,
)
from slamfusion.compute.votes import Votes

__all__ = ["vote_majority", "vote_walls"]

I8 = npt.NDArray[np.int8]
U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]


def vote_majority(grids: Sequence[I8], *, unknown_votes: bool) -> Votes:
    """Let each cell be what most inputs say; any tie for first place is occupied.

    Args:
        grids: 1 to 32 of (H, W) int8 in {-1, 0, 1}.
        unknown_votes: unknown is a value like the others; otherwise it abstains, and a cell that
            all inputs leave unknown stays unknown.

    Source: [F16], the vote: two of three decide, three different values give 1.
    """
    stack = np.stack(grids)
    votes = np.stack([(stack == value).sum(axis=0) for value in (UNKNOWN, FREE, OCCUPIED)])
    if not unknown_votes:
        votes[0] = 0
    winner = votes.argmax(axis=0) - 1
    winner[(votes == votes.max(axis=0)).sum(axis=0) > 1] = OCCUPIED
    cast = votes.sum(axis=0)
    winner[cast == 0] = UNKNOWN
    outvoted = (stack != winner) & ((stack != UNKNOWN) | unknown_votes)
    own = np.take_along_axis(votes, (winner + 1)[None], axis=0)[0]
    phantom = (winner == OCCUPIED) & ~np.any(stack == OCCUPIED, axis=0)
    return _votes(winner, own, cast, outvoted, int(np.count_nonzero(phantom)))


def vote_walls(
    codes: Sequence[U8],
    weights: U8,
    ranks: npt.NDArray[np.uint16],
    trusted: U8,
    *,
    shift: int,
    phase: tuple[int, int],
) -> Votes:
    """Let inputs vote for walls with a tolerance, by weight; each wall is drawn by one input.

    The inputs with a wall within the tolerance of a cell are for a wall. Those that know the cell
    as free are against it, and those that have the same wall elsewhere: one that faces a way that
    the drawn wall faces. Of the inputs for it the one of the highest rank draws: the cell is what
    this one shows. A tie is for the wall. But where an input of weight 1/2 or more has the same
    wall elsewhere, the wall stands at one of two places: there the weights must differ by half, or
    the rank decides. A wall, or a free cell, of inputs whose trust together is less than 1/2 is
    left out, and the cell is unknown.

    Args:
        codes: 1 to 32 of (H, W) uint8, see ``vote.walls.wall_codes``.
        weights: (N, rows of blocks, columns of blocks) uint8, 0 to ``VOTE_ONE`` in each block.
        ranks: the same shape, uint16, all different in a block.
        trusted: (N,) uint8, 0 to ``VOTE_ONE``: weights in all.
        shift: blocks are ``2**shift`` cells on a side.
        phase: row and column of the first cell in its block.
    """
    stack = np.stack(codes)
    height, width = stack.shape[1:]
    rows = np.arange(height) + phase[0] >> shift
    cols = np.arange(width) + phase[1] >> shift
    amount = weights[:, rows[:, None], cols].astype(np.int32)
    rank = ranks[:, rows[:, None], cols].astype(np.int32)
    trust = trusted.astype(np.int32)[:, None, None]
    wall, free, near = (stack & bit != 0 for bit in (WALL_OCCUPIED, WALL_FREE, WALL_NEAR))

    # Who draws here, and which ways its wall faces.
    drawing = np.where(near & (amount > 0), rank, -1)
    first = drawing.argmax(axis=0)[None]
    highest = np.take_along_axis(drawing, first, axis=0)[0]
    shown = np.take_along_axis(stack, first, axis=0)[0]
    ways = np.where(shown & WALL_OCCUPIED != 0, shown >> WALL_SIDES, 0)

    # For and against a wall.
    same = ~near & ((stack >> WALL_SIDES) & ways != 0)
    support = (amount * near).sum(axis=0)
    against = ~near & (free | same)
    contra = (amount * against).sum(axis=0)
    rival = np.where(same & (2 * amount >= VOTE_ONE), rank, -1).max(axis=0)
    stands = np.where(
        rival < 0,
        support >= contra,
        np.where(rival > highest, support >= 2 * contra, 2 * support >= contra),
    )
    stands &= (highest >= 0) & (2 * (trust * near).sum(axis=0) >= VOTE_ONE)

    # Elsewhere who says free says it alone.
    freeing = (amount * free).sum(axis=0)
    is_free = (freeing > 0) & (2 * (trust * free).sum(axis=0) >= VOTE_ONE)
    drawn = np.where(
        shown & WALL_OCCUPIED != 0, OCCUPIED, np.where(shown & WALL_FREE != 0, FREE, UNKNOWN)
    )
    winner = np.where(stands, drawn, np.where(is_free, FREE, UNKNOWN))

    walls = (amount * wall).sum(axis=0)
    own = np.where(winner == OCCUPIED, support, np.where(winner == FREE, freeing, 0))
    cast = np.where(
        winner == OCCUPIED, support + contra, np.where(winner == FREE, freeing + walls, 0)
    )
    outvoted = np.where(winner == OCCUPIED, against, (wall | free & (winner != FREE)) & ~stands)
    return _votes(winner, own, cast, outvoted, 0)


def _votes(
    winner: npt.NDArray[np.int64],
    own: npt.NDArray[np.int64] | I32,
    cast: npt.NDArray[np.int64] | I32,
    outvoted: Mask,
    phantom_cells: int,
) -> Votes:
    """Return the outcome of a vote.

    Args:
        winner: (H, W) in {-1, 0, 1}.
        own: (H, W), weight of the votes for it.
        cast: (H, W), weight of all votes that count.
        outvoted: (N, H, W), input n voted otherwise.
        phantom_cells: cells that are occupied and in no input.
    """
    percent = (200 * own + cast) // np.maximum(2 * cast, 1)
    agreement = np.where(cast > 0, percent, -1).astype(np.int8)
    dissent = np.zeros((-(-len(outvoted) // 8), *winner.shape), dtype=np.uint8)
    for n, mask in enumerate(outvoted):
        dissent[n // 8] |= mask.astype(np.uint8) << np.uint8(n % 8)
    return Votes(winner.astype(np.int8), agreement, dissent, phantom_cells)
