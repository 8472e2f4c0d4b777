"""Tables of map errors over trials: means with their intervals, and tests of every two methods."""

from __future__ import annotations

import csv
import io
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

from slamfusion.evaluation import (
    Interval,
    Moments,
    PairedDifference,
    Summary,
    compare_pairs,
    correct_by_holm,
    pooled_p_value,
    t_interval,
)
from slamfusion.experiments.records import (
    AgainstBestInputJson,
    ErrorTableJson,
    MethodPairJson,
    MethodSummaryJson,
    OverallRatioJson,
    RatiosJson,
    RealLogTableJson,
)
from slamfusion.experiments.table import markdown_table
from slamfusion.experiments.trials import FUSIONS, TrialRecord, alone
from slamfusion.io import AtomicFiles
from slamfusion.slam.registry import BUILT_IN

__all__ = ["Against", "ErrorTable", "MethodPair", "Sheet", "Tables", "write_error_table"]

SIGNIFICANT = 0.05
NO_TEST = "-"


@dataclass(frozen=True)
class Sheet:
    """A table of texts, shown on the console, in Markdown and in HTML.

    Attributes:
        title: above it.
        heading: a text for each column.
        rows: as many texts each.
        note: a sentence that explains it.
    """

    title: str
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def to_markdown(self) -> list[str]:
        """Return its lines."""
        lines = [f"## {self.title}", ""]
        if self.note:
            lines += [self.note, ""]
        return [*lines, *markdown_table(self.heading, self.rows), ""]


@dataclass(frozen=True)
class MethodPair:
    """Two methods on the same drives.

    Attributes:
        condition: of the drives.
        first, second: the methods.
        pooled: p-value of [F16]'s test, which takes the repetitions for unpaired.
        paired: the difference, first minus second, with tests that know the pairs.
        holm: p-value of the paired t-test, corrected for all pairs of this condition.
    """

    condition: str
    first: str
    second: str
    pooled: float
    paired: PairedDifference
    holm: float

    def to_json(self) -> MethodPairJson:
        """Return the pair for a JSON document."""
        return {
            "condition": self.condition,
            "methods": [self.first, self.second],
            "p_pooled_t": self.pooled,
            "p_paired_t_holm": self.holm,
            "paired": self.paired.to_json(),
        }


@dataclass(frozen=True)
class Against:
    """A way to fuse against the best input of a condition.

    Attributes:
        condition: of the drives.
        fusion: the way to vote.
        best: the producer with the smallest mean error.
        ratio: mean error of the fusion over that of the best input.
        interval: 95 %, of the ratio, with the best input's mean held; None for a single drive.
        p_value: of the paired t-test, corrected; None for a single drive.
    """

    condition: str
    fusion: str
    best: str
    ratio: float
    interval: Interval | None
    p_value: float | None

    def to_json(self) -> AgainstBestInputJson:
        """Return the comparison for a JSON document."""
        return {
            "condition": self.condition,
            "fusion": self.fusion,
            "best_input": self.best,
            "ratio": self.ratio,
            "interval": None if self.interval is None else self.interval.to_json(),
            "p_value": self.p_value,
        }

    def sentence(self) -> str:
        """Say whether the fusion is better than the best input."""
        percent = 100.0 * (self.ratio - 1.0)
        where = f"{self.condition}: {self.fusion} is {abs(percent):.1f} %"
        where += f" {'below' if percent < 0.0 else 'above'} {self.best}, the best input"
        if self.interval is None or self.p_value is None:
            return f"{where} (a single drive: nothing can be tested)."
        low, high = (100.0 * (end - 1.0) for end in (self.interval.low, self.interval.high))
        shown = "" if self.p_value < SIGNIFICANT else "; may be chance"
        return (
            f"{where} (95 % interval {low:+.1f} to {high:+.1f} %, "
            f"p {_p_text(self.p_value)} after Holm{shown})."
        )


@dataclass(frozen=True)
class ErrorTable:
    """The errors of all methods over all trials.

    Attributes:
        title: of the experiment.
        records: of the trials, each with the same producers and fusions.
    """

    title: str
    records: tuple[TrialRecord, ...]

    def conditions(self) -> list[str]:
        """Return the conditions, in order."""
        return list(dict.fromkeys(record.condition for record in self.records))

    def of(self, condition: str) -> list[TrialRecord]:
        """Return the records of a condition."""
        return [record for record in self.records if record.condition == condition]

    def methods(self, condition: str | None = None) -> list[str]:
        """Return the producers, then the fusions of them all: of a condition, or of any."""
        records = self.records if condition is None else self.of(condition)
        known = {method for record in records for method in record.errors}
        return [method for method in (*BUILT_IN, *FUSIONS) if method in known]

    def errors(self, condition: str, method: str) -> list[float]:
        """Return a method's errors in the order of the trials."""
        return [record.errors[method] for record in self.of(condition)]

    def best_input(self, condition: str) -> str:
        """Return the producer with the smallest mean error."""
        means = {
            name: Summary.of(self.errors(condition, name)).mean
            for name in self.methods(condition)
            if name in BUILT_IN
        }
        return min(means, key=means.__getitem__)

    def pairs(self, condition: str) -> list[MethodPair]:
        """Return every two methods of a condition, tested; none for a single drive."""
        return self._tested[condition]

    @cached_property
    def _tested(self) -> dict[str, list[MethodPair]]:
        """The pairs of every condition: they take long, and many tables want them."""
        return {condition: self._test(condition) for condition in self.conditions()}

    def _test(self, condition: str) -> list[MethodPair]:
        """Test every two methods of a condition."""
        tested = []
        for first, second in itertools.combinations(self.methods(condition), 2):
            a, b = self.errors(condition, first), self.errors(condition, second)
            paired = compare_pairs(a, b)
            if paired is None:
                return []
            tested.append((first, second, pooled_p_value(_moments(a), _moments(b)), paired))
        corrected = correct_by_holm([paired.t_test for *_, paired in tested])
        return [
            MethodPair(condition, first, second, pooled, paired, holm)
            for (first, second, pooled, paired), holm in zip(tested, corrected, strict=True)
        ]

    def against_best(self, condition: str) -> list[Against]:
        """Return how every way to vote stands against the best input."""
        best = self.best_input(condition)
        base = Summary.of(self.errors(condition, best)).mean
        tested = {frozenset((pair.first, pair.second)): pair for pair in self.pairs(condition)}
        found = []
        for fusion in FUSIONS:
            ratio = Summary.of(self.errors(condition, fusion)).mean / base
            pair = tested.get(frozenset((fusion, best)))
            interval, p_value = None, None
            if pair is not None:
                ends = pair.paired.interval
                low, high = (
                    (ends.low, ends.high) if pair.first == fusion else (-ends.high, -ends.low)
                )
                interval, p_value = Interval(1.0 + low / base, 1.0 + high / base), pair.holm
            found.append(Against(condition, fusion, best, ratio, interval, p_value))
        return found

    def overall(self) -> dict[str, OverallRatioJson]:
        """Return for each way to vote its error against the best inputs' over all conditions.

        ``ratio`` is the mean of the conditions' ratios, ``worst`` the largest of them; ``of_sums``
        is that of the sums of the mean errors, in which large places count more than small ones.
        """
        found: dict[str, OverallRatioJson] = {}
        for number, fusion in enumerate(FUSIONS):
            ratios = [self.against_best(name)[number].ratio for name in self.conditions()]
            best = [
                Summary.of(self.errors(name, self.best_input(name))).mean
                for name in self.conditions()
            ]
            total = sum(ratio * base for ratio, base in zip(ratios, best, strict=True))
            found[fusion] = {
                "ratio": sum(ratios) / len(ratios),
                "worst": max(ratios),
                "of_sums": total / sum(best),
            }
        return found

    def against_others(self, condition: str) -> dict[str, float]:
        """Return every fusion's mean error over that of fusing the unharmed producers alone.

        Empty where no producer alone is harmed.
        """
        if any(alone(fusion) not in self.of(condition)[0].errors for fusion in FUSIONS):
            return {}
        return {
            fusion: Summary.of(self.errors(condition, fusion)).mean
            / Summary.of(self.errors(condition, alone(fusion))).mean
            for fusion in FUSIONS
        }

    # --- shown -----------------------------------------------------------------------------------

    def means_sheet(self) -> Sheet:
        """Return a row for each condition and a column for each method."""
        methods = self.methods()
        rows = []
        for condition in self.conditions():
            best = self.best_input(condition)
            cells = [_mean_text(self.errors(condition, method)) for method in methods]
            smallest = Summary.of(self.errors(condition, best)).mean
            ratios = {item.fusion: item.ratio for item in self.against_best(condition)}
            chosen = min(ratios, key=ratios.__getitem__)
            change = f"{chosen} {100.0 * (ratios[chosen] - 1.0):+.1f} %"
            count = str(len(self.of(condition)))
            rows.append((condition, count, *cells, f"{best} {smallest:.2f}", change))
        return Sheet(
            "Errors of the maps",
            ("condition", "drives", *methods, "best input", "best fusion against it"),
            tuple(rows),
            "[F16] error against the truth, mean ± sample deviation; smaller is better.",
        )

    def intervals_sheet(self) -> Sheet:
        """Return fused minus best input with its interval: of each world, and of all together."""
        rows = []
        for condition in self.conditions():
            records = self.of(condition)
            worlds = list(dict.fromkeys(record.world for record in records))
            groups = [
                (str(world), [record for record in records if record.world == world])
                for world in worlds
            ]
            if len(worlds) > 1:
                groups.append(("all", records))
            for name, group in groups:
                part = ErrorTable(self.title, tuple(group))
                best = part.best_input(condition)
                base = part.errors(condition, best)
                cells = [
                    _difference_text(part.errors(condition, fusion), base) for fusion in FUSIONS
                ]
                mean = f"{best} {Summary.of(base).mean:.2f}"
                rows.append((condition, name, str(len(group)), mean, *cells))
        return Sheet(
            "Fused minus best input",
            ("condition", "world", "drives", "best input", *FUSIONS),
            tuple(rows),
            "Mean difference of the errors, and its 95 % interval by pairs; below 0 the fused map "
            "is better.",
        )

    def harmed_sheet(self) -> Sheet:
        """Return what one harmed producer costs each way to vote."""
        rows = [
            (
                condition,
                fusion,
                _mean_text(self.errors(condition, fusion)),
                _mean_text(self.errors(condition, alone(fusion))),
                f"{100.0 * (ratio - 1.0):+.1f} %",
            )
            for condition in self.conditions()
            for fusion, ratio in self.against_others(condition).items()
        ]
        return Sheet(
            "What one harmed producer costs",
            ("condition", "fusion", "all three", "the two others alone", "change"),
            tuple(rows),
            "Errors with the harmed producer among the inputs, and without it.",
        )

    def spread_sheet(self, condition: str) -> Sheet:
        """Return a row for each method: mean, deviation, intervals, median and worst."""
        rows = []
        for method in self.methods(condition):
            errors = self.errors(condition, method)
            summary, interval = Summary.of(errors), t_interval(errors)
            std = NO_TEST if summary.std is None else f"{summary.std:.2f}"
            ends = NO_TEST if interval is None else f"{interval.low:.2f} to {interval.high:.2f}"
            numbers = (f"{summary.mean:.2f}", std, ends)
            rows.append((method, *numbers, f"{summary.median:.2f}", f"{summary.worst:.2f}"))
        return Sheet(
            f"Errors, {condition}",
            ("method", "mean", "deviation", "95 % of the mean", "median", "worst"),
            tuple(rows),
        )

    def p_sheets(self, condition: str) -> list[Sheet]:
        """Return the p-values between every two methods: as [F16] tests, and by pairs."""
        pairs = {(pair.first, pair.second): pair for pair in self.pairs(condition)}
        if not pairs:
            return []
        methods = self.methods(condition)

        def sheet(title: str, note: str, values: Mapping[tuple[str, str], float]) -> Sheet:
            rows = [
                (
                    first,
                    *(
                        _p_text(values[first, second]) if (first, second) in values else ""
                        for second in methods[1:]
                    ),
                )
                for first in methods[:-1]
            ]
            return Sheet(f"{title}, {condition}", ("", *methods[1:]), tuple(rows), note)

        return [
            sheet(
                "p-values as in [F16]",
                "Pooled two-sided t-test, the drives taken for unpaired.",
                {names: pair.pooled for names, pair in pairs.items()},
            ),
            sheet(
                "p-values of pairs",
                "Paired two-sided t-test, corrected for all pairs of this table by Holm.",
                {names: pair.holm for names, pair in pairs.items()},
            ),
            sheet(
                "p-values of ranks",
                "Wilcoxon's signed-rank test of the pairs, not corrected.",
                {names: pair.paired.wilcoxon for names, pair in pairs.items()},
            ),
        ]

    def notes_sheet(self) -> Sheet:
        """Return how often a map was missing or left out, with the first reason."""
        seen: dict[tuple[str, str], list[str]] = {}
        for record in self.records:
            for method, reason in record.notes.items():
                seen.setdefault((record.condition, method), []).append(reason)
        rows = [
            (condition, method, f"{len(reasons)} of {len(self.of(condition))}", reasons[0])
            for (condition, method), reasons in seen.items()
        ]
        return Sheet(
            "What was left out",
            ("condition", "what", "drives", "first reason"),
            tuple(rows),
            "Where no two maps agree, the best founded one counts alone; a producer without a map "
            "counts as a map that knows nothing.",
        )

    def sentences(self) -> list[str]:
        """Return each way to vote against the best input, and over all conditions."""
        lines = [item.sentence() for name in self.conditions() for item in self.against_best(name)]
        for name in self.conditions():
            lines += [
                f"{name}: {fusion} {100.0 * (ratio - 1.0):+.1f} % against fusing the others alone."
                for fusion, ratio in self.against_others(name).items()
            ]
        for fusion, values in self.overall().items():
            change, worst, of_sums = (
                100.0 * (values[key] - 1.0) for key in ("ratio", "worst", "of_sums")
            )
            lines.append(
                f"all conditions: {fusion} {change:+.1f} % against the best inputs on the mean of "
                f"conditions ({of_sums:+.1f} % of the sums), {worst:+.1f} % where it stands worst."
            )
        return lines

    def sheets(self, *, details: bool) -> list[Sheet]:
        """Return the tables; ``details`` adds spread and p-values of every condition."""
        shown = (self.means_sheet(), self.intervals_sheet(), self.harmed_sheet())
        found = [sheet for sheet in shown if sheet.rows]
        for condition in self.conditions() if details else []:
            found += [self.spread_sheet(condition), *self.p_sheets(condition)]
        notes = self.notes_sheet()
        return [*found, notes] if notes.rows else found

    def to_csv(self) -> str:
        """Return every error, a line each."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(["condition", "world", "seed", "method", "error", "wall_f1"])
        for item in self.records:
            for method, error in item.errors.items():
                row = [item.condition, item.world, item.seed, method, error, item.wall_f1[method]]
                writer.writerow(row)
        return buffer.getvalue()

    def to_json(self) -> ErrorTableJson:
        """Return summaries, tests and every trial."""
        summaries: list[MethodSummaryJson] = []
        for condition in self.conditions():
            for method in self.methods(condition):
                errors = self.errors(condition, method)
                interval = t_interval(errors)
                summaries.append(
                    {
                        "condition": condition,
                        "method": method,
                        **Summary.of(errors).to_json(),
                        "interval": None if interval is None else interval.to_json(),
                    }
                )
        names = self.conditions()
        return {
            "title": self.title,
            "summaries": summaries,
            "pairs": [pair.to_json() for name in names for pair in self.pairs(name)],
            "against_best_input": [
                item.to_json() for name in names for item in self.against_best(name)
            ],
            "overall": self.overall(),
            "against_others_alone": {
                name: ratios for name in names if (ratios := self.against_others(name))
            },
            "trials": [record.to_json() for record in self.records],
        }


class Tables(Protocol):
    """What an experiment on fusion has to show: ``ErrorTable`` says what each means."""

    @property
    def title(self) -> str:
        """Of the experiment."""

    def overall(self) -> Mapping[str, RatiosJson]:
        """Return for each way to vote its error against the best inputs'."""

    def sheets(self, *, details: bool) -> list[Sheet]:
        """Return the tables."""

    def sentences(self) -> list[str]:
        """Return what they say."""

    def to_csv(self) -> str:
        """Return every number."""

    def to_json(self) -> ErrorTableJson | RealLogTableJson:
        """Return everything."""


def write_error_table(
    folder: Path, stem: str, table: Tables, document: Mapping[str, Any], *, details: bool
) -> list[Path]:
    """Write ``stem.csv``, ``.md`` and ``.json``, all or none.

    Args:
        folder: made when missing; older files of the same names are replaced.
        stem: start of the file names.
        table: the errors, an ``ErrorTable`` for one.
        document: joins the JSON document; plain values without NaN.
        details: also the p-values of every condition in the Markdown.

    Raises:
        MapFileError: a file cannot be written.
    """
    lines = [f"# {table.title}", ""]
    for sheet in table.sheets(details=details):
        lines += sheet.to_markdown()
    lines += ["## In words", "", *(f"- {sentence}" for sentence in table.sentences()), ""]
    text = json.dumps({**table.to_json(), **document}, indent=2, allow_nan=False)
    contents = {
        f"{stem}.csv": table.to_csv(),
        f"{stem}.md": "\n".join(lines),
        f"{stem}.json": f"{text}\n",
    }
    with AtomicFiles() as files:
        for name, content in contents.items():
            files.add(folder / name, content.encode())
    return [folder / name for name in contents]


def _moments(errors: Sequence[float]) -> Moments:
    summary = Summary.of(errors)
    return Moments(summary.mean, summary.std or 0.0, summary.count)


def _difference_text(errors: Sequence[float], base: Sequence[float]) -> str:
    """Return the mean difference with its interval; without one where there is a single drive."""
    mean = Summary.of(errors).mean - Summary.of(base).mean
    paired = compare_pairs(errors, base)
    if paired is None:
        return f"{mean:+.2f}"
    return f"{mean:+.2f} ({paired.interval.low:+.2f} to {paired.interval.high:+.2f})"


def _mean_text(errors: Sequence[float]) -> str:
    summary = Summary.of(errors)
    return f"{summary.mean:.2f}" + ("" if summary.std is None else f" ± {summary.std:.2f}")


def _p_text(p_value: float) -> str:
    """Return a p-value as [F16] prints them: two figures, the small ones with an exponent."""
    if p_value < 1e-9:
        return "<1e-9"
    return f"{p_value:.2f}" if p_value >= 0.1 else f"{p_value:.1e}"
