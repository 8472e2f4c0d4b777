"""SLAMfusion: align the occupancy grids of several 2D SLAMs and let them vote cell by cell."""

from __future__ import annotations

from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

__version__ = "0.1.0"

__all__ = [
    "FREE",
    "OCCUPIED",
    "UNKNOWN",
    "OccupancyGrid",
    "Pose2",
    "SlamFusionError",
    "__version__",
]
