"""Simulated drives with ground truth.

``simulate`` drives a ``Course`` and returns scans, odometry and truth; same seed, same bytes.
"""

from __future__ import annotations

from slamfusion.sim.courses import Course as Course
from slamfusion.sim.courses import load_course as load_course
from slamfusion.sim.courses import named_course as named_course
from slamfusion.sim.courses import with_overrides as with_overrides
from slamfusion.sim.simulate import Recording as Recording
from slamfusion.sim.simulate import simulate as simulate
from slamfusion.sim.simulate import write_recording as write_recording
from slamfusion.sim.world import thin_walls as thin_walls
from slamfusion.sim.worlds import draw_building as draw_building
