"""Whether a process whose address space is limited (``ulimit -v``) has room for the libraries.

NumPy, OpenCV and SciPy end such a process in ways of their own: by a signal, by a traceback, or by
trying again for ever. So they are not loaded there. Nothing here may load them.
"""

from __future__ import annotations

import resource

from slamfusion.cores import told_threads, usable_cores

__all__ = ["needed_bytes", "shortage"]

# Measured with small maps: what the libraries reserve with one thread of OpenBLAS, and for each
# further one, which OpenBLAS has three times.
ONE_THREAD_BYTES = 512 * 2**20
THREAD_BYTES = 224 * 2**20
THREADS = "OPENBLAS_NUM_THREADS"


def needed_bytes() -> int:
    """Return the bytes of address space without which nothing is begun."""
    return ONE_THREAD_BYTES + (_threads() - 1) * THREAD_BYTES


def shortage() -> str:
    """Return in one line that the address space is too small, and what to do; empty where not."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    needed = needed_bytes()
    if limit == resource.RLIM_INFINITY or limit >= needed:
        return ""
    fewer = f", or set {THREADS}=1" if _threads() > 1 else ""
    return (
        f"out of memory: the address space is limited to {limit // 2**20} MiB, wanted at least "
        f"{needed // 2**20} MiB to begin; raise the limit (ulimit -v unlimited){fewer}"
    )


def _threads() -> int:
    """Return how many threads OpenBLAS starts: as many as there are cores, or fewer if told so."""
    cores = usable_cores()
    return min(cores, told_threads(THREADS) or cores)
