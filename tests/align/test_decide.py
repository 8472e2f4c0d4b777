"""What decides whether an alignment is believed: the hypotheses it has to beat, and their words."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from slamfusion.align.decide import (
    DECISIONS,
    EXPECTED_WRONG_MAX,
    SYMMETRIC,
    DecisionKind,
    Hypothesis,
    MatchEvidence,
    Reading,
    decide,
    decide_mirrored,
)
from slamfusion.align.hypotheses import Answer
from tests.support.examples import examples

STATISTICS = {"explained": 0.3, "explained_by_chance": 0.2, "overlap": 1.0}
RIVAL = "at 1.00, 2.00 m, 90 deg"
AGAINST: dict[Hypothesis, float] = {"no relation": 30.0}
GOOD = Answer("good", np.zeros(3), np.zeros((0, 3)), AGAINST, 20.0, 0.0, 0.9, 40.0, (1.0, 0.002))


def evidence(**changes: Any) -> MatchEvidence:
    """Return evidence that is believed."""
    return replace(
        MatchEvidence("changed", 40.0, 20.0, "another pose", 0.5, 0.8, 40.0, 0.6, 1e-4), **changes
    )


# Refused: the hypothesis that comes nearest is as likely.
EVEN: dict[str, Any] = {"better": 0.0, "rival_ratio": 1.0, "expected_wrong": 4.0}
KINDS: tuple[tuple[dict[str, Any], DecisionKind, str], ...] = (
    ({}, "accepted", "walls match (fair): 80% of the 40 m of common walls, the next place 60%"),
    ({"share": 0.45}, "accepted", "another storey or another time (moved furniture)?"),
    ({"share": 0.45, "reading": "bent"}, "accepted", "or is a map bent?"),
    ({"scale": 1.02}, "accepted", "differ in scale by 2.0%"),
    ({"pieces": 1.0, **EVEN}, "too little in common", "1.0 independent pieces of wall"),
    ({"pieces": -0.0, **EVEN}, "too little in common", " 0.0 independent pieces of wall"),
    ({"pieces": -1.0, **EVEN}, "too little in common", " 0.0 independent pieces of wall"),
    (
        {"nearest": "a shift of itself", **EVEN, "better": -0.9},
        "too little in common",
        " 0.0 independent pieces tell it from a shift of itself",
    ),
    (EVEN, "ambiguous", f"another transform, {RIVAL}, explains 100% of that"),
    (EVEN | {"share": 0.4}, "different place", "do not show the same place"),
    (EVEN | {"rival_ratio": 0.4}, "different place", "another pose explains 40% of that"),
    ({"expected_wrong": 0.5, "share": 0.3}, "bent", "70% of the common walls contradict"),
    (
        EVEN | {"nearest": "its mirror image", "mirrored": 0.8},
        "different place",
        "a chance fit of the mirror image 80% of that",
    ),
    ({"mirrored": 2.0}, "mirrored", "its mirror image fits as well or better: is a laser"),
    ({"scale": 1.1}, "other scale", "differ in scale by 10.0%: is a resolution wrong?"),
)


@pytest.mark.parametrize(("changes", "kind", "words"), KINDS)
def test_every_kind_of_decision_has_its_reason(
    changes: dict[str, Any], kind: DecisionKind, words: str
) -> None:
    found = decide(evidence(**changes), STATISTICS, RIVAL, 4.0)
    assert (found.kind, found.accepted) == (kind, kind == "accepted"), found.reason
    assert found.kind in DECISIONS
    assert words in found.reason
    assert "\n" not in found.reason


def test_an_image_is_refused_only_where_it_fits_as_well() -> None:
    assert decide_mirrored(None) is None
    assert decide_mirrored(1.0 - 1e-9) is None
    refused = decide_mirrored(1.0)
    assert (refused.accepted, refused.kind) == (False, "mirrored")


# -- what is expected to be wrong ------------------------------------------------------------------

HYPOTHESES: tuple[Hypothesis, ...] = get_args(Hypothesis)


@st.composite
def answers(drawn: st.DrawFn) -> Answer:
    """Draw an answer that some hypotheses speak against, in any reading."""
    names = drawn(st.lists(st.sampled_from(HYPOTHESES), unique=True, max_size=3))
    pieces = st.floats(-5.0, 40.0)
    reading: Reading = drawn(st.sampled_from(get_args(Reading)))
    return Answer(
        reading,
        np.zeros(3),
        np.zeros((0, 3)),
        {name: drawn(pieces) for name in ("no relation", *names)},
        drawn(st.floats(-5.0, 40.0)),
        0.0,
        drawn(st.floats(-0.5, 1.0)),
        drawn(st.floats(0.0, 60.0)),
        (drawn(st.floats(1e-4, 100.0)), drawn(st.floats(1e-4, 1.0))),
        drawn(st.floats(0.0, 1.0)),
    )


@settings(max_examples=examples(100), deadline=None)
@given(answer=answers(), name=st.sampled_from(HYPOTHESES), more=st.floats(0.0, 30.0))
def test_pieces_against_a_hypothesis_never_harm(
    answer: Answer, name: Hypothesis, more: float
) -> None:
    raised = dict(answer.against)
    raised[name] = raised.get(name, math.inf) + more
    assert replace(answer, against=raised).is_accepted >= answer.is_accepted


@settings(max_examples=examples(100), deadline=None)
@given(answer=answers(), shares=st.tuples(st.floats(-0.5, 1.0), st.floats(-0.5, 1.0)))
def test_more_that_contradicts_never_helps(answer: Answer, shares: tuple[float, float]) -> None:
    """Where every hypothesis is worse: of one that is better, weight is no reason to believe."""
    against = {name: abs(pieces) for name, pieces in answer.against.items()}
    less, more = (replace(answer, against=against, share=s) for s in sorted(shares))
    assert more.is_accepted >= less.is_accepted


@settings(max_examples=examples(100), deadline=None)
@given(answer=answers(), factor=st.floats(1.0, 1e4))
def test_more_pairs_and_more_ground_never_help(answer: Answer, factor: float) -> None:
    near, away = answer.trials
    assert answer.is_accepted >= replace(answer, trials=(near * factor, away)).is_accepted


@settings(max_examples=examples(100), deadline=None)
@given(answer=answers())
def test_the_nearest_hypothesis_is_the_one_that_is_not_beaten(answer: Answer) -> None:
    others = replace(
        answer, against={k: v for k, v in answer.against.items() if k != answer.nearest}
    )
    if answer.wrong < EXPECTED_WRONG_MAX:
        assert all(answer.expected(name) < EXPECTED_WRONG_MAX for name in answer.against)
    elif others.against:
        assert others.wrong <= answer.wrong


@settings(max_examples=examples(100), deadline=None)
@given(
    answer=answers(),
    ratios=st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 2.0)),
    is_chance=st.booleans(),
)
def test_an_image_that_fits_better_never_helps(
    answer: Answer, ratios: tuple[float, float], *, is_chance: bool
) -> None:
    assume(answer.weight > 0.0 and "its mirror image" not in answer.against)
    less, more = (
        answer.compared_with_image(ratio, is_chance=is_chance) for ratio in sorted(ratios)
    )
    assert answer.is_accepted >= less.is_accepted >= more.is_accepted


def test_an_image_that_fits_as_well_leaves_nothing_of_a_lead() -> None:
    good = replace(GOOD, against={**AGAINST, "another pose": 8.0})
    leads = [
        good.compared_with_image(r, is_chance=True).against["its mirror image"]
        for r in (0.4, 0.75, 1.5)
    ]
    assert leads == pytest.approx([8.0, 4.0, 0.0])
    # Of an image that chance does not explain only a symmetric place is left.
    symmetric = good.compared_with_image(1.0, is_chance=False).against["its mirror image"]
    assert symmetric == pytest.approx(8.0 + math.log(SYMMETRIC) / good.weight)


def test_maps_that_leave_walls_unexplained_are_not_read_as_good() -> None:
    assert GOOD.is_accepted
    assert not replace(GOOD, share=0.84).is_accepted
    # A score is no more than the evidence itself, however many pieces agree.
    assert not replace(GOOD, total=1.7).is_accepted
    # A piece of maps of two times counts at most once.
    assert not replace(
        GOOD, reading="changed", share=0.99, against={"no relation": 5.9}
    ).is_accepted
    assert not replace(GOOD, reading="bent").is_accepted
    assert replace(GOOD, reading="bent", hit=0.5).is_accepted
