"""Where the recorded maps lie, and how the tests load each kind of them.

The folder is named by ``SLAMFUSION_DATASETS``; without it, ``shared/datasets`` beside the checkout.
"""

from __future__ import annotations

import csv
import gzip
import math
import os
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from slamfusion.align.align import align_pair
from slamfusion.align.features import GridFeatures
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.io.map_server import load_map
from slamfusion.jobs.inputs import LogFiles
from tests.fusion.drawings import features_of

DATASETS = Path(
    os.environ.get(
        "SLAMFUSION_DATASETS", Path(__file__).resolve().parents[2].parent / "shared" / "datasets"
    )
)
MAPS = DATASETS / "maps"
# Cells of maps that do not say their size, metres.
CELL_M = 0.05
CSAIL, INTEL = DATASETS / "mit-csail", DATASETS / "intel"
# The recorded drives whose relations are known.
MEASURED = (
    LogFiles(CSAIL / "mit-csail.clf.gz", CSAIL / "mit-csail.relations"),
    *(
        LogFiles(
            INTEL / f"intel-{count}-raw.log.gz",
            INTEL / "intel.relations",
            INTEL / "intel-odometry-13631.txt.gz",
        )
        for count in (2726, 910)
    ),
)
ABSENT = f"the recorded maps are not at {DATASETS}; set SLAMFUSION_DATASETS to their folder"


@dataclass(frozen=True)
class MapEntry:
    """One row of places.csv: ``file`` relative to maps/, its place, its cell size where known."""

    file: str
    place: str
    cell_size_m: float | None
    note: str

    @property
    def is_drawing(self) -> bool:
        """Whether the file is a drawing or a picture of unknown scale."""
        return "drawing" in self.note or "picture" in self.note


@cache
def map_entries() -> tuple[MapEntry, ...]:
    """Every map that places.csv names and that lies in the folder."""
    with (MAPS / "places.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    entries = []
    for row in rows:
        size = None if row["cell_size_m"] == "unknown" else float(row["cell_size_m"])
        if (MAPS / row["file"]).exists():
            entries.append(MapEntry(row["file"], row["place"], size, row["note"] or ""))
    return tuple(entries)


def load_entry(entry: MapEntry) -> OccupancyGrid:
    """Load a map of places.csv; cells of unknown size are taken as 0.05 m."""
    path = MAPS / entry.file
    if path.name.endswith(".txt.gz"):
        return load_carpin(path)
    size = entry.cell_size_m or CELL_M
    grid = load_map(path) if path.suffix == ".yaml" else load_map(path, resolution=size)
    return grid.with_name(entry.file)


@lru_cache(maxsize=16)
def _ready(entry: MapEntry, resolution: float, device: ComputeDevice) -> GridFeatures:
    return features_of(load_entry(entry), device, resolution)


def align_entries(
    a: MapEntry, b: MapEntry, config: FusionConfig, device: ComputeDevice
) -> Alignment:
    """Align the larger of two recorded maps with the smaller one."""
    size = min(entry.cell_size_m or CELL_M for entry in (a, b))
    features = [_ready(entry, size, device) for entry in (a, b)]
    return align_pair(Pair(*sorted(features, key=lambda own: math.prod(own.shape))), config.align)


def load_carpin(path: Path) -> OccupancyGrid:
    """Load one of Carpin's text maps: a row a line, 0 occupied, 127 unknown, 255 free."""
    with gzip.open(path, "rt", encoding="ascii") as file:
        values = np.loadtxt(file, dtype=np.int16)
    cells = np.full(values.shape, UNKNOWN, dtype=np.int8)
    cells[values == 0] = OCCUPIED
    cells[values == 255] = FREE
    return OccupancyGrid(np.flipud(cells).copy(), CELL_M, name=path.name.split(".")[0])
