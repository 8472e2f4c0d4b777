"""How much memory is available, and the refusal of work that needs more."""

from __future__ import annotations

import ctypes

import psutil

from slamfusion.errors import MemoryBudgetError

# What the interpreter and its buffers take beside the map itself.
WORKING_BYTES = 64 * 2**20


def available_memory() -> int:
    """Return the bytes that processes may still take before the machine swaps."""
    return int(psutil.virtual_memory().available)


def check_memory(
    bytes_needed: int,
    what: str,
    where: str,
    fix: str = "free memory, crop it or use a coarser cell",
) -> None:
    """Refuse work that would not fit into memory.

    Args:
        bytes_needed: the peak of the work, in bytes.
        what: the work, as the subject of a sentence: ``a 30000 x 30000 map``.
        where: the file, topic or option that asked for it.
        fix: what to do.

    Raises:
        MemoryBudgetError: with the needed and the available amount; nothing was allocated.
    """
    available = available_memory()
    if bytes_needed > available:
        message = (
            f"{where}: {what} needs {format_bytes(bytes_needed)} of memory, but only "
            f"{format_bytes(available)} is available; {fix}"
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
