"""Believe an alignment or not, and say why in one line.

No single number separates right from wrong: maps of one place that different SLAMs made may share
a tenth of their wall cells, and maps of two homes half of them. What a right answer has, and a
wrong one lacks, is that it stands out: no other turn and no other shift comes near it. So an
alignment is believed on one of three grounds, each of which no pair of different places among the
recorded maps meets, by a margin (``tests/benchmarks/bench_places.py`` prints the counts; the
nearest pairs are rows of ``tests/fusion/recorded_pairs.csv``):

* **walls match**: most wall cells of both maps lie on walls of the other;
* **yaw stands out**: the best coarse score at any other yaw is clearly lower, and so is the best
  refined rival, and no wall stands in the middle of the other's free space;
* **score stands out**: the refined score exceeds the best refined rival's by a wide margin.

It is never believed when a rival explains the maps about as well (symmetry), unless the answer
agrees with the start transform; nor when it shares too little ground to be judged.

What it lets through: of 100 pairs of drawn buildings of one size with other rooms, which share
their outer walls, two are believed.
"""

from __future__ import annotations

from dataclasses import dataclass

from slamfusion.fusion.start import StartPose

__all__ = ["Evidence", "decide"]

# Fewer wall cells than this fit anywhere.
WALLS_MIN = 24
OVERLAP_MIN = 0.15
SCORE_MIN = 0.05
# The smaller share of matched walls: right pairs mostly above, the highest wrong one seen 0.42.
MATCH_MIN = 0.45
# Matched walls beyond what a random place would match, as a share of what is left to match.
EXCESS_MIN = 0.20
# Walls in the other's free space, more than 20 cells from any wall.
CLASH_MAX = 0.15
CLASH_MAX_STRICT = 0.10
# In a dense map, where a random place already meets walls, whatever stands out must not stand
# beside the walls: wall cells in the other's free space beyond 0.4 m. Right dense pairs have 0.10
# at most; drawn buildings of one size and other rooms, 0.10 and more in 45 of 50.
DENSE_CHANCE = 0.15
CLASH_NEAR_MAX = 0.10
# What stands out this far needs no such check.
STANDS_FAR_OUT = ((0.70, 0.60), (0.80, 0.45))
Z_MIN = 3.5
# The best score at another yaw over the best, the runner-up over the best, and walls that clash.
# Wrong pairs seen: with clashes under 0.15 and a runner-up under 0.80 the ratio is 0.927 or more,
# with clashes under 0.10 it is 0.95 or more.
STANDS_OUT = ((0.85, 0.80, CLASH_MAX), (0.90, 0.75, CLASH_MAX_STRICT))
# Score less runner-up: wrong pairs seen up to 0.066 with clashes under 0.10.
MARGIN_MIN = 0.10
COARSE_RATIO_MARGIN_MAX = 0.98
MARGIN_ALONE_MIN = 0.15
# A rival above this share of the score makes a pair ambiguous, unless the answer leaves less than
# half as much unexplained.
AMBIGUOUS_RATIO = 0.85
UNEXPLAINED_RATIO = 0.5


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against an alignment.

    Attributes:
        score: symmetric wall score.
        overlap: common known cells over those of the smaller map.
        walls: wall cells of the map that has fewer.
        statistics: see ``align.measure``, plus ``z``, ``coarse_ratio``, ``runner_up_ratio``.
        bound_gap: see ``Alignment.bound_gap``.
        rival: whether the proof found a member of the search set, elsewhere, that scores above the
            answer.
        search: what stands behind it: ``full`` (all yaws and shifts), ``window``,
            ``fixed step``, or ``tracked`` (a known transform was only refined).
        near_start: whether the answer agrees with a start transform that was given.
        start: the start that limited the search, with its tolerances; None: none was given.
    """

    score: float
    overlap: float
    walls: int
    statistics: dict[str, float]
    bound_gap: float | None
    rival: bool
    search: str
    near_start: bool
    start: StartPose | None = None


def decide(evidence: Evidence) -> tuple[bool, str]:
    """Return whether to accept, and the reason."""
    match = evidence.statistics["wall_match"]
    clash = evidence.statistics["wall_clash"]
    if evidence.walls < WALLS_MIN:
        return False, f"too few walls to judge: {evidence.walls} of the {WALLS_MIN} needed"
    if evidence.overlap < OVERLAP_MIN:
        return False, f"too little common ground: {evidence.overlap:.0%} of the smaller map"
    if evidence.score < SCORE_MIN:
        return False, f"walls do not match: score {evidence.score:.2f}"
    chance = evidence.statistics["chance"]
    excess = (match - chance) / (1.0 - chance) if chance < 1.0 else 0.0
    do_walls_match = match >= MATCH_MIN and excess >= EXCESS_MIN
    runner_up = evidence.statistics.get("runner_up_ratio")
    if evidence.search in {"tracked", "fixed step"}:
        return _decide_fit(evidence.search, match, clash, do_walls_match=do_walls_match)
    if (
        runner_up is not None
        and _is_ambiguous(evidence.score, runner_up)
        and not evidence.near_start
    ):
        return False, (
            f"ambiguous: another transform scores {runner_up:.0%} of the best, and nothing says "
            "which of the two is right"
        )
    ground = _ground(evidence, match, clash, do_walls_match=do_walls_match)
    if ground is None:
        others = "no rival" if runner_up is None else f"other transforms {runner_up:.0%}"
        ratio = evidence.statistics["coarse_ratio"]
        return False, (
            f"walls do not match: {match:.0%} of the wall cells meet ({chance:.0%} by chance), "
            f"{clash:.0%} stand in free space, other yaws reach {ratio:.0%} and {others} "
            "of the score"
        )
    if evidence.rival and not do_walls_match:
        return False, f"{ground}, but the proof found a rival with a higher lattice score"
    return True, ground


def _ground(evidence: Evidence, match: float, clash: float, *, do_walls_match: bool) -> str | None:
    """Return the ground on which the alignment is believed, or None.

    What stands out among few yaws and shifts stands out of nothing: inside a window only matching
    walls count. Without any rival the best other yaw stands in for the runner-up.
    """
    ratio = evidence.statistics["coarse_ratio"]
    z = evidence.statistics["z"]
    runner_up = evidence.statistics.get("runner_up_ratio", ratio)
    is_dense = evidence.statistics["chance"] >= DENSE_CHANCE
    stands_far_out = any(
        ratio <= most_ratio and runner_up <= most_runner_up
        for most_ratio, most_runner_up in STANDS_FAR_OUT
    )
    if is_dense and evidence.statistics["wall_clash_near"] > CLASH_NEAR_MAX and not stands_far_out:
        return None
    limits = STANDS_OUT if z >= Z_MIN and evidence.search == "full" else ()
    passed = [
        most_clash
        for most_ratio, most_runner_up, most_clash in limits
        if ratio <= most_ratio and runner_up <= most_runner_up
    ]
    if do_walls_match and (clash <= CLASH_MAX or passed):
        return f"walls match: {match:.0%}"
    if passed and clash <= max(passed):
        return f"yaw stands out: others reach {ratio:.0%} (z {z:.1f})"
    margin = evidence.score * (1.0 - runner_up)
    is_wide = margin >= MARGIN_ALONE_MIN or (
        margin >= MARGIN_MIN and ratio <= COARSE_RATIO_MARGIN_MAX
    )
    if is_wide and clash <= CLASH_MAX_STRICT and evidence.search == "full":
        return f"score stands out: {evidence.score:.2f}, the next {evidence.score - margin:.2f}"
    return None


def _is_ambiguous(score: float, ratio: float) -> bool:
    """Whether the runner-up explains the maps about as well as the answer."""
    if ratio <= AMBIGUOUS_RATIO:
        return False
    unexplained = 1.0 - min(score, 1.0)
    return unexplained >= UNEXPLAINED_RATIO * (1.0 - min(score * ratio, 1.0))


def _decide_fit(
    search: str, match: float, clash: float, *, do_walls_match: bool
) -> tuple[bool, str]:
    """Decide on the fit alone, where no search looked for rivals."""
    if do_walls_match and clash <= CLASH_MAX:
        return True, f"{search}: {match:.0%} of the walls match"
    return False, (
        f"{search}: the walls do not match, {match:.0%} of the wall cells meet, "
        f"{clash:.0%} stand in free space"
    )
