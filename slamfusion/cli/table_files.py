"""``--table FILE``: the tables that a command prints, as CSV, Markdown or LaTeX."""

from __future__ import annotations

import csv
import functools
import io
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from slamfusion.cli.options import output_option
from slamfusion.cli.output import Settings
from slamfusion.cli.tables import NOTHING, Table, one_line

__all__ = ["as_csv", "as_latex", "as_markdown", "table_option"]

F = TypeVar("F", bound=Callable[..., Any])

# A spreadsheet takes a cell that begins so for a formula.
FORMULA = ("=", "+", "-", "@")
LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}


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
        settings = click.get_current_context().ensure_object(Settings)
        settings.tables = []
        try:
            return function(*arguments, **given)
        finally:
            if settings.tables:
                _write(table_path, settings.tables)

    return option(wrapper)  # type: ignore[return-value]


def _files(path: Path, _: Mapping[str, Any]) -> list[Path]:
    """Return the file, and those that are there of the names that further tables get."""
    numbered = re.compile(rf"{re.escape(path.stem)}-\d+{re.escape(path.suffix)}")
    return [path, *(item for item in path.parent.glob("*") if numbered.fullmatch(item.name))]


def _write(path: Path, tables: Sequence[Table]) -> None:
    """Write all files or none."""
    from slamfusion.io import AtomicFiles  # noqa: PLC0415  (OpenCV loads slowly; --help needs none)

    with AtomicFiles() as files:
        for name, text in FORMS[path.suffix.lower()](path, tables).items():
            files.add(name, text.encode())


def as_csv(path: Path, tables: Sequence[Table]) -> dict[Path, str]:
    """Return a file for each table; a cell without a value is empty, none is a formula."""
    found = {}
    for number, table in enumerate(tables, start=1):
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        for row in _rows(table):
            writer.writerow("" if cell == NOTHING else _harmless(cell) for cell in row)
        name = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        found[name] = stream.getvalue()
    return found


def as_markdown(path: Path, tables: Sequence[Table]) -> dict[Path, str]:
    """Return one file with a heading for each table."""
    from slamfusion.experiments.table import markdown_table  # noqa: PLC0415  (loads slowly)

    lines = []
    for table in tables:
        head, *rows = _rows(table)
        lines += [f"## {one_line(table.title)}", ""] if table.title else []
        lines += [*markdown_table(head, rows), ""]
    return {path: "\n".join(lines)}


def as_latex(path: Path, tables: Sequence[Table]) -> dict[Path, str]:
    """Return one file with a ``tabular`` for each table, to be put into a ``table``."""
    lines = ["% needs \\usepackage{booktabs}"]
    for table in tables:
        head, *rows = [[_escaped(cell) for cell in row] for row in _rows(table)]
        places = "".join("l" if is_text else "r" for is_text in _texts(table))
        lines += [
            f"% {one_line(table.title)}",
            f"\\begin{{tabular}}{{{places}}}",
            "\\toprule",
            f"{' & '.join(head)} \\\\",
            "\\midrule",
            *(f"{' & '.join(row)} \\\\" for row in rows),
            "\\bottomrule",
            "\\end{tabular}",
            "",
        ]
    return {path: "\n".join(lines)}


FORMS: dict[str, Callable[[Path, Sequence[Table]], dict[Path, str]]] = {
    ".csv": as_csv,
    ".md": as_markdown,
    ".tex": as_latex,
}


def _has_notes(table: Table) -> bool:
    return any(table.notes)


def _rows(table: Table) -> list[list[str]]:
    """Return the heads and the rows; notes are the last column, where there are any."""
    heads = [name.strip() for name in table.columns]
    rows = [[one_line(cell) for cell in row] for row in table.rows]
    if _has_notes(table):
        heads.append(table.note_head)
        rows = [[*row, one_line(note)] for row, note in zip(rows, table.notes, strict=True)]
    return [heads, *rows]


def _texts(table: Table) -> list[bool]:
    """Return of each column whether it is of text."""
    texts = [name.endswith(" ") for name in table.columns]
    return [*texts, True] if _has_notes(table) else texts


def _harmless(cell: str) -> str:
    """Return a cell that no spreadsheet takes for a formula; numbers stay."""
    if not cell.startswith(FORMULA):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def _escaped(cell: str) -> str:
    return "".join(LATEX.get(character, character) for character in cell)
