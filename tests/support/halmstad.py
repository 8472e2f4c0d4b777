"""The Halmstad sensor maps: bent, with transforms between every two that a person annotated."""

from __future__ import annotations

import csv
import math
from functools import cache

from slamfusion.align.records import Alignment
from slamfusion.geometry import Pose2, wrap_angle
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import load_map
from tests.support.datasets import MAPS

FOLDER = MAPS / "halmstad"
CELL_M = 0.05
RIGHT_PIXELS = 30.0
RIGHT_DEGREES = 3.0


@cache
def load_place(place: str) -> dict[str, OccupancyGrid]:
    """Load the sensor maps of a place (E5, F5, HIH, KPT4A) by name; a pixel is taken as 0.05 m."""
    files = sorted((FOLDER / "maps" / place / "pseudo_occupancy").glob("*.png"))
    return {file.stem: load_map(file, resolution=CELL_M) for file in files}


@cache
def annotated() -> dict[tuple[str, str], tuple[float, Pose2]]:
    """Scale and rigid part, in pixels with y up, from the first named map to the second."""
    with (FOLDER / "transforms.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {
        (row["source"], row["destination"]): (
            float(row["scale"]),
            Pose2(float(row["tx_px"]), float(row["ty_px"]), float(row["rotation_rad"])),
        )
        for row in rows
    }


def annotated_error(moving: OccupancyGrid, alignment: Alignment) -> tuple[float, float]:
    """Return how far the moving map's centre lands from the annotated place: pixels, degrees."""
    scale, pose = annotated()[alignment.moving, alignment.reference]
    box = moving.known_box
    assert box is not None
    centre = ((box.col0 + box.col1) / 2, (box.row0 + box.row1) / 2)
    wanted = pose.transform((scale * centre[0], scale * centre[1]))
    found = alignment.transform.transform((centre[0] * CELL_M, centre[1] * CELL_M)) / CELL_M
    turn = wrap_angle(alignment.transform.yaw_rad - pose.yaw_rad)
    return math.dist(found, wanted), abs(math.degrees(turn))
