"""Tables of several maps or paths in several cases: every figure with means, and case by case."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from slamfusion.cli.output import notice, number, print_table

if TYPE_CHECKING:
    from slamfusion.evaluation import MeasuredItem

__all__ = ["print_items"]


def print_items(items: Sequence[MeasuredItem], what: str, leading: Sequence[str]) -> None:
    """Print a row of figures for each item, the means, and the leading figures case by case.

    Args:
        items: at least one.
        what: one of them is, a map or a path.
        leading: names of figures that get a table of their own: a row a method, a column a case.
    """
    _print_all(items, what)
    cases = list(dict.fromkeys(item.case for item in items))
    if len(cases) > 1:
        for name in leading:
            if any(name in item.figures for item in items):
                _print_by_case(items, cases, name, what)
    if len({frozenset(item.case for item in own) for own in _methods(items).values()}) > 1:
        notice("means are of different cases: not every method has a result in each of them")


def _methods(items: Sequence[MeasuredItem]) -> dict[str, list[MeasuredItem]]:
    """Return the items of each method."""
    found: dict[str, list[MeasuredItem]] = {}
    for item in items:
        found.setdefault(item.method, []).append(item)
    return found


def _print_all(items: Sequence[MeasuredItem], what: str) -> None:
    """Print every figure of every item, then the means of the methods over their cases."""
    from slamfusion.evaluation import figure_of, method_means  # noqa: PLC0415  (loads slowly)

    names = list(dict.fromkeys(name for item in items for name in item.figures))
    rows = [(item.case, item.method, item.figures) for item in items]
    rows += [
        (f"mean of {mean.cases}", mean.method, mean.figures)
        for mean in method_means(items)
        if mean.cases > 1
    ]
    print_table(
        ("case ", f"{what} ", *(figure_of(name).label for name in names)),
        [
            [case, method, *(number(own.get(name), figure_of(name).digits) for name in names)]
            for case, method, own in rows
        ],
        title=f"{len(items)} {what}s in {len({item.case for item in items})} cases",
        names=2,
    )


def _print_by_case(
    items: Sequence[MeasuredItem], cases: Sequence[str], name: str, what: str
) -> None:
    """Print one figure: a row a method, a column a case, then mean and deviation."""
    from slamfusion.evaluation import Summary, figure_of  # noqa: PLC0415  (loads slowly)

    figure = figure_of(name)
    rows = []
    for method, own in _methods(items).items():
        values = {item.case: item.figures[name] for item in own if name in item.figures}
        summary = Summary.of(list(values.values())) if len(values) == len(own) else None
        rows.append(
            [
                method,
                *(number(values.get(case), figure.digits) for case in cases),
                number(None if summary is None else summary.mean, figure.digits),
                number(None if summary is None else summary.std, figure.digits),
            ]
        )
    print_table((f"{what} ", *cases, "mean", "std"), rows, title=f"{figure.label}, case by case")
