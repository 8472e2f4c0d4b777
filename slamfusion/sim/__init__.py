"""Simulated drives with ground truth.

``simulate`` drives a ``Course`` and returns scans, odometry and truth; same seed, same bytes.
"""

from __future__ import annotations

from slamfusion.sim.courses import Course, load_course, named_course, with_overrides
from slamfusion.sim.simulate import Recording, simulate, write_recording
from slamfusion.sim.world import thin_walls
from slamfusion.sim.worlds import draw_building

__all__ = [
    "Course",
    "Recording",
    "draw_building",
    "load_course",
    "named_course",
    "simulate",
    "thin_walls",
    "with_overrides",
    "write_recording",
]
