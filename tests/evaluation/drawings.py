"""Maps drawn with characters."""

from __future__ import annotations

import numpy as np

from slamfusion.geometry import Pose2
from slamfusion.grid import IDENTITY, OccupancyGrid

CELLS = {"?": -1, ".": 0, "#": 100, "~": 50}


def draw(*rows: str, resolution: float = 1.0, origin: Pose2 = IDENTITY) -> OccupancyGrid:
    """Draw a grid; the first string is the top row, so the last is row 0."""
    cells = np.array([[CELLS[c] for c in row] for row in reversed(rows)], dtype=np.int8)
    return OccupancyGrid(cells, resolution, origin)
