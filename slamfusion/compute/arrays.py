"""Arrays on an OpenCL device, and launching kernels over them: what every operation stands on."""

from __future__ import annotations

import math
import platform
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.device import choose_device, is_simulator
from slamfusion.compute.pocl import is_plain
from slamfusion.compute.program import KernelProgram
from slamfusion.errors import DeviceError

__all__ = ["EACH_LANE", "DeviceArray", "DeviceArrays"]

# PoCL compiles a kernel again for every new work-group size and picks badly when left to choose:
# one fixed size for each number of dimensions.
LOCAL_SIZES = {1: (16,), 2: (16, 4), 3: (1, 4, 1)}
# A lane of the packed vote is a byte; this spreads a value over the eight lanes of a word.
EACH_LANE = np.uint64(0x0101010101010101)


@dataclass(frozen=True)
class DeviceArray:
    """An array on the device: its buffer, shape and dtype; rows are dense."""

    buffer: Any
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        """Elements."""
        return math.prod(self.shape)

    def reshape(self, shape: tuple[int, ...]) -> DeviceArray:
        """Return the same memory under another shape of as many elements."""
        if math.prod(shape) != self.size:
            message = f"cannot view {self.shape} as {shape}"
            raise ValueError(message)
        return DeviceArray(self.buffer, shape, self.dtype)


class DeviceArrays:
    """One OpenCL device with its queue and kernels, and the arrays on it.

    Raises:
        DeviceError: no such device, or the kernels do not build on it.
    """

    def __init__(self, wanted: str = "auto", *, small_kernels: bool = False) -> None:
        """Choose the device, build the kernels."""
        self.device, self.reason = choose_device(wanted, small_kernels=small_kernels)
        self.name = f"{self.device.name.strip()} ({self.device.platform.name.strip()})"
        self.context = cl.Context([self.device])
        self.queue = cl.CommandQueue(self.context)
        options = []
        is_cpu = bool(self.device.type & cl.device_type.CPU)
        is_x86 = platform.machine().lower() in {"x86_64", "amd64"}
        is_pocl = "portable computing" in self.device.platform.name.lower()
        if is_cpu and is_x86 and is_pocl:
            options.append("-DUNALIGNED_WORDS")
        if is_plain(self.device):
            options.append("-DONE_THREAD")
        self.program = KernelProgram(self.context, self.device, tuple(options))
        self._tables: dict[bytes, DeviceArray] = {}
        # A CPU device reads and writes the host's arrays where they are.
        self.shares_memory = is_cpu and not is_simulator(self.device)

    # -- moving data ---------------------------------------------------------------------------

    def upload(self, array: npt.NDArray[Any]) -> DeviceArray:
        """Bring an array to the device."""
        dense = np.ascontiguousarray(array)
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
        try:
            buffer = cl.Buffer(self.context, flags, hostbuf=dense)
        except cl.Error as error:
            failure = self._failed("upload", error)
            raise failure from error
        return DeviceArray(buffer, dense.shape, dense.dtype)

    def download(self, handle: DeviceArray) -> npt.NDArray[Any]:
        """Bring an array back."""
        out = np.empty(handle.shape, dtype=handle.dtype)
        cl.enqueue_copy(self.queue, out, handle.buffer)
        return out

    def finish(self) -> None:
        """Wait until the device has done all that it was told."""
        self.queue.finish()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> DeviceArray:
        """Reserve an array on the device; its content is undefined."""
        kind = np.dtype(dtype)
        size = max(1, math.prod(shape) * kind.itemsize)
        try:
            buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, size)
        except cl.Error as error:
            failure = self._failed(f"reserving {size / 2**20:.0f} MiB", error)
            raise failure from error
        return DeviceArray(buffer, shape, kind)

    def lend(self, array: npt.NDArray[Any], *, writable: bool = False) -> DeviceArray:
        """Give the device a dense host array: without a copy where both share memory.

        Args:
            array: must outlive the device's use of it; kernels access it in words of 8 bytes.
            writable: a result, to be fetched with ``collect``; its content is not sent.
        """
        lendable = array.flags.c_contiguous and array.ctypes.data % EACH_LANE.itemsize == 0
        if not (self.shares_memory and lendable):
            return self.empty(array.shape, array.dtype) if writable else self.upload(array)
        access = cl.mem_flags.READ_WRITE if writable else cl.mem_flags.READ_ONLY
        try:
            buffer = cl.Buffer(self.context, access | cl.mem_flags.USE_HOST_PTR, hostbuf=array)
        except cl.Error as error:
            failure = self._failed("lending memory", error)
            raise failure from error
        return DeviceArray(buffer, array.shape, array.dtype)

    def collect(self, handle: DeviceArray, array: npt.NDArray[Any]) -> None:
        """Finish the work on an array lent as writable, so that the host may read it."""
        if not self.shares_memory:
            cl.enqueue_copy(self.queue, array, handle.buffer)
            return
        mapped, _ = cl.enqueue_map_buffer(
            self.queue, handle.buffer, cl.map_flags.READ, 0, handle.shape, handle.dtype
        )
        mapped.base.release(self.queue)

    def _launch(self, name: str, size: tuple[int, ...], *arguments: Any) -> None:
        """Start a kernel; its global size is rounded up to the fixed local size."""
        local = LOCAL_SIZES[len(size)]
        rounded = tuple(-(-s // part) * part for s, part in zip(size, local, strict=True))
        plain = [a.buffer if isinstance(a, DeviceArray) else a for a in arguments]
        try:
            self.program[name](self.queue, rounded, local, *plain)
        except cl.Error as error:
            failure = self._failed(f"kernel {name}", error)
            raise failure from error

    def _failed(self, what: str, error: Exception) -> DeviceError:
        """Return the one-line error of a failed device call."""
        words = " ".join(str(error).split())[:200]
        message = f"{self.name}: {what} failed ({words}); try `--device numpy`"
        return DeviceError(message)

    def _table(self, array: npt.NDArray[Any]) -> DeviceArray:
        """Upload a small constant table once."""
        key = array.tobytes()
        if key not in self._tables:
            self._tables[key] = self.upload(array)
        return self._tables[key]
