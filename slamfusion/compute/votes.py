"""Votes: aligned grids decide cell by cell.

``kernels/votes.cl`` computes the same on an OpenCL device, bit for bit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice
from slamfusion.compute.layout import (
    ALONG_COL,
    ALONG_ROW,
    BLOCK_CELLS,
    EACH_LANE,
    FREE,
    MOST_INPUTS,
    OCCUPIED,
    UNKNOWN,
    VOTE_ONE,
    WALL_FREE,
    WALL_NEAR,
    WALL_OCCUPIED,
    WALL_SIDES,
)
from slamfusion.geometry import B8, I8, I32, I64, U8, U16

if TYPE_CHECKING:
    from slamfusion.compute.opencl import OpenCLDevice


class Votes(NamedTuple):
    """What a vote gives.

    Attributes:
        fused: (H, W) int8 in {-1, 0, 1}.
        agreement: (H, W) int8, share of the votes for the winner in percent, rounded half up;
            -1 without votes.
        dissent: (P, H, W) uint8, bit n % 8 of plane n // 8 set where input n voted otherwise
            than the winner; P is the number of inputs over 8, rounded up.
        phantom_cells: cells occupied in the fused grid and in no input.
    """

    fused: I8
    agreement: I8
    dissent: U8
    phantom_cells: int

    def on(self, window: tuple[slice, slice]) -> Votes:
        """Return the decision on some rows and columns, with the phantom cells of the whole."""
        fused, agreement, dissent, phantom_cells = self
        return Votes(
            fused[window], agreement[window], dissent[(slice(None), *window)], phantom_cells
        )


# Cells that one work item decides, one after the other; a multiple of ``BLOCK_CELLS``.
CHUNK_CELLS = 4096


@cache
def _majority_shares(count: int, *, unknown_votes: bool) -> npt.NDArray[np.uint64]:
    """Return the share of the winner in percent for every split of up to ``count`` votes."""
    splits = [
        (cast - others, others, (200 * (cast - others) + cast) // (2 * cast))
        for cast in ((count,) if unknown_votes else range(2, count + 1))
        for others in range(1, cast + 1)
        if unknown_votes or others <= cast - others
    ]
    return np.array(splits or [(count, 0, 100)], dtype=np.uint64) * EACH_LANE


def _votes(winner: I64, own: I64 | I32, cast: I64 | I32, outvoted: B8, phantom_cells: int) -> Votes:
    percent = (200 * own + cast) // np.maximum(2 * cast, 1)
    agreement = np.where(cast > 0, percent, -1).astype(np.int8)
    dissent = np.zeros((-(-len(outvoted) // 8), *winner.shape), dtype=np.uint8)
    for n, mask in enumerate(outvoted):
        dissent[n // 8] |= mask.astype(np.uint8) << np.uint8(n % 8)
    return Votes(winner.astype(np.int8), agreement, dissent, phantom_cells)


def _vote(
    device: OpenCLDevice,
    name: str,
    grids: Sequence[I8 | U8],
    arguments: tuple[Any, ...],
    chunk: int = CHUNK_CELLS,
) -> Votes:
    """Run a kernel of the vote family; its own arguments follow the grids and their sizes."""
    shape, count = grids[0].shape, len(grids)
    cells = math.prod(shape)
    pitch = -(-cells // BLOCK_CELLS) * BLOCK_CELLS
    planes = -(-count // 8)
    fused, agreement = np.empty(shape, dtype=np.int8), np.empty(shape, dtype=np.int8)
    dissent = np.empty((planes, pitch), dtype=np.uint8)
    results = (fused, agreement, dissent)
    wrapped = [device.wrap_host(grid) for grid in grids]
    outs = [device.wrap_host(result, writable=True) for result in results]
    chunks = -(-cells // chunk)
    phantom = device.empty((chunks,), np.int32)
    device.launch(
        name, (chunks,), *wrapped, *[wrapped[0]] * (MOST_INPUTS - count), count, cells, *arguments,
        chunk, *outs, phantom,
    )  # fmt: skip
    phantom_cells = int(device.download(phantom).sum(dtype=np.int64))
    for out, result in zip(outs, results, strict=True):
        device.map_host(out, result)
    return Votes(fused, agreement, dissent[:, :cells].reshape(planes, *shape), phantom_cells)


class VoteDevice(ArrayDevice):
    """A device that counts votes; the grids come from the host and return to it."""

    def vote_majority(self, grids: Sequence[I8], *, unknown_votes: bool) -> Votes:
        """Let each cell be what most inputs say; any tie for first place is occupied.

        Args:
            grids: 1 to 32 of (H, W) int8 in {-1, 0, 1}.
            unknown_votes: unknown is a value like the others; otherwise it abstains, and a cell
                that all inputs leave unknown stays unknown.

        Source: [F16], the vote: two of three decide, three different values give 1.
        """
        if self.opencl:
            shares = _majority_shares(len(grids), unknown_votes=unknown_votes)
            arguments = (unknown_votes, self.opencl.table(shares), len(shares))
            return _vote(self.opencl, "vote_majority", grids, arguments)
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
        self,
        codes: Sequence[U8],
        weights: U8,
        ranks: U16,
        trusted: U8,
        *,
        reach: int,
        shift: int,
        phase: tuple[int, int],
    ) -> Votes:
        """Let inputs vote for walls with a tolerance, by weight; each wall is drawn by one input.

        The inputs with a wall within the tolerance of a cell are for a wall. Those that know the
        cell as free are against it, and those that have the same wall elsewhere: one that faces a
        way that the drawn wall faces. A tie is for the wall; where an input of weight 1/2 or more
        has the same wall elsewhere, two thirds of the weight against it are enough. Of the inputs
        for a wall the one of the highest rank draws: the cell is a wall where this one shows one.
        But where an input of a higher rank has the same wall elsewhere, and it stands there, it is
        drawn there only. Walls, and free cells, of inputs whose trust together is less than 1/2 are
        left out: the cell is unknown.

        Args:
            codes: 1 to 32 of (H, W) uint8, see ``vote.walls.wall_codes``.
            weights: (N, rows of blocks, columns of blocks) uint8, 0 to ``VOTE_ONE`` in each block.
            ranks: the same shape, uint16, all different in a block.
            trusted: (N,) uint8, 0 to ``VOTE_ONE``: weights in all.
            reach: cells up to which a wall that faces the same way is the same wall.
            shift: blocks are ``2**shift`` cells on a side.
            phase: row and column of the first cell in its block.
        """
        if self.opencl:
            width = codes[0].shape[1]
            tables = [self.upload(table) for table in (weights, ranks, trusted)]
            arguments = (*tables, width, reach, shift, *phase, *weights.shape[1:])
            # A work item decides whole rows: the weights change along them every few cells.
            rows = max(1, CHUNK_CELLS // width)
            return _vote(self.opencl, "vote_walls", codes, arguments, chunk=rows * width)
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
        is_wall = shown & WALL_OCCUPIED != 0
        ways = np.where(is_wall, shown >> WALL_SIDES, 0)

        # A wall is drawn where it stands, unless a better map draws it elsewhere.
        stands, support, against, same = _walls_stand(stack, amount, trust, ways)
        contra = (amount * against).sum(axis=0)
        stands &= highest >= 0
        better = stands & same & (2 * amount >= VOTE_ONE) & (rank > highest)
        for n, own in enumerate(stack):
            at = np.nonzero(better[n])
            row, col, found = _same_wall(own, at, (own[at] >> WALL_SIDES) & ways[at], reach)
            there, weighing = stack[:, row, col], amount[:, at[0], at[1]]
            found &= _walls_stand(there, weighing, trust[..., 0], there[n] >> WALL_SIDES)[0]
            stands[at] &= ~found

        # Elsewhere who says free says it alone.
        freeing = (amount * free).sum(axis=0)
        is_free = (freeing > 0) & (2 * (trust * free).sum(axis=0) >= VOTE_ONE)
        winner = np.where(stands & is_wall, OCCUPIED, np.where(is_free, FREE, UNKNOWN))

        walls = (amount * wall).sum(axis=0)
        voted = np.where(winner == OCCUPIED, support, np.where(winner == FREE, freeing, 0))
        cast = np.where(
            winner == OCCUPIED, support + contra, np.where(winner == FREE, freeing + walls, 0)
        )
        outvoted = np.where(winner == OCCUPIED, against, (wall | free & (winner != FREE)) & ~stands)
        return _votes(winner, voted, cast, outvoted, 0)


def _walls_stand(stack: U8, amount: I32, trust: I32, ways: U8) -> tuple[B8, I32, B8, B8]:
    """Return where walls stand that face some ways; see ``VoteDevice.vote_walls``.

    Args:
        stack: (N, ...) codes.
        amount, trust: weights here and in all, of the same number of axes.
        ways: (...) of the walls.

    Returns:
        Where they stand and the weights for them, (...); which inputs are against them and which
        have the same walls elsewhere, (N, ...).
    """
    near = stack & WALL_NEAR != 0
    same = ~near & ((stack >> WALL_SIDES) & ways != 0)
    against = ~near & (same | (stack & WALL_FREE != 0))
    support = (amount * near).sum(axis=0)
    moved = (same & (2 * amount >= VOTE_ONE)).any(axis=0)
    stands = np.where(moved, 3, 2) * support >= 2 * (amount * against).sum(axis=0)
    return stands & (2 * (trust * near).sum(axis=0) >= VOTE_ONE), support, against, same


def _same_wall(own: U8, at: tuple[I64, ...], ways: U8, reach: int) -> tuple[I64, I64, B8]:
    """Return rows and columns (K,) of the nearest wall of one input that faces some ways.

    The search goes along rows and columns from ``at``, ``reach`` cells far; also returns which
    walls were found.
    """
    rows, cols = at[0].copy(), at[1].copy()
    found = np.zeros(len(rows), dtype=np.bool_)
    edge = np.pad(own, reach)
    for step, side, aside in itertools.product(range(1, reach + 1), range(4), (-1, 0, 1)):
        far = -step if side % 2 else step
        down, right = (aside, far) if side < 2 else (far, aside)
        code = edge[at[0] + reach + down, at[1] + reach + right]
        hit = ways & (ALONG_ROW if side < 2 else ALONG_COL) != 0
        hit &= ~found & (code & WALL_OCCUPIED != 0) & ((code >> WALL_SIDES) & ways != 0)
        rows[hit], cols[hit] = at[0][hit] + down, at[1][hit] + right
        found |= hit
    return rows, cols, found
