"""Align two occupancy grids, and decide whether they show the same place.

``align_grids`` is one alignment; ``align.py`` lists its steps in order.
"""

from __future__ import annotations

from slamfusion.align.align import align_grids
from slamfusion.align.records import Alignment

__all__ = ["Alignment", "align_grids"]
