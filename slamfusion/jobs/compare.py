"""Saved results against each other: differences of every figure, with p-values."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import (
    FigureComparison,
    ItemPairs,
    MeasuredItem,
    SeriesComparison,
    compare_figures,
    compare_series,
    holm_corrected,
    pair_items,
)
from slamfusion.io import write_atomic
from slamfusion.jobs.compare_records import (
    ComparedFigureJson,
    CompareDocument,
    ComparedResultsJson,
    ComparedSeriesJson,
)
from slamfusion.jobs.documents import versions
from slamfusion.jobs.inputs import distinct_names
from slamfusion.jobs.results_file import SavedResults, read_results

__all__ = [
    "ComparedResults",
    "ResultsPair",
    "SeriesPair",
    "compare_results",
    "write_comparison_plot",
]


@dataclass(frozen=True, eq=False)
class SeriesPair:
    """Single errors of two paths of one case.

    Attributes:
        first, second: the paths.
        comparison: of one of their series.
    """

    first: MeasuredItem
    second: MeasuredItem
    comparison: SeriesComparison


@dataclass(frozen=True, eq=False)
class ResultsPair:
    """Two files of results against each other.

    Attributes:
        first, second: the files.
        items: which of their items belong together.
        figures: every figure that both have.
        series: the single errors of every pair, where they have some at the same places.
    """

    first: SavedResults
    second: SavedResults
    items: ItemPairs
    figures: tuple[FigureComparison, ...]
    series: tuple[SeriesPair, ...]

    def sentences(self) -> list[str]:
        """Return what of the two is not compared, and what makes the comparison doubtful."""
        found = []
        alone = ((self.first, self.items.first_alone), (self.second, self.items.second_alone))
        if self.items.pairs:
            other = {self.first.name: self.second.name, self.second.name: self.first.name}
            for results, items in alone:
                if items:
                    names = ", ".join(f"{item.method} in {item.case}" for item in items)
                    found.append(f"{results.name}: not in {other[results.name]}: {names}")
        else:
            found.append(
                f"{self.first.name} and {self.second.name} have no map or path of one case in "
                "common; their figures are compared unpaired"
            )
        for role, case in sorted(self.first.yardsticks.keys() & self.second.yardsticks.keys()):
            key = role, case
            if role in _YARDSTICKS and self.first.yardsticks[key] != self.second.yardsticks[key]:
                what = f"{role} of {case}" if case else role
                found.append(
                    f"{self.first.name} and {self.second.name} rest on different files: {what}"
                )
        return found


# Roles of the inputs that figures are measured by: other files make other figures.
_YARDSTICKS = {"truth", "truth image", "relations", "odometry", "scan odometry", "log", "distances"}


@dataclass(frozen=True, eq=False)
class ComparedResults:
    """Every two of several files of results against each other.

    Attributes:
        results: the files.
        files: where they lie, in the same order.
        pairs: every two of them, p-values of a figure corrected for their number.
    """

    results: tuple[SavedResults, ...]
    files: tuple[Path, ...]
    pairs: tuple[ResultsPair, ...]

    def sentences(self) -> list[str]:
        """Return what is not compared, and what is doubtful."""
        return list(dict.fromkeys(line for pair in self.pairs for line in pair.sentences()))

    def to_json(self) -> CompareDocument:
        """Return what ``slamfusion compare`` prints as JSON."""
        results: list[ComparedResultsJson] = [
            {
                "name": item.name,
                "file": str(file),
                "command": item.command,
                "version": item.version,
                "items": [own.to_json() for own in item.items],
            }
            for item, file in zip(self.results, self.files, strict=True)
        ]
        return {
            "results": results,
            "figures": [
                _figure_to_json(pair, item) for pair in self.pairs for item in pair.figures
            ],
            "series": [_series_to_json(pair, item) for pair in self.pairs for item in pair.series],
            "notes": self.sentences(),
            "versions": versions(),
        }


def compare_results(files: Sequence[str | Path]) -> ComparedResults:
    """Compare files that ``--save-results`` wrote, every two of them.

    Items of the same case and method are pairs; so are those of the same case where each file has
    one item a case. Where nothing can be paired, figures are compared as two samples.

    Args:
        files: at least two.

    Raises:
        ResultsFileError: a file is none of saved results, or is damaged.
        SlamFusionError: there are fewer than two, or two have no figure in common.
        OSError: a file cannot be opened.
    """
    paths = tuple(Path(path) for path in files)
    if len(paths) < 2:
        message = "wanted two files of --save-results or more to compare, found one; name another"
        raise SlamFusionError(message)
    names = distinct_names([path.with_suffix("") for path in paths])
    results = [read_results(path, name) for path, name in zip(paths, names, strict=True)]
    pairs = [compare_pair(first, second) for first, second in itertools.combinations(results, 2)]
    return ComparedResults(tuple(results), paths, tuple(_corrected(pairs)))


def compare_pair(first: SavedResults, second: SavedResults) -> ResultsPair:
    """Compare two files of results; see ``compare_results``.

    Raises:
        SlamFusionError: they have no figure in common.
    """
    items = pair_items(first.items, second.items)
    figures = compare_figures(items)
    if not figures:
        message = (
            f"{first.name} is of {first.command}, {second.name} of {second.command}: they have no "
            "figure in common; compare results of the same kind"
        )
        raise SlamFusionError(message)
    series = [
        SeriesPair(own, other, found)
        for own, other in items.pairs
        for name in own.series
        if name in other.series
        and (found := compare_series(name, own.series[name], other.series[name])) is not None
    ]
    return ResultsPair(first, second, items, tuple(figures), tuple(series))


def _corrected(pairs: Sequence[ResultsPair]) -> list[ResultsPair]:
    """Return the pairs with p-values that allow for how many files were compared at once."""
    by_figure: dict[str, list[FigureComparison]] = {}
    for pair in pairs:
        for item in pair.figures:
            by_figure.setdefault(item.figure, []).append(item)
    corrected = {name: iter(holm_corrected(found)) for name, found in by_figure.items()}
    return [
        replace(pair, figures=tuple(next(corrected[item.figure]) for item in pair.figures))
        for pair in pairs
    ]


def write_comparison_plot(found: ComparedResults, path: str | Path) -> None:
    """Write the comparison as one picture: errors along the paths, and figures by case.

    Args:
        found: what was compared.
        path: PNG, SVG or PDF, by its suffix.

    Raises:
        SlamFusionError: matplotlib is missing, or the file cannot be written.
    """
    from slamfusion.report.comparison_plot import comparison_plot  # noqa: PLC0415  (an extra)

    sets = {item.name: item.items for item in found.results}
    write_atomic(path, comparison_plot(sets, Path(path).suffix.lower().removeprefix(".")))


def _figure_to_json(pair: ResultsPair, item: FigureComparison) -> ComparedFigureJson:
    names = (pair.first.name, pair.second.name)
    return {
        "figure": item.figure,
        "first": names[0],
        "second": names[1],
        "items_first": item.count_first,
        "items_second": item.count_second,
        "mean_first": item.mean_first,
        "mean_second": item.mean_second,
        "difference": item.difference,
        "paired": None if item.paired is None else item.paired.to_json(),
        "unpaired": None if item.unpaired is None else item.unpaired.to_json(),
        "p_value": item.p_value,
        "better": None if item.better is None else names[item.better],
    }


def _series_to_json(pair: ResultsPair, item: SeriesPair) -> ComparedSeriesJson:
    found = item.comparison
    return {
        "series": found.name,
        "case": item.first.case,
        "first": pair.first.name,
        "second": pair.second.name,
        "method_first": item.first.method,
        "method_second": item.second.method,
        "common": found.common,
        "spans": found.spans,
        "mean_first": found.mean_first,
        "mean_second": found.mean_second,
        "paired": None if found.paired is None else found.paired.to_json(),
    }
