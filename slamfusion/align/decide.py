"""Accept or reject an alignment: is it better than everything else that may explain the two maps?

The answer of a search is the best of millions of poses, so it fits well even if the maps show two
places. A right answer has no close rival. So it is compared piece by piece of wall (``hypotheses``)
with **another pose**, **a shift of itself** (a corridor slides along itself), **no relation**
between the maps, and, if it is better than these, its **mirror image** and **another scale**. ``n``
is the number of independent pieces of equal weight that prefer the answer; of good maps without
what the fitted motion took to agree (``lines``), and the evidence of another pose counts by the
share that it explains, of the answer's. The image has the same walls and is no place, so it fits as
well as chance allows: for good maps that much is taken from ``n``. Chance does not
make an image that would be accepted itself, but places that are nearly their own image are rare.

Two maps of a place are read in three ways; the weight of a piece depends on how well a reading
fits:

    good      what stays unexplained contradicts         weight = odds(share) / ODDS_ONE
    changed   sharp maps of two times: things moved      weight = twice that, at most 1
    bent      walls lie next to each other, not on them  weight = share of the walls that do
    score = weight * least n
    expected wrong = pairs * prior * TRIALS * exp(-score)    (of one pose without TRIALS)

with odds(share) = share / (1 - share) of the common walls that the answer explains. The exponential
in the pieces is the tail of the best of many chance fits (Karlin and Altschul 1990, for sequences).
The reading with the highest score gives the answer; the expected number of equally good wrong
answers in the whole job must be below ``EXPECTED_WRONG_MAX``. The prior is smaller near a start,
and larger on more ground or with little common ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, get_args

Reading: TypeAlias = Literal["good", "changed", "bent"]
Hypothesis: TypeAlias = Literal[
    "another pose",
    "a shift of itself",
    "no relation",
    "its mirror image",
    "a pose away from the start",
]
DecisionKind: TypeAlias = Literal[
    "accepted",
    "different place",
    "ambiguous",
    "too little in common",
    "bent",
    "mirrored",
    "other scale",
    "not searched",
]
DECISIONS: tuple[DecisionKind, ...] = get_args(DecisionKind)
Strength: TypeAlias = Literal["strong", "fair", "weak"]

# Maps with fewer wall cells than this fit anywhere.
WALLS_MIN = 24
# Limit of the expected number of wrong answers in a job: one job in a hundred.
EXPECTED_WRONG_MAX = 0.01
# Wrong answers that no piece of wall contradicts: two widths of a wall, best of several chances.
TRIALS = 4.0
# Ground on which the middle of the moving map may lie, square metres, for which TRIALS holds: two
# maps of 45 m. More ground has proportionally more places that look right by chance.
GROUND_ONE_M2 = 10_000.0
# Share of given starts that are wrong: the prior of a place away from the start.
START_WRONG = 0.005
# Share of places that are nearly their own mirror image: of 2736 right answers 13.
SYMMETRIC = 0.005
# Share of the walls that is left unexplained by chance: three of four halves of one map leave less.
UNEXPLAINED_MIN = 0.03
# Odds of the explained share at which a piece of good maps would count as one, 0.78 of the walls:
# fitted to halves of recorded maps and to drawn buildings.
ODDS_ONE = 3.5
# Least share of the common walls that two good maps of one place and time explain: of 2736 right
# answers all but 8 explain more.
SAME_TIME_SHARE = 0.85
# Metres of wall that are one observation, two widths of a wall: a score is never more than the
# evidence in nats.
OBSERVED_M = 0.3
# Greatest share that two storeys with the same outer walls explain: outer walls are half to six
# tenths of all, and a quarter of the inner ones meets a wall by chance.
STOREYS_SHARE = 0.7
# Half, as a limit of four shares: of the smaller map, the common ground for which TRIALS holds, and
# above which two places are reported as alike; of the common walls, the least that maps of two
# times explain; of the evidence, the most that a mirror image may have by chance and takes nothing.
# And of the odds at which a piece counts as one, those of changed maps.
MOST = 0.5
# Maps whose scales differ more are rejected.
SCALE_MAX = 0.03


class Decision(NamedTuple):
    """What is decided, and why, in one line."""

    kind: DecisionKind
    reason: str

    @property
    def accepted(self) -> bool:
        """Whether the alignment may be used."""
        return self.kind == "accepted"


@dataclass(frozen=True)
class MatchEvidence:
    """The evidence for and against an alignment, counted in independent pieces of wall."""

    reading: Reading
    """How the maps are read: both good, one changed since (sharp, of two times), or one bent."""
    pieces: float
    """Pieces of wall of equal weight that speak for it."""
    better: float
    """Pieces of equal weight that say that it is better than the hypothesis that comes nearest."""
    nearest: Hypothesis
    """The hypothesis that comes nearest to it."""
    weight: float
    """What a piece counts in this reading; 0 where the maps cannot be read so."""
    share: float
    """Evidence as a share of what the common ground could give, 0 to 1."""
    common_m: float
    """Wall that lies where the other map has seen something, metres."""
    rival_ratio: float
    """The evidence for the best answer elsewhere over that for this one."""
    expected_wrong: float
    """Wrong answers of the whole job that would look as good; accepted below 0.01."""
    mirrored: float | None = None
    """The evidence for the mirror image over that for the answer; null: not looked for."""
    scale: float | None = None
    """The moving map's metre in the reference's; null: not estimated."""


def odds(share: float) -> float:
    """Return what is explained over what is not, ``UNEXPLAINED_MIN`` at least."""
    return share / max(1.0 - share, UNEXPLAINED_MIN)


def expected_wrong(score: float, trials: float) -> float:
    """Return the expected number of equally good wrong answers in the whole job."""
    return trials * math.exp(-min(max(score, -500.0), 500.0))


def strength_of(share: float) -> Strength:
    """Return how good an accepted alignment is, by ``MatchEvidence.share``."""
    if share >= SAME_TIME_SHARE:
        return "strong"
    return "fair" if share >= STOREYS_SHARE else "weak"


def decide(
    evidence: MatchEvidence, statistics: dict[str, float], rival: str | None, trials: float
) -> Decision:
    """Decide on the answer of a search.

    ``statistics`` are those of ``answer.measure``; ``rival`` describes where the best answer
    elsewhere lies, None if there is none.
    """
    mirrored = decide_mirrored(evidence.mirrored)
    if mirrored is not None:
        return mirrored
    if evidence.expected_wrong >= EXPECTED_WRONG_MAX:
        return _not_beaten(evidence, statistics, rival, trials)
    off = abs((evidence.scale or 1.0) - 1.0)
    if off >= SCALE_MAX:
        return Decision(
            "other scale", f"the maps differ in scale by {off:.1%}: is a resolution wrong?"
        )
    strength = strength_of(evidence.share)
    said = f"walls match ({strength}): {_share_of_walls(evidence)}"
    if rival is not None:
        said += f", the next place {evidence.rival_ratio:.0%} of that"
    if strength == "weak":
        said += f"; {_contradiction(evidence)}"
    if off > 0.0:
        said += f"; the maps differ in scale by {off:.1%}"
    return Decision("accepted", said)


def decide_mirrored(mirrored: float | None) -> Decision | None:
    """Reject a pair whose mirror image fits as well; None if it does not."""
    if mirrored is None or mirrored < 1.0:
        return None
    return Decision(
        "mirrored",
        "its mirror image fits as well or better: is a laser upside down, or a map mirrored or "
        "transposed?",
    )


def _share_of_walls(evidence: MatchEvidence) -> str:
    return f"{evidence.share:.0%} of the {evidence.common_m:.0f} m of common walls"


def _contradiction(evidence: MatchEvidence) -> str:
    """Describe what an answer leaves unexplained, with possible causes."""
    bent = ", or is a map bent" if evidence.reading == "bent" else ""
    return (
        f"{1.0 - evidence.share:.0%} of the common walls contradict: another storey or another "
        f"time (moved furniture){bent}?"
    )


def _not_beaten(
    evidence: MatchEvidence, statistics: dict[str, float], rival: str | None, trials: float
) -> Decision:
    """Reject an answer by the hypothesis that it does not beat."""

    def is_enough(pieces: float) -> bool:
        return expected_wrong(pieces, trials) < EXPECTED_WRONG_MAX

    rivalry = f"{evidence.rival_ratio:.0%} of that"
    if evidence.nearest == "its mirror image":
        return Decision(
            "different place",
            "the maps may show two places (give a start if not): the best fit explains "
            f"{_share_of_walls(evidence)}, a chance fit of the mirror image "
            f"{evidence.mirrored:.0%} of that",
        )
    contradiction = "" if evidence.reading == "good" else f"; {_contradiction(evidence)}"
    if not is_enough(evidence.pieces * max(evidence.weight, 1.0)):
        return Decision(
            "too little in common",
            f"too little in common to judge: {evidence.common_m:.1f} m of walls, "
            f"{max(0.0, evidence.pieces):.1f} independent pieces of wall; maps of two places fit "
            f"so well by chance{contradiction}",
        )
    if is_enough(evidence.better):
        return Decision(
            "bent",
            f"maybe the same place, but {evidence.expected_wrong:.2g} wrong answers are expected "
            f"to look as good (limit {EXPECTED_WRONG_MAX:g}): {_contradiction(evidence)}",
        )
    if evidence.nearest == "a shift of itself":
        return Decision(
            "too little in common",
            f"too little in common: of the {evidence.common_m:.1f} m of common walls "
            f"{max(0.0, evidence.better):.1f} independent pieces tell it from a shift of itself",
        )
    is_alike = min(evidence.share, evidence.rival_ratio, statistics["overlap"]) >= MOST
    if is_alike and rival is not None:
        return Decision(
            "ambiguous",
            "ambiguous: the same place twice? the best fit explains "
            f"{_share_of_walls(evidence)}, and another transform, {rival}, explains {rivalry}"
            f"{contradiction}",
        )
    return Decision(
        "different place",
        "the maps do not show the same place: the best fit explains "
        f"{statistics['explained']:.0%} of the smaller map's walls, a random one "
        f"{statistics['explained_by_chance']:.0%}; another pose explains {rivalry}",
    )
