"""Pairs of maps with a known answer, as the numbers that decide whether it is believed."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from slamfusion.align.decide import DecisionKind, Evidence

__all__ = [
    "COLUMNS",
    "OPTIONAL",
    "SAID_ONLY",
    "RecordedPair",
    "changed",
    "load_pairs",
    "row_of",
    "value_of",
]

# What the decision looks at: fields of the evidence, and its statistics.
FIELDS = (
    "walls",
    "common_m",
    "share",
    "witnesses",
    "better",
    "ratio",
    "mirrored",
    "scale",
    "scaled_share",
    "clean_share",
    "common_ground",
    "held_m",
    "beside_lines_m",
)
STATISTICS = ("wall_match", "wall_clash", "chance")
COLUMNS = FIELDS + STATISTICS
# Statistics that a reason names and that decide nothing; the table does not hold them.
SAID_ONLY = {"explained": 0.3, "explained_by_chance": 0.2}
# Numbers that are looked for only where the rest speaks for the answer.
OPTIONAL = ("mirrored", "scale", "held_m", "beside_lines_m")


@dataclass(frozen=True)
class RecordedPair:
    """Two maps, what was found between them, and whether that is right.

    Attributes:
        source: what kind of pair it is.
        reference, moving: names of the maps.
        is_right: whether the transform that was found is the right one.
        decision: what was decided when the record was made.
        evidence: what the decision looks at.
    """

    source: str
    reference: str
    moving: str
    is_right: bool
    decision: DecisionKind
    evidence: Evidence

    @property
    def accepted(self) -> bool:
        """Whether it was believed when the record was made."""
        return self.decision == "accepted"


def value_of(evidence: Evidence, column: str) -> float | None:
    """Return one number; None where it was not looked for."""
    if column in STATISTICS:
        return evidence.statistics[column]
    value: float | None = getattr(evidence, column)
    return None if value is None else float(value)


def changed(evidence: Evidence, column: str, value: float) -> Evidence:
    """Return the evidence with one number changed."""
    if column in STATISTICS:
        return replace(evidence, statistics={**evidence.statistics, column: value})
    if column == "walls":
        return replace(evidence, walls=round(value))
    assert column in FIELDS, column
    fields: dict[str, Any] = {column: value}
    return replace(evidence, **fields)


def row_of(pair: RecordedPair) -> dict[str, str]:
    """Return a pair as a row of the table; numbers of six digits."""
    row = {
        "source": pair.source,
        "reference": pair.reference,
        "moving": pair.moving,
        "answer": "right" if pair.is_right else "wrong",
        "decision": pair.decision,
        "good_maps": "yes" if pair.evidence.is_plain else "no",
        "sharp_maps": "yes" if pair.evidence.is_sharp else "no",
        "prior": f"{pair.evidence.prior:.6g}",
    }
    for column in COLUMNS:
        value = value_of(pair.evidence, column)
        row[column] = "" if value is None else f"{value:.6g}"
    return row


def load_pairs(path: Path) -> tuple[RecordedPair, ...]:
    """Return the pairs of a table that ``record_pairs`` has written."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    return tuple(_pair(row) for row in rows)


def _pair(row: dict[str, str]) -> RecordedPair:
    evidence = Evidence(
        walls=int(row["walls"]),
        common_m=float(row["common_m"]),
        share=float(row["share"]),
        witnesses=float(row["witnesses"]),
        better=float(row["better"]),
        ratio=float(row["ratio"]),
        rival="elsewhere",
        pairs=1,
        prior=float(row["prior"]),
        statistics={name: float(row[name]) for name in STATISTICS} | SAID_ONLY,
        search="full",
        mirrored=float(row["mirrored"]) if row["mirrored"] else None,
        scale=float(row["scale"]) if row["scale"] else None,
        scaled_share=float(row["scaled_share"] or 0.0),
        clean_share=float(row["clean_share"]),
        common_ground=float(row["common_ground"]),
        held_m=float(row["held_m"]) if row["held_m"] else None,
        beside_lines_m=float(row["beside_lines_m"]) if row["beside_lines_m"] else None,
        is_plain=row["good_maps"] == "yes",
        is_sharp=row["sharp_maps"] == "yes",
    )
    return RecordedPair(
        row["source"],
        row["reference"],
        row["moving"],
        row["answer"] == "right",
        cast("DecisionKind", row["decision"]),
        evidence,
    )
