"""Drawn places and drawn faults: buildings whose truth is known, and what a SLAM makes of them.

Everything here is seeded by an explicit ``numpy.random.Generator``: same seed, same bytes.
"""

from __future__ import annotations

from slamfusion.sim.building import draw_building
from slamfusion.sim.degrade import Degradation, degrade_map, draw_degradation

__all__ = ["Degradation", "degrade_map", "draw_building", "draw_degradation"]
