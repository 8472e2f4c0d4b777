"""Saved results against each other: differences of every figure, with p-values."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import compare_pairs, compare_samples, correct_by_holm, figure_of
from slamfusion.evaluation.records import DifferenceJson, MeasuredItemJson, PairedDifferenceJson
from slamfusion.io import write_atomic
from slamfusion.jobs.documents import versions
from slamfusion.jobs.inputs import distinct_names
from slamfusion.jobs.results import PLACE, SavedResults, figures_of, means_of, read_results

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "CompareDocument",
    "ComparedFigureJson",
    "ComparedResults",
    "ComparedResultsJson",
    "ComparedSeriesJson",
    "PairingJson",
    "compare_results",
    "write_comparison_plot",
]

# Rows of two results are paired by the first of these that any two rows have in common. Without the
# seed among them, the means over the seeds are paired.
PAIRED_BY = (["case", "seed", "method"], ["case", "seed"], ["case", "method"], ["case"])
# Errors whose places differ by less than this are at one place: seconds or metres.
SAME_PLACE = 1e-6
# A path is cut into at most this many spans of neighbours, each of at least so many errors.
SPANS, SPAN_ERRORS = 24, 5
# A difference with a smaller p-value counts as one.
SIGNIFICANT = 0.05
# Rows without a partner that a note names.
NAMED_ROWS = 6
# Roles of the inputs that figures are measured by: other files make other figures.
_YARDSTICKS = {"truth", "truth image", "relations", "odometry", "scan odometry", "log", "distances"}


class ComparedResultsJson(TypedDict):
    """A file of saved results, or one method of it."""

    name: str
    """What it is called below: its file's name without the ending, or the method."""
    file: str
    """Its file."""
    command: str
    """The command that saved it."""
    version: str
    """Version of the program that saved it."""
    items: Sequence[MeasuredItemJson]
    """What was measured."""


class PairingJson(TypedDict):
    """Which rows of two results were compared as pairs."""

    first: str
    """One of the results."""
    second: str
    """The other."""
    by: Sequence[str]
    """What the rows of a pair have in common: case, seed, method; empty: nothing was paired."""
    pairs: int
    """Pairs."""
    sentence: str
    """The same in words."""


class ComparedFigureJson(TypedDict):
    """One figure of two results."""

    figure: str
    """Its name."""
    first: str
    """One of the results."""
    second: str
    """The other."""
    items_first: int
    """Maps or paths of the first that have it; of pairs, those of which both have it."""
    items_second: int
    """The same of the second."""
    mean_first: float
    """Its mean over these, of the first."""
    std_first: float | None
    """Its sample standard deviation over these; null for one."""
    mean_second: float
    """The mean of the second."""
    std_second: float | None
    """The deviation of the second."""
    difference: float
    """The first mean less the second."""
    paired: PairedDifferenceJson | None
    """The tests of the pairs; null for fewer than two, or where nothing was paired."""
    unpaired: DifferenceJson | None
    """The tests of two samples; null where there are pairs, or one has fewer than two items."""
    p_value: float | None
    """Of the t-test that was made (paired, or Welch's), after Holm for more than two results."""
    better: str | None
    """The results that are better beyond chance (p below 0.05); null: neither."""


class ComparedSeriesJson(TypedDict):
    """The single errors of two paths of one case and seed, where both have one."""

    series: str
    """Its name, which ends in the unit."""
    case: str
    """The case."""
    seed: str
    """The seed; empty where there is none."""
    first: str
    """One of the results."""
    second: str
    """The other."""
    method_first: str
    """What made the path of the first."""
    method_second: str
    """What made the path of the second."""
    common: int
    """Errors at the same times in both."""
    spans: int
    """Spans of neighbouring errors whose means are the pairs of the tests."""
    mean_first: float
    """Mean of the common errors of the first."""
    mean_second: float
    """Mean of the common errors of the second."""
    paired: PairedDifferenceJson | None
    """The tests over the spans; null for too few errors."""


class CompareDocument(TypedDict):
    """``slamfusion compare``."""

    results: Sequence[ComparedResultsJson]
    """What was compared, in the order given."""
    pairings: Sequence[PairingJson]
    """What was paired, of every two."""
    figures: Sequence[ComparedFigureJson]
    """Every figure of every two."""
    series: Sequence[ComparedSeriesJson]
    """The single errors of every two paths of one case and seed."""
    notes: Sequence[str]
    """What was not compared, and what makes the comparison doubtful, a sentence each."""
    versions: Mapping[str, str | None]
    """Versions of Python, of this package and of those it stands on; null: not installed."""


@dataclass(frozen=True, eq=False)
class ComparedResults:
    """Every two of several results against each other.

    Attributes:
        results: files, or methods of one file.
        document: what was found, as ``slamfusion compare`` prints it as JSON.
    """

    results: tuple[SavedResults, ...]
    document: CompareDocument


def compare_results(files: Sequence[str | Path]) -> ComparedResults:
    """Compare results that ``--save-results`` wrote, every two of them.

    Files are compared; if a file has several methods in a case and none of them is in another file,
    its methods are. Rows of the same case, seed and method are pairs; if there are none and each
    file has one method, rows of the same case and seed are, so that one method is compared with
    another. If no seed is the same, the means over the seeds of each case are pairs. If no case is
    the same, figures are compared as two samples.

    Args:
        files: one with several methods, or more.

    Raises:
        ResultsFileError: a file is none of saved results, or is damaged.
        SlamFusionError: there is nothing to compare, or no two have a figure in common.
        OSError: a file cannot be opened.
    """
    paths = [Path(path) for path in files]
    names = distinct_names([path.with_suffix("") for path in paths])
    results = _compared(list(map(read_results, paths, names)))
    if len(results) < 2:
        message = (
            f"wanted two files of --save-results, or one with several methods of a case, found "
            f"{', '.join(map(str, paths)) or 'none'}; name another file"
        )
        raise SlamFusionError(message)
    pairings: list[PairingJson] = []
    figures: list[ComparedFigureJson] = []
    series: list[ComparedSeriesJson] = []
    notes: list[str] = []
    apart: list[str] = []
    for first, second in itertools.combinations(results, 2):
        keys, rows = _paired(first, second)
        own = _compare_figures(first, second, is_paired=bool(keys), rows=rows)
        if not own:
            both = " and ".join(f"{item.name} ({item.command})" for item in (first, second))
            apart.append(f"{both} have no figure in common")
            continue
        pairings.append(_pairing(first, second, keys, rows))
        figures += own
        series += _compare_paths(first, second, keys) if "seed" in keys else []
        notes += [*_alone(first, second, keys), *_other_yardsticks(first, second)]
    if not figures:
        message = f"{apart[0]}; compare results of the same kind"
        raise SlamFusionError(message)
    _correct(figures)
    document: CompareDocument = {
        "results": list(map(_to_json, results)),
        "pairings": pairings,
        "figures": figures,
        "series": series,
        "notes": list(dict.fromkeys([*apart, *notes])),
        "versions": versions(),
    }
    return ComparedResults(tuple(results), document)


def _to_json(result: SavedResults) -> ComparedResultsJson:
    """Return what was compared for a JSON document."""
    return {
        "name": result.name,
        "file": str(result.file),
        "command": result.command,
        "version": result.version,
        "items": [item.to_json() for item in result.items()],
    }


def _compared(files: Sequence[SavedResults]) -> list[SavedResults]:
    """Return what is compared: files, or the methods of a file."""
    found = []
    for file in files:
        methods = file.table["method"]
        others = {name for other in files if other is not file for name in other.table["method"]}
        if _has_one_method(file.table) or others & set(methods):
            found.append(file)
        else:
            found += [
                replace(file, name=name, table=file.table[methods == name])
                for name in methods.unique()
            ]
    return found


def _has_one_method(table: pd.DataFrame) -> bool:
    """Whether no case and seed has several rows."""
    return not table.duplicated(["case", "seed"]).any()


Rows = tuple["pd.DataFrame", "pd.DataFrame"]


def _paired(first: SavedResults, second: SavedResults) -> tuple[list[str], Rows]:
    """Return what rows are paired by, and these of both results in the same order.

    Where nothing can be paired, that is nothing, and all rows.
    """
    tables = first.table, second.table
    for keys in PAIRED_BY:
        if "method" in keys or all(map(_has_one_method, tables)):
            a, b = (means_of(table, keys) for table in tables)
            common = a.index.intersection(b.index, sort=False)
            if len(common):
                return keys, (a.loc[common], b.loc[common])
    return [], tables


def _pairing(
    first: SavedResults, second: SavedResults, keys: Sequence[str], rows: Rows
) -> PairingJson:
    """Say what was paired, and over how many."""
    tables = first.table, second.table
    has_seeds = any((table["seed"] != "").any() for table in tables)
    if keys:
        shown_keys = [key for key in keys if key != "seed" or has_seeds]
        same = " and ".join(filter(None, [", ".join(shown_keys[:-1]), shown_keys[-1]]))
        sentence = f"{len(rows[0])} pairs of the same {same}"
        cases = rows[0].index.get_level_values("case").nunique()
        if has_seeds and "seed" in keys:
            sentence += f", in {cases} cases" if cases > 1 else ", in 1 case"
        elif has_seeds:
            sentence += "; no seed is in both, so the means over the seeds are the pairs"
    else:
        is_apart = set(tables[0]["case"]).isdisjoint(tables[1]["case"])
        why = "no case in common" if is_apart else "several methods in a case and none in common"
        sentence = f"{why}; figures are compared as two samples"
    return {
        "first": first.name,
        "second": second.name,
        "by": list(keys),
        "pairs": len(rows[0]) if keys else 0,
        "sentence": sentence,
    }


def _compare_figures(
    first: SavedResults, second: SavedResults, *, is_paired: bool, rows: Rows
) -> list[ComparedFigureJson]:
    """Compare every figure that both have, in the order of the first."""
    found: list[ComparedFigureJson] = []
    for name in figures_of(rows[0]):
        if name not in rows[1]:
            continue
        a, b = (own[name] for own in rows)
        if is_paired:
            both = a.notna() & b.notna()
            a, b = a[both], b[both]
        a, b = a.dropna(), b.dropna()
        if a.empty or b.empty:
            continue
        paired = compare_pairs(a, b) if is_paired else None
        unpaired = None if is_paired else compare_samples(a, b)
        p_value = paired["t_test"] if paired is not None else None
        if unpaired is not None:
            p_value = unpaired["welch"]
        std = [float(own.std()) if len(own) > 1 else None for own in (a, b)]
        found.append(
            {
                "figure": name,
                "first": first.name,
                "second": second.name,
                "items_first": len(a),
                "items_second": len(b),
                "mean_first": float(a.mean()),
                "std_first": std[0],
                "mean_second": float(b.mean()),
                "std_second": std[1],
                "difference": float(a.mean() - b.mean()),
                "paired": paired,
                "unpaired": unpaired,
                "p_value": p_value,
                "better": None,
            }
        )
    return found


def _correct(figures: Sequence[ComparedFigureJson]) -> None:
    """Make p-values of each figure allow for how many results are compared, and say what is better.

    Args:
        figures: of every two results; changed in place.
    """
    for name in {item["figure"] for item in figures}:
        own = [item for item in figures if item["figure"] == name and item["p_value"] is not None]
        corrected = correct_by_holm(
            [item["p_value"] for item in own if item["p_value"] is not None]
        )
        larger = figure_of(name).larger_is_better
        for item, p_value in zip(own, corrected, strict=True):
            item["p_value"] = p_value
            if larger is not None and p_value < SIGNIFICANT:
                is_first = (item["difference"] > 0.0) == larger
                item["better"] = item["first"] if is_first else item["second"]


def _compare_paths(
    first: SavedResults, second: SavedResults, keys: Sequence[str]
) -> list[ComparedSeriesJson]:
    """Compare the single errors of every two paths that are a pair."""
    tables = [own.table.reset_index(names="row") for own in (first, second)]
    pairs = tables[0].merge(tables[1], on=list(keys), suffixes=("_first", "_second"))
    series = [
        dict(list(own.series.groupby(["row", "series"], sort=False))) for own in (first, second)
    ]
    found: list[ComparedSeriesJson] = []
    for _, pair in pairs.iterrows():
        for row, name in series[0]:
            other = series[1].get((pair["row_second"], name))
            if row != pair["row_first"] or other is None:
                continue
            errors = _common_errors(series[0][row, name], other)
            if not errors.size:
                continue
            spans, paired = _compare_spans(errors)
            mean_first, mean_second = errors.mean(axis=0).tolist()
            found.append(
                {
                    "series": name,
                    "case": pair["case"],
                    "seed": pair["seed"],
                    "first": first.name,
                    "second": second.name,
                    "method_first": pair.get("method_first", pair.get("method")),
                    "method_second": pair.get("method_second", pair.get("method")),
                    "common": len(errors),
                    "spans": spans,
                    "mean_first": mean_first,
                    "mean_second": mean_second,
                    "paired": paired,
                }
            )
    return found


def _common_errors(first: pd.DataFrame, second: pd.DataFrame) -> np.ndarray[Any, Any]:
    """Return (N, 2) errors of both series at the places that both have, in their order."""
    rounded = [
        own.assign(**(own[PLACE] / SAME_PLACE).round()).drop_duplicates(PLACE)
        for own in (first, second)
    ]
    both = rounded[0].merge(rounded[1], on=PLACE, suffixes=("_first", "_second"))
    columns = ["error_first", "error_second"]
    return np.asarray(both.sort_values(PLACE)[columns], dtype=np.float64)


def _compare_spans(errors: np.ndarray[Any, Any]) -> tuple[int, PairedDifferenceJson | None]:
    """Test (N, 2) errors of two paths; return the number of spans, and the test over them.

    Errors of neighbouring poses share their causes, so they are no independent pairs: the path is
    cut into spans of equal numbers of neighbours, and the spans' mean errors are the pairs.
    """
    spans = min(SPANS, len(errors) // SPAN_ERRORS)
    if spans < 2:
        return spans, None
    ends = -(-np.arange(1, spans) * len(errors) // spans)
    means = np.array([part.mean(axis=0) for part in np.array_split(errors, ends)])
    return spans, compare_pairs(*means.T)


def _alone(first: SavedResults, second: SavedResults, keys: Sequence[str]) -> list[str]:
    """Return a sentence for each of two results that has rows without a partner in the other."""
    found = []
    for own, other in ((first, second), (second, first)) if keys else ():
        partners = other.table[list(keys)].drop_duplicates()
        rows = own.table.merge(partners, on=list(keys), how="left", indicator=True)
        rows = rows[rows["_merge"] == "left_only"]
        named = [
            f"{row.method} in {row.case}" + (f" seed {row.seed}" if row.seed else "")
            for row in rows.head(NAMED_ROWS).itertuples()
        ]
        if len(rows) > len(named):
            named.append(f"and {len(rows) - len(named)} more")
        if named:
            found.append(f"{own.name}: not in {other.name}: {', '.join(named)}")
    return found


def _other_yardsticks(first: SavedResults, second: SavedResults) -> list[str]:
    """Return a sentence for each truth, log, ... of one case that is not the same file in both."""
    return [
        f"{first.name} and {second.name} rest on different files: {role}"
        + (f" of {case}" if case else "")
        for role, case in sorted(first.yardsticks.keys() & second.yardsticks.keys())
        if role in _YARDSTICKS and first.yardsticks[role, case] != second.yardsticks[role, case]
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

    sets = {item.name: item.items() for item in found.results}
    write_atomic(path, comparison_plot(sets, Path(path).suffix.lower().removeprefix(".")))
