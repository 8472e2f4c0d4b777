"""What decides whether an alignment is believed: every kind of answer, monotony, and records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.align.decide import (
    DECISIONS,
    DecisionKind,
    Evidence,
    decide,
    decide_mirrored,
)
from tests.support.examples import examples
from tests.support.recorded_pairs import (
    COLUMNS,
    OPTIONAL,
    SAID_ONLY,
    RecordedPair,
    changed,
    load_pairs,
)
from tests.support.recorded_pairs import value_of as number_of

PAIRS = load_pairs(Path(__file__).with_name("recorded_pairs.csv"))


def evidence(**changes: Any) -> Evidence:
    """Return an alignment that is believed, and on no other ground than its pieces of wall."""
    fields: dict[str, Any] = {
        "walls": 500,
        "common_m": 40.0,
        "share": 0.8,
        "witnesses": 40.0,
        "better": 20.0,
        "ratio": 0.6,
        "rival": "at 1.00, 2.00 m, 90 deg",
        "pairs": 1,
        "prior": 1.0,
        "search": "full",
        "mirrored": None,
        "scale": None,
        "scaled_share": 0.6,
        "clean_share": 0.0,
        "better_inside": None,
        "common_ground": 1.0,
        "is_plain": False,
        "is_sharp": False,
        "is_cut": False,
    }
    statistics = {"wall_match": 0.6, "wall_clash": 0.02, "chance": 0.1} | SAID_ONLY
    for name, value in changes.items():
        (statistics if name in statistics else fields)[name] = value
    return Evidence(statistics=statistics, **fields)


# Believed but for its rival, which says as much.
TIED = {"better": 0.0, "ratio": 1.0}

# What is changed in evidence that is believed, what is decided then, and words of the reason.
KINDS: Sequence[tuple[dict[str, Any], DecisionKind, str]] = (
    ({}, "accepted", "walls match (fair): 80% of the 40 m of common walls, the next place 60%"),
    ({"share": 0.45, "better": 99.0}, "accepted", "another storey or another time"),
    ({"scale": 1.02}, "accepted", "differ in scale by 2.0%"),
    ({"is_cut": True}, "accepted", "walls fill the cells that were searched"),
    ({"walls": 3}, "too little in common", "too few walls to judge: 3 of the"),
    ({"witnesses": 1.0, **TIED}, "too little in common", "1.0 independent pieces of wall"),
    ({"held_m": 0.1}, "too little in common", "run one way, and only 0.1 m hold it"),
    ({"beside_lines_m": 0.1}, "too little in common", "are one corner"),
    (TIED, "ambiguous", "another transform, at 1.00, 2.00 m, 90 deg, explains 100% of that"),
    (TIED | {"rival": None}, "different place", "do not show the same place"),
    ({"wall_clash": 0.5, "share": 0.3}, "different place", "70% of the common walls contradict"),
    ({"mirrored": 2.0}, "mirrored", "fits its mirror image as well or better, 2.0 times"),
    ({"scale": 1.1}, "other scale", "differ in scale by 10.0%: is a resolution wrong?"),
    ({"share": 0.1, "better": 99.0}, "bent", "one of them is bent"),
    ({"share": 0.3, "better": 9.0}, "bent", "wrong answers are to be expected to look as good"),
    ({"search": "tracked"}, "accepted", "tracked: 60% of the walls match"),
    ({"search": "tracked", "wall_match": 0.1, "share": 0.1}, "different place", "do not match"),
)


@pytest.mark.parametrize(("changes", "kind", "words"), KINDS)
def test_every_kind_of_decision_has_its_reason(
    changes: dict[str, Any], kind: DecisionKind, words: str
) -> None:
    found = decide(evidence(**changes))
    assert (found.kind, found.accepted) == (kind, kind == "accepted"), found.reason
    assert words in found.reason


def test_an_image_is_refused_only_where_it_fits_better() -> None:
    assert decide_mirrored(None) is None
    assert decide_mirrored(0.9) is None
    refused = decide_mirrored(0.9 + 1e-9)
    assert refused is not None
    assert (refused.accepted, refused.kind) == (False, "mirrored")


# -- monotony --------------------------------------------------------------------------------------

# Numbers of which more speaks for an alignment, and those of which more speaks against it.
HOLDS = ("common_ground", "held_m", "beside_lines_m")
FOR = ("walls", "share", "witnesses", "better", "wall_match", *HOLDS)
AGAINST = (
    "ratio",
    "clean_share",
    "scaled_share",
    "mirrored",
    "wall_clash",
    "chance",
    "pairs",
    "prior",
)
# What decides nothing: it is only said.
SAID = ("common_m",)
RANGES = {
    "walls": (0.0, 60.0),
    "common_m": (0.0, 100.0),
    "witnesses": (0.0, 30.0),
    "better": (-10.0, 30.0),
    "ratio": (0.0, 1.5),
    "mirrored": (0.0, 3.0),
    "scale": (0.85, 1.15),
    "held_m": (0.0, 9.0),
    "beside_lines_m": (0.0, 3.0),
    "pairs": (1.0, 200.0),
}


def with_number(found: Evidence, column: str, value: float) -> Evidence:
    """Return the evidence with one number changed, those of the job among them."""
    if column == "pairs":
        return replace(found, pairs=round(value))
    if column == "prior":
        return replace(found, prior=value)
    return changed(found, column, value)


def values(column: str) -> st.SearchStrategy[float]:
    """Return values of one number."""
    low, high = RANGES.get(column, (0.0, 1.0))
    return st.one_of(st.sampled_from([low, high]), st.floats(low, high))


@st.composite
def any_evidence(drawn: st.DrawFn) -> Evidence:
    """Draw evidence: that of one kind or of a recorded pair, with some numbers changed."""
    kinds = st.sampled_from(KINDS).map(lambda row: evidence(**row[0]))
    found = drawn(st.one_of(kinds, st.sampled_from(PAIRS).map(lambda pair: pair.evidence)))
    found = replace(
        found,
        search=drawn(st.sampled_from(("full", "full", "window", "tracked", "fixed step"))),
        rival=drawn(st.sampled_from((None, "elsewhere"))),
    )
    for column in drawn(st.lists(st.sampled_from((*COLUMNS, "pairs", "prior")), max_size=3)):
        found = with_number(found, column, drawn(values(column)))
    return found


@pytest.mark.parametrize("column", FOR + AGAINST)
def test_better_evidence_never_turns_an_acceptance_into_a_rejection(column: str) -> None:
    @settings(max_examples=examples(80), deadline=None)
    @given(found=any_evidence(), pair=st.tuples(values(column), values(column)))
    def check(found: Evidence, pair: tuple[float, float]) -> None:
        # Where the rival is the better one, a larger share speaks against the answer.
        if column == "share":
            found = replace(found, better=max(found.better, 0.0))
        worse, better = sorted(pair, reverse=column in AGAINST)
        before = decide(with_number(found, column, worse))
        after = decide(with_number(found, column, better))
        assert after.accepted or not before.accepted, after.reason

    assert {*FOR, *AGAINST, *SAID, "scale"} == {*COLUMNS, "pairs", "prior"}
    check()


@settings(max_examples=examples(80), deadline=None)
@given(found=any_evidence(), shares=st.tuples(st.floats(0.0, 0.06), st.floats(0.0, 1.0)))
def test_more_ground_in_common_never_harms(found: Evidence, shares: tuple[float, float]) -> None:
    less, more = (decide(replace(found, common_ground=share)) for share in sorted(shares))
    assert more.accepted or not less.accepted


@settings(max_examples=examples(80), deadline=None)
@given(found=any_evidence())
def test_a_search_that_was_cut_never_helps(found: Evidence) -> None:
    cut, whole = (decide(replace(found, is_cut=value)) for value in (True, False))
    assert whole.accepted or not cut.accepted


@settings(max_examples=examples(80), deadline=None)
@given(found=any_evidence(), metres=st.tuples(st.floats(0.0, 9.0), st.floats(0.0, 9.0)))
def test_walls_that_hold_it_along_others_never_hurt(
    found: Evidence, metres: tuple[float, float]
) -> None:
    few, many = (decide(replace(found, held_m=value)).accepted for value in sorted(metres))
    assert many >= few
    assert decide(replace(found, held_m=None)).accepted >= many


@settings(max_examples=examples(80), deadline=None)
@given(found=any_evidence(), offs=st.tuples(st.floats(0.0, 0.15), st.floats(0.0, 0.15)))
def test_a_scale_farther_from_one_never_helps(found: Evidence, offs: tuple[float, float]) -> None:
    near, far = sorted(offs)
    for sign in (-1.0, 1.0):
        off = decide(replace(found, scale=1.0 + sign * far))
        assert decide(replace(found, scale=1.0 + sign * near)).accepted or not off.accepted


@settings(max_examples=examples(80), deadline=None)
@given(found=any_evidence())
def test_whatever_is_decided_has_a_reason_in_one_line(found: Evidence) -> None:
    decision = decide(found)
    assert decision.kind in DECISIONS
    assert decision.accepted is (decision.kind == "accepted")
    assert decision.reason
    assert "\n" not in decision.reason


# -- recorded pairs --------------------------------------------------------------------------------


def rows(*, is_right: bool) -> list[Any]:
    """Return the recorded pairs whose answer is right, or those whose answer is wrong."""
    return [
        pytest.param(pair, id=f"{pair.source} {pair.reference} {pair.moving}")
        for pair in PAIRS
        if pair.is_right == is_right
    ]


@pytest.mark.parametrize("pair", rows(is_right=False))
def test_the_nearest_wrong_pairs_are_not_believed(pair: RecordedPair) -> None:
    decision = decide(pair.evidence)
    assert not decision.accepted, decision.reason


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: f"{pair.source} {pair.reference}")
def test_the_nearest_pairs_are_decided_as_when_they_were_recorded(pair: RecordedPair) -> None:
    decision = decide(pair.evidence)
    assert decision.kind == pair.decision, decision.reason


def test_the_record_holds_wrong_pairs_and_right_ones_on_either_side() -> None:
    sides = [(pair.is_right, pair.accepted) for pair in PAIRS]
    for side in ((False, False), (True, True), (True, False)):
        assert sides.count(side) >= 4, side
    for pair in PAIRS:
        for column in COLUMNS:
            is_there = number_of(pair.evidence, column) is not None
            # Looked for where the rest speaks for the answer; an image where that is not sure.
            assert is_there or column in OPTIONAL
            is_sure = pair.evidence.share >= 0.9 and column == "mirrored"
            assert is_there or not pair.accepted or is_sure
