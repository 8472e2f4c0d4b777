"""The page of an experiment: tables, tests, sentences and the plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypedDict

import numpy as np
import pandas as pd
import scipy

from slamfusion.config import RunConfig
from slamfusion.evaluation.measured import Row, figure_of
from slamfusion.evaluation.statistics import correct_by_holm
from slamfusion.experiments.runs import Inputs
from slamfusion.io import AtomicFiles
from slamfusion.jobs.compare import SIGNIFICANT, Comparison, compare_values
from slamfusion.jobs.records import Circumstances, number, p_text, spread
from slamfusion.jobs.results import KEYS, markdown, results_table
from slamfusion.json_values import FLAT

Pairs = Mapping[str, Sequence[tuple[str, str]]]
TextTable = tuple[str, Sequence[str], Sequence[Sequence[str]]]


class SummaryJson(TypedDict):
    """A figure of one method in one case, over all runs."""

    case: str
    """The case."""
    figure: str
    """The figure."""
    method: str
    """The method."""
    count: int
    """Runs."""
    mean: float
    """Their mean."""
    std: float | None
    """Sample standard deviation (divided by N - 1); null for one run."""
    median: float
    """Their median."""
    min: float
    """The smallest."""
    max: float
    """The largest."""
    low: float | None
    """Low end of the mean's 95 % interval (Student's t); null for one run."""
    high: float | None
    """High end of it."""


@dataclass(frozen=True)
class AgainstBest:
    """A fusion compared with the best input of a case, by the [F16] error."""

    case: str
    """The case."""
    fusion: str
    """The fusion."""
    best_input: str
    """The input with the smallest mean error."""
    ratio: float
    """Mean error of the fusion over that of the best input."""
    low: float | None
    """Low end of the ratio's 95 % interval; null for a single run."""
    high: float | None
    """High end of it."""
    p_t: float | None
    """P-value of the paired t-test after Holm; null for a single run."""
    best_error: float = field(repr=False)
    """Mean error of the best input."""


@dataclass(frozen=True)
class Overall:
    """Errors of a fusion over those of the best inputs, over all cases."""

    ratio: float
    """Mean of the cases' ratios."""
    worst: float
    """The largest of them."""
    of_sums: float
    """Ratio of the sums of the mean errors, in which large places count more."""


@dataclass(frozen=True)
class Note:
    """What went wrong in runs of a case."""

    case: str
    """The case."""
    what: str
    """The method, or the part of it."""
    runs: int
    """Runs that it went wrong in."""
    reason: str
    """The reason in the first of them."""


@dataclass(frozen=True, eq=False)
class ExperimentDocument:
    """``slamfusion experiment NAME``."""

    title: str
    """Of the experiment."""
    summaries: Sequence[SummaryJson]
    """Every figure of every method in every case."""
    comparisons: Sequence[Comparison]
    """The methods that are compared."""
    against_best_input: Sequence[AgainstBest]
    """The fusions compared with the best input of each case; empty without fusions."""
    overall: Mapping[str, Overall]
    """The same over all cases, by fusion."""
    notes: Sequence[Note]
    """What went wrong."""
    sentences: Sequence[str]
    """The results in words."""
    files: Sequence[Path]
    """The files that were written."""
    circumstances: Circumstances = field(metadata=FLAT)


@dataclass(frozen=True, eq=False)
class Experiment:
    """The rows of an experiment and their evaluation.

    Attributes:
        name: start of its file names.
        is_paired: whether runs of the same case and seed are pairs.
        inputs, fusions: methods; each fusion is compared with the best input by its ``error``.
        notes: (case, failures by method) of each run.
        failure: why the experiment failed; else empty.
        read: the files that it used.
    """

    name: str
    title: str
    rows: Sequence[Row]
    figures: Sequence[str]
    pairs: Pairs = field(default_factory=dict)
    is_paired: bool = True
    inputs: Sequence[str] = ()
    fusions: Sequence[str] = ()
    notes: Sequence[tuple[str, Mapping[str, str]]] = ()
    remarks: Sequence[str] = ()
    failure: str = ""
    read: Inputs = ()

    @cached_property
    def table(self) -> pd.DataFrame:
        """The rows as a table without undefined values."""
        return results_table(self.rows).dropna(subset="value")

    @cached_property
    def summaries(self) -> pd.DataFrame:
        """Count, mean, std, median, min, max, low and high by case, figure and method."""
        groups = self.table.groupby(["case", "figure", "method"], sort=False)["value"]
        found = groups.agg(["count", "mean", "std", "median", "min", "max"])
        half = found["std"] / np.sqrt(found["count"])
        half *= scipy.stats.t.ppf(0.975, (found["count"] - 1).where(found["count"] > 1))
        return found.assign(low=found["mean"] - half, high=found["mean"] + half)

    @cached_property
    def comparisons(self) -> pd.DataFrame:
        """The tests of ``pairs``, in each case with both methods; see ``Comparison``."""
        found: list[Comparison] = []
        for case, own in self.table.groupby("case", sort=False):
            for figure, pairs in self.pairs.items():
                runs = own[own["figure"] == figure]
                runs = runs.pivot_table(index="seed", columns="method", values="value", sort=False)
                part = [
                    compare_values(
                        pair,
                        *(runs[method] for method in pair),
                        is_paired=self.is_paired,
                        figure=figure,
                        case=case,
                    )
                    for pair in pairs
                    if set(pair) <= set(runs)
                ]
                if self.is_paired:
                    corrected = correct_by_holm([item.p_t or 0.0 for item in part])
                    for item, p_t in zip(part, corrected, strict=True):
                        item.p_t = p_t
                found += part
        return pd.DataFrame(map(vars, found), columns=list(Comparison.__annotations__))

    @cached_property
    def against_best(self) -> list[AgainstBest]:
        """Each fusion compared with the best input of each case (by its mean)."""
        if not self.fusions:
            return []
        tests = self.comparisons[self.comparisons["figure"] == "error"]
        tests = tests.set_index(["case", "first", "second"])[["high", "low", "p_t"]]
        means = self.summaries["mean"].xs("error", level="figure")
        found: list[AgainstBest] = []
        for case in means.index.unique("case"):
            inputs = means[case].reindex(self.inputs).dropna()
            best, base = str(inputs.idxmin()), float(inputs.min())
            for fusion in self.fusions:
                low = high = p_t = np.nan
                if (case, best, fusion) in tests.index:
                    gain_high, gain_low, p_t = tests.loc[case, best, fusion]
                    low, high = 1.0 - gain_high / base, 1.0 - gain_low / base
                ratio = float(means[case, fusion] / base)
                found.append(AgainstBest(case, fusion, best, ratio, low, high, p_t, base))
        return found

    def overall(self) -> dict[str, Overall]:
        """Return the error of each fusion over the best inputs', over all cases."""
        found: dict[str, Overall] = {}
        for fusion in self.fusions:
            own = [item for item in self.against_best if item.fusion == fusion]
            ratios = [item.ratio for item in own]
            of_sums = np.average(ratios, weights=[item.best_error for item in own])
            found[fusion] = Overall(float(np.mean(ratios)), max(ratios), float(of_sums))
        return found

    def sentences(self) -> list[str]:
        """Return each fusion compared with the best input, and the remarks."""
        lines = []
        for item in self.against_best:
            line = (
                f"{item.case}: {item.fusion} {percent(item.ratio)} against {item.best_input}, "
                "the best input"
            )
            if item.p_t is not None and np.isfinite(item.p_t):
                chance = "" if item.p_t < SIGNIFICANT else "; may be chance"
                line += f" (95 % interval {percent(item.low)} to {percent(item.high)}, "
                line += f"p {p_text(item.p_t)} after Holm{chance})"
            lines.append(f"{line}.")
        for fusion, values in self.overall().items():
            lines.append(
                f"all cases: {fusion} {percent(values.ratio)} against the best inputs on the "
                f"mean of cases ({percent(values.of_sums)} of the sums), "
                f"{percent(values.worst)} in the worst case."
            )
        return [*lines, *self.remarks]

    def text_tables(self, *, details: bool) -> list[TextTable]:
        """Return the tables: cases by methods; for single runs, methods by figures."""
        shown = [name for name in self.figures if (self.table["figure"] == name).any()]
        found = self._single_tables(shown)
        if len(shown) == 1 or self.summaries["count"].max() > 1:
            found = [self._means(name) for name in shown]
        if details and len(self.comparisons):
            names = ["case", "figure", "first", "second", "count", "difference"]
            digits = [figure_of(name).digits for name in self.comparisons["figure"]]
            rows = [
                [
                    *row[["case"]], figure_of(row["figure"]).label, *row[["first", "second"]],
                    str(row["count_first"]), number(row["difference"], places),
                    " to ".join(number(row[end], places) for end in ("low", "high")),
                    *(p_text(row[p]) for p in ("p_pooled", "p_t", "p_rank")),
                ]
                for (_, row), places in zip(self.comparisons.iterrows(), digits, strict=True)
            ]  # fmt: skip
            t_test = "p paired t" if self.is_paired else "p Welch"
            rank = "p Wilcoxon" if self.is_paired else "p Mann-Whitney"
            heads = (*names, "95 %", "p pooled t [F16]", t_test, rank)
            found.append(("Tests of every two methods", heads, rows))
        notes = self.noted()
        if notes:
            rows = [[own.case, own.what, str(own.runs), own.reason] for own in notes]
            found.append(("What was left out", ("case", "what", "runs", "first reason"), rows))
        return found

    def _means(self, figure: str) -> TextTable:
        """Return mean ± deviation of a figure: a row per case, a column per method."""
        digits = figure_of(figure).digits
        own = self.summaries.xs(figure, level="figure")
        texts = [spread(*both, digits) for both in zip(own["mean"], own["std"], strict=True)]
        wide = pd.Series(texts, own.index).unstack("method")  # noqa: PD010
        wide = wide.reindex(own.index.unique("case"))[own.index.unique("method")].fillna("-")
        counts = own.groupby("case")["count"].max()
        rows = [[case, str(counts[case]), *cells] for case, *cells in wide.itertuples(name=None)]
        what = ", mean ± deviation" if own["count"].max() > 1 else ""
        return f"{figure_of(figure).label}{what}", ("case", "runs", *wide.columns), rows

    def _single_tables(self, figures: Sequence[str]) -> list[TextTable]:
        """Return the figures of single runs: a table per case, a row per method."""
        wide = self.summaries["mean"].unstack("figure").reindex(columns=figures)  # noqa: PD010
        texts = wide.apply(lambda own: own.map(lambda v: number(v, figure_of(own.name).digits)))
        order = self.table[["case", "method"]].drop_duplicates()
        heads = ("map", *(figure_of(name).label for name in figures))
        return [
            (str(case), heads, [[method, *texts.loc[(case, method)]] for method in methods])
            for case, methods in order.groupby("case", sort=False)["method"]
        ]

    def noted(self) -> list[Note]:
        """Return the failures with the number of runs and the first reason."""
        seen: dict[tuple[str, str], list[str]] = {}
        for case, notes in self.notes:
            for what, reason in notes.items():
                seen.setdefault((case, what), []).append(reason)
        return [Note(*key, len(reasons), reasons[0]) for key, reasons in seen.items()]

    def document(self, files: Sequence[Path], config: RunConfig, device: str) -> ExperimentDocument:
        """Return what ``slamfusion experiment NAME`` prints as JSON."""
        return ExperimentDocument(
            self.title,
            self.summaries.reset_index().to_dict("records"),
            self.comparisons.to_dict("records"),
            self.against_best,
            self.overall(),
            self.noted(),
            self.sentences(),
            files,
            Circumstances(device, config),
        )

    def write(self, folder: Path, forms: Sequence[str] = ()) -> list[Path]:
        """Write ``NAME.csv`` (all rows), ``NAME.md`` (tables and sentences) and the plot."""
        from slamfusion.report.result_plots import experiment_plot  # noqa: PLC0415  (an extra)

        lines = [f"# {self.title}\n"]
        for title, heads, rows in self.text_tables(details=True):
            lines.append(f"## {title}\n\n{markdown(heads, rows)}")
        lines += ["## In words\n"] if self.sentences() else []
        lines += [f"- {sentence}" for sentence in self.sentences()]
        table = self.table[[*KEYS, "figure", "value"]]
        contents = {
            "csv": table.to_csv(index=False, lineterminator="\n").encode(),
            "md": "\n".join([*lines, f"\n![{self.title}]({self.name}.png)\n"]).encode(),
        }
        for form in ("png", *forms):
            contents[form] = experiment_plot(self.summaries, self.figures, form)
        with AtomicFiles() as files:
            for form, data in contents.items():
                files.add(folder / f"{self.name}.{form}", data)
        return [folder / f"{self.name}.{form}" for form in contents]


def percent(ratio: float | None) -> str:
    """Return a ratio as a change in per cent."""
    return f"{100.0 * ((ratio or 0.0) - 1.0):+.1f} %"
