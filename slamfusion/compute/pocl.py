"""Let the PoCL of the wheel build kernels on newer processors, and offer both of its devices.

The wheel brings PoCL 3.0 with LLVM 14 of 2022. On a processor that LLVM does not know (AMD Zen 5,
for example) PoCL requests the processor "generic", which its compiler rejects, so that no kernel
builds ("unknown target CPU 'generic'", PoCL issue 1049). PoCL 3.0 has no setting for it. So the one
function of the library that names the processor is replaced, in this process's memory and before
PoCL lists its devices, by one that returns the best known name for the processor's feature flags.
Nothing is written to disk, and other installations of PoCL are not changed.

Only libraries that were examined are changed: ``CHECKED`` has the SHA-256 of their end, where the
build ID is, and how the function starts. The first command of an installation reports it, and
``slamfusion doctor`` always does. ``SLAMFUSION_PATCH_POCL=0`` switches it off; 1 agrees to it
without a report. Without a needed change the wheel's devices cannot be used, and ``PoclState`` says
what to install.

PoCL has two devices for one processor: ``pthread``, the default, runs kernels in its own threads;
``basic`` runs them in the calling thread, a tenth of a millisecond faster.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import mmap
import multiprocessing
import os
import platform
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.compute_device import PoclState
from slamfusion.compute.pocl_cache import user_caches

LOG = logging.getLogger(__name__)
# The environment variable that switches the replacement off, or agrees to it.
SWITCH, OFF, AGREED = "SLAMFUSION_PATCH_POCL", "0", "1"
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
END_BYTES = 1 << 20
# mov rdi, text; mov rax, strdup; jmp rax: the caller frees what it gets.
RETURN_COPY = (b"\x48\xbf", b"\x48\xb8", b"\xff\xe0")
INSTEAD = (
    "install another device: `apt install pocl-opencl-icd`, or `pip install 'slamfusion[intel]'`; "
    "`--device numpy` works without"
)


@dataclass(frozen=True)
class CheckedLibrary:
    """A library whose function was examined.

    Attributes:
        wheel: version of ``pocl-binary-distribution`` that has it.
        sha256: of the file's last ``END_BYTES``, with the build ID, in hexadecimal digits. All of
            its 104 MB would take 0.07 s of every start.
        function: the first bytes of ``pocl_get_llvm_cpu_name``, at least as many as are replaced:
            push rbp; push rbx; sub rsp, 8; call llvm::sys::getHostCPUName; test rdx, rdx; je ...;
            then copies the name to memory of its own, which it returns.
    """

    wheel: str
    sha256: str
    function: bytes


CHECKED = (
    CheckedLibrary(
        wheel="3.0",
        sha256="b64f0f0a8171ac1b1992aab79fad9f5fa157f777458f58ea0e8febf19846bd3a",
        function=bytes.fromhex("55534883ec08e8058ab0034885d274304889c54889d3488d7a01e841b1ecff48"),
    ),
)


class _RefusedError(Exception):
    """The library must not be, or cannot be, changed; the message completes a sentence."""


def processor_name(flags: set[str]) -> str:
    """Return LLVM's best processor name whose features are all in ``flags`` of /proc/cpuinfo."""
    for name, needed in PROCESSORS:
        if flags.issuperset(needed.split()):
            return name
    return ANY_PROCESSOR


def offer_single_thread() -> None:
    """Show both devices of the wheel's PoCL before listing devices; user settings stay."""
    if _library() and not os.environ.get("PYOPENCL_CTX"):
        os.environ.setdefault("POCL_DEVICES", "pthread basic")


def is_single_thread(device: Any) -> bool:
    """Return whether a device runs its kernels in the calling thread."""
    return bool(device.name.startswith("basic"))


def is_refused(device: Any) -> bool:
    """Return whether a device is one of the wheel's PoCL, and that cannot build for it."""
    state = name_processor()
    if state.state != "refused" or state.library is None:
        return False
    found = _library_of(device.platform)
    return found is not None and found.resolve() == state.library.resolve()


@cache
def name_processor() -> PoclState:
    """Tell the wheel's PoCL which processor this is, once; call it before listing devices."""
    path = _library()
    if path is None:
        return PoclState("absent", "PoCL's wheel is not installed")
    try:
        function = ctypes.CDLL(str(path)).pocl_get_llvm_cpu_name
        function.restype = ctypes.c_char_p
        own = function()
    except (OSError, AttributeError) as error:  # another build of PoCL: leave it as it is
        return PoclState("known", f"{path.name} was left as it is ({error})", path)
    if own != UNKNOWN:
        return PoclState("known", f"{path.name} knows this processor ({own.decode()})", path)
    try:
        name = _replace(path, function)
    except _RefusedError as reason:
        detail = (
            f"{path.name} of the wheel does not know this processor, so that no kernel builds on "
            f"it, and was left as it is: {reason}; {INSTEAD}"
        )
        state = PoclState("refused", detail, path)
    else:
        detail = (
            f"{path.name} does not know this processor; a change in memory lets it build for "
            f"{name} ({SWITCH}={OFF} prevents the change)"
        )
        state = PoclState("patched", detail, path)
    # Processes that a command starts for its work do not repeat it.
    if multiprocessing.parent_process() is None and (state.state == "refused" or _is_news(path)):
        LOG.warning("%s", state.detail)
    return state


def _is_news(library: Path) -> bool:
    """Whether this library's change was not yet reported; if so, record it in a file."""
    if os.environ.get(SWITCH) == AGREED:
        return False
    name = hashlib.sha256(os.fsencode(library)).hexdigest()[:16]
    reported = user_caches() / "slamfusion" / f"pocl-{name}"
    try:
        reported.parent.mkdir(parents=True, exist_ok=True)
        reported.touch(exist_ok=False)
    except FileExistsError:
        return False
    except OSError:  # no cache to write to: report it each time
        pass
    return True


def _library() -> Path | None:
    """Return the wheel's PoCL; None on other platforms than the wheel's."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return None
    return min(Path(cl.__file__).parent.glob(".libs/libpocl*.so*"), default=None)


def _replace(path: Path, function: Any) -> str:
    if os.environ.get(SWITCH) == OFF:
        raise _RefusedError(f"{SWITCH}={OFF} says so")
    try:
        with path.open("rb") as file:
            file.seek(-END_BYTES, os.SEEK_END)
            digest = hashlib.sha256(file.read()).hexdigest()
        flags = _processor_flags(Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError as error:
        raise _RefusedError(str(error)) from error
    checked = next((item for item in CHECKED if item.sha256 == digest), None)
    if checked is None:
        wheels = ", ".join(item.wheel for item in CHECKED)
        message = f"it is not the library that was checked (pocl-binary-distribution {wheels})"
        raise _RefusedError(message)
    address = ctypes.cast(function, ctypes.c_void_p).value
    if address is None or ctypes.string_at(address, len(checked.function)) != checked.function:
        raise _RefusedError("its function does not begin as it did when it was checked")
    name = processor_name(flags)
    _overwrite(address, _returning(name), checked.function)
    return name


def _returning(name: str) -> bytes:
    """Return the code of a function that returns a copy of a name."""
    process = ctypes.CDLL(None)
    process.strdup.restype = ctypes.c_void_p
    text: int | None = process.strdup(name.encode())  # lives as long as the process
    copy = ctypes.cast(process.strdup, ctypes.c_void_p).value
    if text is None or copy is None:
        raise _RefusedError("the C library has no strdup")
    to_text, to_copy, jump = RETURN_COPY
    return to_text + text.to_bytes(8, "little") + to_copy + copy.to_bytes(8, "little") + jump


def _overwrite(address: int, code: bytes, before: bytes) -> None:
    """Write code over the first bytes of a function, which must be ``before`` and long enough."""
    if len(code) > len(before):
        message = "what was checked of its function is shorter than what would be replaced"
        raise _RefusedError(message)
    page = mmap.PAGESIZE
    start = address // page * page
    length = -(-(address + len(code)) // page) * page - start
    protect = ctypes.CDLL(None, use_errno=True).mprotect
    protect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    if protect(start, length, READ_WRITE_EXECUTE) != 0:
        raise _RefusedError(f"mprotect does not open its code ({os.strerror(ctypes.get_errno())})")
    ctypes.memmove(address, code, len(code))
    if protect(start, length, READ_EXECUTE) != 0:
        words = os.strerror(ctypes.get_errno())
        ctypes.memmove(address, before, len(code))
        raise _RefusedError(f"mprotect does not close its code again ({words})")


def _processor_flags(cpuinfo: str) -> set[str]:
    for line in cpuinfo.splitlines():
        if line.startswith("flags"):
            return set(line.partition(":")[2].split())
    return set()


class _Symbol(ctypes.Structure):
    """The result of ``dladdr``."""

    _fields_ = (
        ("file", ctypes.c_char_p),
        ("base", ctypes.c_void_p),
        ("name", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
    )


def _library_of(vendor: Any) -> Path | None:
    """Return the file of a platform's functions, found by the loader's table."""
    table = ctypes.c_void_p.from_address(vendor.int_ptr).value
    first = ctypes.c_void_p.from_address(table).value if table else None
    symbol = _Symbol()
    if not first or not ctypes.CDLL(None).dladdr(ctypes.c_void_p(first), ctypes.byref(symbol)):
        return None
    return Path(os.fsdecode(symbol.file)) if symbol.file else None
