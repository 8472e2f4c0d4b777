"""The vote on an OpenCL device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import BLOCK_CELLS, EACH_LANE, MOST_INPUTS
from slamfusion.compute.opencl_queue import OpenCLQueue
from slamfusion.compute.votes import Votes

__all__ = ["OpenCLVotes"]

# Cells that one work item decides, one after the other; a multiple of ``BLOCK_CELLS``.
CHUNK_CELLS = 4096


class OpenCLVotes(OpenCLQueue):
    """The operations of ``VoteDevice`` on one OpenCL device."""

    def vote_majority(self, grids: Sequence[npt.NDArray[np.int8]], *, unknown_votes: bool) -> Votes:
        """See ``votes.numpy.vote_majority``."""
        shares = _majority_shares(len(grids), unknown_votes=unknown_votes)
        arguments = (np.int32(unknown_votes), self._table(shares), np.int32(len(shares)))
        return self._vote("vote_majority", grids, arguments)

    def vote_walls(
        self,
        codes: Sequence[npt.NDArray[np.uint8]],
        weights: npt.NDArray[np.uint8],
        ranks: npt.NDArray[np.uint16],
        trusted: npt.NDArray[np.uint8],
        *,
        shift: int,
        phase: tuple[int, int],
    ) -> Votes:
        """See ``votes.numpy.vote_walls``."""
        width = codes[0].shape[1]
        tables = [self.upload(table) for table in (weights, ranks, trusted)]
        sizes = (width, shift, *phase, *weights.shape[1:])
        arguments = (*tables, *(np.int32(size) for size in sizes))
        # A work item decides whole rows: the weights change along them every few cells.
        rows = max(1, CHUNK_CELLS // width)
        return self._vote("vote_walls", codes, arguments, chunk=rows * width)

    def _vote(
        self,
        name: str,
        grids: Sequence[npt.NDArray[np.int8] | npt.NDArray[np.uint8]],
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
        wrapped = [self.wrap_host(grid) for grid in grids]
        outs = [self.wrap_host(result, writable=True) for result in results]
        chunks = -(-cells // chunk)
        phantom = self.empty((chunks,), np.int32)
        self._launch(
            name,
            (chunks,),
            *wrapped,
            *[wrapped[0]] * (MOST_INPUTS - count),
            np.int32(count),
            np.int32(cells),
            *arguments,
            np.int32(chunk),
            *outs,
            phantom,
        )
        phantom_cells = int(self.download(phantom).sum(dtype=np.int64))
        for out, result in zip(outs, results, strict=True):
            self.map_host(out, result)
        return Votes(fused, agreement, dissent[:, :cells].reshape(planes, *shape), phantom_cells)


@cache
def _majority_shares(count: int, *, unknown_votes: bool) -> npt.NDArray[np.uint64]:
    """Return the share of the winner in percent for every split of up to ``count`` votes.

    Returns:
        (S, 3) uint64: votes for the winner, votes for others (at least 1), percent rounded half
        up, each in all eight lanes of the word.
    """
    splits = [
        (cast - others, others, (200 * (cast - others) + cast) // (2 * cast))
        for cast in ((count,) if unknown_votes else range(2, count + 1))
        for others in range(1, cast + 1)
        if unknown_votes or others <= cast - others
    ]
    return np.array(splits or [(count, 0, 100)], dtype=np.uint64) * EACH_LANE
