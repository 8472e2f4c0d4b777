"""How many cores there are to work with. Light: nothing here may load the libraries."""

from __future__ import annotations

import os

__all__ = ["told_threads", "usable_cores"]


def usable_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def told_threads(variable: str) -> int | None:
    """Return the threads that an environment variable asks for; None where it names no number."""
    told = os.environ.get(variable, "")
    return int(told) if told.isdecimal() and int(told) else None
