"""What tracking is held against: both sides of each limit, for walls and for common ground."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slamfusion.align.records import Alignment, MatchEvidence
from slamfusion.fusion.live.searched import CLASH_MORE, LASTING_SHARE, Searched
from tests.fusion.live.scripted import found

SHARE = 0.5
THEN = Searched(0.8, 0.75, 0.125, "walls match", ground=0.75, pieces=32.0)


def tracked(
    score: float, ground: float, pieces: float, *, accepted: bool = True, **statistics: float
) -> Alignment:
    """Return what tracking gave, with what the common ground says."""
    pair = found(score=score, accepted=accepted, **statistics)
    evidence = MatchEvidence(pieces, pieces, ground, 10.0, 0.0, 0.0, None, None)
    return replace(pair, evidence=evidence)


@pytest.mark.parametrize(
    ("score", "ground", "pieces", "lasts"),
    [
        (0.4, 0.0, 0.0, True),
        (0.39, 0.0, 0.0, False),
        # Maps that grew away from each other: the ground that both know says as much as before.
        (0.0, SHARE * 0.75, SHARE * 32.0, True),
        (0.0, SHARE * 0.75 - 1e-9, SHARE * 32.0, False),
        (0.0, SHARE * 0.75, SHARE * 32.0 - 1e-9, False),
        (0.0, 1.0, 1000.0, True),
    ],
)
def test_a_fit_lasts_by_its_score_or_by_the_common_ground(
    score: float, ground: float, pieces: float, lasts: bool
) -> None:
    assert THEN.lasts(tracked(score, ground, pieces), SHARE) is lasts


@pytest.mark.parametrize(
    ("ground", "pieces", "clash", "lasts"),
    [
        (LASTING_SHARE * 0.75, LASTING_SHARE * 32.0, 0.125, True),
        (LASTING_SHARE * 0.75 - 1e-9, 32.0, 0.125, False),
        (0.75, LASTING_SHARE * 32.0 - 1e-9, 0.125, False),
        (0.75, 32.0, 0.125 + CLASH_MORE, True),
        (0.75, 32.0, 0.125 + CLASH_MORE + 1e-9, False),
    ],
)
def test_walls_that_match_no_more_may_be_walls_that_only_one_map_has(
    ground: float, pieces: float, clash: float, lasts: bool
) -> None:
    pair = tracked(0.0, ground, pieces, accepted=False, wall_match=0.1, wall_clash=clash)
    assert THEN.lasts(pair, SHARE) is lasts


def test_without_evidence_the_common_ground_says_nothing() -> None:
    assert not THEN.lasts(found(score=0.39), SHARE)
    kept = Searched(0.8, 0.75, 0.125, "kept over a restart")
    assert not kept.lasts(tracked(0.39, 1.0, 1e9), SHARE)
    assert kept.lasts(tracked(0.4, 0.0, 0.0), SHARE)


def test_what_a_search_gave_is_kept_with_the_common_ground() -> None:
    pair = tracked(0.8, 0.75, 32.0, wall_match=0.75, wall_clash=0.125, reason="walls match")
    assert Searched.of(pair) == THEN
    bare = Searched.of(found(score=0.8))
    assert (bare.score, bare.match, bare.clash) == (0.8, 0.0, 0.0)
    assert not bare.lasts(tracked(0.39, 1.0, 1e9), SHARE)


@pytest.mark.parametrize(
    ("score", "ground", "pieces", "kept"),
    [
        (0.3, SHARE * 0.75, SHARE * 32.0, 0.3),
        (0.3, SHARE * 0.75 - 1e-9, 32.0, 0.8),
        (0.3, 0.75, SHARE * 32.0 - 1e-9, 0.8),
        (0.9, 0.75, 32.0, 0.8),
    ],
)
def test_growth_lowers_the_score_that_is_expected_and_nothing_else_does(
    score: float, ground: float, pieces: float, kept: float
) -> None:
    after = THEN.tracked(tracked(score, ground, pieces), SHARE)
    assert after == replace(THEN, score=kept)
