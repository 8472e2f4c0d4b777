"""Random input for the checks of a device."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice, NumpyDevice
from slamfusion.compute.arrays import DeviceArray

NUMPY = NumpyDevice()
Arrays: TypeAlias = list[npt.NDArray[Any]]


@dataclass(frozen=True)
class Sample:
    """Random input of one size; equal fields make equal input.

    Attributes:
        shape: rows and columns.
        seed: of every random number.
        known_share: of the cells; 0 makes a grid of unknown cells only.
        away: cells that poses shift everything by; far more than the shape leaves no overlap.
    """

    shape: tuple[int, int]
    seed: int = 0
    known_share: float = 0.7
    away: float = 0.0

    @property
    def rng(self) -> np.random.Generator:
        """A generator that starts again from the seed at each use."""
        return np.random.default_rng(self.seed)

    def grids(self, count: int) -> list[npt.NDArray[np.int8]]:
        """Return trinary grids (H, W) int8."""
        share = (1.0 - self.known_share, 0.8 * self.known_share, 0.2 * self.known_share)
        values = np.array([-1, 0, 1], dtype=np.int8)
        stack = self.rng.choice(values, (count, *self.shape), p=share)
        return list(stack)

    @cached_property
    def cells(self) -> npt.NDArray[np.int8]:
        """(H, W) int8 trinary."""
        return self.grids(1)[0]

    @cached_property
    def solid(self) -> npt.NDArray[np.uint8]:
        """(H, W) uint8, 1 where occupied."""
        solid: npt.NDArray[np.uint8] = (self.cells == 1).astype(np.uint8)
        return solid

    @cached_property
    def walls(self) -> npt.NDArray[np.uint8]:
        """(H, W) uint8, 0 or 1."""
        return NUMPY.download(NUMPY.surface_walls(self.cells, self.solid))

    @cached_property
    def distance2(self) -> npt.NDArray[np.uint16]:
        """(H, W) uint16."""
        return NUMPY.download(NUMPY.distance_squared(self.walls))

    @cached_property
    def field(self) -> npt.NDArray[np.uint8]:
        """(H, W) uint8."""
        field: npt.NDArray[np.uint8] = self.rng.integers(0, 256, self.shape).astype(np.uint8)
        return field

    @cached_property
    def motions(self) -> npt.NDArray[np.float64]:
        """(3, 3) x, y in cells and yaw."""
        size = max(self.shape)
        scale = np.array([size, size, 6.0])
        motions: npt.NDArray[np.float64] = self.rng.uniform(-0.5, 0.5, (3, 3)) * scale
        motions[:, :2] += self.away
        return motions

    def points(self, count: int) -> npt.NDArray[np.int32]:
        """Return cell centres (N, 2) int32 in half cells, x and y."""
        rows, cols = self.rng.integers(0, self.shape, (count, 2)).T
        return (2 * np.stack((cols, rows), axis=1) + 1).astype(np.int32)


# What an operation gives on a sample; its name in the registry is the operation's.
Check: TypeAlias = Callable[[ComputeDevice, Sample], Arrays]


def fetch(device: ComputeDevice, handles: Iterable[DeviceArray[Any]]) -> Arrays:
    """Download results."""
    return [device.download(handle) for handle in handles]
