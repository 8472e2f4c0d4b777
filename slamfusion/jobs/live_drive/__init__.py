"""Score the paths of several SLAMs during the drive, and fuse them into one path.

The method is that of ``run``: predictive consistency scores the paths, ``fuse_weighed_paths`` fuses
them, and all scans are aligned along the result. The whole drive is solved from time to time, and
in between its last ``WINDOW_S`` seconds, which continue the last solution (``Pace``). More often,
since it takes a third of the time, the inputs are judged, by the scans that were located since.
When the scans stop, the drive is solved with all hits that ``run`` scores, which gives the answer
of ``run``.

``DriveMemory`` keeps what comes, ``DriveSolver`` solves it, and ``DriveLocator`` says where the
robot is. A solution takes at most ``MOST_SCANS`` scans and ``MOST_HITS`` hits, which bounds time
and memory.
"""

from slamfusion.jobs.live_drive.locating import DriveLocator
from slamfusion.jobs.live_drive.memory import DriveMemory
from slamfusion.jobs.live_drive.solution import DriveSolution
from slamfusion.jobs.live_drive.solver import DriveSolver, Pace

__all__ = ["DriveLocator", "DriveMemory", "DriveSolution", "DriveSolver", "Pace"]
