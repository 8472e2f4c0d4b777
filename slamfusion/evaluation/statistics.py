"""Figures that stand for many: of the errors along a path, and of repetitions of an experiment."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.evaluation.records import (
    DifferenceJson,
    ErrorStatisticsJson,
    PairedDifferenceJson,
    SummaryJson,
)

__all__ = [
    "ErrorStatistics",
    "Summary",
    "compare_pairs",
    "compare_samples",
    "correct_by_holm",
    "difference_test",
    "mean_interval",
    "pooled_p_value",
    "t_interval",
]

# Samples that are drawn for an interval; those that are in memory at once; what draws them.
DRAWS, DRAWS_AT_ONCE, SEED = 4000, 250, 0
# Differences that vary by less than this share of the values vary by rounding alone.
ROUNDING = 1e-12


@dataclass(frozen=True)
class ErrorStatistics:
    """The errors of one run, all of them: a population, not a sample.

    Attributes:
        mean: of the absolute errors; this and all others in the unit of the errors.
        std: population standard deviation (divided by N).
        rmse: root of the mean square.
        median: the middle one.
        min: the smallest.
        max: the largest.
    """

    mean: float
    std: float
    rmse: float
    median: float
    min: float
    max: float

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

    def scaled(self, factor: float) -> ErrorStatistics:
        """Return the same figures in another unit (radians to degrees)."""
        return ErrorStatistics(**{name: factor * value for name, value in asdict(self).items()})

    def to_json(self) -> ErrorStatisticsJson:
        """Return the figures by name."""
        return cast("ErrorStatisticsJson", asdict(self))


@dataclass(frozen=True)
class Summary:
    """What a table says of one figure over repetitions; smaller is better.

    Attributes:
        count: repetitions.
        mean: their mean.
        std: sample standard deviation (divided by N - 1); None for one repetition.
        median: the middle one.
        worst: the largest.
    """

    count: int
    mean: float
    std: float | None
    median: float
    worst: float

    @classmethod
    def of(cls, values: npt.ArrayLike) -> Summary:
        """Return the summary of at least one value.

        Raises:
            ValueError: there is no value, or one is not finite.
        """
        known = _checked(values)
        return cls(
            count=len(known),
            mean=float(known.mean()),
            std=float(known.std(ddof=1)) if len(known) > 1 else None,
            median=float(np.median(known)),
            worst=float(known.max()),
        )

    def to_json(self) -> SummaryJson:
        """Return the figures by name."""
        return cast("SummaryJson", asdict(self))


class DifferenceTest(NamedTuple):
    """Whether two samples differ; NaN: cannot be tested.

    Attributes:
        low, high: ends of the 95 % interval of the mean difference, first minus second (Student's
            t); NaN for unpaired samples.
        p_t: p-value of the paired t-test, or of Welch's.
        p_rank: p-value of Wilcoxon's signed-rank test, or of Mann and Whitney's U test. Ranks need
            no normal distribution, but with few values this cannot be small (5 pairs: 0.06).
    """

    low: float = math.nan
    high: float = math.nan
    p_t: float = math.nan
    p_rank: float = math.nan


def difference_test(first: npt.ArrayLike, second: npt.ArrayLike, *, paired: bool) -> DifferenceTest:
    """Test whether two methods differ in a figure; two-sided, by ``scipy.stats``.

    Args:
        first: (N,) the figure of one method, in each case or repetition.
        second: (M,) of the other; paired: (N,), in the same order.
        paired: whether the values are pairs.

    Returns:
        All NaN for fewer than two values of either; equal values have no p-value.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if min(len(a), len(b)) < 2:
        return DifferenceTest()
    with warnings.catch_warnings():
        # SciPy warns of values that do not vary. Their p-value is 0 or NaN, which says the same.
        warnings.simplefilter("ignore", RuntimeWarning)
        if not paired:
            welch = scipy.stats.ttest_ind(a, b, equal_var=False)
            ranks = scipy.stats.mannwhitneyu(a, b)
            return DifferenceTest(p_t=float(welch.pvalue), p_rank=float(ranks.pvalue))
        if np.abs(a - b).max() <= ROUNDING * np.abs((a, b)).max():
            return DifferenceTest(0.0, 0.0)
        t_test = scipy.stats.ttest_rel(a, b)
        low, high = t_test.confidence_interval()
        ranks = scipy.stats.wilcoxon(a - b)
    return DifferenceTest(float(low), float(high), float(t_test.pvalue), float(ranks.pvalue))


def compare_samples(first: npt.ArrayLike, second: npt.ArrayLike) -> DifferenceJson | None:
    """Test whether the repetitions of two methods differ: Welch's t-test and Mann-Whitney's U test.

    The U test needs no normal distribution, but with few repetitions its p-value cannot be small (4
    and 4: 0.029).

    Args:
        first: (N,) one figure of each repetition of one method.
        second: (M,) the same of the other; the repetitions are not paired.

    Returns:
        The p-values; None where a method has fewer than two repetitions. Methods that do not vary
        at all have a Welch p-value of 1 when their values are equal, else 0.

    Raises:
        ValueError: there is no value, or one is not finite.
    """
    a, b = _checked(first), _checked(second)
    if min(len(a), len(b)) < 2:
        return None
    u_test = scipy.stats.mannwhitneyu(a, b, alternative="two-sided")
    moments = [(float(x.mean()), float(x.std(ddof=1)), len(x)) for x in (a, b)]
    if np.ptp(a) == 0.0 and np.ptp(b) == 0.0:
        moments = [(float(x[0]), 0.0, len(x)) for x in (a, b)]
    return {"welch": _t_test(*moments, equal_var=False), "mann_whitney": float(u_test.pvalue)}


def pooled_p_value(first: tuple[float, float, int], second: tuple[float, float, int]) -> float:
    """Return the two-sided p-value of Student's t-test with one variance for both methods.

    It is the test of [F16]: its Table I with 3 repetitions gives all of its 12 p-values, the
    printed deviations taken for sample deviations.

    Args:
        first: mean, sample standard deviation (divided by N - 1) and number of repetitions.
        second: the same of the other method.

    Source: Student, The Probable Error of a Mean, Biometrika 6(1), 1908.
    """
    return _t_test(first, second, equal_var=True)


def _t_test(
    first: tuple[float, float, int], second: tuple[float, float, int], *, equal_var: bool
) -> float:
    """Return the p-value of a t-test from mean, deviation and count of two samples."""
    if first[1] == 0.0 and second[1] == 0.0:
        # Without any spread the t statistic is 0 / 0 or infinite.
        return 1.0 if first[0] == second[0] else 0.0
    test = scipy.stats.ttest_ind_from_stats(*first, *second, equal_var=equal_var)
    return float(test.pvalue)


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
    return _bootstrap(np.abs(_checked(errors)), share)


def t_interval(values: npt.ArrayLike, share: float = 0.95) -> tuple[float, float] | None:
    """Return both ends of the interval that holds the mean of a normal distribution (Student's t).

    Args:
        values: (N,) a sample; the sign counts.
        share: of the cases in which the interval holds the mean, between 0 and 1.

    Returns:
        The interval; None for a single value.

    Raises:
        ValueError: there is no value, or one is not finite.
    """
    known = _checked(values)
    if len(known) < 2:
        return None
    # Scaled here: where the values do not vary, SciPy's own scale of 0 gives NaN.
    mean, error = float(known.mean()), float(scipy.stats.sem(known))
    low, high = scipy.stats.t.interval(share, len(known) - 1)
    return mean + error * float(low), mean + error * float(high)


def compare_pairs(first: npt.ArrayLike, second: npt.ArrayLike) -> PairedDifferenceJson | None:
    """Test whether two methods differ on the same cases: paired t-test and Wilcoxon's.

    Wilcoxon's signed-rank test leaves out pairs without a difference. It needs no normal
    distribution, but with few pairs its p-value cannot be small (5: 0.06).

    Args:
        first: (N,) one figure of each case by one method.
        second: (N,) the same by the other, in the same order.

    Returns:
        The difference, first minus second; None for fewer than two pairs. Differences that do not
        vary at all have p-values of the t-test of 1 when they are 0, else 0.

    Raises:
        ValueError: there is no value, one is not finite, or the lengths differ.
    """
    a, b = _checked(first), _checked(second)
    if len(a) != len(b):
        message = f"pairs need as many values of both methods, found {len(a)} and {len(b)}"
        raise ValueError(message)
    differences = a - b
    interval = t_interval(differences)
    if interval is None:
        return None
    if np.ptp(differences) <= ROUNDING * np.abs((a, b)).max():
        t_test = 1.0 if np.ptp((a, b), axis=0).max() <= ROUNDING * np.abs(a).max() else 0.0
    else:
        t_test = float(scipy.stats.ttest_rel(a, b).pvalue)
    return {
        "count": len(a),
        "mean": float(differences.mean()),
        "interval": interval,
        "bootstrap": _bootstrap(differences, 0.95),
        "t_test": t_test,
        "wilcoxon": float(scipy.stats.wilcoxon(differences).pvalue) if differences.any() else 1.0,
    }


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
    return corrected.tolist()


def _bootstrap(values: npt.NDArray[np.float64], share: float) -> tuple[float, float]:
    """Return the percentile interval of the mean; the same values give the same interval."""
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


def _checked(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the values as a row, refusing what has no statistics."""
    row = np.asarray(values, dtype=np.float64).ravel()
    if row.size == 0 or not np.isfinite(row).all():
        message = f"statistics need at least one value, all finite; found {row.size} values"
        raise ValueError(message)
    return row
