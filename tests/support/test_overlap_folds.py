"""Constants fitted on half of the places are counted on the other half alone."""

from __future__ import annotations

import json
import math
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from slamfusion.align.decide import decide
from tests.benchmarks.overlap_folds import (
    NEEDED,
    Counted,
    fitted_odds,
    fold_of,
    is_believed,
    load_counted,
    print_folds,
)
from tests.fusion.test_accept import evidence


def pair(**changes: Any) -> Counted:
    """Return a pair of one place that is right and believed: 10 pieces, by odds of 19 to 1."""
    fields: dict[str, Any] = {
        "places": ("sim/a/1", "sim/a/1"),
        "overlap": 0.2,
        "is_right": True,
        "accepted": True,
        "pieces": 10.0,
        "share": 0.95,
    }
    return Counted(**(fields | changes))


@pytest.mark.parametrize("better", [NEEDED - 1e-6, NEEDED + 1e-6])
def test_what_is_needed_is_what_the_decision_needs(better: float) -> None:
    counted = pair(pieces=better, share=11 / 12, accepted=False)
    wanted = decide(evidence(is_plain=True, better=better, share=11 / 12)).accepted
    assert is_believed(counted, 11.0) is wanted


def test_the_odds_are_the_least_that_leave_no_wrong_answer_near() -> None:
    wrong = pair(is_right=False, accepted=False, share=0.8, overlap=None)
    # 10 pieces by the square of 4 / odds are half of what is needed, or less.
    least = 4.0 * math.sqrt(10.0 / (NEEDED / 2.0))
    assert fitted_odds([pair(), wrong]) == math.ceil(2.0 * least) / 2.0
    assert fitted_odds([pair(), pair(share=0.8)]) == 2.0, "halves have no say"


def test_with_higher_odds_less_is_believed_but_for_what_does_not_rest_on_them() -> None:
    assert is_believed(pair(), 11.0)
    assert not is_believed(pair(), 40.0)
    assert is_believed(pair(pieces=None), 40.0), "not weighed as good maps"
    assert is_believed(pair(pieces=0.1), 40.0), "nearly whole maps"
    assert not is_believed(pair(pieces=0.1, accepted=False), 2.0)


def line(what: str, place: str, **alignment: Any) -> str:
    """Return a record as the benchmark writes it, shortened to what is read."""
    match = {"better": 9.0, "share": 0.9, "good_maps": True} | alignment.pop("match", {})
    found = {"accepted": True, "match_decision": "accepted", "match_evidence": match} | alignment
    row = {"what": what, "reference_map": place, "moving_map": place, "overlap": 0.4}
    return json.dumps(row | {"is_right": True, "alignment": found})


def test_records_are_read_and_each_half_is_told(tmp_path: Path) -> None:
    places = [f"sim/office/{number}" for number in range(8)]
    mirrored = {"accepted": False, "match_decision": "mirrored"}
    lines = [
        *(line("simulated", place) for place in places),
        line("simulated", places[0], **mirrored),
        line("simulated", places[0], match_evidence=None),
    ]
    file = tmp_path / "records.jsonl"
    file.write_text("\n".join(lines), encoding="utf-8")
    pairs = load_counted([file])
    assert [found.pieces for found in pairs] == [9.0] * 8 + [None, None]
    folds = [fold_of(found) for found in pairs]
    assert set(folds) == {0, 1}
    across = (places[folds.index(0)], places[folds.index(1)])
    assert fold_of(pair(places=across)) is None
    console = Console(width=160, record=True, file=StringIO())
    print_folds(pairs, console)
    said = console.export_text()
    for fold in (0, 1):
        assert f" of {folds.count(fold)} " in said
