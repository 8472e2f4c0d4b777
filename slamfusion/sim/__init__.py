"""Places whose truth is known: drawn, driven through with a robot, or damaged as a SLAM would.

``simulate`` drives a ``Course`` and gives the scans, the odometry and the truth;
``degrade_map`` makes of a true map what another SLAM would have saved. Everything here is seeded:
same seed, same bytes.
"""

from __future__ import annotations

from slamfusion.sim.building import draw_building
from slamfusion.sim.courses import COURSES, Course, load_course, named_course, with_overrides
from slamfusion.sim.degrade import Degradation, degrade_map, draw_degradation
from slamfusion.sim.simulate import Recording, simulate, write_recording
from slamfusion.sim.world import thin_walls

__all__ = [
    "COURSES",
    "Course",
    "Degradation",
    "Recording",
    "degrade_map",
    "draw_building",
    "draw_degradation",
    "load_course",
    "named_course",
    "simulate",
    "thin_walls",
    "with_overrides",
    "write_recording",
]
