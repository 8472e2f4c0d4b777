"""Everything that runs once per cell, per point or per candidate pose, on a compute device.

Each family of operations is one module: an operation is a method that launches kernels on an OpenCL
device and otherwise computes the same with NumPy. ``ComputeDevice`` has all of them, and
``open_device`` chooses the device. pyopencl is imported only if an OpenCL device is requested.
"""

from __future__ import annotations

import logging
from functools import cache
from typing import TYPE_CHECKING

from slamfusion.compute.compute_device import ComputeDevice, NumpyDevice
from slamfusion.compute.pocl_cache import find_cache
from slamfusion.errors import DeviceError

if TYPE_CHECKING:
    from slamfusion.compute.compute_device import DeviceInfo

_LOG = logging.getLogger(__name__)

__all__ = ["ComputeDevice", "NumpyDevice", "list_devices", "open_device", "shared_device"]


def open_device(wanted: str = "auto", *, small_kernels: bool = False) -> ComputeDevice:
    """Return the compute device that ``wanted`` names.

    If PoCL would be chosen but cannot store its kernels, ``auto`` means NumPy; it is logged.

    Args:
        wanted: ``auto``, ``numpy``, an index of ``slamfusion devices``, or part of a name.
        small_kernels: the work is many kernels of well below a millisecond in sequence. Their
            thread holds Python's lock meanwhile, so it is not for a process with further threads.

    Raises:
        DeviceError: pyopencl or the device is missing, or its kernels do not build.
    """
    if wanted == "numpy":
        return NumpyDevice()
    problem = find_cache()  # before pyopencl, which keeps files too
    try:
        from slamfusion.compute.opencl import OpenCLDevice  # noqa: PLC0415 - optional at run time

        return OpenCLDevice(wanted, small_kernels=small_kernels)
    except ImportError as error:
        message = f"pyopencl cannot be imported ({error}); install it or use `--device numpy`"
        raise DeviceError(message) from error
    except (DeviceError, OSError) as error:
        if not problem:
            raise
        if wanted != "auto":
            advice = "free some space, or run with `--device numpy`"
            raise DeviceError(f"{problem}; {advice}") from error
        _LOG.warning("%s: NumPy computes instead, which takes longer", problem)
        return NumpyDevice()


@cache
def shared_device(wanted: str) -> ComputeDevice:
    """Return this process's device, built once; sent to another process it becomes that one's."""
    return open_device(wanted)


def list_devices() -> list[DeviceInfo]:
    """Describe every OpenCL device; empty if pyopencl or a platform is missing."""
    find_cache()
    try:
        from slamfusion.compute import device  # noqa: PLC0415 - optional at run time
    except ImportError:
        return []
    return device.list_devices()
