"""Whether a process whose address space is limited (``ulimit -v``) has room for OpenCL.

PoCL's threads and its compiler end a process that has too little, by a signal. So OpenCL is not
begun there.
"""

from __future__ import annotations

import resource
from pathlib import Path

from slamfusion.cores import told_threads, usable_cores

__all__ = ["opencl_shortage"]

# Measured: what pyopencl, PoCL and its compiler reserve, and each thread of PoCL (stack and heap).
OPENCL_BYTES = 512 * 2**20
THREAD_BYTES = 72 * 2**20
THREADS = "POCL_MAX_PTHREAD_COUNT"
_SIZE = Path("/proc/self/statm")  # its first number is the address space in use, pages


def opencl_shortage() -> str:
    """Return in one line that there is no room for OpenCL, and what to do; empty where there is."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return ""
    threads = _threads()
    room, needed = limit - _used(), OPENCL_BYTES + threads * THREAD_BYTES
    if room >= needed:
        return ""
    fewer = f", set {THREADS}=1" if threads > 1 else ""
    return (
        f"OpenCL needs {needed // 2**20} MiB of address space, but only {max(room, 0) // 2**20} "
        f"MiB of its limit are left; raise the limit (ulimit -v unlimited){fewer}"
    )


def _used() -> int:
    """Return the address space in use, bytes; 0 where the system does not tell."""
    try:
        return int(_SIZE.read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    except OSError:
        return 0


def _threads() -> int:
    """Return how many threads PoCL starts: as many as there are cores, unless told."""
    return told_threads(THREADS) or usable_cores()
