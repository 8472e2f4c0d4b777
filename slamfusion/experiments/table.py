"""Repeated experiments: conditions times seeds, every single run kept, and tables of them.

A condition is one level of each factor, e.g. a drive, a cell size and a method. The last factor is
the one that is compared: tables have a column for each of its levels, and p-values between them.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from slamfusion.evaluation import Difference, MeasuredItem, Summary, compare_samples
from slamfusion.experiments.records import ComparisonJson, RepeatedRunsJson
from slamfusion.io import AtomicFiles

__all__ = [
    "Comparison",
    "Level",
    "Results",
    "Run",
    "markdown_table",
    "measure_label",
    "p_text",
    "repeat",
    "write_results",
]

Level = str | float
Progress = Callable[[str, int, int], None]

# Decimals of a measure, by the unit that its name ends in.
DIGITS = {"m": 4, "deg": 3, "ms": 2}


@dataclass(frozen=True)
class Run:
    """One run.

    Attributes:
        levels: the condition: a level of each factor.
        seed: of the run.
        values: what was measured, by name; the name ends in the unit.
    """

    levels: tuple[Level, ...]
    seed: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class Comparison:
    """Two methods under the same other levels.

    Attributes:
        levels: of every factor but the last.
        methods: both levels of the last factor.
        measure: what is compared.
        first: summary of the first method; smaller is better.
        second: summary of the second.
        difference: p-values; None where a method has a single run.
    """

    levels: tuple[Level, ...]
    methods: tuple[Level, Level]
    measure: str
    first: Summary
    second: Summary
    difference: Difference | None

    def to_json(self) -> ComparisonJson:
        """Return the comparison for a JSON document."""
        return {
            "levels": list(self.levels),
            "methods": list(self.methods),
            "measure": self.measure,
            "means": [self.first.mean, self.second.mean],
            "p_values": None if self.difference is None else self.difference.to_json(),
        }


@dataclass(frozen=True)
class Results:
    """All runs of an experiment.

    Attributes:
        title: of its tables.
        factors: names of the factors; the last one is compared.
        runs: in the order in which they were made.
        planned: how many runs there are to be.
    """

    title: str
    factors: tuple[str, ...]
    runs: tuple[Run, ...]
    planned: int

    @property
    def is_complete(self) -> bool:
        """Whether every planned run was made."""
        return len(self.runs) == self.planned

    def levels(self, factor: int) -> list[Level]:
        """Return the levels of a factor (by its number, from 0) in order."""
        return list(dict.fromkeys(run.levels[factor] for run in self.runs))

    def conditions(self) -> list[tuple[Level, ...]]:
        """Return the conditions that have a run, in order."""
        return list(dict.fromkeys(run.levels for run in self.runs))

    def groups(self) -> list[tuple[Level, ...]]:
        """Return the conditions without the factor that is compared, in order."""
        return list(dict.fromkeys(run.levels[:-1] for run in self.runs))

    def measures(self) -> list[str]:
        """Return the names of what was measured: in order, but errors before times."""
        names = dict.fromkeys(name for run in self.runs for name in run.values)
        return sorted(names, key=lambda name: name.endswith("_ms"))

    def values(self, levels: tuple[Level, ...], measure: str) -> list[float]:
        """Return a measure of every run of a condition; empty where it was not measured."""
        return [
            run.values[measure]
            for run in self.runs
            if run.levels == levels and measure in run.values
        ]

    def summary(self, levels: tuple[Level, ...], measure: str) -> Summary | None:
        """Return mean, deviation and worst of a condition; None where there is no value."""
        values = self.values(levels, measure)
        return Summary.of(values) if values else None

    def comparisons(self, measure: str) -> list[Comparison]:
        """Return every two methods under each group that has values of both."""
        found = []
        for group in self.groups():
            for pair in itertools.combinations(self.levels(-1), 2):
                first, second = (self.values((*group, method), measure) for method in pair)
                if first and second:
                    found.append(
                        Comparison(
                            group,
                            pair,
                            measure,
                            Summary.of(first),
                            Summary.of(second),
                            compare_samples(first, second),
                        )
                    )
        return found

    def rows(self, measure: str) -> tuple[list[str], list[list[str]]]:
        """Return a measure as a table: heading, and a row a group.

        Of each method mean and sample deviation, and the worst run; then for every two methods the
        p-value of Welch's t-test.
        """
        methods = self.levels(-1)
        pairs = list(itertools.combinations(methods, 2))
        heading = [*self.factors[:-1], "runs"]
        for method in methods:
            heading += [str(method), "worst"]
        heading += [f"p {a} / {b}" if len(pairs) > 1 else "p" for a, b in pairs]
        compared = {(item.levels, item.methods): item for item in self.comparisons(measure)}
        rows = []
        for group in self.groups():
            summaries = [self.summary((*group, method), measure) for method in methods]
            if not any(summaries):
                continue
            counts = sorted({item.count for item in summaries if item is not None})
            row = [*(_shown(level) for level in group), " to ".join(map(str, counts))]
            for summary in summaries:
                row += _cells(summary, measure)
            row += [_p_cell(compared.get((group, pair))) for pair in pairs]
            rows.append(row)
        return heading, rows

    def items(self) -> list[MeasuredItem]:
        """Return every single run as a method in a case: of its other levels, and its seed."""
        return [
            MeasuredItem(
                ", ".join([*map(_shown, run.levels[:-1]), f"seed {run.seed}"]),
                _shown(run.levels[-1]),
                run.values,
            )
            for run in self.runs
        ]

    def to_csv(self) -> str:
        """Return every single run, a line each; a measure that a run lacks is empty."""
        measures = self.measures()
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow([*self.factors, "seed", *measures])
        for run in self.runs:
            writer.writerow(
                [*run.levels, run.seed, *(run.values.get(name, "") for name in measures)]
            )
        return buffer.getvalue()

    def to_markdown(self) -> str:
        """Return the tables of all measures."""
        lines = [f"# {self.title}", ""]
        if not self.is_complete:
            lines += [f"**Unfinished**: {len(self.runs)} of {self.planned} runs.", ""]
        for measure in self.measures():
            heading, rows = self.rows(measure)
            lines += [
                f"## {measure_label(measure)}",
                "",
                "Mean ± sample deviation, worst run; p of Welch's t-test.",
                "",
                *markdown_table(heading, rows),
                "",
            ]
        return "\n".join(lines)

    def to_json(self) -> RepeatedRunsJson:
        """Return conditions with their summaries, comparisons, and every run."""
        measures = self.measures()
        return {
            "title": self.title,
            "complete": self.is_complete,
            "runs_made": len(self.runs),
            "runs_planned": self.planned,
            "factors": list(self.factors),
            "conditions": [
                {
                    **dict(zip(self.factors, levels, strict=True)),
                    **{
                        measure: summary.to_json()
                        for measure in measures
                        if (summary := self.summary(levels, measure)) is not None
                    },
                }
                for levels in self.conditions()
            ],
            "comparisons": [
                item.to_json() for measure in measures for item in self.comparisons(measure)
            ],
            "runs": [
                {
                    **dict(zip(self.factors, run.levels, strict=True)),
                    "seed": run.seed,
                    **run.values,
                }
                for run in self.runs
            ],
        }


def repeat(
    plan: Results,
    conditions: Sequence[tuple[Level, ...]],
    seeds: Sequence[int],
    once: Callable[[tuple[Level, ...], int], Mapping[str, float]],
    *,
    keep: Callable[[Results], None] | None = None,
    progress: Progress | None = None,
) -> Results:
    """Run every condition with every seed, one after the other.

    Args:
        plan: title and factors; its runs come first.
        conditions: a level of each factor.
        seeds: of each condition's runs.
        once: makes one run of a condition with a seed, and returns what it measured.
        keep: given the results so far after each condition, to save them from an interruption.
        progress: told the runs that are done.

    Returns:
        The results of all runs.
    """
    total = len(conditions) * len(seeds)
    results = replace(plan, planned=len(plan.runs) + total)
    done = 0
    for levels in conditions:
        for seed in seeds:
            if progress is not None:
                progress("runs", done, total)
            run = Run(levels, seed, dict(once(levels, seed)))
            results = replace(results, runs=(*results.runs, run))
            done += 1
        if keep is not None:
            keep(results)
    if progress is not None:
        progress("runs", done, total)
    return results


def write_results(
    folder: str | Path,
    stem: str,
    results: Results,
    *,
    text: str = "",
    document: Mapping[str, Any] | None = None,
    pictures: Mapping[str, bytes] | None = None,
) -> list[Path]:
    """Write ``stem.csv``, ``.md`` and ``.json`` and the pictures, all or none.

    Args:
        folder: made when missing; older files of the same names are replaced.
        stem: start of the file names.
        results: what was run so far.
        text: Markdown that follows the tables: what they say in words.
        document: joins the JSON document; plain values without NaN.
        pictures: files by name; of each one the PNG is shown in the Markdown.

    Returns:
        The files.

    Raises:
        MapFileError: a file cannot be written.
    """
    folder = Path(folder)
    shown = "".join(f"\n![{name}]({name})\n" for name in pictures or {} if name.endswith(".png"))
    markdown = results.to_markdown() + (f"\n{text}\n" if text else "") + shown
    json_text = json.dumps({**results.to_json(), **(document or {})}, indent=2, allow_nan=False)
    contents = {
        f"{stem}.csv": results.to_csv().encode(),
        f"{stem}.md": markdown.encode(),
        f"{stem}.json": f"{json_text}\n".encode(),
        **(pictures or {}),
    }
    with AtomicFiles() as files:
        for name, data in contents.items():
            files.add(folder / name, data)
    return [folder / name for name in contents]


def measure_label(measure: str) -> str:
    """Return a measure's name in words, its unit after them."""
    words, _, unit = measure.rpartition("_")
    return f"{words.replace('_', ' ')} in {unit}"


def markdown_table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table; text to the left, numbers to the right."""
    texts = [all(not _is_number(row[index]) for row in rows) for index in range(len(heading))]
    rule = ["---" if is_text else "---:" for is_text in texts]
    lines = [heading, rule, *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]


def _is_number(cell: str) -> bool:
    return cell[:1].isdigit() or cell[:1] in {"-", "<"}


def _shown(level: Level) -> str:
    return level if isinstance(level, str) else f"{level:g}"


def _cells(summary: Summary | None, measure: str) -> list[str]:
    """Return mean with deviation, and the worst."""
    if summary is None:
        return ["-", "-"]
    digits = DIGITS.get(measure.rsplit("_", 1)[-1], 3)
    spread = "" if summary.std is None else f" ± {summary.std:.{digits}f}"
    return [f"{summary.mean:.{digits}f}{spread}", f"{summary.worst:.{digits}f}"]


def _p_cell(comparison: Comparison | None) -> str:
    if comparison is None or comparison.difference is None:
        return "-"
    return p_text(comparison.difference.welch)


def p_text(p_value: float) -> str:
    """Return a p-value with three decimals; what is smaller is said to be."""
    return "<0.001" if p_value < 0.001 else f"{p_value:.3f}"
