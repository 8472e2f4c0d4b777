"""List OpenCL devices and choose one; offer Intel's (the extra ``intel``) too."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import shutil
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.compute_device import DeviceInfo
from slamfusion.compute.pocl import is_refused, name_processor
from slamfusion.compute.pocl_cache import PLATFORM, find_cache
from slamfusion.errors import DeviceError

DISTRIBUTION = "intel-opencl-rt"
LIBRARY = "libintelocl.so"
INTEL_PLATFORM = "Intel(R) OpenCL"
# Where the loader looks for platforms.
VENDORS, USUAL_FOLDER = "OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH"
DEFAULT_FOLDER = "/etc/OpenCL/vendors"


@cache
def intel_library() -> Path | None:
    """Return Intel's OpenCL of this environment; None where the extra is not installed.

    The extra's wheel puts ``libintelocl.so`` into the environment's ``lib`` folder, with an entry
    for OpenCL's loader that names the folder of another machine. So the loader gets a folder with
    the usual entries and this one. It is no default where PoCL works, which is as fast; and its
    threads wait busily.
    """
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        for file in importlib.metadata.files(DISTRIBUTION) or []:
            if file.name == LIBRARY:
                return Path(str(file.locate())).resolve()
    return None


def is_intel_extra(device: Any) -> bool:
    """Return whether a device is the one that the extra brings."""
    return intel_library() is not None and device.platform.name.strip() == INTEL_PLATFORM


@contextlib.contextmanager
def intel_shown() -> Iterator[None]:
    """Show OpenCL's loader Intel's CPU device too, unless the environment sets its folder."""
    library = intel_library()
    if library is None or os.environ.get(VENDORS):
        yield
        return
    usual = Path(os.environ.get(USUAL_FOLDER) or DEFAULT_FOLDER)
    with tempfile.TemporaryDirectory(prefix="slamfusion-icd-") as folder:
        for entry in usual.glob("*.icd"):
            shutil.copy(entry, folder)
        # Beside it the loader of pyopencl's wheel always looks into its own folder, for PoCL's.
        Path(folder, "slamfusion-intel.icd").write_text(f"{library}\n", encoding="utf-8")
        os.environ[VENDORS] = folder
        try:
            yield
        finally:
            del os.environ[VENDORS]


SIMULATOR = "oclgrind"
NO_DEVICE = (
    "no OpenCL device found; install one (x86-64 CPU: `pip install pocl-binary-distribution`, "
    "any CPU on Debian or Ubuntu: `apt install pocl-opencl-icd`) or run with `--device numpy`"
)


def find_devices() -> list[Any]:
    """Return every OpenCL device, by preference; PoCL's only if it can store its kernels.

    The wheel's PoCL has two for one processor, unless the user's settings say otherwise:
    ``pthread`` runs kernels in its own threads, ``basic`` in the calling thread, a tenth of a
    millisecond faster.
    """
    if name_processor() and not os.environ.get("PYOPENCL_CTX"):
        os.environ.setdefault("POCL_DEVICES", "pthread basic")
    try:
        with intel_shown():
            platforms = cl.get_platforms()
    except cl.Error:
        return []
    devices = []
    for vendor in platforms:
        if vendor.name.strip() == PLATFORM and find_cache():
            continue
        try:
            devices.extend(vendor.get_devices())
        except cl.Error:
            continue
    return sorted(devices, key=_rank)


def _rank(device: Any, *, small_kernels: bool = False) -> int:
    """Return the place of a device among those of its type: the extra's Intel device is last."""
    return 2 if is_intel_extra(device) else int(is_single_thread(device) != small_kernels)


def is_single_thread(device: Any) -> bool:
    """Return whether a device runs its kernels in the calling thread."""
    return bool(device.name.startswith("basic"))


def is_simulator(device: Any) -> bool:
    """Whether the device is the Oclgrind simulator, which is for tests only."""
    return SIMULATOR in f"{device.platform.name} {device.name}".lower()


def _note(device: Any) -> str:
    """Return when a device is chosen, if that does not follow from its type."""
    if is_simulator(device):
        return "simulator, only when asked for by name"
    if is_refused(device):
        return "never: does not know this processor, see `slamfusion doctor`"
    if is_intel_extra(device):
        return "when asked for by name, or where PoCL cannot build"
    return "one thread; for many small kernels" if is_single_thread(device) else ""


def _type_name(device: Any) -> str:
    if device.type & cl.device_type.GPU:
        return "gpu"
    return "cpu" if device.type & cl.device_type.CPU else "other"


def list_devices() -> list[DeviceInfo]:
    """Describe every OpenCL device; the index is what ``--device`` takes."""
    return [
        DeviceInfo(
            index=index,
            name=device.name.strip(),
            platform=device.platform.name.strip(),
            type=_type_name(device),
            version=device.version.strip(),
            compute_units=int(device.max_compute_units),
            memory_mb=int(device.global_mem_size // 2**20),
            usable=bool(device.available and device.compiler_available) and not is_refused(device),
            note=_note(device),
        )
        for index, device in enumerate(find_devices())
    ]


def choose_device(wanted: str = "auto", *, small_kernels: bool = False) -> Any:
    """Return a device.

    Order: the option, then ``PYOPENCL_CTX``, then the first GPU, then the first CPU; the simulator
    only when asked for by name. Of PoCL's two devices the single-thread one where kernels are
    small; the extra's Intel device after both; none of a PoCL that does not know the processor.

    Args:
        wanted: ``auto``, an index of ``slamfusion devices``, or part of a device's or platform's
            name, any case.
        small_kernels: the work is many kernels of well below a millisecond, one after the other.

    Raises:
        DeviceError: no device, or none that fits; the message lists what there is.
    """
    devices = find_devices()
    if not devices:
        raise DeviceError(NO_DEVICE)
    if wanted != "auto":
        return _named(devices, wanted)
    if os.environ.get("PYOPENCL_CTX"):
        try:
            context = cl.create_some_context(interactive=False)
        except (cl.Error, RuntimeError) as error:
            wish = os.environ["PYOPENCL_CTX"]
            message = f"PYOPENCL_CTX={wish!r} names no device ({error}); correct or unset it"
            raise DeviceError(message) from error
        return context.devices[0]
    real = [
        device
        for device in devices
        if not is_simulator(device) and device.available and not is_refused(device)
    ]
    if not real:
        raise _no_device(devices)
    types = ["gpu", "cpu", "other"]
    return min(
        real,
        key=lambda one: (types.index(_type_name(one)), _rank(one, small_kernels=small_kernels)),
    )


def _no_device(devices: list[Any]) -> DeviceError:
    """Return the advice if none of some devices can be chosen."""
    state = name_processor()
    return DeviceError(state.detail if state and any(map(is_refused, devices)) else NO_DEVICE)


def _named(devices: list[Any], wanted: str) -> Any:
    if wanted.isdecimal():
        fitting = devices[int(wanted) : int(wanted) + 1]
    else:
        fitting = [
            device
            for device in devices
            if wanted.lower() in f"{device.platform.name} {device.name}".lower()
        ]
    if fitting:
        device = next((item for item in fitting if not is_refused(item)), None)
        if device is None:
            raise _no_device(fitting)
        return device
    names = "; ".join(f"{i}: {device.name.strip()}" for i, device in enumerate(devices))
    message = f"no OpenCL device fits {wanted!r}; there are: {names}; or use `--device numpy`"
    raise DeviceError(message)
