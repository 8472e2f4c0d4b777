"""Believe an alignment or not, and say why in one line.

The answer of a search over all poses is the best of millions: it fits well even where the maps
show two places. What a right answer has, and a wrong one lacks, is that nothing else comes near
it. So the answer is compared with the best answer elsewhere, piece of wall by piece of wall
(``scores``). Were both chance, either could be the better one at any piece, and the number of
pieces of equal weight that speak for the answer would seldom be large: what falls off there is the
tail of the best of many chance fits (Karlin and Altschul 1990, for sequences), and the rival, the
best of all other poses, stands for all that were searched. The pieces count by the share of what
the common ground could give, since a chance fit leaves much of it unexplained:

    n = better * min((share / (1 - share) / ODDS_ONE)^2, WEIGHT_MOST)    two good maps of one place
    n = better * min(share / (1 - share) / ODDS_SHARP, 1)                sharp ones, one is old
    n = better * max(share, SHARE_FLOOR)                                 one is bent
    expected_wrong = pairs * prior * TRIALS * exp(-RATE * n)

is the number of wrong answers to be expected among the pairs of a job, and must stay below
``EXPECTED_WRONG_MAX``: TRIALS and RATE accept from n = 6.0. A search that was cut
leaves poses in which a better rival may be, and has ``CUT_TRIALS`` times the TRIALS. A start that
was given makes the poses near it as much more probable as they are fewer than all poses; of maps
that may be bent there are more where there is more ground.

A mirror image and a map of another scale may match better than anything else does and are looked
for on their own; a map that is bent may stand roughly where it belongs, with most of its walls
beside those of the other, and is not believed.

An accepted answer is strong, fair or weak by its share alone (``strength_of``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, get_args

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

# Fewer wall cells than this fit anywhere.
WALLS_MIN = 24
# Of the wrong answers in a job fewer than this are to be expected.
EXPECTED_WRONG_MAX = 0.01
# Where fewer than this are, maps that do not fit are refused as bent, and not as different places:
# 5 of 3403 pairs that show no common place are.
MAYBE_HERE = 0.1
# Wrong answers that no piece of wall speaks against, and how fast chance runs out, per piece. One
# for each of two widths of a wall, and twice that, since an answer is the best of more chances: of
# good maps it is fitted narrowly, too (the corner of a depot on the map of a lost SLAM, the best of
# some 2000 such pairs, counts 6.4), and maps that may be bent are let off a part of what they leave
# unexplained (a plan of offices on a warehouse counts 5.6).
TRIALS = 4.0
RATE = 1.0
# Maps that are bent explain less of their common ground; pieces count at least this much.
SHARE_FLOOR = 0.6
# Where this share of all walls of both maps meets within 0.15 m, and this share of the common
# ground fits whole (``WallPieces.whole``), neither map is bent: what stays unexplained was moved,
# or belongs to another building with these outer walls. Pieces count by the odds of what is
# explained, as one at these: 0.2 where five eighths are.
SHARP_MATCH, SHARP_WHOLE, ODDS_SHARP = 0.45, 0.4, 8.0
# Ground on which the middle of the moving map may lie, in square metres, at which TRIALS is what it
# is: two maps of 30 m. On more there are as many more places that may look right by chance: halves
# of a place 150 m long, one drawn 1.1 times as large, count 7.2 of the 6.0 that are needed, and a
# room of 9 m in one of the many rooms there 5.8. The latter are good maps, of which more has to fit
# at a place: there are half as many.
GROUND_ONE_M2, GROUND_ONE_GOOD_M2 = 5000.0, 10000.0
# Good maps explain nearly all of it. At these odds of what is explained against what is not (92 %)
# a piece counts as one, by the square of the odds, as two at most (from 94 % on): where a fifth is
# unexplained, wrong answers have up to ten pieces for them.
ODDS_ONE, WEIGHT_MOST = 11.0, 2.0
# Poses that a search which was cut has left out count as further trials: so many in all.
CUT_TRIALS = 5.0
# More pieces than this make no difference that a number can show.
COUNTED_MAX = 500.0
# Less of what the common ground could give: the maps do not fit each other.
SHARE_MIN = 0.25
# An answer with this share is a good fit, if another fits as well.
SHARE_FIT = 0.5
# Most of the smaller map: of its ground where two places are said to be alike (elsewhere the best
# fit lays an edge of one map on an edge of the other), of its walls where two storeys may be.
MOST = 0.5
# Share of the common walls that two maps of one place and time explain: of recorded pairs of two
# SLAMs MIT CSAIL 0.86, a room 0.87 to 0.96, the Intel lab 0.91, offices 0.97 to 0.99.
SAME_TIME_SHARE = 0.85
# Share that two storeys with the same outer walls explain at most. Outer walls are half to six
# tenths of all (44 of 85 m of a building of 12 m x 10 m), and up to a quarter of the inner ones
# lies on walls by chance (``chance`` of recorded buildings: 0.15 to 0.3). Of 60 buildings that were
# drawn with other rooms in the same outer walls the most is 0.63.
STOREYS_SHARE = 0.7
# Walls of one map in the middle of the other's free space, as a share of all its walls.
CLASH_MAX = 0.15
# ... which maps of one place and different age have, too; they explain this much of what is common.
CLASH_SHARE = 0.55
# Nearly all walls of both maps meet: such an answer may have a rival that leaves twice as many.
MATCH_SURE = 0.9
UNEXPLAINED_RATIO = 0.5
# No less than this counts as unexplained: of copies turned on themselves neither is better.
MISSED_MIN = 0.01
# Metres of common wall, found without a start, below which any corner of a room fits some other:
# 2.8 m of a half that was drawn 1.1 times as large were believed.
COMMON_MIN_M = 3.0
# Share of what the smaller map knows that the other must know, too, without a start. Right halves
# that share a tenth share 0.06 of what they know; where less meets, only walls at the very edge of
# both do: 5 m of a floor of 2700 m2 on a room, 0.01 of which met, were believed.
GROUND_MIN = 0.03
# Metres of common wall, and share of it, beside its two longest straight lines, below which it is
# one corner. Where 10 to 21 m of two places were nearly believed 0 to 0.05 m were, and once 1 m; of
# 555 right halves that share 10 to 30 % four are as poor, and five more below 0.5 m.
BESIDE_MIN_M, BESIDE_SHARE = 0.3, 0.02
# Pieces of wall that hold an answer, for each metre in the direction in which the fewest do: one of
# each map, and as many in the other direction. Longer walls there make it no surer.
HELD_PIECES = 4.0
# A rival that gives at least this share of the answer's evidence may be the place as well: of good
# maps it takes off of what speaks for the answer (``WallPieces.against``), and it is named as the
# second place. One that gives less is no such place, though few pieces tell it from the answer.
RIVAL_RATIO = 0.5
# A start chooses between answers that are as good but for so many pieces, if they fit so well.
TIE, SHARE_TIED = 0.25, 0.75
# An answer elsewhere whose share is so much higher may be right.
CLEANER = 0.25
# The mirror image gives nearly as much as the answer, or more.
MIRROR_GAIN = 0.9
# Scales that differ less are said, those that differ more are refused.
SCALE_SAID = 0.01
SCALE_MAX = 0.03
# Maps that fit so well at another scale have a wrong resolution; others are bent, and their scale
# differs from place to place.
SCALED_SHARE_MIN = 0.6
# A known transform that was only refined: matched walls of all walls, or of the common ground.
MATCH_MIN = 0.45
EXCESS_MIN = 0.20
TRACKED_WITNESSES_MIN = 12.0


@dataclass(frozen=True)
class Decision:
    """What is believed.

    Attributes:
        accepted: whether the alignment is.
        kind: in one of a few words.
        reason: in one line.
    """

    accepted: bool
    kind: DecisionKind
    reason: str


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against an alignment.

    Attributes:
        walls: wall cells of the map that has fewer.
        common_m: metres of wall that lie where the other map has seen something.
        common_ground: share of the known cells of the map that has fewer that the other knows, too.
        share: evidence as a share of what the common ground could give, at most 1.
        witnesses: pieces of wall of equal weight that speak for the answer.
        better: pieces of equal weight that say that it is better than the best answer elsewhere,
            at most ``witnesses``; below 0 where the other is better.
        ratio: the evidence for the best answer elsewhere over that for this one.
        rival: where that lies, for the reason; None without one.
        pairs: pairs of maps in the job.
        prior: how much fewer the poses near a given start are than all; above 1 where there are
            more than on ``GROUND_ONE_M2``, of good maps ``GROUND_ONE_GOOD_M2``.
        statistics: see ``answer.measure``.
        search: what stands behind it: ``full`` (all yaws and shifts), ``window``,
            ``fixed step``, or ``tracked`` (a known transform was only refined).
        mirrored: the evidence for the mirror image over that for the answer; None: not looked for.
        scale: size of the moving map's metre in the reference's, None: not estimated.
        scaled_share: ``share`` at that scale, by the narrow width of a wall.
        is_plain: weighed as two good maps (``WallPieces.doubt``), not as maps that may be bent.
        is_sharp: whether walls meet so well, or not at all, that neither map is bent
            (``SHARP_MATCH``).
        is_cut: whether walls fill the cells that were searched (``CoarseSearch.is_cut``).
        held_m: metres of wall that hold the answer in the direction in which the fewest do (see
            ``common_walls``); None: not asked.
        beside_lines_m: metres of common wall beside the two straight lines on which most of it
            lies (see ``common_walls``); None: not asked.
        better_inside: ``better`` among the answers in the window; None without one.
        clean_share: the highest share of another answer that gives at least 0.7 of its evidence.
    """

    walls: int
    common_m: float
    share: float
    witnesses: float
    better: float
    ratio: float
    rival: str | None
    pairs: int
    prior: float
    statistics: dict[str, float]
    search: str
    mirrored: float | None = None
    scale: float | None = None
    scaled_share: float = 0.0
    clean_share: float = 0.0
    held_m: float | None = None
    beside_lines_m: float | None = None
    better_inside: float | None = None
    common_ground: float = 1.0
    is_plain: bool = False
    is_sharp: bool = False
    is_cut: bool = False


def expected_wrong(
    better: float,
    share: float,
    pairs: int = 1,
    prior: float = 1.0,
    *,
    is_plain: bool = False,
    is_sharp: bool = False,
    is_cut: bool = False,
) -> float:
    """Return how many wrong answers are to be expected to look as good, in the whole job.

    Args:
        better, share, pairs, prior, is_plain, is_sharp, is_cut: see ``Evidence``.
    """
    weight = piece_weight(share, is_plain=is_plain, is_sharp=is_sharp)
    counted = min(better * weight, COUNTED_MAX)
    trials = TRIALS * (CUT_TRIALS if is_cut else 1.0)
    return pairs * prior * trials * math.exp(-RATE * max(counted, -COUNTED_MAX))


def piece_weight(
    share: float, *, is_plain: bool = False, is_sharp: bool = False, odds_one: float = ODDS_ONE
) -> float:
    """Return what a piece of wall that speaks for an answer counts.

    Args:
        share, is_plain, is_sharp: see ``Evidence``.
        odds_one: odds of what is explained at which a piece of good maps counts as one.
    """
    odds = share / max(1.0 - share, 1e-9)
    if is_plain:
        return min((odds / odds_one) ** 2, WEIGHT_MOST)
    bent = max(share, SHARE_FLOOR)
    return min(odds / ODDS_SHARP, bent) if is_sharp else bent


def strength_of(share: float) -> Strength:
    """Return how good an accepted alignment is.

    Args:
        share: of the common walls that it explains (``Evidence.share``).
    """
    if share >= SAME_TIME_SHARE:
        return "strong"
    return "fair" if share >= STOREYS_SHARE else "weak"


def decide(evidence: Evidence) -> Decision:
    """Return what to believe, and why; what was left undecided is said."""
    decision = _decide(evidence)
    said = ""
    if evidence.is_cut:
        said = (
            "; walls fill the cells that were searched at every yaw; on finer ones only yaws with "
            "parallel walls were"
        )
    return replace(decision, reason=decision.reason + said)


def _decide(evidence: Evidence) -> Decision:
    if evidence.walls < WALLS_MIN:
        return _refused(
            "too little in common",
            f"too few walls to judge: {evidence.walls} of the {WALLS_MIN} needed",
        )
    if evidence.search in {"tracked", "fixed step"}:
        return _decide_fit(evidence)
    mirrored = decide_mirrored(evidence.mirrored)
    if mirrored is not None:
        return mirrored
    contradicted = _contradicted(evidence)
    if contradicted is not None:
        return contradicted
    wrong = wrong_in_job(evidence)
    if wrong >= EXPECTED_WRONG_MAX and not (_is_whole(evidence) or _is_expected(evidence)):
        return _not_alone(evidence, wrong)
    too_little = _too_little(evidence)
    if too_little is not None:
        return too_little
    is_scaled = evidence.scale is not None and abs(evidence.scale - 1.0) >= SCALE_MAX
    if evidence.scale is not None and is_scaled and evidence.scaled_share >= SCALED_SHARE_MIN:
        return _refused(
            "other scale",
            f"the maps differ in scale by {abs(evidence.scale - 1.0):.1%}: is a resolution wrong?",
        )
    if evidence.share < SHARE_MIN:
        return _refused(
            "bent",
            "roughly here, but the maps do not fit each other: "
            f"{_share_of_walls(evidence)}; one of them is bent",
        )
    return _accepted(evidence)


def _accepted(evidence: Evidence) -> Decision:
    """Accept an answer, and say how good it is."""
    strength = strength_of(evidence.share)
    said = (
        f"walls match ({strength}): {_share_of_walls(evidence)}, the next place "
        f"{evidence.ratio:.0%} of that"
    )
    if strength == "weak":
        said += f"; {_contradiction(evidence)}"
    if evidence.scale is not None and abs(evidence.scale - 1.0) >= SCALE_SAID:
        said += f"; the maps differ in scale by {abs(evidence.scale - 1.0):.1%}"
    return Decision(True, "accepted", said)


def _share_of_walls(evidence: Evidence) -> str:
    return f"{evidence.share:.0%} of the {evidence.common_m:.0f} m of common walls"


def _contradiction(evidence: Evidence, *, asks: bool = True) -> str:
    """Say what an answer leaves unexplained, and ask what may be the cause."""
    said = f"{1.0 - evidence.share:.0%} of the common walls contradict"
    if not asks:
        return said
    bent = "" if evidence.is_sharp else ", or is a map bent"
    return f"{said}: another storey or another time{bent}?"


def wrong_in_job(evidence: Evidence) -> float:
    """Return the wrong answers to be expected to look as good as an answer, in the whole job."""
    return _wrong(evidence, evidence.better)


def _wrong(evidence: Evidence, better: float) -> float:
    """Return the wrong answers to be expected if the answer were better by so many pieces."""
    return expected_wrong(
        better,
        evidence.share,
        evidence.pairs,
        evidence.prior,
        is_plain=evidence.is_plain,
        is_sharp=evidence.is_sharp,
        is_cut=evidence.is_cut,
    )


def decide_mirrored(mirrored: float | None) -> Decision | None:
    """Return why a pair is refused whose mirror image fits better; None where it does not.

    Args:
        mirrored: see ``Evidence``.
    """
    if mirrored is None or mirrored <= MIRROR_GAIN:
        return None
    return _refused(
        "mirrored",
        f"fits its mirror image as well or better, {mirrored:.1f} times: is a laser upside down, "
        "or a map mirrored or transposed?",
    )


def _refused(kind: DecisionKind, reason: str) -> Decision:
    return Decision(False, kind, reason)


def _contradicted(evidence: Evidence) -> Decision | None:
    """Refuse what the other map's free space or a cleaner answer speaks against; None: nothing."""
    clash = evidence.statistics["wall_clash"]
    if clash > CLASH_MAX and evidence.share < CLASH_SHARE:
        return _different(evidence)
    if evidence.clean_share - evidence.share >= CLEANER:
        return _alike(evidence) or _different(evidence)
    return None


def _alike(evidence: Evidence) -> Decision | None:
    """Refuse two places of which both explain most walls; None: they do not."""
    if (
        evidence.rival is None
        or evidence.share < SHARE_FIT
        or evidence.ratio < RIVAL_RATIO
        or evidence.common_ground < MOST
    ):
        return None
    return _refused(
        "ambiguous",
        f"ambiguous: the same place twice? the best fit explains {_share_of_walls(evidence)}, "
        f"and another transform, {evidence.rival}, explains {evidence.ratio:.0%} of that",
    )


def _different(evidence: Evidence) -> Decision:
    """Refuse a best fit that most walls contradict, or that is no better than one elsewhere."""
    explained = evidence.statistics["explained"]
    if evidence.share < CLASH_SHARE:
        why = _contradiction(evidence, asks=explained >= MOST)
    else:
        why = f"the next place gives {evidence.ratio:.0%} of its evidence"
    return _refused(
        "different place",
        f"the maps do not show the same place: the best fit explains {explained:.0%} of the "
        f"smaller map's walls, a random one {evidence.statistics['explained_by_chance']:.0%}; "
        f"{why}",
    )


def _too_little(evidence: Evidence) -> Decision | None:
    """Refuse what rests on short walls, on those that run one way, or on a corner; None: not so."""
    is_searched = evidence.search == "full" and not _is_whole(evidence)
    if is_searched:
        if evidence.common_m < COMMON_MIN_M:
            return _refused(
                "too little in common",
                f"too little in common: {evidence.common_m:.1f} m of common walls of the "
                f"{COMMON_MIN_M:g} m needed",
            )
        if evidence.common_ground < GROUND_MIN:
            return _refused(
                "too little in common",
                f"too little in common: {evidence.common_ground:.1%} of what the smaller map knows "
                f"of the {GROUND_MIN:.0%} needed",
            )
    if (
        evidence.held_m is not None
        and _wrong(evidence, HELD_PIECES * evidence.held_m) >= EXPECTED_WRONG_MAX
    ):
        return _refused(
            "too little in common",
            f"too little in common: the {evidence.common_m:.0f} m of common walls run one way, and "
            f"only {evidence.held_m:.1f} m hold it along them",
        )
    beside = max(BESIDE_MIN_M, BESIDE_SHARE * evidence.common_m)
    if is_searched and evidence.beside_lines_m is not None and evidence.beside_lines_m < beside:
        return _refused(
            "too little in common",
            f"too little in common: the {evidence.common_m:.0f} m of common walls are one corner, "
            f"of the {beside:.1f} m needed beside its two lines there are "
            f"{evidence.beside_lines_m:.1f} m",
        )
    return None


def _is_whole(evidence: Evidence) -> bool:
    """Whether the answer leaves nearly nothing of either map unexplained, and all others do."""
    match = evidence.statistics["wall_match"]
    missed = max(1.0 - match, MISSED_MIN)
    return match >= MATCH_SURE and missed <= UNEXPLAINED_RATIO * (1.0 - match * evidence.ratio)


def _is_expected(evidence: Evidence) -> bool:
    """Whether a start chooses between answers of which none elsewhere is better than this one."""
    if evidence.search != "window" or evidence.better_inside is None:
        return False
    is_as_good = evidence.better >= -TIE and evidence.share >= SHARE_TIED
    found = _wrong(evidence, evidence.better_inside)
    return is_as_good and found < EXPECTED_WRONG_MAX


def _not_alone(evidence: Evidence, wrong: float) -> Decision:
    """Refuse what chance or another place may explain as well."""
    # Pieces counted whole: of maps that leave much unexplained, none counts much.
    whole = replace(evidence, share=1.0, is_plain=False, is_sharp=False)
    if _wrong(whole, evidence.witnesses) >= EXPECTED_WRONG_MAX:
        return _refused(
            "too little in common",
            f"too little in common to judge: {evidence.common_m:.1f} m of walls, "
            f"{evidence.witnesses:.1f} independent pieces of wall",
        )
    is_fit, is_alone = evidence.share >= SHARE_FIT, evidence.ratio < RIVAL_RATIO
    is_little = _wrong(whole, evidence.better) >= EXPECTED_WRONG_MAX
    if is_fit and is_alone and is_little:
        return _refused(
            "too little in common",
            f"too little in common to judge: {evidence.common_m:.1f} m of walls, of "
            f"{evidence.witnesses:.1f} independent pieces of wall {evidence.better:.1f} tell it "
            f"from other places, the best of which explains {evidence.ratio:.0%} of it",
        )
    if (is_alone and not is_little) or (not is_fit and wrong < MAYBE_HERE):
        job = f" in a job of {evidence.pairs} pairs" if evidence.pairs > 1 else ""
        return _refused(
            "bent",
            f"maybe here, but {wrong:.2g} wrong answers are to be expected to look as good{job} "
            f"({EXPECTED_WRONG_MAX:g} at most): "
            + _contradiction(evidence, asks=evidence.share < STOREYS_SHARE),
        )
    return _alike(evidence) or _different(evidence)


def _decide_fit(evidence: Evidence) -> Decision:
    """Decide on the fit alone, where no search looked for rivals."""
    match, chance = evidence.statistics["wall_match"], evidence.statistics["chance"]
    clash = evidence.statistics["wall_clash"]
    excess = (match - chance) / (1.0 - chance) if chance < 1.0 else 0.0
    do_walls_match = match >= MATCH_MIN and excess >= EXCESS_MIN
    does_ground_match = evidence.share >= SHARE_FIT and evidence.witnesses >= TRACKED_WITNESSES_MIN
    if (do_walls_match or does_ground_match) and clash <= CLASH_MAX:
        said = f"{match:.0%}" if do_walls_match else f"{evidence.share:.0%} of the common ground"
        return Decision(True, "accepted", f"{evidence.search}: {said} of the walls match")
    return _refused(
        "different place",
        f"{evidence.search}: the walls do not match, {match:.0%} of the wall cells meet, "
        f"{clash:.0%} stand in free space",
    )
