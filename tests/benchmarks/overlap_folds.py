"""Does the decision hold on maps that it was not fitted on? Half of the places against the other.

The one constant that was fitted on many pairs, the odds of what is explained at which a piece of
wall of good maps counts as one (``decide.ODDS_ONE``), is fitted once more on the pairs of half of
the places: the least odds by which the most that a wrong answer counts is half of what is needed.
With these the pairs of the other half are decided. Nothing is aligned again: the records that
``bench_overlap --jsonl`` wrote hold the numbers that the decision looks at.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from slamfusion.align.decide import EXPECTED_WRONG_MAX, ODDS_ONE, TRIALS, piece_weight
from tests.support.overlap import OVERLAPS, place_of

__all__ = ["Counted", "fitted_odds", "fold_of", "is_believed", "load_counted", "print_folds"]

# What an answer must count, and the most that wrong ones may where the odds are fitted.
NEEDED = math.log(TRIALS / EXPECTED_WRONG_MAX)
WRONG_MOST = NEEDED / 2.0
ODDS = np.arange(2.0, 40.5, 0.5)


@dataclass(frozen=True)
class Counted:
    """What the decision looks at in a pair of good maps.

    Attributes:
        places: of both maps.
        overlap: of each half; None where there is no right answer.
        is_right: whether the answer is.
        accepted: as it was decided when it was recorded.
        pieces: of equal weight for the answer against the best one elsewhere; None where the maps
            were not weighed as good ones, or something else refused them.
        share: of what the common ground could give.
    """

    places: tuple[str, str]
    overlap: float | None
    is_right: bool
    accepted: bool
    pieces: float | None
    share: float

    def count(self, odds_one: float) -> float:
        """Return what the pieces count with these odds."""
        if self.pieces is None:
            return 0.0
        return self.pieces * piece_weight(self.share, is_plain=True, odds_one=odds_one)


def load_counted(paths: Iterable[Path]) -> list[Counted]:
    """Return the pairs of the records that ``bench_overlap --jsonl`` wrote."""
    lines = (line for path in paths for line in path.read_text(encoding="utf-8").splitlines())
    return [_counted(json.loads(line)) for line in lines]


def _counted(row: dict[str, Any]) -> Counted:
    alignment, evidence = row["alignment"], row["alignment"]["match_evidence"]
    is_weighed = (
        evidence is not None
        and evidence["good_maps"]
        and alignment["match_decision"] not in {"mirrored", "other scale"}
    )
    return Counted(
        (place_of(row["reference_map"]), place_of(row["moving_map"])),
        row["overlap"],
        row["is_right"],
        alignment["accepted"],
        evidence["better"] if is_weighed else None,
        0.0 if evidence is None else evidence["share"],
    )


def fold_of(pair: Counted) -> int | None:
    """Return the half that both places are in; None where they are in different ones."""
    first, second = (zlib.crc32(place.encode()) % 2 for place in pair.places)
    return first if first == second else None


def fitted_odds(pairs: Sequence[Counted]) -> float:
    """Return the least odds by which no pair without a right answer counts more than it may."""
    wrong = [pair for pair in pairs if pair.overlap is None]
    for odds in ODDS:
        if all(pair.count(float(odds)) <= WRONG_MOST for pair in wrong):
            return float(odds)
    return float(ODDS[-1])


def is_believed(pair: Counted, odds_one: float) -> bool:
    """Whether a pair is with these odds; one that is not weighed by them as it was."""
    if pair.pieces is None:
        return pair.accepted
    was_enough = pair.count(ODDS_ONE) >= NEEDED
    # Nearly whole maps are believed on other grounds.
    return pair.count(odds_one) >= NEEDED or (pair.accepted and not was_enough)


def print_folds(pairs: Sequence[Counted], console: Console) -> None:
    """Print for each half of the places what is believed of it with the odds of the other."""
    columns = [f"right at {overlap:.0%}" for overlap in OVERLAPS]
    table = Table("places", "odds fitted on the others", *columns, "wrong", title="held out")
    for fold in (0, 1):
        own = [pair for pair in pairs if fold_of(pair) == fold]
        odds = fitted_odds([pair for pair in pairs if fold_of(pair) == 1 - fold])
        cells = []
        for overlap in OVERLAPS:
            some = [pair for pair in own if pair.overlap == overlap]
            right = sum(pair.is_right and is_believed(pair, odds) for pair in some)
            cells.append(f"{right} of {len(some)}")
        wrong = [pair for pair in own if not pair.is_right]
        believed = sum(is_believed(pair, odds) for pair in wrong)
        names = {place for pair in own for place in pair.places}
        table.add_row(str(len(names)), f"{odds:g}", *cells, f"{believed} of {len(wrong)}")
    console.print(table)
    console.print(f"ODDS_ONE is {ODDS_ONE:g}; pairs of places of both halves are left out")
