"""Tables of several maps or paths with their means, and ``--save-results``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from slamfusion.cli.options import output_option
from slamfusion.cli.output import Settings, notice, number, print_table

if TYPE_CHECKING:
    import pandas as pd

    from slamfusion.evaluation import MeasuredItem

__all__ = ["print_by_case", "print_items", "print_repetitions", "results_option", "save_results"]

F = TypeVar("F", bound=Callable[..., Any])

SUFFIX = ".zip"


def results_option(function: F) -> F:
    """Give a command ``--save-results``, which it then hands to ``save_results``."""
    option = output_option(
        "--save-results",
        "results_path",
        metavar="FILE.zip",
        help="Save what was measured, its settings and the inputs' SHA-256, for slamfusion "
        "compare.",
    )

    @functools.wraps(function)
    def wrapper(*arguments: Any, results_path: Path | None, **given: Any) -> Any:
        if results_path is not None:
            if results_path.suffix.lower() != SUFFIX:
                message = f"{results_path}: wanted a name that ends in {SUFFIX}"
                raise click.BadParameter(message, param_hint="'--save-results'")
            import slamfusion.jobs.results  # noqa: F401, PLC0415  (says what to install)
        return function(*arguments, results_path=results_path, **given)

    return option(wrapper)  # type: ignore[return-value]


def save_results(
    path: Path | None,
    document: Mapping[str, Any],
    items: Callable[[], Sequence[MeasuredItem]],
    inputs: Callable[[], Sequence[tuple[str, str, Path]]] = list,
) -> None:
    """Write what the running command measured, where it was asked for.

    Args:
        path: as ``--save-results`` has it; None: it was not asked for.
        document: what the command prints with ``--json``.
        items: returns what was measured.
        inputs: returns role, case and path of the files that it rests on.
    """
    if path is None:
        return
    from slamfusion.jobs.results import write_results_file  # noqa: PLC0415  (loads slowly)

    context = click.get_current_context()
    words = context.command_path.split()[1:]
    write_results_file(
        path,
        command=" ".join(words),
        arguments=context.ensure_object(Settings).arguments,
        document=document,
        items=items(),
        inputs=inputs(),
    )


def print_items(items: Sequence[MeasuredItem], what: str, leading: Sequence[str]) -> None:
    """Print a row of figures for each item, the means, and the leading figures case by case.

    Args:
        items: at least one.
        what: one of them is, a map or a path.
        leading: names of figures that get a table of their own: a row a method, a column a case.
    """
    from slamfusion.jobs.results import item_table, means_of  # noqa: PLC0415  (loads slowly)

    table = item_table(items)
    by_case = means_of(table, ["case", "method"]).reset_index()
    means = means_of(by_case, ["method"]).reset_index()
    cases = means["method"].map(by_case.groupby("method").size())
    means["case"] = "mean of " + cases.astype(str)
    count = f"{len(items)} {what}s in {table['case'].nunique()} cases"
    rows = [table, *_repetitions(table), means[cases > 1]]
    _print_figures(rows, what, count)
    print_by_case(table, what, leading)
    if len(set(table.groupby("method")["case"].agg(frozenset))) > 1:
        notice("means are of different cases: not every method has a result in each of them")


def print_repetitions(items: Sequence[MeasuredItem], what: str) -> None:
    """Print mean and deviation over the seeds of each method, where there are several."""
    if any(item.seed for item in items):
        from slamfusion.jobs.results import item_table  # noqa: PLC0415  (loads slowly)

        rows = _repetitions(item_table(items))
        if len(rows[0]):
            _print_figures(rows, what, "Mean and sample deviation over the seeds")


def _repetitions(table: pd.DataFrame) -> list[pd.DataFrame]:
    """Return means and deviations over the seeds of each case and method that has several."""
    from slamfusion.jobs.results import means_of  # noqa: PLC0415  (loads slowly)

    keys = ["case", "method"]
    found = []
    for how in ("mean", "std"):
        rows = means_of(table, keys, how)
        runs = table.groupby(keys, sort=False).size()
        rows.insert(0, "seed", f"{how} of " + runs.astype(str))
        found.append(rows[runs > 1].reset_index())
    return found


def _print_figures(tables: Sequence[pd.DataFrame], what: str, title: str) -> None:
    """Print the figures of rows; the seed only where there is one."""
    import pandas as pd  # noqa: PLC0415  (an extra)

    from slamfusion.evaluation import figure_of  # noqa: PLC0415  (loads slowly)
    from slamfusion.jobs.results import figures_of  # noqa: PLC0415  (loads slowly)

    table = pd.concat([own for own in tables if len(own)]).fillna({"seed": ""})
    names = ["case", *(["seed"] if table["seed"].any() else []), "method"]
    figures = [name for name in figures_of(table) if name in tables[0]]
    rows = [
        [
            *(row[name] for name in names),
            *(number(row[name], figure_of(name).digits) for name in figures),
        ]
        for row in table.to_dict("records")
    ]
    heads = {"case": "case ", "seed": "seed ", "method": f"{what} "}
    columns = (*(heads[name] for name in names), *(figure_of(name).label for name in figures))
    print_table(columns, rows, title=title, names=len(names))


def print_by_case(table: pd.DataFrame, what: str, leading: Sequence[str]) -> None:
    """Print a table for each leading figure, where there are several cases or seeds.

    It has a row a method and a column a case, with mean and deviation over the seeds, and then the
    mean and deviation over the cases.

    Args:
        table: see ``item_table``.
        what: a row is, a map or a path.
        leading: names of figures; those that nothing has are left out.
    """
    from slamfusion.evaluation import figure_of  # noqa: PLC0415  (loads slowly)
    from slamfusion.jobs.results import means_of  # noqa: PLC0415  (loads slowly)

    keys = ["method", "case"]
    cases = list(table["case"].unique())
    if len(cases) < 2 and not table.duplicated(keys).any():
        return
    means, deviations = means_of(table, keys), means_of(table, keys, "std")
    for name in (name for name in leading if name in table):
        figure = figure_of(name)
        shown = {
            key: _with_deviation(means.loc[key, name], deviations.loc[key, name], figure.digits)
            for key in means.index
        }
        rows = []
        for method, own in means[name].groupby(level="method", sort=False):
            over_cases = (own.mean(skipna=False), own.std(skipna=False))
            cells = [shown.get((method, case), "-") for case in cases]
            rows.append([method, *cells, *(number(value, figure.digits) for value in over_cases)])
        title = f"{figure.label}, case by case"
        print_table((f"{what} ", *cases, "mean", "std"), rows, title=title)


def _with_deviation(mean: float, deviation: float, digits: int) -> str:
    """Return a mean with its deviation; without, where there is none."""
    spread = number(deviation, digits)
    return number(mean, digits) if spread == "-" else f"{number(mean, digits)} ± {spread}"
