"""Pairs of maps with a known answer, as the numbers that decide whether it is believed."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

from slamfusion.fusion.accept import Evidence

__all__ = ["COLUMNS", "RecordedPair", "changed", "load_pairs", "row_of", "value_of"]

# What the decision looks at: fields of the evidence, and its statistics.
FIELDS = ("score", "overlap", "walls")
STATISTICS = (
    "wall_match",
    "wall_clash",
    "wall_clash_near",
    "chance",
    "z",
    "coarse_ratio",
    "runner_up_ratio",
)
COLUMNS = FIELDS + STATISTICS


@dataclass(frozen=True)
class RecordedPair:
    """Two maps, what was found between them, and whether that is right.

    Attributes:
        source: what kind of pair it is.
        reference, moving: names of the maps.
        is_right: whether the transform that was found is the right one.
        accepted: what was decided when the record was made.
        evidence: what the decision looks at.
    """

    source: str
    reference: str
    moving: str
    is_right: bool
    accepted: bool
    evidence: Evidence


def value_of(evidence: Evidence, column: str) -> float | None:
    """Return one number; None where there is none (no rival was found)."""
    if column in FIELDS:
        return float(getattr(evidence, column))
    return evidence.statistics.get(column)


def changed(evidence: Evidence, column: str, value: float) -> Evidence:
    """Return the evidence with one number changed."""
    if column == "walls":
        return replace(evidence, walls=round(value))
    if column == "score":
        return replace(evidence, score=value)
    if column == "overlap":
        return replace(evidence, overlap=value)
    return replace(evidence, statistics={**evidence.statistics, column: value})


def row_of(pair: RecordedPair) -> dict[str, str]:
    """Return a pair as a row of the table; numbers of six digits."""
    row = {
        "source": pair.source,
        "reference": pair.reference,
        "moving": pair.moving,
        "answer": "right" if pair.is_right else "wrong",
        "decision": "accepted" if pair.accepted else "rejected",
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
        score=float(row["score"]),
        overlap=float(row["overlap"]),
        walls=int(row["walls"]),
        statistics={name: float(row[name]) for name in STATISTICS if row[name]},
        bound_gap=None,
        rival=False,
        search="full",
        near_start=False,
    )
    return RecordedPair(
        row["source"],
        row["reference"],
        row["moving"],
        row["answer"] == "right",
        row["decision"] == "accepted",
        evidence,
    )
