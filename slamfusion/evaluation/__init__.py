"""How good a map is: against the truth, against measured distances, and by its doubled walls.

Everything here is a pure function on value types; nothing is drawn, printed or written.
"""

from __future__ import annotations

from slamfusion.evaluation.distances import (
    DistanceComparison,
    DistanceRow,
    MeasuredDistance,
    compare_distances,
    load_distances,
)
from slamfusion.evaluation.doubled_walls import (
    added_doubled_share,
    doubled_wall_cells,
    doubled_wall_share,
)
from slamfusion.evaluation.map_error import (
    AGREE_FREE,
    AGREE_UNKNOWN,
    AGREE_WALL,
    EXTRA_FREE,
    EXTRA_WALL,
    MISSING_FREE,
    MISSING_WALL,
    MapError,
    WallDistance,
    compare_to_truth,
)

__all__ = [
    "AGREE_FREE",
    "AGREE_UNKNOWN",
    "AGREE_WALL",
    "EXTRA_FREE",
    "EXTRA_WALL",
    "MISSING_FREE",
    "MISSING_WALL",
    "DistanceComparison",
    "DistanceRow",
    "MapError",
    "MeasuredDistance",
    "WallDistance",
    "added_doubled_share",
    "compare_distances",
    "compare_to_truth",
    "doubled_wall_cells",
    "doubled_wall_share",
    "load_distances",
]
