"""Cell means: maps whose cells keep a mean of what scans told them.

tinySLAM's map (a beam leaves a valley around its hit) and the likelihood field of the graph's
submaps (how near a scan's hits come) share the way: a scan is marked into a pool of words, then
what was marked is integrated, so that each cell learns once a scan.

``numpy.py`` defines each operation, ``opencl.py`` and ``kernels/cell_means.cl`` do it on a device.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.compute.arrays import ArrayDevice, DeviceArray

__all__ = ["CellMeanDevice", "LikelihoodRule", "ScanRule"]

U8 = npt.NDArray[np.uint8]


class ScanRule(NamedTuple):
    """How beams of one scan write into the map.

    Attributes:
        half_blur: half width of the valley around a hit, 1/1024 cell.
        behind: least value that is written behind a hit, 0 to 4095.
        free: value of a passed cell for the matcher, 0 to 4095.
        map_free: the same for the published map.
        quality: how much of the scan is believed, in 1/1024.
        is_mean: cell model ``mean``; otherwise ``base``.
        wall_floor: mean of a cell, in 1/2^20, up to which the score field is 0.
        wall_gain: what a mean above it adds to the field; at most 2000.
    """

    half_blur: int
    behind: int
    free: int
    map_free: int
    quality: int
    is_mean: bool
    wall_floor: int
    wall_gain: int


class LikelihoodRule(NamedTuple):
    """How the hits of one scan spread into the cells around them.

    Attributes:
        table: (256,) uint8 value by the squared distance from a cell's centre to a hit, in (1/1024
            cell)^2; it never rises, and its last counts for all that is farther.
        shift: the squared distance is shifted right by this first.
        reach: cells around a hit's own that learn of it.
        most: observations that a cell remembers, 1 to 4095.
    """

    table: U8
    shift: int
    reach: int
    most: int


class CellMeanDevice(ArrayDevice, Protocol):
    """A device that updates cell means, in place.

    ``cell_means.numpy`` says what each operation does.
    """

    def mark_scan(
        self,
        observed: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: ScanRule,
        wanted: DeviceArray[np.int32],
    ) -> bool:
        """See ``cell_means.numpy.mark_scan``."""

    def integrate_scan(
        self,
        observed: DeviceArray[np.uint32],
        valley: DeviceArray[np.uint32],
        published: DeviceArray[np.uint32],
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: ScanRule,
    ) -> None:
        """See ``cell_means.numpy.integrate_scan``."""

    def mark_likelihood(
        self,
        observed: DeviceArray[np.uint32],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: LikelihoodRule,
        wanted: DeviceArray[np.int32],
    ) -> bool:
        """See ``cell_means.numpy.mark_likelihood``."""

    def update_likelihood(
        self,
        observed: DeviceArray[np.uint32],
        states: DeviceArray[np.uint32],
        field: DeviceArray[np.uint8],
        pages: DeviceArray[np.int32],
        beams: DeviceArray[np.int32],
        rule: LikelihoodRule,
    ) -> None:
        """See ``cell_means.numpy.update_likelihood``."""
