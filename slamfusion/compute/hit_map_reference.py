"""Names of before; they go with the next commits."""

from __future__ import annotations

from slamfusion.compute.hit_counts import BeamScan, FieldRule
from slamfusion.compute.hit_counts.numpy import count_beams, full_field, settle_field, touch_pages
from slamfusion.compute.layout import FULL_HITS, FULL_VISITS, MOST_BEAMS, MOST_REACH

__all__ = [
    "FULL_HITS",
    "FULL_VISITS",
    "MOST_BEAMS",
    "MOST_REACH",
    "BeamScan",
    "FieldRule",
    "count_beams",
    "full_field",
    "settle_field",
    "touch_pages",
]
