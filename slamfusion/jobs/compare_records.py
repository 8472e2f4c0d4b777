"""What ``slamfusion compare`` prints with ``--json``; the text below a key is its meaning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypedDict

from slamfusion.evaluation.records import DifferenceJson, MeasuredItemJson, PairedDifferenceJson

__all__ = ["CompareDocument", "ComparedFigureJson", "ComparedResultsJson", "ComparedSeriesJson"]


class ComparedResultsJson(TypedDict):
    """A file of saved results."""

    name: str
    """What it is called below: its file's name without the ending."""
    file: str
    """Its file."""
    command: str
    """The command that saved it."""
    version: str
    """Version of the program that saved it."""
    items: Sequence[MeasuredItemJson]
    """What was measured."""


class ComparedFigureJson(TypedDict):
    """One figure of two files of results."""

    figure: str
    """Its name."""
    first: str
    """One file."""
    second: str
    """The other."""
    items_first: int
    """Maps or paths of the first that have it; of pairs, those of which both have it."""
    items_second: int
    """The same of the second."""
    mean_first: float
    """Its mean over these, of the first."""
    mean_second: float
    """The same of the second."""
    difference: float
    """The first mean less the second."""
    paired: PairedDifferenceJson | None
    """The tests of the pairs; null for fewer than two, or where the items are not the same."""
    unpaired: DifferenceJson | None
    """The tests of two samples; null where there are pairs, or a file has fewer than two items."""
    p_value: float | None
    """Of the t-test that was made (paired, or Welch's), after Holm for more than two files."""
    better: str | None
    """The file that is better beyond chance (p below 0.05); null: neither."""


class ComparedSeriesJson(TypedDict):
    """The single errors of two paths of one case, where both have one."""

    series: str
    """Its name, which ends in the unit."""
    case: str
    """The case."""
    first: str
    """One file."""
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
    """The files in the order given."""
    figures: Sequence[ComparedFigureJson]
    """Every figure of every two files."""
    series: Sequence[ComparedSeriesJson]
    """The single errors of every two paths of one case."""
    notes: Sequence[str]
    """What was not compared, and what makes the comparison doubtful, a sentence each."""
    versions: Mapping[str, str | None]
    """Versions of Python, of this package and of those it stands on; null: not installed."""
