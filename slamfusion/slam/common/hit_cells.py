"""Cells that count hits and visits: kept from overflowing, and shown as occupancy.

See ``slamfusion.compute.hit_counts`` for their words.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.layout import FULL_HITS, FULL_VISITS
from slamfusion.grid import UNKNOWN

# Rows of a map that are turned into percent together: floating point takes memory for these alone.
ROWS_AT_ONCE = 256
# The limits of the map servers, in percent.
FREE_PERCENT, OCCUPIED_PERCENT = 25.0, 65.0


def halve_counts(device: ComputeDevice, pools: dict[str, DeviceArray[Any]]) -> None:
    """Halve the counts of every busy cell before they overflow; means and shares stay.

    Of few counts the halves would be something else: those of other cells are left.
    """
    counts = device.download(pools["counts"])
    is_busy = (counts >= FULL_HITS // 2 << 16) | (counts & 0xFFFF >= FULL_VISITS // 2)
    busy = np.nonzero(is_busy)
    hits, visits = counts[busy] >> 16, counts[busy] & 0xFFFF
    fewer = (hits + 1) >> 1
    counts[busy] = fewer << 16 | (visits + 1) >> 1
    pools["counts"] = device.upload(counts)
    sums = device.download(pools["sums"])
    some = np.maximum(hits, 1)
    sum_x, sum_y = (
        (half * fewer + some // 2) // some for half in (sums[busy] >> 16, sums[busy] & 0xFFFF)
    )
    sums[busy] = sum_x << 16 | sum_y
    pools["sums"] = device.upload(sums)


def percent_of_counts(
    counts: npt.NDArray[np.uint32], threshold: float, least_visits: int = 1
) -> npt.NDArray[np.int8]:
    """Return hits and visits as occupancy in percent.

    The percent rises with the share of hits so that the threshold comes to lie at 65, the limit of
    the map servers: what is a wall by the threshold is published as one, all else as free.

    Args:
        counts: (H, W) uint32, hits above 16 bits of visits.
        threshold: a cell is a wall when more than this share of its visits were hits, 0 to 1.
    """
    percent = np.empty(counts.shape, dtype=np.int8)
    for start in range(0, len(counts), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        percent[rows] = _percent_rows(counts[rows], threshold, least_visits)
    return percent


def _percent_rows(
    counts: npt.NDArray[np.uint32], threshold: float, least_visits: int
) -> npt.NDArray[np.int8]:
    """Return ``percent_of_counts`` of a few rows."""
    hits, visits = (counts >> 16).astype(np.float64), (counts & 0xFFFF).astype(np.float64)
    share = hits / np.maximum(visits, 1.0)
    rising = np.rint(np.interp(share, (0.0, threshold, 1.0), (0.0, OCCUPIED_PERCENT, 100.0)))
    is_wall = (hits > 0) & (share > threshold)
    percent = np.where(
        is_wall, np.maximum(rising, OCCUPIED_PERCENT), np.minimum(rising, FREE_PERCENT)
    )
    percent[visits < least_visits] = UNKNOWN
    return np.asarray(percent.astype(np.int8))
