"""Maps in and out of files, checked on the way in and whole on the way out.

``load_map`` and ``save_map`` speak the format of ROS map servers pixel for pixel. Everything is
written through ``atomic``: a file is there whole or not at all. What would not fit into memory is
refused with numbers before it is allocated (``check_memory``).
"""

from __future__ import annotations

from slamfusion.io.atomic import AtomicFiles, write_atomic, write_json_atomic, write_text_atomic
from slamfusion.io.images import save_image
from slamfusion.io.map_server import load_map, save_map
from slamfusion.io.memory import available_memory, check_memory, map_memory_needed

__all__ = [
    "AtomicFiles",
    "available_memory",
    "check_memory",
    "load_map",
    "map_memory_needed",
    "save_image",
    "save_map",
    "write_atomic",
    "write_json_atomic",
    "write_text_atomic",
]
