"""Maps and paths by case and method: their means, and how two sets of them compare."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.evaluation import (
    ErrorSeries,
    MeasuredItem,
    compare_figures,
    compare_series,
    holm_corrected,
    method_means,
    pair_items,
)
from slamfusion.evaluation.measured_pairs import SPANS


def item(case: str, method: str, **figures: float) -> MeasuredItem:
    return MeasuredItem(case, method, figures)


def series(errors: list[float], first_s: float = 0.0) -> ErrorSeries:
    return ErrorSeries(first_s + np.arange(len(errors), dtype=float)[:, None], np.array(errors))


def test_means_are_over_all_cases_of_a_method_or_none() -> None:
    means = method_means(
        [item("a", "x", error=1.0, ssim=0.5), item("b", "x", error=3.0), item("a", "y", error=4.0)]
    )
    assert [(mean.method, mean.cases, mean.figures) for mean in means] == [
        ("x", 2, {"error": 2.0}),
        ("y", 1, {"error": 4.0}),
    ]


def test_the_same_case_and_method_are_pairs_and_others_are_named() -> None:
    first = [item("a", "x", error=1.0), item("a", "y", error=2.0), item("b", "x", error=3.0)]
    second = [item("a", "y", error=5.0), item("a", "x", error=4.0), item("c", "x", error=6.0)]
    found = pair_items(first, second)
    assert found.pairs == ((first[0], second[1]), (first[1], second[0]))
    assert found.first_alone == (first[2],)
    assert found.second_alone == (second[2],)


def test_one_method_against_another_is_paired_by_case() -> None:
    first = [item("a", "x", error=1.0), item("b", "x", error=2.0)]
    second = [item("b", "y", error=2.5), item("a", "y", error=1.5)]
    assert pair_items(first, second).pairs == ((first[0], second[1]), (first[1], second[0]))
    # Of two methods in a case nothing says which one is meant.
    assert not pair_items([*first, item("a", "z", error=9.0)], second).pairs


def test_pairs_are_tested_as_pairs() -> None:
    values = np.array([1.0, 5.0, 9.0, 2.0, 7.0])
    gains = np.array([0.1, 0.12, 0.09, 0.11, 0.1])
    first = [item(str(n), "x", error=value) for n, value in enumerate(values)]
    second = [item(str(n), "y", error=value) for n, value in enumerate(values - gains)]
    (found,) = compare_figures(pair_items(first, second))
    assert found.paired is not None
    assert (found.count_first, found.unpaired) == (5, None)
    assert found.difference == pytest.approx(gains.mean())
    assert found.p_value == found.paired.t_test < 0.001
    assert found.better == 1
    # As two samples the spread between the cases hides it.
    apart = [MeasuredItem(f"other {own.case}", "y", own.figures) for own in second]
    (unpaired,) = compare_figures(pair_items(first, apart))
    assert unpaired.paired is None
    assert unpaired.unpaired is not None
    assert unpaired.p_value == unpaired.unpaired.welch > 0.5
    assert unpaired.better is None


@pytest.mark.parametrize(("figure", "better"), [("wall_f1", 0), ("error", 1), ("seen_share", None)])
def test_some_figures_are_better_when_they_are_larger(figure: str, better: int | None) -> None:
    first = [item(str(n), "x", **{figure: 2.0 + 0.01 * n}) for n in range(4)]
    second = [item(str(n), "x", **{figure: 1.0 + 0.02 * n}) for n in range(4)]
    (found,) = compare_figures(pair_items(first, second))
    assert found.better == better


def test_figures_that_one_side_lacks_are_left_out() -> None:
    pairs = pair_items(
        [item("a", "x", error=1.0, ssim=0.1), item("b", "x", error=2.0)],
        [item("a", "x", error=1.5), item("b", "x", error=2.5, ssim=0.2)],
    )
    assert [found.figure for found in compare_figures(pairs)] == ["error"]


def test_p_values_of_several_sets_are_corrected_together() -> None:
    def compared(gain: float) -> float | None:
        first = [item(str(n), "x", error=float(n)) for n in range(4)]
        second = [item(str(n), "x", error=n + gain + 0.05 * (n % 2)) for n in range(4)]
        return compare_figures(pair_items(first, second))[0]

    single = [compared(0.2), compared(-0.02)]
    least, most = holm_corrected(single)
    assert least.p_value == pytest.approx(2.0 * single[0].p_value)
    assert most.p_value == single[1].p_value


def test_errors_are_compared_where_both_paths_have_one() -> None:
    first = series([0.1 + 0.001 * (n % 7) for n in range(200)])
    second = series([0.2 + 0.001 * (n % 5) for n in range(100)], first_s=150.0)
    found = compare_series("ate_m", first, second)
    assert found is not None
    assert (found.common, found.spans) == (50, 10)
    assert found.mean_first == pytest.approx(0.103, abs=0.001)
    assert found.mean_second == pytest.approx(0.202, abs=0.001)
    assert found.paired is not None
    assert found.paired.count == 10
    assert found.paired.t_test < 0.001
    assert compare_series("ate_m", first, series([1.0], first_s=1e6)) is None
    pairs = ErrorSeries(np.array([[0.0, 1.0]]), np.array([0.5]))
    assert compare_series("relations_m", first, pairs) is None


def test_a_slow_drift_is_no_proof() -> None:
    """Errors of neighbours share their causes: 2000 of them are no 2000 pairs."""
    rng = np.random.default_rng(3)
    false_alarms = 0
    for _ in range(40):
        walks = np.abs(np.cumsum(rng.normal(0.0, 0.01, (2000, 2)), axis=0) % 0.5 - 0.25)
        found = compare_series("ate_m", *(series(list(walk)) for walk in walks.T))
        assert found is not None
        assert found.spans == SPANS
        assert found.paired is not None
        false_alarms += found.paired.t_test < 0.001
    assert false_alarms <= 4


def test_a_few_errors_give_means_and_no_test() -> None:
    found = compare_series("ate_m", series([0.1, 0.2]), series([0.3, 0.4]))
    assert found is not None
    assert (found.common, found.paired) == (2, None)


def test_places_and_errors_must_fit() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        ErrorSeries(np.zeros((2, 1)), np.zeros(3))
    with pytest.raises(ValueError, match="finite"):
        ErrorSeries(np.zeros((1, 1)), np.array([np.nan]))
