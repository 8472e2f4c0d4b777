"""Names of before; they go with the next commits."""

from __future__ import annotations

from slamfusion.compute.lattice import fixed_cells, fixed_poses
from slamfusion.compute.layout import (
    DISTANCE2_MAX,
    DISTANCE_MAX,
    DISTANCE_TABLE,
    FIXED_ONE,
    MOST_INPUTS,
)
from slamfusion.compute.rays.numpy import cast_rays
from slamfusion.compute.votes import Votes

__all__ = [
    "DISTANCE2_MAX",
    "DISTANCE_MAX",
    "DISTANCE_TABLE",
    "FIXED_ONE",
    "MOST_INPUTS",
    "Votes",
    "cast_rays",
    "fixed_cells",
    "fixed_poses",
]
