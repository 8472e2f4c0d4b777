"""What tracking is compared with: the last search, its walls and the common ground."""

from __future__ import annotations

import pytest

from slamfusion.align.records import Alignment, MatchEvidence
from slamfusion.fusion.live.align import LastSearch
from slamfusion.geometry import Pose2

SHARE = 0.5
THEN = LastSearch(0.8, 0.75, 0.125, "walls match", ground=0.75, pieces=32.0)


def tracked(
    score: float, ground: float, pieces: float, *, accepted: bool = True, **statistics: float
) -> Alignment:
    """Return what tracking gave, with the evidence of the common ground."""
    evidence = MatchEvidence("changed", pieces, pieces, "no relation", 1.0, ground, 10.0, 0.0, 0.0)
    given = ("walls match", score, 0.6, 0.0, None, 0.0, statistics)
    return Alignment("a", "b", Pose2(), accepted, *given, evidence=evidence)


@pytest.mark.parametrize(
    ("pair", "lasts"),
    [
        (tracked(0.5, 0.0, 0.0), True),
        (tracked(0.3, 0.0, 0.0), False),
        # Maps that grew away from each other: the ground that both know says as much as before.
        (tracked(0.0, 0.7, 30.0), True),
        (tracked(0.0, 0.2, 30.0), False),
        (tracked(0.0, 0.7, 10.0), False),
        # Walls that match no more may be walls that only one map has, but do not clash.
        (tracked(0.0, 0.7, 30.0, accepted=False, wall_match=0.1, wall_clash=0.125), True),
        (tracked(0.0, 0.5, 30.0, accepted=False, wall_match=0.1, wall_clash=0.125), False),
        (tracked(0.0, 0.7, 30.0, accepted=False, wall_match=0.1, wall_clash=0.3), False),
    ],
)
def test_a_fit_lasts_by_its_score_or_by_the_common_ground(pair: Alignment, lasts: bool) -> None:
    assert THEN.lasts(pair, SHARE) is lasts


def test_what_is_kept_over_a_restart_knows_no_common_ground() -> None:
    kept = LastSearch(0.8, 0.75, 0.125, "kept over a restart")
    assert not kept.lasts(tracked(0.39, 1.0, 1e9), SHARE)
    assert kept.lasts(tracked(0.41, 0.0, 0.0), SHARE)


def test_growth_lowers_the_score_that_is_expected_and_nothing_else_does() -> None:
    assert LastSearch.of(tracked(0.8, 0.75, 32.0, wall_match=0.75, wall_clash=0.125)) == THEN
    assert THEN.tracked(tracked(0.3, 0.7, 30.0), SHARE).score == 0.3
    assert THEN.tracked(tracked(0.3, 0.2, 30.0), SHARE) == THEN
    assert THEN.tracked(tracked(0.9, 0.7, 30.0), SHARE) == THEN
