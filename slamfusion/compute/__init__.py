"""Everything that runs once per cell, per point or per candidate pose, on an OpenCL device.

``open_backend`` chooses the device; the NumPy twins are a backend too, for machines without
OpenCL. pyopencl is imported here only, and only when an OpenCL device is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamfusion.compute.backend import Backend, NumpyBackend
from slamfusion.compute.self_test import self_test
from slamfusion.errors import DeviceError

if TYPE_CHECKING:
    from slamfusion.compute.device import DeviceInfo

__all__ = ["Backend", "NumpyBackend", "list_devices", "open_backend", "self_test"]


def open_backend(device: str = "auto", *, small_kernels: bool = False) -> Backend:
    """Return the backend for ``device``.

    Args:
        device: ``auto``, ``numpy``, an index of ``slamfusion devices``, or part of a name.
        small_kernels: the work is many kernels of well below a millisecond, one after the other.
            Their thread holds Python's lock meanwhile, so it is not for a process that has more.

    Raises:
        DeviceError: pyopencl or the device is missing, or its kernels do not build.
    """
    if device == "numpy":
        return NumpyBackend()
    try:
        from slamfusion.compute.opencl import OpenCLBackend  # noqa: PLC0415 - optional at run time
    except ImportError as error:
        message = f"pyopencl cannot be imported ({error}); install it or use `--device numpy`"
        raise DeviceError(message) from error
    return OpenCLBackend(device, small_kernels=small_kernels)


def list_devices() -> list[DeviceInfo]:
    """Describe every OpenCL device; empty where pyopencl or a platform is missing."""
    try:
        from slamfusion.compute import device  # noqa: PLC0415 - optional at run time
    except ImportError:
        return []
    return device.list_devices()
