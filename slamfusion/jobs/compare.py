"""Compare saved results: the differences of every figure, with p-values."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from slamfusion.errors import SlamFusionError, counted
from slamfusion.evaluation.measured import figure_of
from slamfusion.evaluation.statistics import correct_by_holm
from slamfusion.io import write_atomic
from slamfusion.jobs.inputs import distinct_names
from slamfusion.jobs.results import KEYS, SavedResults, figures_of, means_of, read_results
from slamfusion.version import versions

if TYPE_CHECKING:
    import pandas as pd

# Rows of two results are paired by the first of these that any two rows have in common. Without the
# seed among them, the means over the seeds are paired.
PAIRED_BY = (["case", "seed", "method"], ["case", "seed"], ["case", "method"], ["case"])
# A difference with a smaller p-value counts as one.
SIGNIFICANT = 0.05
# Differences that vary by less than this share of the values are rounding.
ROUNDING = 1e-12
# Rows without a partner that a note names.
NAMED_ROWS = 6
# Roles of the inputs that figures are measured by: other files make other figures.
_YARDSTICKS = {"truth", "truth image", "relations", "odometry", "scan odometry", "log", "distances"}


@dataclass(eq=False)
class Comparison:
    """One figure of two results or methods."""

    figure: str
    """The figure's name."""
    case: str
    """The case; empty for a figure over all cases."""
    first: str
    """One of the results or methods."""
    second: str
    """The other."""
    count_first: int
    """Maps or paths of the first; of pairs, those that both have."""
    count_second: int
    """The same of the second."""
    mean_first: float
    """Mean of the first."""
    std_first: float | None
    """Sample standard deviation of the first; null for one value."""
    mean_second: float
    """Mean of the second."""
    std_second: float | None
    """Sample standard deviation of the second."""
    difference: float
    """The first mean less the second."""
    low: float | None = math.nan
    """Low end of the interval of the difference: 95 %, wider by Holm's correction for every two of
    several results, so that it agrees with p_holm. Null without pairs."""
    high: float | None = math.nan
    """High end of it."""
    p_t: float | None = math.nan
    """P-value of the paired t-test, or of Welch's, not corrected. Null where nothing can be
    tested."""
    p_holm: float | None = math.nan
    """The same after Holm's correction for every two of several results."""
    p_rank: float | None = math.nan
    """P-value of Wilcoxon's signed-rank test, or of Mann and Whitney's; not corrected. Few values
    cannot make it small: 0.06 at least of five pairs."""
    p_pooled: float | None = math.nan
    """P-value of Student's t-test of unpaired values with one variance, the test of [F16]."""
    better: str | None = None
    """The results that are better beyond chance (p_holm below 0.05); null: neither."""


@dataclass(frozen=True, eq=False)
class ComparedResults:
    """Every two of several results compared; ``slamfusion compare``."""

    results: Sequence[SavedResults]
    """The compared results, in the order given."""
    pairings: Sequence[str]
    """For every two results, which of their rows are pairs."""
    figures: Sequence[Comparison]
    """Every figure of every two results."""
    notes: Sequence[str]
    """What was not compared, and what makes the comparison doubtful."""
    versions: Mapping[str, str | None]
    """Versions of Python, of this package and of the packages it needs; null: not installed."""
    is_paired: Collection[bool] = field(repr=False)
    """Whether the figures of any two results are pairs, and of any two are not."""


def compare_results(files: Sequence[str | Path]) -> ComparedResults:
    """Compare every two results that ``--save-results`` wrote.

    Files are compared; if a file has several methods in a case and none of them is in another file,
    its methods are. Rows of the same case, seed and method are pairs; if there are none and each
    file has one method, rows of the same case and seed are. If no seed is the same, the means over
    the seeds of each case are pairs. If no case is the same, figures are compared as two samples.

    Raises:
        ResultsFileError: a file holds no saved results, or is damaged.
        SlamFusionError: there is nothing to compare, or no two have a figure in common.
    """
    paths = [Path(path) for path in files]
    names = distinct_names([path.with_suffix("") for path in paths])
    results = _compared(list(map(read_results, paths, names)))
    if len(results) < 2:
        raise SlamFusionError(
            f"wanted two files of --save-results, or one with several methods of a case, found "
            f"{', '.join(map(str, paths)) or 'none'}; name another file"
        )
    figures: list[Comparison] = []
    pairings, notes, apart, is_paired = [], [], [], set()
    for first, second in itertools.combinations(results, 2):
        keys, rows = _paired(first, second)
        both = first.name, second.name
        own = [
            compare_values(both, a[name], b[name], is_paired=bool(keys), figure=name)
            for a, b in [rows]
            for name in a
            if name in b
        ]
        own = [item for item in own if item.count_first and item.count_second]
        if not own:
            named = " and ".join(f"{item.name} ({item.command})" for item in (first, second))
            apart.append(f"{named} have no figure in common")
            continue
        sentence = _pairing(first, second, keys, rows)
        pairings.append(
            sentence if len(results) == 2 else f"{first.name} and {second.name}: {sentence}"
        )
        is_paired.add(bool(keys))
        figures += own
        notes += [*_alone(first, second, keys), *_other_yardsticks(first, second)]
    if not figures:
        raise SlamFusionError(f"{apart[0]}; compare results of the same kind")
    _correct(figures)
    return ComparedResults(
        results,
        pairings,
        figures,
        list(dict.fromkeys([*apart, *notes, *_too_few(figures, is_paired)])),
        versions(),
        is_paired,
    )


def _compared(files: Sequence[SavedResults]) -> list[SavedResults]:
    found = []
    for file in files:
        methods = file.table["method"]
        others = {name for other in files if other is not file for name in other.table["method"]}
        if _has_one_method(figures_of(file.table)) or others & set(methods):
            found.append(file)
        else:
            found += [
                replace(file, name=name, table=file.table[methods == name])
                for name in methods.unique()
            ]
    return found


def _has_one_method(figures: pd.DataFrame) -> bool:
    """Whether no case and seed has several rows."""
    return not figures.index.droplevel("method").has_duplicates


Rows = tuple["pd.DataFrame", "pd.DataFrame"]


def _paired(first: SavedResults, second: SavedResults) -> tuple[list[str], Rows]:
    """Return the keys of the pairs and both results in the same order; no keys: all rows."""
    tables = figures_of(first.table), figures_of(second.table)
    for keys in PAIRED_BY:
        if "method" in keys or all(map(_has_one_method, tables)):
            a, b = (means_of(table, keys) for table in tables)
            common = a.index.intersection(b.index, sort=False)
            if len(common):
                return keys, (a.loc[common], b.loc[common])
    return [], tables


def _pairing(first: SavedResults, second: SavedResults, keys: Sequence[str], rows: Rows) -> str:
    """Return a sentence on what was paired, and over how many."""
    tables = first.table, second.table
    if not keys:
        is_apart = set(tables[0]["case"]).isdisjoint(tables[1]["case"])
        why = "no case in common" if is_apart else "several methods in a case and none in common"
        return f"{why}; figures are compared as two samples"
    has_seeds = any((table["seed"] != "").any() for table in tables)
    shown = [key for key in keys if key != "seed" or has_seeds]
    same = " and ".join(filter(None, [", ".join(shown[:-1]), shown[-1]]))
    sentence = f"{counted(len(rows[0]), 'pair')} of the same {same}"
    cases = rows[0].index.get_level_values("case").nunique()
    if has_seeds and "seed" in keys:
        return f"{sentence}, in {counted(cases, 'case')}"
    if has_seeds:
        return f"{sentence}; no seed is in both, so the means over the seeds are the pairs"
    return sentence


def compare_values(
    names: tuple[str, str],
    first: pd.Series,
    second: pd.Series,
    *,
    is_paired: bool,
    figure: str,
    case: str = "",
) -> Comparison:
    """Compare a figure by two-sided tests of ``scipy.stats``.

    Args:
        first, second: of each case or repetition; of pairs in the same order. Fewer than two values
            of either are not tested, and equal values have no p-value.
    """
    if is_paired:
        both = first.notna() & second.notna()
        first, second = first[both], second[both]
    first, second = first.dropna(), second.dropna()
    found = Comparison(
        figure,
        case,
        *names,
        count_first=len(first),
        count_second=len(second),
        mean_first=float(first.mean()),
        std_first=float(first.std()),
        mean_second=float(second.mean()),
        std_second=float(second.std()),
        difference=float(first.mean() - second.mean()),
    )
    a, b = first.to_numpy(np.float64), second.to_numpy(np.float64)
    if min(len(a), len(b)) < 2:
        return found
    with warnings.catch_warnings():
        # SciPy warns of constant values; their p-value is 0 or NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        found.p_pooled = float(scipy.stats.ttest_ind(a, b).pvalue)
        if not is_paired:
            found.p_t = float(scipy.stats.ttest_ind(a, b, equal_var=False).pvalue)
            found.p_rank = float(scipy.stats.mannwhitneyu(a, b).pvalue)
        elif np.abs(a - b).max() <= ROUNDING * np.abs((a, b)).max():
            found.low = found.high = 0.0
        else:
            t_test = scipy.stats.ttest_rel(a, b)
            found.low, found.high = map(float, t_test.confidence_interval())
            found.p_t = float(t_test.pvalue)
            found.p_rank = float(scipy.stats.wilcoxon(a - b).pvalue)
    found.p_holm = found.p_t
    return found


def _correct(figures: Sequence[Comparison]) -> None:
    """Correct the p-values of each figure for several comparisons, and name the better."""
    for name in {item.figure for item in figures}:
        own = [item for item in figures if item.figure == name]
        larger = figure_of(name).larger_is_better
        corrected = correct_by_holm([item.p_t or 0.0 for item in own])
        for item, p_holm in zip(own, corrected, strict=True):
            item.p_holm = p_holm
            item.low, item.high = _agreeing_interval(item, p_holm)
            if larger is not None and p_holm < SIGNIFICANT:
                is_first = (item.difference > 0.0) == larger
                item.better = item.first if is_first else item.second


def _agreeing_interval(item: Comparison, p_holm: float) -> tuple[float | None, float | None]:
    """Return the interval that excludes zero exactly if ``p_holm`` is below ``SIGNIFICANT``."""
    low, high, p_t = item.low, item.high, item.p_t
    if low is None or high is None or not p_t or not low < high:
        return low, high
    tails = 0.5 * SIGNIFICANT * np.array([p_t / p_holm, 1.0])
    wide, usual = scipy.stats.t.isf(tails, item.count_first - 1)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * wide / usual
    return float(middle - half), float(middle + half)


def _too_few(figures: Sequence[Comparison], is_paired: Collection[bool]) -> list[str]:
    """Report that the rank test cannot be significant, with the least p that it can have."""
    first, second = min((item.count_first, item.count_second) for item in figures)
    least = 2.0 / (2**first if True in is_paired else math.comb(first + second, first))
    if least < SIGNIFICANT:
        return []
    test, found = "Mann and Whitney's test", f"{first} and {counted(second, 'result')}"
    if True in is_paired:
        test, found = "Wilcoxon's test", counted(first, "pair")
    least_p = f"{min(least, 1.0):.2g}"
    return [f"{found}: too few for {test}, whose p cannot be below {least_p}; add cases or seeds"]


def _alone(first: SavedResults, second: SavedResults, keys: Sequence[str]) -> list[str]:
    """Return a sentence for each of two results that has rows without a partner in the other."""
    found = []
    for own, other in ((first, second), (second, first)) if keys else ():
        partners = other.table[list(keys)].drop_duplicates()
        rows = own.table[KEYS].drop_duplicates().merge(partners, how="left", indicator=True)
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
    """Write one picture (PNG, SVG or PDF) of errors along the paths and figures by case."""
    from slamfusion.report.result_plots import comparison_plot  # noqa: PLC0415  (an extra)

    tables = {item.name: item.table for item in found.results}
    write_atomic(path, comparison_plot(tables, Path(path).suffix.lower().removeprefix(".")))
