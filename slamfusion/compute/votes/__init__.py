"""Votes: aligned grids decide cell by cell.

``numpy.py`` defines each operation, ``opencl.py`` and ``kernels/votes.cl`` do it on a device.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice

__all__ = ["VoteDevice", "Votes"]

I8 = npt.NDArray[np.int8]
U8 = npt.NDArray[np.uint8]


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


class VoteDevice(ArrayDevice, Protocol):
    """A device that counts votes; the grids come from the host and return to it.

    ``votes.numpy`` says what each operation does.
    """

    def vote_majority(self, grids: Sequence[npt.NDArray[np.int8]], *, unknown_votes: bool) -> Votes:
        """See ``votes.numpy.vote_majority``."""

    def vote_walls(
        self,
        codes: Sequence[U8],
        weights: U8,
        ranks: npt.NDArray[np.uint16],
        trusted: U8,
        *,
        shift: int,
        phase: tuple[int, int],
    ) -> Votes:
        """See ``votes.numpy.vote_walls``."""
