"""What each object of gmapping is saved as: one typed record of plain values and arrays each.

``slamfusion.slam.common.state`` writes them into a file and reads them back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2
from slamfusion.slam.common.shapes import check_finite, check_indices, check_shapes
from slamfusion.slam.common.tracking import TrackerState
from slamfusion.slam.gmapping.health import FilterHealth
from slamfusion.slam.gmapping.particles import Particles

__all__ = ["GmappingState", "MapsState"]

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MapsState:
    """Of ``ParticleMaps``: its anchor, and the tiles as ``SharedTileMaps.to_arrays`` has them."""

    anchor: F64
    tiles: dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class GmappingState:
    """Of ``Gmapping``.

    Attributes:
        health: the record.
        last_stamp_s: time of the last scan.
        chosen: all settings: what was left open means what it meant.
        tracker: between filter steps.
        moved: of the robot since the last filter step.
        filtered_s: time of that.
        is_mapped: whether a scan is in the maps.
        particles: poses and weights.
        maps: of the particles.
        paths: as ``ParticlePaths.to_arrays`` has them.
    """

    health: FilterHealth
    last_stamp_s: float | None
    chosen: dict[str, Any]
    tracker: TrackerState
    moved: Pose2
    filtered_s: float
    is_mapped: bool
    particles: Particles
    maps: MapsState
    paths: dict[str, npt.NDArray[Any]]

    def __post_init__(self) -> None:
        """Refuse parts that do not fit each other.

        Raises:
            ValueError: other numbers of particles, or numbers that are not finite.
        """
        own = self.particles
        arrays = {
            "poses": own.poses,
            "log_weights": own.log_weights,
            "path_weights": own.path_weights,
            "anchor": self.maps.anchor,
            "pages": self.maps.tiles["pages"],
        }
        shapes = {"poses": "N 3", "log_weights": "N", "path_weights": "N", "anchor": "2"}
        check_shapes(arrays, {**shapes, "pages": "N H W"})
        check_finite(arrays)
        check_indices("best", own.best, len(own))
