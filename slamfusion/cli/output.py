"""What commands print: one JSON document, or tables; progress on a terminal's stderr."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import click

from slamfusion.jobs.documents import number, plain
from slamfusion.jobs.inputs import Progress

__all__ = [
    "Settings",
    "notice",
    "number",
    "one_line",
    "print_json",
    "print_table",
    "progress_bar",
]

# Tables in a pipe or file are never squeezed to a terminal's width.
PIPE_WIDTH = 240
# Paths of people are shorter; what is longer is no word.
WORD_CHARACTERS, WORD_ENDS = 400, 40


@dataclass
class Settings:
    """What the common options of a run say; the error handler reads them."""

    debug: bool = False
    json: bool = False
    printed: bool = False


def print_json(document: Mapping[str, Any]) -> None:
    """Print the run's one JSON document to stdout; NaN and infinity become null."""
    print(json.dumps(plain(document), indent=2, allow_nan=False))
    context = click.get_current_context(silent=True)
    if context is not None:
        context.ensure_object(Settings).printed = True


def one_line(text: str) -> str:
    """Return the text without line breaks and control characters; the middle of long words goes."""
    words = (
        word if len(word) <= WORD_CHARACTERS else f"{word[:WORD_ENDS]}...{word[-WORD_ENDS:]}"
        for word in text.split()
    )
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in " ".join(words)
    )


def notice(text: str) -> None:
    """Print one line about this run to stderr."""
    print(f"slamfusion: {one_line(text)}", file=sys.stderr)


def print_table(
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    title: str | None = None,
    header: bool = True,
) -> None:
    """Print a table to stdout; columns whose name ends in a space are aligned left."""
    from rich.box import SIMPLE_HEAD  # noqa: PLC0415  (rich loads slowly; --help needs none)
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    width = None if sys.stdout.isatty() else PIPE_WIDTH

    class Pipe(Console):
        """Leaves a reader that went away to the caller; rich would exit with code 1."""

        def on_broken_pipe(self) -> None:
            raise  # noqa: PLE0704 - rich calls it where it has caught the error

    console = Pipe(file=sys.stdout, width=width, markup=False, highlight=False)
    table = Table(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, show_header=header
    )
    for name in columns:
        table.add_column(name.rstrip(), justify="left" if name.endswith(" ") else "right")
    for row in rows:
        table.add_row(*(Text(one_line(cell)) for cell in row))
    console.print(table)


@contextlib.contextmanager
def progress_bar() -> Iterator[Progress | None]:
    """Give a callback (stage, done, total) that draws on stderr; None where nobody watches."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import Progress as Bar  # noqa: PLC0415
    from rich.progress import TaskID  # noqa: PLC0415

    tasks: dict[str, TaskID] = {}
    with Bar(console=Console(stderr=True), transient=True) as bar:

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total)

        yield report
