"""``--table FILE``: the tables that a command prints, as CSV, Markdown or LaTeX."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from slamfusion.cli.options import output_option
from slamfusion.cli.output import Settings
from slamfusion.cli.tables import NOTHING, Table, one_line

F = TypeVar("F", bound=Callable[..., Any])

FORMS = (".csv", ".md", ".tex")
# A spreadsheet takes a cell that begins so for a formula.
FORMULA = ("=", "+", "-", "@")


def table_option(function: F) -> F:
    """Give a command ``--table``; it stands right above the command, below ``common_options``."""
    option = output_option(
        "--table",
        "table_path",
        files=_files,
        metavar="FILE",
        help="Also write the tables here: .csv (a file for each: FILE-2.csv ...), .md or .tex.",
    )

    @functools.wraps(function)
    def wrapper(*arguments: Any, table_path: Path | None, **given: Any) -> Any:
        if table_path is None:
            return function(*arguments, **given)
        if table_path.suffix.lower() not in FORMS:
            message = f"{table_path}: wanted a name that ends in {', '.join(FORMS)}"
            raise click.BadParameter(message, param_hint="'--table'")
        if given.get("as_json"):
            message = "--table writes what is printed; leave out --json"
            raise click.UsageError(message)
        import slamfusion.jobs.results  # noqa: F401, PLC0415  (says what to install)

        settings = click.get_current_context().ensure_object(Settings)
        settings.tables = []
        try:
            return function(*arguments, **given)
        finally:
            _write(table_path, settings.tables)

    return option(wrapper)  # type: ignore[return-value]


def _files(path: Path, _: Mapping[str, Any]) -> list[Path]:
    """Return the file, and those that are there of the names that further tables get."""
    numbered = re.compile(rf"{re.escape(path.stem)}-\d+{re.escape(path.suffix)}")
    return [path, *(item for item in path.parent.glob("*") if numbered.fullmatch(item.name))]


def _write(path: Path, tables: list[Table]) -> None:
    """Write all files or none: of CSV one a table, of the others one in all."""
    from slamfusion.io import AtomicFiles  # noqa: PLC0415  (OpenCV loads slowly; --help needs none)

    form = path.suffix.lower()
    texts = [_text(table, form) for table in tables]
    if form != ".csv" and tables:
        texts = ["\n".join(texts)]
    with AtomicFiles() as files:
        for number, text in enumerate(texts, start=1):
            name = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
            files.add(name, text.encode())


def _text(table: Table, form: str) -> str:
    """Return a table in one of ``FORMS``; Markdown and LaTeX have its title."""
    import pandas as pd  # noqa: PLC0415  (an extra)

    from slamfusion.jobs.results import markdown  # noqa: PLC0415  (loads slowly)

    heads, rows, title = table.heads, table.cells(), one_line(table.title)
    if form == ".md":
        return (f"## {title}\n\n" if title else "") + markdown(heads, rows)
    frame = pd.DataFrame(rows, columns=heads, dtype=object)
    if form == ".csv":
        return str(frame.map(_harmless).to_csv(index=False, lineterminator="\n"))
    is_text = [*(name.endswith(" ") for name in table.columns), *([True] if table.notes else [])]
    places = "".join("l" if text else "r" for text in is_text)
    body = frame.to_latex(index=False, escape=True, column_format=places)
    return f"% {title}; needs \\usepackage{{booktabs}}\n{body}"


def _harmless(cell: str) -> str:
    """Return a cell that no spreadsheet takes for a formula; numbers stay, no value is empty."""
    if cell == NOTHING:
        return ""
    if not cell.startswith(FORMULA):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell
