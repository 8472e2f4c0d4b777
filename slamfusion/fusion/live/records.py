"""What an update of the live fusion says: of the fused map and of each input."""

from __future__ import annotations

from dataclasses import dataclass

from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid


@dataclass(frozen=True, eq=False)
class LiveInput:
    """One input as the last update left it.

    Attributes:
        name: as given to ``put``.
        age_s: time since its last message; infinite before the first.
        rate_hz: messages a second, smoothed; 0 before the second.
        accepted: whether it votes.
        reason: why (not), one line.
        transform: its map frame into the fused frame, metres; the last that was believed.
        score, overlap: of its last alignment, see ``Alignment``; 1 for the reference.
        maps: messages that came, usable or not.
        rejected: those among them that said too little or could not be read.
        is_tracked: whether the last alignment started from the last transform.
    """

    name: str
    age_s: float
    rate_hz: float
    accepted: bool
    reason: str
    transform: Pose2 | None
    score: float
    overlap: float
    maps: int
    rejected: int
    is_tracked: bool


@dataclass(frozen=True, eq=False)
class LiveUpdate:
    """What an update did.

    Attributes:
        fused: cells -1, 0, 100 in the fused frame; None when there is nothing new to publish.
        agreement: share of votes for the winner, 0..100, -1 without; None with ``fused``.
        inputs: every input that ever came, in the order in which they came.
        phantom_cells: occupied in the fused map, in no input.
        time_s: seconds by step: ``prepare``, ``align``, ``vote``.
        is_full_search: whether an input was searched everywhere.
        reference: name of the input that others are aligned to; empty without.
        changed_box: holds the cells of ``fused`` that were voted on; None with ``fused``.
        problem: why nothing is fused, one line; empty while something is.
    """

    fused: OccupancyGrid | None
    agreement: OccupancyGrid | None
    inputs: tuple[LiveInput, ...]
    phantom_cells: int
    time_s: dict[str, float]
    is_full_search: bool
    reference: str
    changed_box: CellBox | None
    problem: str = ""
