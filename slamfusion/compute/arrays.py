"""Arrays on a compute device, as whoever hands them from one operation to the next sees them."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

__all__ = ["ArrayDevice", "DeviceArray"]

Scalar = TypeVar("Scalar", bound=np.generic)
Scalar_co = TypeVar("Scalar_co", bound=np.generic, covariant=True)


class DeviceArray(Protocol[Scalar_co]):
    """An array that stays on its device: shape and dtype are known, the content is not.

    On the device of the NumPy twins it is an ``ndarray``.
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

    def reshape(self, shape: tuple[int, ...], /) -> DeviceArray[Scalar_co]:
        """Return the same memory under another shape of as many elements."""


class ArrayDevice(Protocol):
    """A device that holds arrays: what every family of operations stands on.

    Attributes:
        name: the device in words, for tables and reports.
        is_opencl: False for the NumPy twins.
    """

    name: str
    is_opencl: bool

    def upload(self, array: npt.NDArray[Scalar]) -> DeviceArray[Scalar]:
        """Bring an array to the device; later changes of ``array`` do not reach it."""

    def download(self, handle: DeviceArray[Scalar]) -> npt.NDArray[Scalar]:
        """Bring an array back, shape and dtype kept."""

    def finish(self) -> Any:
        """Wait until the device has done all that it was told."""
