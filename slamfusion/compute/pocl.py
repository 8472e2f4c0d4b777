"""Let the PoCL of the wheel build kernels on newer processors, and offer both of its devices.

The wheel brings PoCL 3.0 with LLVM 14 of 2022. On a processor that LLVM does not know (AMD Zen 5,
for example) it asks its own compiler for the processor "generic", which that compiler refuses, so
that no kernel builds ("unknown target CPU 'generic'", PoCL issue 1049). PoCL 3.0 has no setting for
it. What the processor can do is known from its feature flags, so the one function of the library
that names the processor is replaced, in this process's memory and before PoCL is first asked for
its devices, by one that returns the best name which both sides know. Nothing is written to disk,
and where PoCL knows the processor, or comes from elsewhere, nothing is touched.

PoCL has two devices for one processor. ``pthread``, the one it shows, hands each kernel to threads
of its own; ``basic`` runs it in the thread that asks, which takes a tenth of a millisecond less.
"""

from __future__ import annotations

import ctypes
import logging
import mmap
import os
import platform
import sys
from functools import cache
from pathlib import Path

import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

__all__ = ["is_single_thread", "name_processor", "offer_single_thread", "processor_name"]

LOG = logging.getLogger(__name__)
# LLVM's names with the feature flags (as /proc/cpuinfo spells them) that each needs, best first.
PROCESSORS = (
    ("skylake-avx512", "avx512f avx512dq avx512cd avx512bw avx512vl avx2 fma bmi2 adx clflushopt"),
    ("haswell", "avx2 fma bmi1 bmi2 f16c movbe"),
    ("sandybridge", "avx popcnt sse4_2"),
)
ANY_PROCESSOR = "x86-64"
UNKNOWN = b"generic"
READ_WRITE_EXECUTE = mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC
READ_EXECUTE = mmap.PROT_READ | mmap.PROT_EXEC
# mov rdi, text; mov rax, strdup; jmp rax: the caller frees what it gets.
RETURN_COPY = (b"\x48\xbf", b"\x48\xb8", b"\xff\xe0")


def processor_name(flags: set[str]) -> str:
    """Return LLVM's name of the best processor whose features are all among ``flags``.

    Args:
        flags: as in the ``flags`` line of /proc/cpuinfo.
    """
    for name, needed in PROCESSORS:
        if flags.issuperset(needed.split()):
            return name
    return ANY_PROCESSOR


def offer_single_thread() -> None:
    """Let the wheel's PoCL show both of its devices; call it before listing devices.

    What ``POCL_DEVICES`` says stays, and so does the meaning of ``PYOPENCL_CTX``.
    """
    if _libraries() and not os.environ.get("PYOPENCL_CTX"):
        os.environ.setdefault("POCL_DEVICES", "pthread basic")


def is_single_thread(device: cl.Device) -> bool:
    """Return whether a device runs its kernels in the thread that asks."""
    return bool(device.name.startswith("basic"))


def _libraries() -> list[Path]:
    """Return the wheel's PoCL."""
    return sorted(Path(cl.__file__).parent.glob(".libs/libpocl*.so*"))


@cache
def name_processor() -> str | None:
    """Tell the wheel's PoCL which processor this is, once; call it before listing devices.

    Returns:
        The name given, or None where PoCL needed none.
    """
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return None
    try:
        flags = _processor_flags(Path("/proc/cpuinfo").read_text(encoding="utf-8"))
        named = [path for path in _libraries() if _name_in(path, processor_name(flags))]
    except (OSError, AttributeError) as error:  # another build of PoCL: leave it as it is
        LOG.warning("PoCL's processor name cannot be set: %s", error)
        return None
    return processor_name(flags) if named else None


def _processor_flags(cpuinfo: str) -> set[str]:
    """Return the feature flags of the first processor."""
    for line in cpuinfo.splitlines():
        if line.startswith("flags"):
            return set(line.partition(":")[2].split())
    return set()


def _name_in(path: Path, name: str) -> bool:
    """Give one PoCL library the name; False when it knows the processor by itself."""
    function = ctypes.CDLL(str(path)).pocl_get_llvm_cpu_name
    function.restype = ctypes.c_char_p
    if function() != UNKNOWN:
        return False
    process = ctypes.CDLL(None, use_errno=True)
    process.strdup.restype = ctypes.c_void_p
    text = process.strdup(name.encode())  # lives as long as the process
    copy = ctypes.cast(process.strdup, ctypes.c_void_p).value
    address = ctypes.cast(function, ctypes.c_void_p).value
    if text is None or copy is None or address is None:
        return False
    to_text, to_copy, jump = RETURN_COPY
    code = to_text + text.to_bytes(8, "little") + to_copy + copy.to_bytes(8, "little") + jump
    page = mmap.PAGESIZE
    start = address // page * page
    length = -(-(address + len(code)) // page) * page - start
    protect = process.mprotect
    protect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    if protect(start, length, READ_WRITE_EXECUTE) != 0:
        raise OSError(ctypes.get_errno(), "mprotect refused to open PoCL's code", str(path))
    ctypes.memmove(address, code, len(code))
    protect(start, length, READ_EXECUTE)
    LOG.info("%s does not know this processor; it builds for %s", path.name, name)
    return True
