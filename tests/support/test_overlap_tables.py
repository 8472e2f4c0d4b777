"""What the benchmark of overlaps counts: all pairs, those with wall enough, from kept lines too."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from typing import Any, cast

import pytest
from rich.console import Console

from slamfusion.align.decide import RIVAL_RATIO, decide
from slamfusion.align.hypotheses import WITNESSES_A_METRE
from slamfusion.align.records import AlignmentJson
from tests.benchmarks.bench_overlap import (
    PIECES_ENOUGH,
    WALL_ENOUGH_M,
    Result,
    line_of,
    load_results,
    print_all,
)
from tests.fusion.test_accept import evidence


def result(number: int, *, accepted: bool = True, **changes: Any) -> Result:
    """Return a pair of halves that is right and believed, and shares wall enough."""
    alignment = {"accepted": accepted, "reason": "walls match", "time_s": 0.25}
    fields: dict[str, Any] = {
        "name": f"pair {number}",
        "what": "one map cut in two",
        "place": "sim/hall/1",
        "seed": 1,
        "reference_map": "sim/hall/1",
        "moving_map": "sim/hall/1",
        "axis": "x",
        "reference_side": "low",
        "moving_side": "high",
        "overlap": 0.3,
        "common_walls": 240,
        "common_wall_m": 12.0,
        "is_right": True,
        "error_m": 0.01,
        "error_deg": 0.1,
        "alignment": cast("AlignmentJson", alignment),
    }
    return Result(**(fields | changes))


RESULTS = [
    result(1),
    result(2, common_walls=200, common_wall_m=float(WALL_ENOUGH_M)),
    result(3, accepted=False, is_right=False),
    result(4, accepted=False, common_walls=199, common_wall_m=WALL_ENOUGH_M - 0.05),
]


@pytest.mark.parametrize("share", [0.25, 0.6])
@pytest.mark.parametrize(("more", "is_believed"), [(1e-6, True), (-1e-6, False)])
def test_pieces_enough_are_those_that_bent_maps_need(
    share: float, more: float, *, is_believed: bool
) -> None:
    found = decide(evidence(better=PIECES_ENOUGH + more, share=share))
    assert found.accepted is is_believed, found.reason


def test_wall_enough_is_believed_against_a_rival_that_explains_half() -> None:
    pieces = WALL_ENOUGH_M * WITNESSES_A_METRE
    left = evidence(better=pieces * (1.0 - RIVAL_RATIO), share=0.25, witnesses=pieces)
    assert decide(left).accepted
    less = (WALL_ENOUGH_M - 1) * WITNESSES_A_METRE * (1.0 - RIVAL_RATIO)
    assert not decide(evidence(better=less, share=0.25)).accepted


def test_pairs_with_wall_enough_are_counted_once_more() -> None:
    console = Console(width=160, record=True, file=StringIO())
    print_all(RESULTS, console)
    rows = [line for line in console.export_text().splitlines() if "one map cut" in line]
    assert [row.count("0 / 0 / 0 / 0 of 0") for row in rows] == [4, 4, 0]
    assert "2 / 0 / 1 / 1 of 4" in rows[0]
    assert "2 / 0 / 0 / 1 of 3" in rows[1]


def test_kept_lines_give_the_same_results(tmp_path: Path) -> None:
    file = tmp_path / "kept.jsonl"
    file.write_text("".join(line_of(item) + "\n" for item in RESULTS), encoding="utf-8")
    assert load_results(file) == RESULTS
