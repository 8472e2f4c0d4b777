"""gmapping's record in the registry of producers."""

from __future__ import annotations

from slamfusion.config import GmappingConfig
from slamfusion.slam.gmapping.slam import Gmapping
from slamfusion.slam.registry import Producer


def _map_interval_s(config: GmappingConfig) -> float:
    """Return seconds between two maps: gmapping has a parameter for that."""
    return float(config.chosen().map_update_interval or 0.0)


PRODUCER = Producer(
    name="gmapping",
    summary="gmapping: a Rao-Blackwellised particle filter",
    config=GmappingConfig(),
    make=Gmapping,
    load=Gmapping.load_state,
    cost=6.0,
    map_interval_s=_map_interval_s,
)
