"""Read and write maps, logs and trajectories.

Input is checked when it is read; output files appear complete or not at all (``AtomicFiles``).
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
