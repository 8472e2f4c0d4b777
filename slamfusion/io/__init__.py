"""Maps, logs and trajectories in and out of files, checked on the way in, whole on the way out.

``load_map`` and ``save_map`` speak the format of ROS map servers pixel for pixel. ``open_log``
reads the scans of CARMEN and tinySLAM logs and of ROS bags; ``read_trajectory`` finds the poses in
any file that holds some; ``write_carmen`` and ``write_tum`` write both back. Everything is
written through ``atomic``: a file is there whole or not at all. What would not fit into memory is
refused with numbers before it is allocated (``check_memory``).
"""

from __future__ import annotations

from slamfusion.io.carmen import write_carmen
from slamfusion.io.files import AtomicFiles, available_memory, check_memory, write_atomic
from slamfusion.io.log import LogScan, ScanLog, Skips
from slamfusion.io.logs import open_log
from slamfusion.io.map_server import load_map, save_map
from slamfusion.io.trajectories import read_trajectory, write_tum

__all__ = [
    "AtomicFiles",
    "LogScan",
    "ScanLog",
    "Skips",
    "available_memory",
    "check_memory",
    "load_map",
    "open_log",
    "read_trajectory",
    "save_map",
    "write_atomic",
    "write_carmen",
    "write_tum",
]
