"""``ComputeDevice``: every operation on one device, and the device that computes with NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import DeviceArray, host
from slamfusion.compute.cell_means import CellMeanDevice
from slamfusion.compute.chunk_marks import ChunkMarkDevice
from slamfusion.compute.fields import FieldDevice
from slamfusion.compute.hit_counts import HitCountDevice
from slamfusion.compute.rays import RayDevice
from slamfusion.compute.scan_match import ScanMatchDevice
from slamfusion.compute.search import SearchDevice
from slamfusion.compute.tiles import TileDevice
from slamfusion.compute.votes import VoteDevice
from slamfusion.compute.wall_pieces import WallPieceDevice
from slamfusion.geometry import Scalar


@dataclass(frozen=True)
class DeviceInfo:
    """An OpenCL device."""

    index: int
    """What --device takes."""
    name: str
    """The device's own name."""
    platform: str
    """The OpenCL driver that offers it."""
    type: str
    """cpu, gpu or other."""
    version: str
    """Of OpenCL, in the driver's words."""
    compute_units: int
    """As the driver counts them."""
    memory_mb: int
    """Global memory, MB."""
    usable: bool
    """Whether it can run the kernels."""
    note: str
    """Why it cannot, or when it is chosen; may be empty."""


class ComputeDevice(
    FieldDevice,
    SearchDevice,
    VoteDevice,
    RayDevice,
    TileDevice,
    ScanMatchDevice,
    CellMeanDevice,
    HitCountDevice,
    ChunkMarkDevice,
    WallPieceDevice,
):
    """A device with all operations.

    Arrays that stay on the device travel as ``DeviceArray``; small results return as NumPy arrays.
    """


class NumpyDevice(ComputeDevice):
    """The whole program without OpenCL, slowly and plainly."""

    name = "NumPy twins (no OpenCL)"

    def upload(self, array: npt.NDArray[Scalar]) -> DeviceArray[Scalar]:
        """Return a copy that operations may change in place."""
        return array.copy()

    def wrap_host(self, array: npt.NDArray[Scalar]) -> DeviceArray[Scalar]:
        """Return the array itself."""
        return array

    def zeros(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> DeviceArray[Any]:
        """Return zeros; the system gives them memory when they are written."""
        return np.zeros(shape, dtype)

    def download(self, handle: DeviceArray[Scalar]) -> npt.NDArray[Scalar]:
        """Return the array itself."""
        return host(handle)
