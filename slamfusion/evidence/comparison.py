"""Whether one path is borne out better than another: a paired block bootstrap over the drive.

Neighbouring scans see the same walls, so that their scores are no independent draws; blocks of
neighbouring scans are. A block is resampled with the scores of both paths in it.

Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, sections 8.5 and 16.4 (blocks
of a series, and achieved significance).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

# Parts of the judged scans that are drawn anew: four for each chunk, so that a path that is wrong
# for a tenth of the drive is wrong in many of them.
BLOCKS = 96
DRAWS = 2000
# Below this a difference counts as one; below the second one it also decides something.
SIGNIFICANT, SURE = 0.05, 0.01


@dataclass(frozen=True)
class Comparison:
    """How one path compares with another.

    Attributes:
        verdict: what the scans say of the first path against the second.
        difference: score of the first less that of the second, log-likelihood of a hit.
        low, high: interval of the difference, 95 % of the draws.
        p_value: two-sided: share of the draws in which the sign of the difference turns, doubled;
            1 for equal paths.
    """

    verdict: Literal["better", "worse", "cannot tell"]
    difference: float
    low: float
    high: float
    p_value: float


def compare_sums(
    first: F64,
    second: F64,
    beams: npt.NDArray[np.int64],
    is_judged: npt.NDArray[np.bool_],
    blocks: int = BLOCKS,
) -> Comparison:
    """Compare the sums of log-likelihoods of two paths on the same hits.

    Args:
        first, second: (N,) float64, sums of each scan.
        beams: (N,) int64, judged hits of each scan.
        is_judged: (N,) bool, scans that were judged.
    """
    judged = np.flatnonzero(is_judged)
    block = np.arange(len(judged)) * blocks // len(judged)
    apart = np.bincount(block, (first - second)[judged], blocks)
    hits = np.bincount(block, beams[judged], blocks)
    difference = float(apart.sum() / hits.sum())
    # Seeded: the same paths compare the same way each time.
    draws = np.random.default_rng(0).multinomial(blocks, np.full(blocks, 1.0 / blocks), DRAWS)
    drawn = (draws @ apart) / np.maximum(draws @ hits, 1)
    low, high = np.quantile(drawn, (0.025, 0.975))
    turned = min(np.count_nonzero(drawn <= 0.0), np.count_nonzero(drawn >= 0.0))
    p_value = min(1.0, 2.0 * (turned + 1) / (DRAWS + 1))
    verdict: Literal["better", "worse", "cannot tell"] = "cannot tell"
    if p_value < SIGNIFICANT:
        verdict = "better" if difference > 0.0 else "worse"
    return Comparison(verdict, difference, float(low), float(high), p_value)
