"""Names of before; they go with the next commits."""

from __future__ import annotations

from slamfusion.compute.cell_means import BeamRule, SmearRule
from slamfusion.compute.layout import BEAM_ONE, CLIMBERS, MOST_OBSERVATIONS, TILE, UNSEEN, VALUE_ONE
from slamfusion.compute.layout import MEAN_HALF as HALF

__all__ = [
    "BEAM_ONE",
    "CLIMBERS",
    "HALF",
    "MOST_OBSERVATIONS",
    "TILE",
    "UNSEEN",
    "VALUE_ONE",
    "BeamRule",
    "SmearRule",
]
