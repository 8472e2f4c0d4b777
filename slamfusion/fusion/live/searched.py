"""``Searched``: what a search gave for a pair, which its tracking is held against."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slamfusion.align.decide import CLASH_MAX, MATCH_MIN
from slamfusion.align.records import Alignment

# An input that the search believed by clearly matching walls must go on to match; one that it
# believed since its place stood out among all others, by this share of the walls that met then.
CLEAR_MATCH = MATCH_MIN + 0.05
LASTING_SHARE = 0.85
CLASH_MORE = 0.05


@dataclass(frozen=True)
class Searched:
    """What the search, or the first fusion, gave for a pair.

    The score and the walls that meet are shares of all walls of both maps. Where two robots' maps
    grow away from each other these fall although all is well; what the ground that both maps know
    says does not.

    Attributes:
        score: of all walls; lower where the maps grew away from each other since.
        match, clash: shares of all walls, see ``measure``.
        reason: why the pair was believed.
        ground: evidence as a share of what the ground that both maps know could give.
        pieces: pieces of wall there that spoke for the pair; infinite where it is not known.
    """

    score: float
    match: float
    clash: float
    reason: str
    ground: float = 1.0
    pieces: float = math.inf

    @classmethod
    def of(cls, pair: Alignment) -> Searched:
        """Return what is kept of a pair that was searched."""
        statistics, evidence = pair.statistics, pair.evidence
        return cls(
            pair.score,
            statistics.get("wall_match", 0.0),
            statistics.get("wall_clash", 0.0),
            pair.reason,
            *(() if evidence is None else (evidence.share, evidence.pieces)),
        )

    def lasts(self, pair: Alignment, share: float) -> bool:
        """Whether a tracked pair still fits.

        By a share of its score then, or of what the common ground said; and by its walls, or nearly
        all that the common ground said.
        """
        if pair.score < share * self.score and not self._has_ground(pair, share):
            return False
        if pair.accepted:
            return True
        statistics = pair.statistics
        was_clear = self.match >= CLEAR_MATCH and self.clash <= CLASH_MAX
        do_walls_last = (
            not was_clear and statistics.get("wall_match", 0.0) >= LASTING_SHARE * self.match
        )
        return (do_walls_last or self._has_ground(pair, LASTING_SHARE)) and statistics.get(
            "wall_clash", 1.0
        ) <= self.clash + CLASH_MORE

    def tracked(self, pair: Alignment, share: float) -> Searched:
        """Return this with the lower score of a pair whose maps grew away from each other."""
        if pair.score >= self.score or not self._has_ground(pair, share):
            return self
        return replace(self, score=pair.score)

    def _has_ground(self, pair: Alignment, share: float) -> bool:
        """Whether the common ground still says this share of what it said then, in both ways."""
        now = pair.evidence
        return (
            now is not None
            and now.share >= share * self.ground
            and now.pieces >= share * self.pieces
        )
