"""How much memory may still be taken, and the refusal when that is too little.

The answer is the smallest of what the machine, the control group (container) and the process's
own limit leave, so that large work is refused with numbers before anything is allocated.
"""

from __future__ import annotations

import ctypes
import resource
from pathlib import Path

import psutil

from slamfusion.errors import MemoryBudgetError

__all__ = [
    "available_memory",
    "check_memory",
    "format_bytes",
    "map_memory_needed",
    "return_freed_memory",
]

# What rows in flight, the encoder and the interpreter take beside the map itself.
WORKING_BYTES = 64 * 2**20

_CGROUP_ROOT = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")


def map_memory_needed(cells: int) -> int:
    """Return the bytes that loading a map of this number of cells takes at its peak.

    Args:
        cells: height times width; one byte of image and one of grid for each.
    """
    return 2 * cells + WORKING_BYTES


def available_memory() -> int:
    """Return the bytes that this process may still take before the system would stop it."""
    process = psutil.Process()
    rooms = [int(psutil.virtual_memory().available)]
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY:
        rooms.append(limit - int(process.memory_info().vms))
    rooms.extend(_cgroup_rooms())
    return max(min(rooms), 0)


def check_memory(
    bytes_needed: int,
    what: str,
    where: str,
    mend: str = "free memory, crop it or use a coarser cell",
) -> None:
    """Refuse work that would not fit into memory.

    Args:
        bytes_needed: the peak of the work, in bytes.
        what: the work, as the subject of a sentence: ``a 30000 x 30000 map``.
        where: the file, topic or option that asked for it.
        mend: what to do.

    Raises:
        MemoryBudgetError: with the needed and the available amount; nothing was allocated.
    """
    available = available_memory()
    if bytes_needed > available:
        message = (
            f"{where}: {what} needs {format_bytes(bytes_needed)} of memory, but only "
            f"{format_bytes(available)} is available; {mend}"
        )
        raise MemoryBudgetError(message)


def return_freed_memory() -> None:
    """Give memory that was freed back to the system, where the C library can (glibc).

    Arrays of some megabytes come from a heap that otherwise keeps them: after fields of three maps
    of 8000 x 8000 cells some 600 MB.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def format_bytes(count: int) -> str:
    """Return a byte count as people read it: ``1.7 GiB``."""
    for power, unit in ((4, "TiB"), (3, "GiB"), (2, "MiB"), (1, "KiB")):
        if count >= 1024**power:
            return f"{count / 1024**power:.1f} {unit}"
    return f"{count} bytes"


def _cgroup_rooms() -> list[int]:
    """Return what is left below each memory limit of the control groups this process is in."""
    try:
        lines = _OWN_CGROUPS.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return []
    rooms = []
    for line in lines:
        _, controllers, own = line.split(":", 2)
        if controllers == "":
            root, limit_name, usage_name = _CGROUP_ROOT, "memory.max", "memory.current"
        elif "memory" in controllers.split(","):
            root = _CGROUP_ROOT / "memory"
            limit_name, usage_name = "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        # A container often sees its own group as the root, so a missing folder is no surprise.
        relative = Path(own.lstrip("/"))
        for folder in (relative, *relative.parents):
            room = _room_below_limit(root / folder, limit_name, usage_name)
            if room is not None:
                rooms.append(room)
    return rooms


def _room_below_limit(folder: Path, limit_name: str, usage_name: str) -> int | None:
    """Return limit less usage of one control group, page cache given back, or None: no limit."""
    try:
        limit = int((folder / limit_name).read_text(encoding="ascii"))
        usage = int((folder / usage_name).read_text(encoding="ascii"))
        stat = dict(
            line.split() for line in (folder / "memory.stat").read_text("ascii").splitlines()
        )
        reclaimable = int(stat.get("inactive_file", 0))
    except (OSError, ValueError):  # no such group, or the word "max"
        return None
    return limit - (usage - reclaimable)
