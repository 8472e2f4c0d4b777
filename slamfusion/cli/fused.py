"""How a fusion is shown as tables; shared by ``fuse`` and ``run``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from slamfusion.cli.output import notice, number, print_table

if TYPE_CHECKING:
    from slamfusion.fusion.records import Alignment, Fusion, InputRecord

__all__ = ["print_alignments", "print_pairs", "tell_left_out"]

PAIR_COLUMNS = (
    "reference ",
    "input ",
    "accepted ",
    "dx m",
    "dy m",
    "yaw deg",
    "score",
    "overlap",
    "runner-up ratio",
    "gap",
)


def print_alignments(result: Fusion) -> None:
    """Print how each input lies to the reference."""
    print_table(
        PAIR_COLUMNS[1:],
        [_row(record, result.reference) for record in result.inputs],
        notes=[record.reason for record in result.inputs],
        title=f"Alignment to {result.reference}, on {result.device}",
    )


def tell_left_out(result: Fusion) -> None:
    """Name on stderr the inputs that have no vote."""
    from slamfusion.jobs.fuse_documents import left_out_sentences  # noqa: PLC0415  (loads slowly)

    for sentence in left_out_sentences(result):
        notice(sentence)


def print_pairs(pairs: Sequence[Alignment], device: str) -> None:
    """Print the pairs of maps of which nothing was fused."""
    print_table(
        PAIR_COLUMNS,
        [[pair.reference, *_cells(pair, "yes" if pair.accepted else "NO")] for pair in pairs],
        notes=[pair.reason for pair in pairs],
        title=f"Nothing was fused, on {device}",
    )


def _row(record: InputRecord, reference: str) -> list[str]:
    """Return an input's row of the alignment table."""
    accepted = "yes" if record.accepted else "NO"
    if record.name == reference:
        accepted = "reference"
    if record.copy_of is not None:
        accepted = "copy"
    if record.alignment is None:
        return [record.name, accepted, *["-"] * (len(PAIR_COLUMNS) - 3)]
    return [record.name, *_cells(record.alignment, accepted)[1:]]


def _cells(found: Alignment, accepted: str) -> list[str]:
    """Return an alignment's cells of the table, from the input's name on."""
    return [
        found.moving,
        accepted,
        number(found.transform.x),
        number(found.transform.y),
        number(math.degrees(found.transform.yaw_rad), 2),
        number(found.score),
        number(found.overlap),
        number(None if found.runner_up is None else found.runner_up.ratio, 2),
        number(found.bound_gap),
    ]
