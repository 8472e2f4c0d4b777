"""Arrays on a compute device, as callers pass them from one operation to the next."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Scalar

if TYPE_CHECKING:
    from slamfusion.compute.opencl import OpenCLDevice

Scalar_co = TypeVar("Scalar_co", bound=np.generic, covariant=True)


class DeviceArray(Protocol[Scalar_co]):
    """An array that stays on its device: shape and dtype are known, the content is not.

    With NumPy it is an ``ndarray``.
    """

    @property
    def shape(self) -> tuple[int, ...]:
        """Elements along each axis; rows are dense."""

    @property
    def dtype(self) -> np.dtype[Scalar_co]:
        """Kind of the elements."""

    @property
    def size(self) -> int:
        """Elements."""

    def __getitem__(self, rows: slice, /) -> DeviceArray[Scalar_co]:
        """Return the first rows, ``array[:n]``, in the same memory."""


def host(handle: DeviceArray[Scalar]) -> npt.NDArray[Scalar]:
    """Return an array of the NumPy device as an ``ndarray``."""
    return cast("npt.NDArray[Scalar]", handle)


class ArrayDevice(ABC):
    """A device that holds arrays; the families of operations are built on it.

    Each operation is one method: with ``opencl`` it launches kernels, otherwise it computes the
    same with NumPy, which defines the result. ``name`` describes the device.
    """

    name: str

    @property
    def opencl(self) -> OpenCLDevice | None:
        """The kernel launcher; None if NumPy computes."""
        return None

    @abstractmethod
    def upload(self, array: npt.NDArray[Scalar]) -> DeviceArray[Scalar]:
        """Bring an array to the device; later changes of ``array`` do not reach it."""

    @abstractmethod
    def wrap_host(self, array: npt.NDArray[Scalar]) -> DeviceArray[Scalar]:
        """Return an array that operations only read, without a copy where memory is shared."""

    @abstractmethod
    def zeros(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> DeviceArray[Any]:
        """Return an array of zeros for few writes: on a CPU pages that stay 0 take no memory."""

    @abstractmethod
    def download(self, handle: DeviceArray[Scalar]) -> npt.NDArray[Scalar]:
        """Bring an array back, shape and dtype kept."""
