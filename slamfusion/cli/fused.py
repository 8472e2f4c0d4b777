"""What a fusion is shown and written as; shared by ``fuse`` and ``run``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamfusion.cli.output import number, print_table, versions
from slamfusion.config import RunConfig, to_mapping
from slamfusion.errors import AlignmentError
from slamfusion.grid import OccupancyGrid

if TYPE_CHECKING:
    from slamfusion.fusion.records import Alignment, AlignmentJson, FusionResult, InputRecord
    from slamfusion.jobs.records import (
        CircumstancesJson,
        DoubledWallsJson,
        FusionJson,
        NoAlignmentJson,
        UnalignedInputJson,
    )

__all__ = [
    "AllRequiredError",
    "DoubledWalls",
    "circumstances",
    "failure_document",
    "fusion_document",
    "fusion_sentences",
    "print_alignments",
    "print_pairs",
]

NO_ALIGNMENT: NoAlignmentJson = {
    "dx_m": None,
    "dy_m": None,
    "yaw_rad": None,
    "score": None,
    "overlap": None,
    "error": None,
    "runner_up": None,
    "bound_gap": None,
    "time_s": None,
}

PAIR_COLUMNS = (
    "reference ",
    "input ",
    "accepted ",
    "dx m",
    "dy m",
    "yaw deg",
    "score",
    "overlap",
    "runner-up",
    "gap",
    "time s",
    "reason ",
)


class AllRequiredError(AlignmentError):
    """A fusion that had to leave an input out, where ``--require-all`` forbids it.

    Attributes:
        result: what would have been fused.
    """

    def __init__(self, result: FusionResult) -> None:
        rejected = ", ".join(f"{record.name} ({record.reason})" for record in result.rejected)
        super().__init__(f"--require-all, but rejected: {rejected}; nothing was fused")
        self.pairs = result.pairs
        self.result = result


@dataclass(frozen=True)
class DoubledWalls:
    """Shares of the wall cells that have a parallel wall close by, the trace of a slip.

    Attributes:
        inputs: by name, of each input as it was given.
        fused: of the fused map.
        added: of the fused map, doubled there and in no input.
    """

    inputs: dict[str, float]
    fused: float
    added: float

    @classmethod
    def of(cls, result: FusionResult, config: RunConfig) -> DoubledWalls:
        """Measure a fusion."""
        from slamfusion.evaluation import doubled_wall_share  # noqa: PLC0415

        normalize = config.fusion.normalize
        return cls(
            {
                record.name: doubled_wall_share(record.grid, normalize=normalize)
                for record in result.inputs
            },
            doubled_wall_share(result.fused, normalize=normalize),
            _added_doubled(result),
        )

    def to_json(self) -> DoubledWallsJson:
        """Return the shares for a JSON document."""
        return {"inputs": self.inputs, "fused": self.fused, "added_by_fusion": self.added}


def fusion_document(result: FusionResult, doubled: DoubledWalls) -> FusionJson:
    """Return what a JSON document says of a fusion."""
    return {
        "inputs": [_input(record, result.reference) for record in result.inputs],
        "reference": result.reference,
        "fused_count": len(result.accepted),
        "phantom_cells": result.phantom_cells,
        "wall_backs": result.wall_backs,
        "doubled_wall_share": doubled.to_json(),
        "weights": result.weights,
        "pairs": [pair.to_json() for pair in result.pairs],
    }


def failure_document(
    grids: Sequence[OccupancyGrid], pairs: Sequence[Alignment], reason: str
) -> FusionJson:
    """Return the same keys where nothing was fused.

    Args:
        grids: the inputs.
        pairs: every pair that was aligned; may be empty.
        reason: why nothing was fused; that of an input in no pair.
    """
    return {
        "inputs": [
            {
                **NO_ALIGNMENT,
                "name": grid.name,
                "reference": None,
                "accepted": False,
                "reason": _reason(grid.name, pairs, reason),
            }
            for grid in grids
        ],
        "reference": None,
        "fused_count": 0,
        "phantom_cells": None,
        "wall_backs": None,
        "doubled_wall_share": None,
        "weights": {},
        "pairs": [pair.to_json() for pair in pairs],
    }


def fusion_sentences(result: FusionResult, doubled: DoubledWalls) -> tuple[str, ...]:
    """Say how many inputs were fused, what became of the others, and what the vote added."""
    text = f"fused {len(result.accepted)} of {len(result.inputs)} inputs"
    if result.rejected:
        reasons = ", ".join(f"{record.name}: {record.reason}" for record in result.rejected)
        text += f"; rejected: {reasons}"
    added = (
        f"{result.phantom_cells} phantom cells, {result.wall_backs} cells behind walls filled, "
        f"{doubled.added:.1%} of the walls doubled by the fusion, {result.time_s:.2f} s"
    )
    return text, added


def print_alignments(result: FusionResult) -> None:
    """Print how each input lies to the reference."""
    print_table(
        PAIR_COLUMNS[1:],
        [_row(record, result.reference) for record in result.inputs],
        title=f"Alignment to {result.reference}, on {result.device}",
    )


def print_pairs(pairs: Sequence[Alignment], device: str) -> None:
    """Print the pairs of maps of which nothing was fused."""
    print_table(
        PAIR_COLUMNS,
        [[pair.reference, *_cells(pair, "yes" if pair.accepted else "NO")] for pair in pairs],
        title=f"Nothing was fused, on {device}",
    )


def circumstances(config: RunConfig, device: str) -> CircumstancesJson:
    """Return what a result depends on beside its inputs, for a JSON document."""
    return {
        "device": device,
        "seed": config.seed,
        "config": to_mapping(config),
        "versions": versions(),
    }


def _input(record: InputRecord, reference: str | None) -> AlignmentJson | UnalignedInputJson:
    """Return one input's record: its alignment, and what became of it."""
    if record.alignment is None:
        return {
            **NO_ALIGNMENT,
            "name": record.name,
            "reference": reference,
            "accepted": record.accepted,
            "reason": record.reason,
        }
    return {
        **record.alignment.to_json(),
        "name": record.name,
        "accepted": record.accepted,
        "reason": record.reason,
    }


def _row(record: InputRecord, reference: str) -> list[str]:
    """Return an input's row of the alignment table."""
    accepted = "yes" if record.accepted else "NO"
    if record.name == reference:
        accepted = "reference"
    if record.alignment is None:
        return [record.name, accepted, *["-"] * 8, record.reason]
    return [record.name, *_cells(record.alignment, accepted)[1:-1], record.reason]


def _cells(found: Alignment, accepted: str) -> list[str]:
    """Return an alignment's cells of the table, from the input's name to the reason."""
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
        number(found.time_s, 2),
        found.reason,
    ]


def _added_doubled(result: FusionResult) -> float:
    """Return the share of fused wall cells that are doubled in no input."""
    from slamfusion.evaluation import added_doubled_share  # noqa: PLC0415

    cells = result.fused.cells
    aligned = [record.aligned for record in result.accepted if record.aligned is not None]
    return added_doubled_share(np.sign(cells).astype(np.int8), aligned)


def _reason(name: str, pairs: Sequence[Alignment], otherwise: str) -> str:
    """Return why an input found no partner: the reason of its best rejected pair."""
    rejected = [
        pair for pair in pairs if name in {pair.reference, pair.moving} and not pair.accepted
    ]
    if not rejected:
        return otherwise
    best = max(rejected, key=lambda pair: pair.score)
    other = best.reference if best.moving == name else best.moving
    return f"against {other}: {best.reason}"
