"""Tables of several maps or paths with their means, and ``--save-results``."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import click

from slamfusion import evaluation, jobs
from slamfusion.cli import options, output, tables
from slamfusion.errors import counted
from slamfusion.io.files import AtomicFiles
from slamfusion.jobs.records import Summaries, number, spread
from slamfusion.json_values import plain

if TYPE_CHECKING:
    import pandas as pd

# Case, seed and method, and figures by name.
Item: TypeAlias = tuple[tuple[str, str, str], Mapping[str, float]]

# Its import says what to install.
RESULTS = "slamfusion.jobs.results"

results_option = options.output(
    "--save-results",
    "results_path",
    ends=[".zip"],
    needs=RESULTS,
    metavar="FILE.zip",
    help="Save all results, settings and the SHA-256 of the inputs, for `slamfusion compare`.",
)


def save_results(
    document: Any,
    rows: Sequence[evaluation.measured.Row],
    inputs: Callable[[], Sequence[tuple[str, str, Path]]],
) -> None:
    """Write what the running command measured, if it was asked for."""
    context, settings = click.get_current_context(), output.settings()
    path = settings.results_path
    if path is None:
        return
    jobs.results.write_results_file(
        path,
        command=" ".join(context.command_path.split()[1:]),
        arguments=settings.arguments,
        document=plain(document),
        rows=rows,
        inputs=inputs(),
    )
    if not settings.as_json:
        context.call_on_close(lambda: output.print_facts(("results", path)))  # below the tables


def print_items(rows: Sequence[evaluation.measured.Row], what: str, leading: Sequence[str]) -> None:
    """Print a row of figures for each item, the means, and the leading figures case by case."""
    figures = jobs.results.figures_of(jobs.results.results_table(rows))
    found = jobs.results.summaries(rows)
    in_cases = figures.index.unique("case").size
    count = f"{counted(len(figures), 'result')} in {counted(in_cases, 'case')}"
    means: list[Item] = [
        ((f"mean of {own['cases']}", "", own["method"]), own["figures"])
        for own in found.means
        if own["cases"] > 1
    ]
    items = zip(figures.index, figures.to_dict("records"), strict=True)
    _print_figures([*items, *_repetitions(found), *means], what, count)
    print_by_case(figures, what, leading)
    in_cases = figures.reset_index().groupby("method")["case"].agg(frozenset)
    if len(set(in_cases)) > 1:
        output.notice("means are of different cases: not every method has a result in each of them")


def print_repetitions(rows: Sequence[evaluation.measured.Row], what: str) -> None:
    """Print mean and deviation over the seeds of each method, where there are several."""
    if any(row[1] for row in rows) and (found := _repetitions(jobs.results.summaries(rows))):
        _print_figures(found, what, "Mean and sample deviation over the seeds")


def _repetitions(found: Summaries) -> list[Item]:
    """Return means and deviations over the seeds of each case and method that has several."""
    return [
        ((own["case"], f"{how} of {own['seeds']}", own["method"]), figures)
        for how in ("mean", "std")
        for own in found.repetitions
        for figures in [own["std" if how == "std" else "figures"]]
    ]


def _print_figures(items: Sequence[Item], what: str, title: str) -> None:
    """Print the figures of items; the seed only if there is one."""
    names = dict.fromkeys(name for _, own in items for name in own)
    figures = [
        [(evaluation.measured.figure_of(name), own.get(name)) for name in names] for _, own in items
    ]
    # Without seeds there is no column of them.
    shown = slice(None, None, 1 if any(key[1] for key, _ in items) else 2)
    heads = ("case ", "seed ", f"{what} ")[shown]
    tables.print_figures(heads, [key[shown] for key, _ in items], figures, title)


def print_by_case(figures: pd.DataFrame, what: str, leading: Sequence[str]) -> None:
    """Print each leading figure, methods by cases, with mean and deviation over seeds and cases."""
    keys = ["method", "case"]
    cases = list(figures.index.unique("case"))
    if len(cases) < 2 and not figures.index.droplevel("seed").has_duplicates:
        return
    means, deviations = (jobs.results.means_of(figures, keys, how) for how in ("mean", "std"))
    for name in (name for name in leading if name in figures):
        figure = evaluation.measured.figure_of(name)
        shown = {
            key: spread(means.loc[key, name], deviations.loc[key, name], figure.digits)
            for key in means.index
        }
        rows = []
        for method, own in means[name].groupby(level="method", sort=False):
            over_cases = (own.mean(skipna=False), own.std(skipna=False))
            cells = [shown.get((method, case), "-") for case in cases]
            rows.append([method, *cells, *(number(value, figure.digits) for value in over_cases)])
        title = f"{figure.label}, case by case"
        output.Table((f"{what} ", *cases, "mean", "std"), rows, title=title).print()


FORMS = (".csv", ".md", ".tex")
# A spreadsheet takes a cell that starts with one of these for a formula.
FORMULA = ("=", "+", "-", "@")


def table_option(function: options.F) -> options.F:
    """Give a command ``--table``; it stands right above the command, below ``options.common``."""
    option = options.output(
        "--table",
        "table_path",
        files=_files,
        ends=FORMS,
        needs=RESULTS,
        metavar="FILE",
        help="Also write all tables: .csv (FILE.csv, FILE-2.csv ...), .md or .tex.",
    )

    @functools.wraps(function)
    def wrapper(*arguments: Any, table_path: Path | None, **given: Any) -> Any:
        if table_path is None:
            return function(*arguments, **given)
        settings = output.settings()
        if settings.as_json:
            raise click.UsageError("--table and --json exclude each other; leave one out")
        settings.tables, settings.verbose = [], True
        try:
            return function(*arguments, **given)
        finally:
            written = write_tables(table_path, settings.tables)
            output.print_facts(*(("" if n else "tables", file) for n, file in enumerate(written)))

    return option(wrapper)  # type: ignore[return-value]


def _files(path: Path, _: Mapping[str, Any]) -> list[Path]:
    """Return the file, and those that are there of the names that further tables get."""
    numbered = re.compile(rf"{re.escape(path.stem)}-\d+{re.escape(path.suffix)}")
    return [path, *(item for item in path.parent.glob("*") if numbered.fullmatch(item.name))]


def write_tables(path: Path, tables: list[output.Table]) -> list[Path]:
    """Write all files or none, and return them: of CSV one a table, of the others one in all."""
    form = path.suffix.lower()
    texts = [_text(table, form) for table in tables]
    if form != ".csv" and tables:
        texts = ["\n".join(texts)]
    numbers = range(2, 1 + len(texts))
    names = [path, *(path.with_name(f"{path.stem}-{number}{path.suffix}") for number in numbers)]
    written = names[: len(texts)]
    with AtomicFiles() as files:
        for name, text in zip(written, texts, strict=True):
            files.add(name, text.encode())
    return written


def _text(table: output.Table, form: str) -> str:
    """Return a table in one of ``FORMS``; Markdown and LaTeX have its title."""
    import pandas as pd  # noqa: PLC0415  (an extra)

    heads, rows, title = table.heads, table.cells(), output.one_line(table.title)
    if form == ".md":
        return (f"## {title}\n\n" if title else "") + jobs.results.markdown(heads, rows)
    frame = pd.DataFrame(rows, columns=heads, dtype=object)
    if form == ".csv":
        return str(frame.map(_harmless).to_csv(index=False, lineterminator="\n"))
    is_text = [*(name.endswith(" ") for name in table.columns), *([True] if table.notes else [])]
    places = "".join("l" if text else "r" for text in is_text)
    body = frame.to_latex(index=False, escape=True, column_format=places)
    return f"% {title}; needs \\usepackage{{booktabs}}\n{body}"


def _harmless(cell: str) -> str:
    """Return a cell that no spreadsheet takes for a formula; numbers stay, no value is empty."""
    if cell == output.NOTHING:
        return ""
    if not cell.startswith(FORMULA):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell
