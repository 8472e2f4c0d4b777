"""Tables of paths and of walls' faces: what is the path's, and what is the vote's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from slamfusion.evaluation import compare_pairs, correct_by_holm
from slamfusion.experiments.drive_paths import CHOICE, DRAWN, FUSED_PATH, drawn_at
from slamfusion.experiments.records import MeasurePairJson
from slamfusion.experiments.sheets import Sheet
from slamfusion.jobs.defaults import RUN_VOTE
from slamfusion.jobs.documents import p_text
from slamfusion.slam.registry import BUILT_IN

if TYPE_CHECKING:
    from slamfusion.experiments.error_table import ErrorTable
    from slamfusion.experiments.trials import TrialRecord

__all__ = ["measure_pairs", "sheets"]

Measure = Literal["ate_m", "faces_f1"]
# Of each drive the best producer, known only afterwards.
HINDSIGHT = "best in hindsight"
NO_NUMBER = "-"


@dataclass(frozen=True)
class _Kind:
    """What a table is about.

    Attributes:
        measure: name of the figure in a trial's record.
        title, note: of the table.
        form: of a number.
        best: the better of several numbers.
    """

    measure: Measure
    title: str
    note: str
    form: str
    best: Callable[[Sequence[float]], float]

    def values(self, record: TrialRecord) -> dict[str, float]:
        """Return the figures of a trial by method, the choice and the best in hindsight too."""
        known: Mapping[str, float] = getattr(record, self.measure)
        found = dict(known)
        if record.choice in known:
            found[CHOICE] = known[record.choice]
        own = [known[name] for name in BUILT_IN if name in known]
        if own:
            found[HINDSIGHT] = self.best(own)
        drawn = [known[drawn_at(name)] for name in BUILT_IN if drawn_at(name) in known]
        if drawn:
            found[drawn_at(HINDSIGHT)] = self.best(drawn)
        return found


PATHS = _Kind(
    "ate_m",
    "Paths",
    "Absolute error of the path (ATE), mean, m; less is better. The evidence choice is the "
    "producer whose path is nearest to the fused one, where the scans do not contradict that.",
    "{:.3f}",
    min,
)
FACES = _Kind(
    "faces_f1",
    "Faces of the walls",
    "F1 of wall cells beside free ones within 0.1 m of the true ones, mean; more is better, and "
    "thickness counts for nothing. A producer's map that is drawn has its own path and the sensor "
    "model of the drawn map: what that map gains over it is the fused path's.",
    "{:.3f}",
    max,
)


def measure_pairs(table: ErrorTable) -> list[MeasurePairJson]:
    """Return the fused path and the fused map against all others, tested."""
    return _pairs(table, PATHS) + _pairs(table, FACES)


def sheets(table: ErrorTable) -> list[Sheet]:
    """Return the tables of what the records hold: paths and faces."""
    found = [_sheet(table, kind) for kind in (PATHS, FACES)]
    return [sheet for sheet in found if sheet.rows]


def _ours(kind: _Kind, methods: Sequence[str]) -> str:
    """Return what is held against the others: the fused path, the drawn map, or else the vote."""
    if kind is PATHS:
        return FUSED_PATH
    return DRAWN if DRAWN in methods else RUN_VOTE


def _methods(table: ErrorTable, kind: _Kind) -> list[str]:
    """Return the columns of a table, in order: those that some drive has."""
    wanted = (
        *BUILT_IN,
        CHOICE,
        HINDSIGHT,
        RUN_VOTE,
        *map(drawn_at, BUILT_IN),
        drawn_at(HINDSIGHT),
        DRAWN,
        FUSED_PATH,
    )
    known = {name for record in table.records for name in kind.values(record)}
    return [name for name in wanted if name in known]


def _pairs(table: ErrorTable, kind: _Kind) -> list[MeasurePairJson]:
    methods = _methods(table, kind)
    ours = _ours(kind, methods)
    found: list[MeasurePairJson] = []
    for condition in table.conditions() if ours in methods else []:
        values = [kind.values(record) for record in table.of(condition)]
        part: list[MeasurePairJson] = []
        for against in methods:
            both = [item for item in values if ours in item and against in item]
            if against == ours or not both:
                continue
            a, b = ([item[name] for item in both] for name in (ours, against))
            tested = compare_pairs(a, b)
            part.append(
                {
                    "condition": condition,
                    "measure": kind.measure,
                    "method": ours,
                    "against": against,
                    "drives": len(both),
                    "mean": float(np.mean(a)),
                    "against_mean": float(np.mean(b)),
                    "p_paired_t_holm": None if tested is None else tested["t_test"],
                    "p_wilcoxon": None if tested is None else tested["wilcoxon"],
                }
            )
        given = [pair["p_paired_t_holm"] for pair in part]
        corrected = iter(correct_by_holm([value for value in given if value is not None]))
        for pair in part:
            if pair["p_paired_t_holm"] is not None:
                pair["p_paired_t_holm"] = next(corrected)
        found += part
    return found


def _sheet(table: ErrorTable, kind: _Kind) -> Sheet:
    """Return a row of means for each condition, and below it the p-values against each."""
    methods = _methods(table, kind)
    ours = _ours(kind, methods)
    tested = {(pair["condition"], pair["against"]): pair for pair in _pairs(table, kind)}
    rows = []
    for condition in table.conditions() if methods else []:
        values = [kind.values(record) for record in table.of(condition)]
        cells, tests = [], []
        for name in methods:
            own = [item[name] for item in values if name in item]
            cells.append(kind.form.format(float(np.mean(own))) if own else NO_NUMBER)
            pair = tested.get((condition, name))
            p_value = None if pair is None else pair["p_paired_t_holm"]
            tests.append("" if p_value is None else f"p {p_text(p_value)}")
        rows.append((condition, str(len(values)), *cells))
        if any(tests):
            rows.append((f"{ours} against it", "", *tests))
    note = f"{kind.note} p: paired two-sided t-test of {ours} against it, after Holm."
    return Sheet(kind.title, ("condition", "drives", *methods), tuple(rows), note)
