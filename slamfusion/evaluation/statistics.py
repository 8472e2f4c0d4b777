"""Statistics of the errors along a path, and of repetitions of an experiment."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.geometry import F64

# Bootstrap samples, samples in memory at once, and the seed.
DRAWS, DRAWS_AT_ONCE, SEED = 4000, 250, 0
# Differences that vary by less than this share of the values are rounding.
ROUNDING = 1e-12


@dataclass(frozen=True)
class ErrorStatistics:
    """Figures of absolute errors, in the unit of the key that holds them."""

    mean: float
    """Mean of the errors."""
    std: float
    """Their standard deviation (divided by N)."""
    rmse: float
    """Root of the mean square."""
    median: float
    """The middle one."""
    min: float
    """The smallest."""
    max: float
    """The largest."""

    @classmethod
    def of(cls, errors: npt.ArrayLike) -> ErrorStatistics:
        """Return the figures of at least one error; the sign of an error does not count.

        Raises:
            ValueError: there is no error, or one is not finite.
        """
        values = np.abs(_checked(errors))
        return cls(
            mean=float(values.mean()),
            std=float(values.std()),
            rmse=float(np.sqrt(np.mean(values**2))),
            median=float(np.median(values)),
            min=float(values.min()),
            max=float(values.max()),
        )


class DifferenceTest(NamedTuple):
    """A test whether two samples differ; NaN: cannot be tested.

    Attributes:
        low, high: ends of the 95 % interval of the mean difference, first minus second (Student's
            t); NaN for unpaired samples.
        p_t: p-value of the paired t-test, or of Welch's.
        p_rank: p-value of Wilcoxon's signed-rank test, or of Mann and Whitney's U test. No normal
            distribution is needed, but with few values it cannot be small (5 pairs: 0.06).
        p_pooled: p-value of Student's t-test of unpaired values with one variance, the test of
            [F16].
    """

    low: float = math.nan
    high: float = math.nan
    p_t: float = math.nan
    p_rank: float = math.nan
    p_pooled: float = math.nan


def difference_test(first: npt.ArrayLike, second: npt.ArrayLike, *, paired: bool) -> DifferenceTest:
    """Test whether two methods differ in a figure; two-sided, by ``scipy.stats``.

    Args:
        first: (N,) the figure of one method, in each case or repetition.
        second: (M,) of the other; paired: (N,), in the same order.

    Returns:
        All NaN for fewer than two values of either; equal values have no p-value.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if min(len(a), len(b)) < 2:
        return DifferenceTest()
    with warnings.catch_warnings():
        # SciPy warns of constant values; their p-value is 0 or NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        pooled = float(scipy.stats.ttest_ind(a, b).pvalue)
        if not paired:
            welch = scipy.stats.ttest_ind(a, b, equal_var=False)
            p_rank = float(scipy.stats.mannwhitneyu(a, b).pvalue)
            return DifferenceTest(math.nan, math.nan, float(welch.pvalue), p_rank, pooled)
        if np.abs(a - b).max() <= ROUNDING * np.abs((a, b)).max():
            return DifferenceTest(0.0, 0.0, p_pooled=pooled)
        t_test = scipy.stats.ttest_rel(a, b)
        low, high = map(float, t_test.confidence_interval())
        p_rank = float(scipy.stats.wilcoxon(a - b).pvalue)
    return DifferenceTest(low, high, float(t_test.pvalue), p_rank, pooled)


def mean_interval(errors: npt.ArrayLike) -> tuple[float, float]:
    """Return the 95 % interval of the mean error by the percentile bootstrap; reproducible.

    Errors are taken as independent, which those of one path are not quite.

    Args:
        errors: (N,) at least one; the sign does not count.

    Raises:
        ValueError: there is no error, or one is not finite.

    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3.
    """
    values = np.abs(_checked(errors))
    if len(values) == 1:  # SciPy refuses it
        return float(values[0]), float(values[0])
    drawn = scipy.stats.bootstrap(
        (values,),
        np.mean,
        n_resamples=DRAWS,
        batch=DRAWS_AT_ONCE,
        vectorized=True,
        method="percentile",
        random_state=np.random.default_rng(SEED),
    ).confidence_interval
    return float(drawn.low), float(drawn.high)


def correct_by_holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for the number of tests (family-wise error rate), in order.

    NaN (not tested) stays NaN.

    Source: Holm, A Simple Sequentially Rejective Multiple Test Procedure, Scand. J. Stat., 1979.
    """
    values = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    left = np.isfinite(values).sum() - np.arange(len(values))
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(left * values[order]))
    return [float(p_value) for p_value in corrected]


def _checked(values: npt.ArrayLike) -> F64:
    """Return the values as a row; ValueError if empty or not finite."""
    row = np.asarray(values, dtype=np.float64).ravel()
    if row.size == 0 or not np.isfinite(row).all():
        raise ValueError(f"statistics need at least one value, all finite; found {row.size} values")
    return row
