"""Two sets of measured maps or paths against each other: paired wherever the items are the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from slamfusion.evaluation.measured import ErrorSeries, MeasuredItem, figure_of
from slamfusion.evaluation.statistics import (
    Difference,
    PairedDifference,
    compare_pairs,
    compare_samples,
    correct_by_holm,
)

__all__ = [
    "FigureComparison",
    "ItemPairs",
    "SeriesComparison",
    "compare_figures",
    "compare_series",
    "holm_corrected",
    "pair_items",
]

F64 = npt.NDArray[np.float64]

# Errors whose places differ by less than this are at one place: seconds or metres.
SAME_PLACE = 1e-6
# A path is cut into at most this many spans of neighbours, each of at least so many errors.
SPANS, SPAN_ERRORS = 24, 5
# A difference with a smaller p-value counts as one.
SIGNIFICANT = 0.05


@dataclass(frozen=True, eq=False)
class ItemPairs:
    """Which items of two sets belong together.

    Attributes:
        pairs: of the first set and the second, of one case each.
        first_alone, second_alone: items of one set that have no partner in the other.
    """

    pairs: tuple[tuple[MeasuredItem, MeasuredItem], ...]
    first_alone: tuple[MeasuredItem, ...]
    second_alone: tuple[MeasuredItem, ...]


def pair_items(first: Sequence[MeasuredItem], second: Sequence[MeasuredItem]) -> ItemPairs:
    """Pair items of the same case and method; where there are none, of the same case.

    Those of one case are paired whatever made them where neither set has two items of a case: then
    each set is a method of its own.
    """
    pairs = _paired(first, second, by_case=False)
    if not pairs and _has_distinct_cases(first) and _has_distinct_cases(second):
        pairs = _paired(first, second, by_case=True)
    taken = {id(item) for pair in pairs for item in pair}
    return ItemPairs(
        tuple(pairs),
        tuple(item for item in first if id(item) not in taken),
        tuple(item for item in second if id(item) not in taken),
    )


def _paired(
    first: Sequence[MeasuredItem], second: Sequence[MeasuredItem], *, by_case: bool
) -> list[tuple[MeasuredItem, MeasuredItem]]:
    def key(item: MeasuredItem) -> tuple[str, str]:
        return item.case, "" if by_case else item.method

    others = {key(item): item for item in second}
    return [(item, others[key(item)]) for item in first if key(item) in others]


def _has_distinct_cases(items: Sequence[MeasuredItem]) -> bool:
    return len({item.case for item in items}) == len(items)


@dataclass(frozen=True)
class FigureComparison:
    """How one figure of two sets of items differs.

    Attributes:
        figure: its name.
        count_first, count_second: items that have it: of pairs, those of which both have it.
        mean_first, mean_second: over these.
        paired: the test of the pairs, first less second; None for fewer than two, or none.
        unpaired: the tests of sets whose items are not the same; None where there are pairs, or a
            set has fewer than two items.
        p_value: of the t-test that was made (of pairs, or Welch's), allowing for how many sets were
            compared; None where there was none.
    """

    figure: str
    count_first: int
    count_second: int
    mean_first: float
    mean_second: float
    paired: PairedDifference | None = None
    unpaired: Difference | None = None
    p_value: float | None = None

    @property
    def difference(self) -> float:
        """Mean of the first set less that of the second."""
        return self.mean_first - self.mean_second

    @property
    def better(self) -> int | None:
        """0 where the first set is better beyond chance, 1 where the second is; None: neither."""
        larger = figure_of(self.figure).larger_is_better
        if larger is None or self.p_value is None or self.p_value >= SIGNIFICANT:
            return None
        return int((self.difference > 0.0) != larger)


def compare_figures(found: ItemPairs) -> list[FigureComparison]:
    """Compare every figure that both sets have.

    Args:
        found: the pairs of the sets; where there are none, their items are compared unpaired.

    Returns:
        In the order of the first set's figures; p-values are not corrected yet.
    """
    if found.pairs:
        sides = [[pair[side] for pair in found.pairs] for side in (0, 1)]
    else:
        sides = [list(found.first_alone), list(found.second_alone)]
    names = dict.fromkeys(name for item in sides[0] for name in item.figures)
    compared = []
    for name in names:
        if found.pairs:
            both = [pair for pair in found.pairs if all(name in item.figures for item in pair)]
            first, second = ([pair[side].figures[name] for pair in both] for side in (0, 1))
        else:
            first, second = (
                [item.figures[name] for item in side if name in item.figures] for side in sides
            )
        if first and second:
            compared.append(_compared(name, first, second, is_paired=bool(found.pairs)))
    return compared


def _compared(
    name: str, first: Sequence[float], second: Sequence[float], *, is_paired: bool
) -> FigureComparison:
    paired = compare_pairs(first, second) if is_paired else None
    unpaired = None if is_paired else compare_samples(first, second)
    p_value = paired.t_test if paired is not None else None
    if unpaired is not None:
        p_value = unpaired.welch
    return FigureComparison(
        name,
        len(first),
        len(second),
        float(np.mean(first)),
        float(np.mean(second)),
        paired,
        unpaired,
        p_value,
    )


def holm_corrected(compared: Sequence[FigureComparison]) -> list[FigureComparison]:
    """Return comparisons of one figure between several sets, with p-values for all of them at once.

    Args:
        compared: of every two sets, all of one figure.
    """
    known = [item.p_value for item in compared if item.p_value is not None]
    corrected = iter(correct_by_holm(known))
    return [
        item if item.p_value is None else replace(item, p_value=next(corrected))
        for item in compared
    ]


@dataclass(frozen=True)
class SeriesComparison:
    """How the single errors of two paths differ where both have one.

    Attributes:
        name: of the series.
        common: errors that both have, at the same places.
        spans: of neighbouring errors, whose means are the pairs of the test.
        mean_first, mean_second: over the common errors.
        paired: the test over the spans, first less second; None for too few errors.
    """

    name: str
    common: int
    spans: int
    mean_first: float
    mean_second: float
    paired: PairedDifference | None


def compare_series(name: str, first: ErrorSeries, second: ErrorSeries) -> SeriesComparison | None:
    """Compare the single errors of two paths at the places that both have.

    Errors of neighbouring poses share their causes, so they are no independent pairs: the path is
    cut into spans of equal numbers of neighbours, and the spans' mean errors are the pairs.

    Args:
        name: of the series.
        first: the errors of one path.
        second: those of the other.

    Returns:
        The comparison; None where no place is in both.
    """
    errors = _at_common_places(first, second)
    count = len(errors)
    if not count:
        return None
    spans = min(SPANS, count // SPAN_ERRORS)
    paired = None
    if spans > 1:
        span = np.arange(count) * spans // count
        sizes = np.bincount(span, minlength=spans)
        means = [np.bincount(span, errors[:, side], spans) / sizes for side in (0, 1)]
        paired = compare_pairs(*means)
    mean_first, mean_second = errors.mean(axis=0).tolist()
    return SeriesComparison(name, count, spans, mean_first, mean_second, paired)


def _at_common_places(first: ErrorSeries, second: ErrorSeries) -> F64:
    """Return (N, 2) errors of both series at the places that both have, in their order."""
    if first.at.shape[1] != second.at.shape[1]:
        return np.empty((0, 2))
    places = [
        list(map(tuple, np.rint(series.at / SAME_PLACE).tolist())) for series in (first, second)
    ]
    others = {place: index for index, place in enumerate(places[1])}
    rows = [(index, others[place]) for index, place in enumerate(places[0]) if place in others]
    if not rows:
        return np.empty((0, 2))
    own, other = np.array(rows).T
    order = np.lexsort(first.at[own].T[::-1])
    return np.stack((first.errors[own], second.errors[other]), axis=1)[order]
