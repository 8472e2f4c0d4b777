"""``ComputeDevice`` on one OpenCL device: its queue, arrays on it, and launching kernels."""

from __future__ import annotations

import ctypes
import math
import mmap
import platform
import re
import threading
import warnings
import weakref
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

import numpy as np
import numpy.typing as npt
import pyopencl as cl  # noqa: TID251 - compute/ is where pyopencl belongs

from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.compute_device import ComputeDevice
from slamfusion.compute.device import choose_device, is_simulator, is_single_thread
from slamfusion.compute.layout import CLIMBERS, EACH_LANE, kernel_options
from slamfusion.compute.pocl_cache import PLATFORM, cache_folders
from slamfusion.errors import DeviceError
from slamfusion.geometry import I64, Scalar

INCLUDE = re.compile(r'^#include "([\w.]+)"$', flags=re.MULTILINE)


def kernel_folder() -> Path:
    """Return the folder of the .cl files: inside the wheel, or beside an editable checkout.

    Raises:
        DeviceError: neither place has them.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "kernels", package.parent / "kernels"):
        if (folder / "common.h").is_file():
            return folder
    message = f"no kernel sources in {package / 'kernels'} or next to it; reinstall slamfusion"
    raise DeviceError(message)


def kernel_source(folder: Path) -> str:
    """Return the source of all kernels in a folder, with their headers written out.

    It is one program, since PoCL reads the OpenCL header of 1 MB for each program in its cache.
    It contains no path, so that installations of equal sources share that cache.
    """
    families = sorted(path.stem for path in folder.glob("*.cl"))
    return "\n".join(_family_source(folder, family) for family in families)


def _family_source(folder: Path, family: str) -> str:
    """Return the source of a family, with its lines named, and arithmetic set to the default."""
    source = (folder / f"{family}.cl").read_text(encoding="utf-8")

    def write_out(found: re.Match[str]) -> str:
        header = (folder / found[1]).read_text(encoding="utf-8")
        next_line = source.count("\n", 0, found.end()) + 2
        return f'#line 1 "{found[1]}"\n{header}\n#line {next_line} "{family}.cl"'

    begin = f'#pragma OPENCL FP_CONTRACT ON\n#line 1 "{family}.cl"\n'
    return begin + INCLUDE.sub(write_out, source)


# PoCL compiles a kernel for every new work-group size, and chooses slow sizes by itself: one fixed
# size for each number of dimensions. A group of one dimension is a round of a climb, a
# fit, or a map's beams: ``count_beams`` relies on it.
LOCAL_SIZES = {1: (CLIMBERS,), 2: (16, 4), 3: (1, 4, 1)}
# Tables that are kept, the last ones: alignments make tables of their own for each map.
MOST_TABLES = 64
# By how much an array that is copied to more memory may grow before the next copy.
GROWTH = 1.5


@dataclass(frozen=True)
class OpenCLArray(Generic[Scalar]):
    """An array on an OpenCL device: its buffer, shape and dtype; rows are dense."""

    buffer: Any
    shape: tuple[int, ...]
    dtype: np.dtype[Scalar]

    @property
    def size(self) -> int:
        """Elements."""
        return math.prod(self.shape)

    def __getitem__(self, rows: slice, /) -> OpenCLArray[Scalar]:
        """Return the first rows, ``array[:n]`` with n from 0, in the same memory."""
        return OpenCLArray(self.buffer, (rows.stop, *self.shape[1:]), self.dtype)


class OpenCLDevice(ComputeDevice):
    """One OpenCL device with an in-order queue and all kernels, and the arrays on it.

    ``wanted`` is its name for ``open_device``; with ``shares_memory`` it uses the host's arrays;
    if ``is_pocl``, a work-group is one thread, one item after the other.

    Raises:
        DeviceError: no such device, or the kernels do not build on it.
    """

    def __init__(self, wanted: str = "auto", *, small_kernels: bool = False) -> None:
        self.wanted = wanted
        self.device = choose_device(wanted, small_kernels=small_kernels)
        self.name = f"{self.device.name.strip()} ({self.device.platform.name.strip()})"
        self.context = cl.Context([self.device])
        self.queue = cl.CommandQueue(self.context)
        is_cpu = bool(self.device.type & cl.device_type.CPU)
        self.shares_memory = is_cpu and not is_simulator(self.device)
        options = ["-w", *kernel_options()]
        self.is_pocl = is_cpu and self.device.platform.name.strip() == PLATFORM
        if self.is_pocl:
            options.append("-DONE_THREAD_A_GROUP")
            if platform.machine().lower() in {"x86_64", "amd64"}:
                options.append("-DUNALIGNED_WORDS")
        if is_single_thread(self.device):
            options.append("-DONE_THREAD")
        program = cl.Program(self.context, kernel_source(kernel_folder()))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", cl.CompilerWarning)
                self.program = program.build(options=options, devices=[self.device])
        except cl.Error as error:
            words = " ".join(str(error).split())[:400]
            message = f"the kernels do not build on {self.device.name.strip()}: {words}"
            raise DeviceError(message) from error
        if self.is_pocl and not self.program.kernel_names:
            folder, _ = cache_folders()
            message = f"the kernels in PoCL's cache {folder} are damaged; delete that folder"
            raise DeviceError(message)
        # Idle kernel objects by name: one holds the arguments of one launch at a time.
        self._kernels: defaultdict[str, list[Any]] = defaultdict(list)
        self._tables: dict[bytes, OpenCLArray[Any]] = {}
        self._tables_lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as the wanted device; see ``shared_device``."""
        from slamfusion.compute import shared_device  # noqa: PLC0415 - which imports this module

        return shared_device, (self.wanted,)

    @property
    def opencl(self) -> OpenCLDevice:
        """Itself."""
        return self

    # -- moving data ---------------------------------------------------------------------------

    def upload(self, array: npt.NDArray[Scalar]) -> OpenCLArray[Scalar]:
        """Bring an array to the device."""
        if not array.size:
            return self.empty(array.shape, array.dtype)
        dense = np.ascontiguousarray(array)
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
        return OpenCLArray(self._reserve(flags, dense.nbytes, dense), dense.shape, dense.dtype)

    def download(self, handle: DeviceArray[Scalar]) -> npt.NDArray[Scalar]:
        """Bring an array back."""
        out = np.empty(handle.shape, dtype=handle.dtype)
        if out.size:
            cl.enqueue_copy(self.queue, out, self._buffer(handle))
        return out

    def empty(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> OpenCLArray[Any]:
        """Reserve an array on the device; its content is undefined."""
        kind = np.dtype(dtype)
        size = max(1, math.prod(shape) * kind.itemsize)
        return OpenCLArray(self._reserve(cl.mem_flags.READ_WRITE, size), shape, kind)

    def wrap_host(
        self, array: npt.NDArray[Scalar], *, writable: bool = False
    ) -> OpenCLArray[Scalar]:
        """Wrap a dense host array for the device: without a copy where both share memory.

        Args:
            array: must outlive the device's use of it; kernels access it in words of 8 bytes.
            writable: a result, to be fetched with ``map_host``; its content is not sent.
        """
        address: int = array.__array_interface__["data"][0]  # a third of the time of ctypes.data
        is_aligned = array.flags.c_contiguous and address % EACH_LANE.itemsize == 0
        if not (self.shares_memory and is_aligned):
            return self.empty(array.shape, array.dtype) if writable else self.upload(array)
        access = cl.mem_flags.READ_WRITE if writable else cl.mem_flags.READ_ONLY
        buffer = self._reserve(access | cl.mem_flags.USE_HOST_PTR, array.nbytes, array)
        return OpenCLArray(buffer, array.shape, array.dtype)

    def map_host(self, handle: OpenCLArray[Any], array: npt.NDArray[Any]) -> None:
        """Finish the work on an array wrapped as writable, so that the host may read it."""
        if not self.shares_memory:
            cl.enqueue_copy(self.queue, array, handle.buffer)
            return
        self._mapped(handle).base.release(self.queue)

    def extended(
        self, array: DeviceArray[Any], count: int, fill: int | None, room: int
    ) -> OpenCLArray[Any]:
        """Return an array with ``count`` rows: on the same memory, or copied to more of it.

        New memory has none to spare if ``room`` is 0, else on a device that uses the host's memory
        ``room`` rows at the least; without ``fill`` the new rows are undefined.
        """
        buffer = self._buffer(array)
        if count * math.prod(array.shape[1:]) * array.dtype.itemsize > buffer.size:
            least = room if self.shares_memory else 0
            rows = max(least, int(GROWTH * count)) if room else count
            grown = self._paged((rows, *array.shape[1:]), array.dtype)
            size = array.size * array.dtype.itemsize
            cl.enqueue_copy(self.queue, grown.buffer, buffer, byte_count=size)
            if fill is not None:
                self.fill(grown, fill, first=array.size)
            buffer = grown.buffer
        return OpenCLArray(buffer, (count, *array.shape[1:]), array.dtype)

    def _paged(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> OpenCLArray[Any]:
        """Reserve an array; on the host's memory it starts at a page."""
        if not self.shares_memory:
            return self.empty(shape, dtype)
        size = math.prod(shape) * dtype.itemsize
        whole = self.empty((size + mmap.PAGESIZE,), np.uint8)
        mapped = self._mapped(whole)
        first = -mapped.__array_interface__["data"][0] % mmap.PAGESIZE
        mapped.base.release(self.queue)
        return OpenCLArray(whole.buffer.get_sub_region(first, size), shape, dtype)

    def _mapped(self, array: DeviceArray[Any]) -> Any:
        """Return an array in the host's memory, to be released."""
        flags, buffer = cl.map_flags.READ, self._buffer(array)
        return cl.enqueue_map_buffer(self.queue, buffer, flags, 0, array.shape, array.dtype)[0]

    def discard_rows(self, array: DeviceArray[Any], rows: I64) -> None:
        """Return pages of rows, (K,) rising, to the system if the host's; then undefined."""
        if not (self.shares_memory and len(rows)):
            return
        mapped, page, advise = self._mapped(array), mmap.PAGESIZE, ctypes.CDLL(None).madvise
        address, size = mapped.__array_interface__["data"][0], mapped.strides[0]
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            first, end = address + int(run[0]) * size, address + int(run[-1] + 1) * size
            first, end = -(-first // page) * page, end // page * page
            if first < end:
                advise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), mmap.MADV_DONTNEED)
        mapped.base.release(self.queue)

    def copy_rows(self, source: DeviceArray[Any], target: OpenCLArray[Any]) -> None:
        """Copy the first columns of an array into one of another width, as many as both have."""
        item, origin = source.dtype.itemsize, (0, 0, 0)
        height, width = source.shape
        cl.enqueue_copy(
            self.queue,
            target.buffer,
            self._buffer(source),
            src_origin=origin,
            dst_origin=origin,
            region=(min(width, target.shape[1]) * item, height, 1),
            src_pitches=(width * item,),
            dst_pitches=(target.shape[1] * item,),
        )

    def fill(self, array: OpenCLArray[Any], value: int, first: int = 0) -> None:
        """Set all elements from one on to a value."""
        item = array.dtype.itemsize
        pattern = np.array([value], dtype=array.dtype)
        size = (array.size - first) * item
        if size:
            cl.enqueue_fill_buffer(self.queue, array.buffer, pattern, first * item, size)

    def cleared(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> OpenCLArray[Any]:
        """Reserve an array of zeros."""
        array = self.empty(shape, dtype)
        self.fill(array, 0)
        return array

    def zeros(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> OpenCLArray[Any]:
        """Reserve an array of zeros; in the host's memory a page takes room once it is written."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if not (self.shares_memory and size):
            return self.cleared(shape, dtype)
        pages = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        array = np.frombuffer(pages, dtype).reshape(shape)
        # A kernel may still write to them when the last reference goes.
        weakref.finalize(array, self.queue.finish)
        return self.wrap_host(array, writable=True)

    def table(self, array: npt.NDArray[Scalar]) -> OpenCLArray[Scalar]:
        """Upload a small constant table once."""
        key = array.tobytes()
        with self._tables_lock:
            found = self._tables.pop(key, None)
            table = self._tables[key] = self.upload(array) if found is None else found
            if len(self._tables) > MOST_TABLES:
                self._tables.pop(next(iter(self._tables)))
        return table

    # -- launching -----------------------------------------------------------------------------

    def launch(self, name: str, size: tuple[int, ...], *arguments: Any) -> Any:
        """Start a kernel; its global size is rounded up to the fixed local size, 0 starts none.

        Python's numbers become int32 and float32. Returns the event of its end.
        """
        if 0 in size:
            return None
        local = LOCAL_SIZES[len(size)]
        rounded = tuple(-(-s // part) * part for s, part in zip(size, local, strict=True))
        plain = [item.buffer if type(item) is OpenCLArray else item for item in arguments]
        idle = self._kernels[name]
        try:
            try:
                kernel = idle.pop()
            except IndexError:
                kernel = cl.Kernel(self.program, name)
                # The types of the numbers in its first launch: finding each takes 4 us.
                kernel.set_scalar_arg_dtypes([_number_type(item) for item in plain])
            event = kernel(self.queue, rounded, local, *plain)
            idle.append(kernel)
        except cl.Error as error:
            raise self._failed(f"kernel {name}", error) from error
        return event

    def launch_new(
        self,
        shape: tuple[int, ...],
        dtype: npt.DTypeLike,
        name: str,
        size: tuple[int, ...],
        *arguments: Any,
    ) -> OpenCLArray[Any]:
        """Start a kernel whose last argument is a new array on the device; return that array."""
        out = self.empty(shape, dtype)
        self.launch(name, size, *arguments, out)
        return out

    def launch_into(
        self, result: npt.NDArray[Scalar], name: str, size: tuple[int, ...], *arguments: Any
    ) -> npt.NDArray[Scalar]:
        """Start a kernel whose last argument is a host array to fill; return that array, filled."""
        return self.start_into(result, name, size, *arguments)()

    def start_into(
        self, result: npt.NDArray[Scalar], name: str, size: tuple[int, ...], *arguments: Any
    ) -> Callable[[], npt.NDArray[Scalar]]:
        """Start as ``launch_into`` does; return a function that waits and returns the array."""
        if 0 in (*size, result.size):
            return lambda: result
        out = self.wrap_host(result, writable=True)
        return _Filling(self, result, out, self.launch(name, size, *arguments, out))

    def _reserve(self, flags: int, size: int, hostbuf: Any = None) -> Any:
        try:
            return cl.Buffer(self.context, flags, size, hostbuf)
        except cl.Error as error:
            raise self._failed(f"reserving {size / 2**20:.0f} MiB", error) from error

    @staticmethod
    def _buffer(handle: DeviceArray[Any]) -> Any:
        if not isinstance(handle, OpenCLArray):
            raise DeviceError(f"wanted an array on an OpenCL device, found {type(handle).__name__}")
        return handle.buffer

    def _failed(self, what: str, error: Exception) -> DeviceError:
        words = " ".join(str(error).split())[:200]
        return DeviceError(f"{self.name}: {what} failed ({words}); try `--device numpy`")


class _Filling(Generic[Scalar]):
    """Wait for a kernel that fills a host array; keep the array until the kernel has ended."""

    def __init__(
        self,
        device: OpenCLDevice,
        result: npt.NDArray[Scalar],
        out: OpenCLArray[Scalar],
        event: Any,
    ) -> None:
        self._device, self._result, self._out, self._event = device, result, out, event

    def __call__(self) -> npt.NDArray[Scalar]:
        # PoCL writes to the host's array itself: to map it would be two more commands.
        if self._device.is_pocl and self._device.shares_memory:
            self._event.wait()
        else:
            self._device.map_host(self._out, self._result)
        return self._result

    def __del__(self) -> None:
        self._event.wait()


def _number_type(item: Any) -> Any:
    """Return the type of a number in a kernel; None of a buffer."""
    if isinstance(item, (int, np.int64)):
        return np.int32
    if isinstance(item, float):
        return np.float32
    return type(item) if isinstance(item, np.generic) else None
