"""Let the PoCL of the wheel build kernels on processors that are newer than its compiler.

The wheel has PoCL 3.0 with LLVM 14 of 2022. On a processor that LLVM does not know (AMD Zen 5, for
example) PoCL requests the processor "generic", which its compiler rejects, so that no kernel builds
("unknown target CPU 'generic'", PoCL issue 1049), and it has no setting for it. So the one function
of the library that names the processor is replaced, in this process's memory and before PoCL lists
its devices, by one that returns the best known name for the processor's feature flags. Nothing is
written to disk, and other installations of PoCL are not changed.

Only the function that was examined is replaced: all its bytes are compared, with the distances to
what it calls, which no other build shares. ``slamfusion doctor`` and the log report the change;
``SLAMFUSION_PATCH_POCL=0`` prevents it. Without a needed change the wheel's devices cannot be used.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import logging
import mmap
import os
import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from slamfusion.errors import DeviceError

LOG = logging.getLogger(__name__)
SWITCH, OFF = "SLAMFUSION_PATCH_POCL", "0"
# The release of ``pocl-binary-distribution`` that was examined.
WHEEL = "3.0"
# Its function ``pocl_get_llvm_cpu_name``, which copies the name to memory that the caller frees.
FUNCTION_BYTES = 83
FUNCTION_SHA256 = "fd587da3800019b6c70376351f2227b8fea5f15daff803329977ee54951655b6"
UNKNOWN = b"generic"
# LLVM's names with the feature flags (as /proc/cpuinfo spells them) that each needs, best first.
PROCESSORS = {
    "skylake-avx512": "avx512f avx512dq avx512cd avx512bw avx512vl avx2 fma bmi2 adx clflushopt",
    "haswell": "avx2 fma bmi1 bmi2 f16c movbe",
    "sandybridge": "avx popcnt sse4_2",
    "x86-64": "",
}
INSTEAD = (
    "install another device: `apt install pocl-opencl-icd`, or `pip install 'slamfusion[intel]'`; "
    "`--device numpy` works without"
)


@dataclass(frozen=True)
class PoclState:
    """How the PoCL that came with the package was changed."""

    state: Literal["known", "patched", "refused"]
    """Knows the processor; was made to know it; was left and is not used."""
    detail: str
    """One line for people, with what to do where something is to be done."""


def wheel_library() -> Path | None:
    """Return the library of PoCL's wheel; None where it is not installed."""
    package = importlib.util.find_spec("pyopencl")
    if package is None or package.origin is None:
        return None
    return min(Path(package.origin).parent.glob(".libs/libpocl*.so*"), default=None)


@cache
def name_processor() -> PoclState | None:
    """Tell the wheel's PoCL which processor this is, once; call it before listing devices."""
    path = wheel_library()
    if path is None:
        return None
    try:
        function = ctypes.CDLL(str(path)).pocl_get_llvm_cpu_name
        function.restype = ctypes.c_char_p
        own = function()
    except (OSError, AttributeError) as error:  # another build of PoCL: leave it as it is
        return PoclState("known", f"{path.name} was left as it is ({error})")
    if own != UNKNOWN:
        return PoclState("known", f"{path.name} knows this processor ({own.decode()})")
    try:
        name = _replace(function)
    except (DeviceError, OSError) as reason:
        detail = (
            f"{path.name} of the wheel does not know this processor, so that no kernel builds on "
            f"it, and was left as it is: {reason}; {INSTEAD}"
        )
        state = PoclState("refused", detail)
    else:
        detail = (
            f"{path.name} does not know this processor; a change in memory lets it build for "
            f"{name} ({SWITCH}={OFF} prevents the change)"
        )
        state = PoclState("patched", detail)
    LOG.info("%s", state.detail)
    return state


def is_refused(device: Any) -> bool:
    """Return whether a device is one of the wheel's PoCL, and that cannot build for it."""
    state, path = name_processor(), wheel_library()
    if path is None or state is None or state.state != "refused":
        return False
    # As "OpenCL 3.0 PoCL 3.0-rc2  Linux, ...", of which the library has the start.
    release = device.platform.version.partition("  ")[0] + "  "
    return release.encode() in path.read_bytes()


def _replace(function: Any) -> str:
    """Let the function return the best name for this processor; return the name."""
    if os.environ.get(SWITCH) == OFF:
        raise DeviceError(f"{SWITCH}={OFF} says so")
    address = ctypes.cast(function, ctypes.c_void_p).value or 0
    before = ctypes.string_at(address, FUNCTION_BYTES)
    if hashlib.sha256(before).hexdigest() != FUNCTION_SHA256:
        message = f"its function is not that of pocl-binary-distribution {WHEEL}, which was checked"
        raise DeviceError(message)
    words = Path("/proc/cpuinfo").read_text(encoding="utf-8").partition("\nflags")[2]
    flags = set(words.partition("\n")[0].split())
    name = next(name for name, needed in PROCESSORS.items() if flags.issuperset(needed.split()))

    process = ctypes.CDLL(None)
    process.strdup.restype = ctypes.c_void_p
    text = process.strdup(name.encode())  # lives as long as the process
    strdup = ctypes.cast(process.strdup, ctypes.c_void_p).value
    # mov rdi, text; mov rax, strdup; jmp rax
    code = struct.pack("<2sQ2sQ2s", b"\x48\xbf", text, b"\x48\xb8", strdup, b"\xff\xe0")
    _protect(address, "open", mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    ctypes.memmove(address, code, len(code))
    try:
        _protect(address, "close", mmap.PROT_READ | mmap.PROT_EXEC)
    except DeviceError:
        ctypes.memmove(address, before, len(code))
        raise
    return name


def _protect(address: int, verb: str, rights: int) -> None:
    """Set the rights of the pages of the function."""
    start = address - address % mmap.PAGESIZE
    size = ctypes.c_size_t(address + FUNCTION_BYTES - start)
    process = ctypes.CDLL(None, use_errno=True)
    if process.mprotect(ctypes.c_void_p(start), size, rights) != 0:
        words = os.strerror(ctypes.get_errno())
        raise DeviceError(f"mprotect does not {verb} its code ({words})")
