"""The score field of a map of hit counts, by its definition."""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt

from slamfusion.compute.hit_counts import FieldRule


def score_field_of(
    counts: npt.NDArray[np.uint32], sums: npt.NDArray[np.uint32], rule: FieldRule
) -> npt.NDArray[np.uint8]:
    """Return the (H, W) field of (H, W) counts and sums: each wall marks the cells around it."""
    hits, visits = (counts >> 16).astype(np.int64), (counts & 0xFFFF).astype(np.int64)
    rows, cols = np.nonzero((hits >= rule.least_hits) & (hits * 65536 > rule.occupied * visits))
    total = sums[rows, cols].astype(np.int64)
    # From the centre of its cell to the mean hit, in 1/256 cell.
    x, y = (16 * half // hits[rows, cols] + 8 - 128 for half in (total >> 16, total & 0xFFFF))
    side = range(-rule.reach, rule.reach + 1)
    padded = np.zeros([length + 2 * rule.reach for length in counts.shape], dtype=np.uint8)
    for down, right in product(side, repeat=2):
        squared = (x - 256 * right) ** 2 + (y - 256 * down) ** 2
        value = rule.table[np.minimum(squared >> rule.shift, 255)]
        np.maximum.at(padded, (rows + rule.reach + down, cols + rule.reach + right), value)
    height, width = counts.shape
    return padded[rule.reach : rule.reach + height, rule.reach : rule.reach + width]
