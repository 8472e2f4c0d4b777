"""Small maps as they are written down, and a fusion of some that says where they lie."""

from __future__ import annotations

import numpy as np

from slamfusion.align.records import Alignment, FusionResult, InputRecord
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

CELL = 0.1
MEANING = {".": FREE, "#": OCCUPIED, " ": UNKNOWN}


def written_map(name: str, rows: str, origin: Pose2 = Pose2()) -> OccupancyGrid:  # noqa: B008 - frozen
    """A map as it is written down, the lowest row first; bars stand for its edges."""
    lines = [line.strip().strip("|") for line in rows.strip().splitlines()]
    cells = np.array([[MEANING[mark] for mark in line] for line in lines], dtype=np.int8)
    return OccupancyGrid(cells, CELL, origin, name)


def fits(*maps: OccupancyGrid, **transforms: Pose2) -> FusionResult:
    """The fusion of maps that fit as they lie, or by the transforms given."""
    records = []
    for item in maps:
        at = transforms.get(item.name, Pose2())
        alignment = Alignment(
            reference=maps[0].name, moving=item.name, accepted=True, reason="fits", transform=at,
            score=1.0, overlap=1.0, error=0.0, runner_up=None, time_s=0.0,
        )  # fmt: skip
        records.append(InputRecord(item, alignment, True, "fits"))
    return FusionResult(
        reference=maps[0].name,
        inputs=tuple(records),
        fused=maps[0],
        agreement=maps[0],
        pairs=(),
        phantom_cells=7,
        weights={},
        device="numpy",
        time_s=0.0,
    )
