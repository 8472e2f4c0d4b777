"""Figures of errors and of repetitions, checked by hand and against SciPy's definitions."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from scipy import stats

from slamfusion.evaluation.statistics import ErrorStatistics, correct_by_holm, mean_interval
from slamfusion.jobs.compare import Comparison, compare_values


def difference_test(first: npt.ArrayLike, second: npt.ArrayLike, *, paired: bool) -> Comparison:
    return compare_values(
        ("a", "b"), pd.Series(first), pd.Series(second), is_paired=paired, figure="error"
    )


def test_error_statistics_of_a_worked_example() -> None:
    found = ErrorStatistics.of([1.0, -2.0, 3.0, 6.0])
    assert found.mean == 3.0
    assert found.std == pytest.approx(np.sqrt(3.5))
    assert found.rmse == pytest.approx(np.sqrt(12.5))
    assert (found.median, found.min, found.max) == (2.5, 1.0, 6.0)
    assert list(asdict(found)) == ["mean", "std", "rmse", "median", "min", "max"]


def test_p_values_of_a_worked_example() -> None:
    # No value of one exceeds the other's: 2 of the C(10, 5) = 252 orders are as extreme.
    first, second = [1.0, 2.0, 3.0, 4.0, 5.0], [11.0, 12.0, 13.0, 14.0, 15.5]
    found = difference_test(first, second, paired=False)
    assert found.p_rank == pytest.approx(2 / 252)
    # Welch: t = 10.1 / sqrt(2.5 / 5 + 3.05 / 5) = 9.59 at 7.92 degrees of freedom.
    p_value = 2.0 * stats.t.sf(10.1 / np.sqrt(1.11), 7.9219)
    assert found.p_t == pytest.approx(p_value, rel=1e-3)
    assert np.isnan([found.low, found.high]).all()
    few = difference_test([1.0], [2.0, 3.0], paired=False)
    assert np.isnan([few.p_t, few.p_holm, few.p_rank, few.p_pooled]).all()


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_equal_values_have_no_p_value_and_a_constant_difference_is_sure() -> None:
    for paired in (True, False):
        same = difference_test([2.0] * 3, [2.0] * 3, paired=paired)
        other = difference_test([2.0, 2.0, 2.0], [3.0, 3.0, 3.0], paired=paired)
        assert np.isnan(same.p_t)
        assert other.p_t == 0.0
    rounded = difference_test([0.1 + 0.2, 1.0], [0.3, 1.0], paired=True)
    assert (rounded.low, rounded.high) == (0.0, 0.0)
    assert np.isnan(rounded.p_t)


def test_the_interval_of_a_mean_is_that_of_theory_where_errors_are_normal() -> None:
    errors = np.random.default_rng(1).normal(5.0, 1.0, 400)
    found = mean_interval(errors)
    spread = stats.t.ppf(0.975, 399) * errors.std(ddof=1) / np.sqrt(400)
    assert found == pytest.approx((errors.mean() - spread, errors.mean() + spread), abs=0.01)
    assert found == mean_interval(errors) == mean_interval(-errors)
    # What the draws of seed 0 give, on every machine.
    found = mean_interval([0.03, 0.07, 0.011, 0.045, 0.09, 0.2])
    assert found == pytest.approx((0.032825, 0.1275), rel=1e-12)


def test_errors_that_do_not_vary_have_an_interval_without_width() -> None:
    assert mean_interval([0.25]) == (0.25, 0.25)
    assert mean_interval([0.5, -0.5, 0.5]) == (0.5, 0.5)


# Table I of [F16]: mean and deviation of the error over 3 repetitions.
PUBLISHED = {
    "no obstacle": {
        "gmapping": (148.63, 2.24),
        "karto": (128.36, 2.03),
        "rtabmap": (106.38, 7.74),
        "fused": (97.88, 6.58),
    },
    "obstacle": {
        "gmapping": (151.28, 5.30),
        "karto": (132.58, 0.75),
        "rtabmap": (110.03, 2.27),
        "fused": (97.45, 4.73),
    },
}


def pooled_p(first: tuple[float, float], second: tuple[float, float]) -> float:
    """Return [F16]'s p-value of two means with sample deviations, three repetitions each."""
    samples = (mean + std * np.array([-1.0, 0.0, 1.0]) for mean, std in (first, second))
    return difference_test(*samples, paired=False).p_pooled


@pytest.mark.parametrize(
    ("condition", "first", "second", "printed"),
    [
        ("no obstacle", "gmapping", "karto", "3.1e-04"),
        ("no obstacle", "gmapping", "rtabmap", "8.1e-04"),
        ("no obstacle", "gmapping", "fused", "2.3e-04"),
        ("no obstacle", "karto", "rtabmap", "8.9e-03"),
        ("no obstacle", "karto", "fused", "1.6e-03"),
        ("no obstacle", "rtabmap", "fused", "2.2e-01"),
        ("obstacle", "gmapping", "karto", "3.8e-03"),
        ("obstacle", "gmapping", "rtabmap", "2.4e-04"),
        ("obstacle", "gmapping", "fused", "1.9e-04"),
        ("obstacle", "karto", "rtabmap", "8.2e-05"),
        ("obstacle", "karto", "fused", "2.2e-04"),
        ("obstacle", "rtabmap", "fused", "1.4e-02"),
    ],
)
def test_published_p_values_are_the_pooled_test_of_sample_deviations(
    condition: str, first: str, second: str, printed: str
) -> None:
    a, b = (PUBLISHED[condition][name] for name in (first, second))
    assert f"{pooled_p(a, b):.1e}" == printed
    # Taken for population deviations (divided by N) they would give other values.
    wider = [(mean, std * 1.5**0.5) for mean, std in (a, b)]
    assert f"{pooled_p(*wider):.1e}" != printed


def test_the_interval_of_a_difference_by_hand() -> None:
    # Mean -2, deviation 1, three values; the quantile for 2 degrees of freedom is 4.303.
    margin = 4.303 / 3**0.5
    found = difference_test([4.0, 5.0, 6.0], [5.0, 7.0, 9.0], paired=True)
    assert (found.low, found.high) == pytest.approx((-2.0 - margin, -2.0 + margin), abs=1e-3)


def test_holm_of_a_worked_example() -> None:
    # Sorted 0.01, 0.02, 0.03, 0.04 times 4, 3, 2, 1: 0.04, 0.06, 0.06, 0.04, never falling.
    assert correct_by_holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert correct_by_holm([0.9, 0.8]) == [1.0, 1.0]
    assert correct_by_holm([]) == []
    # What could not be tested does not count.
    assert correct_by_holm([float("nan"), 0.02, 0.01]) == pytest.approx(
        [float("nan"), 0.02, 0.02], nan_ok=True
    )
