"""Map errors over trials: means with their intervals, and tests of every two methods."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from slamfusion.evaluation import (
    Row,
    Summary,
    compare_pairs,
    correct_by_holm,
    pooled_p_value,
    result_rows,
    t_interval,
)
from slamfusion.experiments import error_sheets, path_sheets
from slamfusion.experiments.records import (
    AgainstBestInputJson,
    ErrorTableJson,
    MethodPairJson,
    MethodSummaryJson,
    OverallRatioJson,
)
from slamfusion.experiments.sheets import Sheet
from slamfusion.experiments.trials import TrialRecord, alone
from slamfusion.experiments.voting import FUSIONS
from slamfusion.slam.registry import BUILT_IN

__all__ = ["ErrorTable"]

# What is measured of a map or a path, as its column of the CSV is called.
FIGURES = ("error", "wall_f1", "faces_f1", "ate_m")


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

    def pairs(self, condition: str) -> list[MethodPairJson]:
        """Return every two methods of a condition, tested; none for a single drive."""
        return self._tested[condition]

    @cached_property
    def _tested(self) -> dict[str, list[MethodPairJson]]:
        """The pairs of every condition: they take long, and many tables want them."""
        return {condition: self._test(condition) for condition in self.conditions()}

    def _test(self, condition: str) -> list[MethodPairJson]:
        """Test every two methods of a condition."""
        tested: list[MethodPairJson] = []
        for first, second in itertools.combinations(self.methods(condition), 2):
            a, b = self.errors(condition, first), self.errors(condition, second)
            paired = compare_pairs(a, b)
            if paired is None:
                return []
            tested.append(
                {
                    "condition": condition,
                    "methods": [first, second],
                    "p_pooled_t": pooled_p_value(_moments(a), _moments(b)),
                    "p_paired_t_holm": paired["t_test"],
                    "paired": paired,
                }
            )
        corrected = correct_by_holm([pair["p_paired_t_holm"] for pair in tested])
        for pair, p_value in zip(tested, corrected, strict=True):
            pair["p_paired_t_holm"] = p_value
        return tested

    def against_best(self, condition: str) -> list[AgainstBestInputJson]:
        """Return how every way to vote stands against the best input.

        The interval takes the best input's mean for known.
        """
        best = self.best_input(condition)
        base = Summary.of(self.errors(condition, best)).mean
        tested = {frozenset(pair["methods"]): pair for pair in self.pairs(condition)}
        found: list[AgainstBestInputJson] = []
        for fusion in FUSIONS:
            pair = tested.get(frozenset((fusion, best)))
            interval, p_value = None, None
            if pair is not None:
                low, high = pair["paired"]["interval"]
                if pair["methods"][0] != fusion:
                    low, high = -high, -low
                interval, p_value = (1.0 + low / base, 1.0 + high / base), pair["p_paired_t_holm"]
            found.append(
                {
                    "condition": condition,
                    "fusion": fusion,
                    "best_input": best,
                    "ratio": Summary.of(self.errors(condition, fusion)).mean / base,
                    "interval": interval,
                    "p_value": p_value,
                }
            )
        return found

    def overall(self) -> dict[str, OverallRatioJson]:
        """Return for each way to vote its error against the best inputs' over all conditions.

        ``ratio`` is the mean of the conditions' ratios, ``worst`` the largest of them; ``of_sums``
        is that of the sums of the mean errors, in which large places count more than small ones.
        """
        found: dict[str, OverallRatioJson] = {}
        for number, fusion in enumerate(FUSIONS):
            ratios = [self.against_best(name)[number]["ratio"] for name in self.conditions()]
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

    def borne_out(self) -> frozenset[str]:
        """Return the ways to vote that are better than the best input, by the test, everywhere."""
        compared = [against for name in self.conditions() for against in self.against_best(name)]
        unsure = {
            against["fusion"]
            for against in compared
            if against["ratio"] >= 1.0 or not error_sheets.is_sure(against["p_value"])
        }
        return frozenset(FUSIONS) - unsure

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

    def sheets(self, *, details: bool) -> list[Sheet]:
        """Return the tables; ``details`` adds spread and p-values of every condition."""
        return error_sheets.sheets(self, details=details)

    def sentences(self) -> list[str]:
        """Return each way to vote against the best input, and over all conditions."""
        return error_sheets.sentences(self)

    def to_csv(self) -> str:
        """Return every figure of a map or a path, a line each; empty: it has none."""
        import pandas as pd  # noqa: PLC0415  (an extra)

        rows = [
            (item.condition, item.world, item.seed, method, *map(figures.get, FIGURES))
            for item in self.records
            for method, figures in _figures(item).items()
        ]
        table = pd.DataFrame(rows, columns=["condition", "world", "seed", "method", *FIGURES])
        return str(table.to_csv(index=False, lineterminator="\n"))

    def figure_rows(self) -> list[Row]:
        """Return every map and path of every trial."""
        return [
            row
            for record in self.records
            for method, figures in _figures(record).items()
            for row in result_rows(
                f"{record.condition}, world {record.world}", str(record.seed), method, figures
            )
        ]

    def to_json(self) -> ErrorTableJson:
        """Return summaries, tests and every trial."""
        summaries: list[MethodSummaryJson] = []
        for condition in self.conditions():
            for method in self.methods(condition):
                errors = self.errors(condition, method)
                summaries.append(
                    {
                        "condition": condition,
                        "method": method,
                        **Summary.of(errors).to_json(),
                        "interval": t_interval(errors),
                    }
                )
        names = self.conditions()
        return {
            "title": self.title,
            "summaries": summaries,
            "pairs": [pair for name in names for pair in self.pairs(name)],
            "against_best_input": [item for name in names for item in self.against_best(name)],
            "overall": self.overall(),
            "against_others_alone": {
                name: ratios for name in names if (ratios := self.against_others(name))
            },
            "paths_and_faces": path_sheets.measure_pairs(self),
            "trials": [record.to_json() for record in self.records],
        }


def _figures(record: TrialRecord) -> dict[str, dict[str, float]]:
    """Return what was measured of each map and path, of ``FIGURES`` those that it has."""
    parts = (record.errors, record.wall_f1, record.faces_f1, record.ate_m)
    return {
        method: {
            name: part[method] for name, part in zip(FIGURES, parts, strict=True) if method in part
        }
        for method in dict.fromkeys((*record.errors, *record.ate_m))
    }


def _moments(errors: Sequence[float]) -> tuple[float, float, int]:
    summary = Summary.of(errors)
    return summary.mean, summary.std or 0.0, summary.count
