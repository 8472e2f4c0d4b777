"""Figures that stand for many: of the errors along a path, and of repetitions of an experiment."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

# Samples that are drawn for an interval; those that are in memory at once; what draws them.
DRAWS, DRAWS_AT_ONCE, SEED = 4000, 250, 0
# Differences that vary by less than this share of the values vary by rounding alone.
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
    """Whether two samples differ; NaN: cannot be tested.

    Attributes:
        low, high: ends of the 95 % interval of the mean difference, first minus second (Student's
            t); NaN for unpaired samples.
        p_t: p-value of the paired t-test, or of Welch's.
        p_rank: p-value of Wilcoxon's signed-rank test, or of Mann and Whitney's U test. Ranks need
            no normal distribution, but with few values this cannot be small (5 pairs: 0.06).
        p_pooled: p-value of Student's t-test of unpaired values with one variance. It is the test
            of [F16]: its Table I with 3 repetitions gives all of its 12 p-values, if the printed
            deviations are sample deviations.
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
        # SciPy warns of values that do not vary. Their p-value is 0 or NaN, which says the same.
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


def mean_interval(errors: npt.ArrayLike, share: float = 0.95) -> tuple[float, float]:
    """Return both ends of the interval that holds the mean error, by the percentile bootstrap.

    The errors are resampled with replacement; the same errors always give the same interval. It
    takes them for independent. Those of one path are not quite: neighbours share their causes.

    Args:
        errors: (N,) at least one; the sign of an error does not count.
        share: of the cases in which the interval holds the mean, between 0 and 1.

    Raises:
        ValueError: there is no error, or one is not finite.

    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3.
    """
    values = np.abs(_checked(errors))
    if len(values) == 1:  # which SciPy refuses to draw from
        return float(values[0]), float(values[0])
    drawn = scipy.stats.bootstrap(
        (values,),
        np.mean,
        n_resamples=DRAWS,
        batch=DRAWS_AT_ONCE,
        vectorized=True,
        confidence_level=share,
        method="percentile",
        random_state=np.random.default_rng(SEED),
    ).confidence_interval
    return float(drawn.low), float(drawn.high)


def correct_by_holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values that allow for the number of tests made at once, in the order given.

    A value below 0.05 then is so by chance in at most 5 % of all such tables. SciPy's own
    correction holds the share of false findings, which is less.

    Args:
        p_values: each in 0 to 1; NaN: not tested, and stays so.

    Source: Holm, A Simple Sequentially Rejective Multiple Test Procedure, Scand. J. Stat., 1979.
    """
    values = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    left = np.isfinite(values).sum() - np.arange(len(values))
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(left * values[order]))
    return [float(p_value) for p_value in corrected]


def _checked(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the values as a row, refusing what has no statistics."""
    row = np.asarray(values, dtype=np.float64).ravel()
    if row.size == 0 or not np.isfinite(row).all():
        raise ValueError(f"statistics need at least one value, all finite; found {row.size} values")
    return row
