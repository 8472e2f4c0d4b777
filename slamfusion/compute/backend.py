"""``Backend``: the dozen operations that run once per cell, point or candidate pose.

Host logic is written once above this protocol. Arrays that stay on the device are passed as opaque
handles from ``upload`` or from another operation; small results come back as NumPy arrays.
"""

from __future__ import annotations

from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from slamfusion.compute import reference

__all__ = ["Backend", "Handle", "NumpyBackend"]

Handle: TypeAlias = Any


class Backend(Protocol):
    """What a compute device must offer; ``slamfusion.compute.reference`` defines each operation.

    Attributes:
        name: the device in words, for tables and reports.
        is_opencl: False for the NumPy twins.
    """

    name: str
    is_opencl: bool

    def upload(self, array: npt.NDArray[Any]) -> Handle:
        """Bring an array to the device."""

    def download(self, handle: Handle) -> npt.NDArray[Any]:
        """Bring an array back, shape and dtype kept."""

    def surface_walls(self, cells: Handle) -> Handle:
        """See ``reference.surface_walls``."""

    def shrink(self, walls: Handle, cells: Handle, step: int) -> tuple[Handle, Handle]:
        """See ``reference.shrink``."""

    def distance_squared(self, walls: Handle) -> Handle:
        """See ``reference.distance_squared``."""

    def score_field(
        self,
        distance2: Handle,
        free_share: Handle,
        hit: npt.NDArray[np.uint16],
        miss: npt.NDArray[np.uint16],
        base: int,
    ) -> Handle:
        """See ``reference.score_field``."""

    def max_window(self, field: Handle, window: int, *, along_rows: bool, fill: int) -> Handle:
        """See ``reference.max_window``."""

    def warp(
        self, cells: Handle, poses: npt.NDArray[np.int64], shape: tuple[int, int], fill: int
    ) -> Handle:
        """See ``reference.warp``."""

    def confusion(self, a: Handle, b: Handle) -> npt.NDArray[np.int64]:
        """See ``reference.confusion``."""

    def correlate(
        self, fields: Handle, offsets: npt.NDArray[np.int32], shift_shape: tuple[int, int]
    ) -> Handle:
        """See ``reference.correlate``; ``shift_shape[1]`` a multiple of 64."""

    def tile_peaks(
        self, forward: Handle, backward: Handle, width: int, tile: int
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """See ``reference.tile_peaks``."""

    def pose_counts(
        self,
        points: npt.NDArray[np.int32],
        poses: npt.NDArray[np.int64],
        field: Handle,
        distance2: Handle,
        free_cell: Handle,
        *,
        base: int,
        near2: int,
        far2: int,
    ) -> npt.NDArray[np.int64]:
        """See ``reference.pose_counts``."""

    def refine_terms(
        self,
        points: npt.NDArray[np.float32],
        poses: npt.NDArray[np.float32],
        distance2: Handle,
        *,
        scale: float,
        centre: tuple[float, float],
        backward: bool,
    ) -> npt.NDArray[np.float64]:
        """See ``reference.refine_terms``."""


class NumpyBackend:
    """The twins as a backend: the whole program without OpenCL, slowly and plainly."""

    name = "NumPy twins (no OpenCL)"
    is_opencl = False

    surface_walls = staticmethod(reference.surface_walls)
    shrink = staticmethod(reference.shrink)
    distance_squared = staticmethod(reference.distance_squared)
    score_field = staticmethod(reference.score_field)
    max_window = staticmethod(reference.max_window)
    warp = staticmethod(reference.warp)
    confusion = staticmethod(reference.confusion)
    correlate = staticmethod(reference.correlate)
    tile_peaks = staticmethod(reference.tile_peaks)
    pose_counts = staticmethod(reference.pose_counts)
    refine_terms = staticmethod(reference.refine_terms)

    @staticmethod
    def upload(array: npt.NDArray[Any]) -> Handle:
        """Return the array itself."""
        return array

    @staticmethod
    def download(handle: Handle) -> npt.NDArray[Any]:
        """Return the array itself."""
        array: npt.NDArray[Any] = handle
        return array
