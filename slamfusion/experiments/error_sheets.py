"""What an ``ErrorTable`` shows: tables of texts, and sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from slamfusion.evaluation import Summary, compare_pairs, t_interval
from slamfusion.experiments import path_sheets
from slamfusion.experiments.records import AgainstBestInputJson
from slamfusion.experiments.sheets import Sheet
from slamfusion.experiments.trials import alone
from slamfusion.experiments.voting import FUSIONS
from slamfusion.jobs.documents import p_text

if TYPE_CHECKING:
    from slamfusion.experiments.error_table import ErrorTable

__all__ = [
    "harmed_sheet",
    "intervals_sheet",
    "is_sure",
    "means_sheet",
    "notes_sheet",
    "p_sheets",
    "sentences",
    "sheets",
    "spread_sheet",
]

NO_TEST = "-"
# A difference with a smaller p-value counts as one.
SIGNIFICANT = 0.05


def means_sheet(table: ErrorTable) -> Sheet:
    """Return a row for each condition and a column for each method."""
    methods = table.methods()
    rows = []
    for condition in table.conditions():
        best = table.best_input(condition)
        cells = [_mean_text(table.errors(condition, method)) for method in methods]
        smallest = Summary.of(table.errors(condition, best)).mean
        ratios = {item["fusion"]: item["ratio"] for item in table.against_best(condition)}
        chosen = min(ratios, key=ratios.__getitem__)
        change = f"{chosen} {100.0 * (ratios[chosen] - 1.0):+.1f} %"
        count = str(len(table.of(condition)))
        rows.append((condition, count, *cells, f"{best} {smallest:.2f}", change))
    return Sheet(
        "Errors of the maps",
        ("condition", "drives", *methods, "best input", "best fusion against it"),
        tuple(rows),
        "[F16] error against the truth, mean ± sample deviation; smaller is better.",
    )


def intervals_sheet(table: ErrorTable) -> Sheet:
    """Return fused minus best input with its interval: of each world, and of all together."""
    rows = []
    for condition in table.conditions():
        records = table.of(condition)
        worlds = list(dict.fromkeys(record.world for record in records))
        groups = [
            (str(world), [record for record in records if record.world == world])
            for world in worlds
        ]
        if len(worlds) > 1:
            groups.append(("all", records))
        for name, group in groups:
            part = replace(table, records=tuple(group))
            best = part.best_input(condition)
            base = part.errors(condition, best)
            cells = [_difference_text(part.errors(condition, fusion), base) for fusion in FUSIONS]
            mean = f"{best} {Summary.of(base).mean:.2f}"
            rows.append((condition, name, str(len(group)), mean, *cells))
    return Sheet(
        "Fused minus best input",
        ("condition", "world", "drives", "best input", *FUSIONS),
        tuple(rows),
        "Mean difference of the errors, and its 95 % interval by pairs; below 0 the fused map "
        "is better.",
    )


def harmed_sheet(table: ErrorTable) -> Sheet:
    """Return what one harmed producer costs each way to vote."""
    rows = [
        (
            condition,
            fusion,
            _mean_text(table.errors(condition, fusion)),
            _mean_text(table.errors(condition, alone(fusion))),
            f"{100.0 * (ratio - 1.0):+.1f} %",
        )
        for condition in table.conditions()
        for fusion, ratio in table.against_others(condition).items()
    ]
    return Sheet(
        "What one harmed producer costs",
        ("condition", "fusion", "all three", "the two others alone", "change"),
        tuple(rows),
        "Errors with the harmed producer among the inputs, and without it.",
    )


def spread_sheet(table: ErrorTable, condition: str) -> Sheet:
    """Return a row for each method: mean, deviation, intervals, median and worst."""
    rows = []
    for method in table.methods(condition):
        errors = table.errors(condition, method)
        summary, interval = Summary.of(errors), t_interval(errors)
        std = NO_TEST if summary.std is None else f"{summary.std:.2f}"
        ends = NO_TEST if interval is None else f"{interval[0]:.2f} to {interval[1]:.2f}"
        numbers = (f"{summary.mean:.2f}", std, ends)
        rows.append((method, *numbers, f"{summary.median:.2f}", f"{summary.worst:.2f}"))
    return Sheet(
        f"Errors, {condition}",
        ("method", "mean", "deviation", "95 % of the mean", "median", "worst"),
        tuple(rows),
    )


def p_sheets(table: ErrorTable, condition: str) -> list[Sheet]:
    """Return the p-values between every two methods: as [F16] tests, and by pairs."""
    pairs = {tuple(pair["methods"]): pair for pair in table.pairs(condition)}
    if not pairs:
        return []
    methods = table.methods(condition)

    def sheet(title: str, note: str, values: Mapping[tuple[str, ...], float]) -> Sheet:
        rows = [
            (
                first,
                *(
                    p_text(values[first, second]) if (first, second) in values else ""
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
            {names: pair["p_pooled_t"] for names, pair in pairs.items()},
        ),
        sheet(
            "p-values of pairs",
            "Paired two-sided t-test, corrected for all pairs of this table by Holm.",
            {names: pair["p_paired_t_holm"] for names, pair in pairs.items()},
        ),
        sheet(
            "p-values of ranks",
            "Wilcoxon's signed-rank test of the pairs, not corrected.",
            {names: pair["paired"]["wilcoxon"] for names, pair in pairs.items()},
        ),
    ]


def notes_sheet(table: ErrorTable) -> Sheet:
    """Return how often a map was missing or left out, with the first reason."""
    seen: dict[tuple[str, str], list[str]] = {}
    for record in table.records:
        for method, reason in record.notes.items():
            seen.setdefault((record.condition, method), []).append(reason)
    rows = [
        (condition, method, f"{len(reasons)} of {len(table.of(condition))}", reasons[0])
        for (condition, method), reasons in seen.items()
    ]
    return Sheet(
        "What was left out",
        ("condition", "what", "drives", "first reason"),
        tuple(rows),
        "Where no two maps agree, the fallback map counts alone; a producer without a map "
        "counts as a map that knows nothing.",
    )


def sentences(table: ErrorTable) -> list[str]:
    """Return each way to vote against the best input, and over all conditions."""
    lines = [
        _against_best(item) for name in table.conditions() for item in table.against_best(name)
    ]
    for name in table.conditions():
        lines += [
            f"{name}: {fusion} {100.0 * (ratio - 1.0):+.1f} % against fusing the others alone."
            for fusion, ratio in table.against_others(name).items()
        ]
    for fusion, values in table.overall().items():
        change, worst, of_sums = (
            100.0 * (values[key] - 1.0) for key in ("ratio", "worst", "of_sums")
        )
        lines.append(
            f"all conditions: {fusion} {change:+.1f} % against the best inputs on the mean of "
            f"conditions ({of_sums:+.1f} % of the sums), {worst:+.1f} % where it stands worst."
        )
    return lines


def is_sure(p_value: float | None) -> bool:
    """Return whether a difference was tested, and is hardly chance."""
    return p_value is not None and p_value < SIGNIFICANT


def _against_best(item: AgainstBestInputJson) -> str:
    """Say whether a fusion is better than the best input."""
    percent = 100.0 * (item["ratio"] - 1.0)
    where = f"{item['condition']}: {item['fusion']} is {abs(percent):.1f} %"
    where += f" {'below' if percent < 0.0 else 'above'} {item['best_input']}, the best input"
    if item["interval"] is None:
        return f"{where} (a single drive: nothing can be tested)."
    low, high = (100.0 * (end - 1.0) for end in item["interval"])
    doubt = "" if is_sure(item["p_value"]) else "; may be chance"
    return (
        f"{where} (95 % interval {low:+.1f} to {high:+.1f} %, "
        f"p {p_text(item['p_value'])} after Holm{doubt})."
    )


def sheets(table: ErrorTable, *, details: bool) -> list[Sheet]:
    """Return the tables; ``details`` adds spread and p-values of every condition."""
    shown = (means_sheet(table), intervals_sheet(table), harmed_sheet(table))
    found = [sheet for sheet in shown if sheet.rows] + path_sheets.sheets(table)
    for condition in table.conditions() if details else []:
        found += [spread_sheet(table, condition), *p_sheets(table, condition)]
    notes = notes_sheet(table)
    return [*found, notes] if notes.rows else found


def _difference_text(errors: Sequence[float], base: Sequence[float]) -> str:
    """Return the mean difference with its interval; without one where there is a single drive."""
    mean = Summary.of(errors).mean - Summary.of(base).mean
    paired = compare_pairs(errors, base)
    if paired is None:
        return f"{mean:+.2f}"
    low, high = paired["interval"]
    return f"{mean:+.2f} ({low:+.2f} to {high:+.2f})"


def _mean_text(errors: Sequence[float]) -> str:
    summary = Summary.of(errors)
    return f"{summary.mean:.2f}" + ("" if summary.std is None else f" ± {summary.std:.2f}")
