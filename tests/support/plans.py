"""The floor plans of the Halmstad maps, and the corners that a person marked on both."""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path

import numpy as np

from slamfusion.geometry import F64, Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import load_map
from tests.support.datasets import DATASETS
from tests.support.halmstad import CELL_M

FOLDERS = tuple(
    folder
    for folder in (base / "maps" / "halmstad" for base in (DATASETS, DATASETS.parent / "second"))
    if folder.exists()
)


@cache
def places() -> dict[str, Path]:
    """Return the folder of each place that has a plan."""
    return {place.name: place for folder in FOLDERS for place in sorted(folder.glob("maps/*"))}


def plan_of(place: str) -> OccupancyGrid:
    """Return a plan, its pixels taken for 0.05 m."""
    path = places()[place] / "layout" / f"{place}_layout.png"
    return load_map(path, resolution=CELL_M, settle_edges=True)


def maps_of(place: str) -> list[Path]:
    """Return the files of the sensor maps of a place."""
    return sorted((places()[place] / "pseudo_occupancy").glob("*.png"))


@cache
def marked(seen: str, plan: str) -> tuple[F64, F64]:
    """Return (N, 2) the same corners on a sensor map and on a plan, pixels with y up."""
    points: dict[tuple[str, str], list[float]] = {}
    pairs: list[tuple[str, str]] = []
    for folder in FOLDERS:
        for row in _rows(folder / "keypoints.csv"):
            points[row["map"], row["index"]] = [float(row["x"]), float(row["y"])]
        pairs += [
            (row["source_index"], row["destination_index"])
            for row in _rows(folder / "associations.csv")
            if (row["source"], row["destination"]) == (seen, plan)
        ]
    there = np.array([points[plan, other] for _, other in pairs])
    return np.array([points[seen, own] for own, _ in pairs]), there


def marked_error_m(seen: str, plan: OccupancyGrid, transform: Pose2) -> float:
    """Return how far the marked corners lie apart, their mean, metres.

    Args:
        seen: the sensor map's name.
        plan: with the resolution that was found.
        transform: maps the plan's frame into the sensor map's.
    """
    own, there = marked(seen, plan.name)
    placed = transform.transform(there * plan.resolution)
    return float(np.hypot(*(placed - own * CELL_M).T).mean())


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))
