"""Pairs of recorded and simulated maps are decided as they were, by all of the code.

``decided_pairs.csv`` names pairs of ``tests.support.overlap`` of each kind, and what is decided;
none of them is near the decision. Of those with a right answer, none that is wrong is believed.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path

import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.fusion import align_grids
from tests.fusion.drawings import fusion_config
from tests.support.overlap import SETS, Draft

pytestmark = [pytest.mark.datasets, pytest.mark.once]

with Path(__file__).with_name("decided_pairs.csv").open(encoding="utf-8", newline="") as table:
    PAIRS = list(csv.DictReader(table))
# One pair in three, of every kind, is in every run.
EVERY = slice(2, None, 3)


@cache
def drafts(what: str, seed: int) -> dict[str, Draft]:
    """Return the drafts of a kind by name."""
    return {draft.name: draft for draft in SETS[what](seed)}


@pytest.mark.parametrize(
    "pair",
    [
        pytest.param(
            pair,
            id=f"{pair['name']} {pair['decision']}",
            marks=() if pair in PAIRS[EVERY] else pytest.mark.full,
        )
        for pair in PAIRS
    ],
)
def test_recorded_pairs_are_decided_as_they_were(
    device: ComputeDevice, pair: dict[str, str]
) -> None:
    case = drafts(pair["kind"], int(pair["seed"]))[pair["name"]].draw()
    found = align_grids(case.reference, case.moving, fusion_config(), device)
    assert found.accepted == (pair["decision"] == "accepted"), found.reason
    assert not found.accepted or case.is_right(found.transform), found.reason
