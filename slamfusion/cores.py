"""The number of usable CPU cores."""

from __future__ import annotations

import os

# Objects after which Python looks for cycles: our own are few, and each look at what the imports
# made takes as long as many scans.
GC_OBJECTS = 100_000


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
