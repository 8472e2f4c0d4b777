"""Repeated experiments: conditions times seeds, every single run kept, and tables of them.

A condition is one level of each factor, e.g. a drive, a cell size and a method. The last factor is
the one that is compared: tables have a column for each of its levels, and p-values between them.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamfusion.evaluation import Row, Summary, compare_samples, result_rows
from slamfusion.experiments.records import ComparisonJson, RepeatedRunsJson
from slamfusion.io import AtomicFiles
from slamfusion.jobs.documents import p_text

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Level", "Results", "markdown_table", "measure_label", "repeat", "write_results"]

Level = str | float
Progress = Callable[[str, int, int], None]

# Decimals of a measure, by the unit that its name ends in.
DIGITS = {"m": 4, "deg": 3, "ms": 2}


@dataclass(frozen=True, eq=False)
class Results:
    """All runs of an experiment.

    Attributes:
        title: of its tables.
        factors: names of the factors; the last one is compared.
        runs: a row for each run: a level of each factor, the seed, and what was measured (NaN where
            it was not); the names of measures end in the unit.
        planned: how many runs there are to be.
    """

    title: str
    factors: tuple[str, ...]
    runs: pd.DataFrame
    planned: int

    @property
    def is_complete(self) -> bool:
        """Whether every planned run was made."""
        return len(self.runs) == self.planned

    def levels(self, factor: int) -> list[Level]:
        """Return the levels of a factor (by its number, from 0) in order."""
        return list(self.runs[self.factors[factor]].unique())

    def groups(self) -> list[tuple[Level, ...]]:
        """Return the conditions without the factor that is compared, in order."""
        return self._distinct(self.factors[:-1])

    def measures(self) -> list[str]:
        """Return the names of what was measured: in order, but errors before times."""
        names = [name for name in self.runs.columns if name not in {*self.factors, "seed"}]
        return sorted(names, key=lambda name: name.endswith("_ms"))

    def values(self, levels: tuple[Level, ...], measure: str) -> list[float]:
        """Return a measure of every run of a condition; empty where it was not measured."""
        if measure not in self.runs:
            return []
        is_own = (self.runs[list(self.factors)] == list(levels)).all(axis="columns")
        values = self.runs.loc[is_own, measure].dropna()
        return [float(value) for value in values]

    def summary(self, levels: tuple[Level, ...], measure: str) -> Summary | None:
        """Return mean, deviation and worst of a condition; None where there is no value."""
        values = self.values(levels, measure)
        return Summary.of(values) if values else None

    def comparisons(self, measure: str) -> list[ComparisonJson]:
        """Return every two methods under each group that has values of both."""
        found: list[ComparisonJson] = []
        for group in self.groups():
            for pair in itertools.combinations(self.levels(-1), 2):
                first, second = (self.values((*group, method), measure) for method in pair)
                if first and second:
                    found.append(
                        {
                            "levels": list(group),
                            "methods": list(pair),
                            "measure": measure,
                            "means": [Summary.of(own).mean for own in (first, second)],
                            "p_values": compare_samples(first, second),
                        }
                    )
        return found

    def _distinct(self, names: Sequence[str]) -> list[tuple[Level, ...]]:
        """Return the distinct rows of some columns, in order."""
        rows = self.runs[list(names)].drop_duplicates()
        return list(rows.itertuples(index=False, name=None))

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
        compared = {
            (*item["levels"], *item["methods"]): item["p_values"]
            for item in self.comparisons(measure)
        }
        rows = []
        for group in self.groups():
            summaries = [self.summary((*group, method), measure) for method in methods]
            if not any(summaries):
                continue
            counts = sorted({item.count for item in summaries if item is not None})
            row = [*(_shown(level) for level in group), " to ".join(map(str, counts))]
            for summary in summaries:
                row += _cells(summary, measure)
            tests = [compared.get((*group, *pair)) for pair in pairs]
            row += [p_text(None if test is None else test["welch"]) for test in tests]
            rows.append(row)
        return heading, rows

    def figure_rows(self) -> list[Row]:
        """Return every single run as a method in a case (its other levels), with its seed."""
        return [
            row
            for run in self._records()
            for row in result_rows(
                ", ".join(_shown(run[name]) for name in self.factors[:-1]),
                str(run["seed"]),
                _shown(run[self.factors[-1]]),
                {name: run[name] for name in self.measures() if name in run},
            )
        ]

    def _records(self) -> list[dict[str, Any]]:
        """Return every single run by name, without what was not measured."""
        return [
            {name: value for name, value in run.items() if value == value}  # noqa: PLR0124  NaN
            for run in self.runs.to_dict("records")
        ]

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
                for levels in self._distinct(self.factors)
            ],
            "comparisons": [item for measure in measures for item in self.comparisons(measure)],
            "runs": self._records(),
        }


def repeat(
    title: str,
    factors: tuple[str, ...],
    conditions: Sequence[tuple[Level, ...]],
    seeds: Sequence[int],
    once: Callable[[tuple[Level, ...], int], Mapping[str, float]],
    *,
    keep: Callable[[Results], None] | None = None,
    progress: Progress | None = None,
) -> Results:
    """Run every condition with every seed, one after the other.

    Args:
        title, factors: see ``Results``.
        conditions: a level of each factor.
        seeds: of each condition's runs.
        once: makes one run of a condition with a seed, and returns what it measured.
        keep: receives the results so far after each condition, to save them from an interruption.
        progress: told the runs that are done.

    Returns:
        The results of all runs.
    """
    import pandas as pd  # noqa: PLC0415  (an extra)

    total = len(conditions) * len(seeds)
    results = Results(title, factors, pd.DataFrame(columns=[*factors, "seed"]), total)
    rows: list[dict[str, Any]] = []
    for levels in conditions:
        for seed in seeds:
            if progress is not None:
                progress("runs", len(rows), total)
            row = {**dict(zip(factors, levels, strict=True)), "seed": seed}
            rows.append(row | dict(once(levels, seed)))
        results = replace(results, runs=pd.DataFrame(rows))
        if keep is not None:
            keep(results)
    if progress is not None:
        progress("runs", len(rows), total)
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
        f"{stem}.csv": results.runs.to_csv(index=False, lineterminator="\n").encode(),
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
