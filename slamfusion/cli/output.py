"""What commands print: one JSON document, or tables; progress on a terminal's stderr."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.table import Table as RichTable

    from slamfusion.jobs.inputs import Progress

# Narrower terminals break the lines themselves.
LEAST_WIDTH = 40
# Where nobody watches, a line tells this often how far a long stage is, seconds.
TOLD_EVERY_S = 10.0


@dataclass
class Settings:
    """What the common options of a run say; the error handler reads them.

    Attributes:
        debug, json: as asked.
        printed: whether the JSON document was.
        tables: where tables that are printed are kept, too; None: nowhere.
        arguments: the whole command line, without the program.
    """

    debug: bool = False
    json: bool = False
    printed: bool = False
    tables: list[Table] | None = None
    arguments: tuple[str, ...] = ()


def print_json(document: Mapping[str, Any]) -> None:
    """Print the run's one JSON document to stdout; NaN and infinity become null."""
    from slamfusion.json_values import plain  # noqa: PLC0415  (NumPy loads slowly; --help needs none)

    print(json.dumps(plain(document), indent=2, allow_nan=False))
    context = click.get_current_context(silent=True)
    if context is not None:
        context.ensure_object(Settings).printed = True


def notice(text: str) -> None:
    """Print one line about this run to stderr."""
    print(f"slamfusion: {one_line(text)}", file=sys.stderr)


def print_table(
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    notes: Sequence[str] = (),
    title: str = "",
    header: bool = True,
    names: int = 1,
) -> None:
    """Print a table to stdout, fitted to a terminal or tab-separated; see ``Table``."""
    table = Table(columns, rows, notes, title, has_head=header, names=names)
    context = click.get_current_context(silent=True)
    kept = None if context is None else context.ensure_object(Settings).tables
    if kept is not None and header:
        kept.append(table)
    if sys.stdout.isatty():
        text = table.fitted(max(LEAST_WIDTH, shutil.get_terminal_size().columns))
    else:
        text = "\n".join(table.tabbed())
    print(f"{text}\n")


def fitted(text: str, indent: int = 0) -> str:
    """Break a line where the terminal ends, further lines indented; unchanged for a file."""
    if not sys.stdout.isatty():
        return text
    width = max(LEAST_WIDTH, shutil.get_terminal_size().columns)
    return textwrap.fill(text, width, subsequent_indent=" " * indent)


@contextlib.contextmanager
def progress_bar() -> Iterator[Progress]:
    """Give a callback (stage, done, total): bars on a terminal's stderr, else lines."""
    if not sys.stderr.isatty():
        yield _Lines()
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


class _Lines:
    """Tells progress in lines on stderr; what is done soon says nothing."""

    def __init__(self) -> None:
        self._told_s = time.monotonic()

    def __call__(self, stage: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        if now_s - self._told_s >= TOLD_EVERY_S:
            self._told_s = now_s
            notice(f"{stage}: {100 * done // max(total, 1)} %")


def print_next_steps(map_file: Path, steps: Sequence[str]) -> None:
    """Print how nav2 and RViz load a map, and what can be done now.

    Args:
        map_file: its YAML.
        steps: each what for and a command or file, e.g. ``look: out/report/report.html``.
    """
    where = shlex.quote(f"yaml_filename:={map_file.absolute()}")
    server = f"ros2 run nav2_map_server map_server --ros-args -p {where}"
    print(f"nav2, RViz: {server}")
    print("            (then: ros2 run nav2_util lifecycle_bringup map_server)")
    for number, step in enumerate(steps):
        print(f"{'' if number else 'next:':<12}{step}")


# --- tables ---------------------------------------------------------------------------------------


# Text is wrapped down to this many characters before a table is cut into several.
LEAST_TEXT = 18
NOTHING = "-"
# Places between two columns.
GAP = 2
# Paths of people are shorter; what is longer is no word.
WORD_CHARACTERS, WORD_ENDS = 400, 40

# A column's place, and the least and the most places of the terminal that it takes.
_Column = tuple[int, int, int]


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


@dataclass(frozen=True)
class Table:
    """Rows of cells under heads, each row with a note of any length.

    Attributes:
        columns: heads with their units; a name that ends in a space is of text, aligned left.
        rows: as many cells each; the first names the row.
        notes: one for each row, e.g. a reason; empty where there is nothing to say.
        title: a line above; empty for none.
        has_head: whether the heads are shown.
        names: the number of first columns that name the row. They are in every part of a table that
            is cut.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()
    title: str = ""
    has_head: bool = True
    names: int = 1

    @property
    def heads(self) -> list[str]:
        """The names of all columns, the notes among them."""
        return [*(name.strip() for name in self.columns), *(["reason"] if self.notes else [])]

    def cells(self) -> list[list[str]]:
        """Return the cells of all rows, each in one line, the notes as the last column."""
        rows = [[*row, self.notes[n]] if self.notes else row for n, row in enumerate(self.rows)]
        return [list(map(one_line, row)) for row in rows]

    def tabbed(self) -> Iterator[str]:
        """Yield a line for each row, cells parted by tabs, nothing wrapped, padded or drawn."""
        if self.title:
            yield one_line(self.title)
        if self.has_head:
            yield "\t".join(self.heads)
        yield from ("\t".join(row) for row in self.cells())

    def fitted(self, width: int) -> str:
        """Return the table in at most ``width`` places, drawn by rich.

        Columns that hold nothing are left out. Heads and text are wrapped; if that is not enough,
        the table is cut into several, each with the names. Notes are below, with the row's name.
        """
        from rich.console import Console  # noqa: PLC0415  (a pipe needs none)

        cells, file = self.cells(), io.StringIO()
        console = Console(file=file, width=width, color_system=None, highlight=False)
        if self.title:
            console.print(one_line(self.title), markup=False)
        for number, part in enumerate(self._parts(cells, width)):
            if number:
                console.print()
            console.print(self._drawn(cells, part))
        for row, note in zip(cells, self.notes, strict=bool(self.notes)):
            if note:
                console.print(f" {row[0]}: {one_line(note)}", markup=False)
        return "\n".join(line.rstrip() for line in file.getvalue().splitlines())

    def _parts(self, cells: list[list[str]], width: int) -> list[list[_Column]]:
        """Cut the columns into tables that fit, each with the names."""
        from rich.cells import cell_len  # noqa: PLC0415  (a pipe needs none)

        columns: list[_Column] = []
        for place, name in enumerate(self.columns):
            own = [row[place] for row in cells]
            if place >= self.names and self.has_head and own and not set(own) - {NOTHING}:
                continue
            words = max(map(cell_len, name.split()), default=1)
            most = max(map(cell_len, own), default=1)
            least = min(most, LEAST_TEXT) if name.endswith(" ") else most
            columns.append((place, max(words, least, 1), max(words, most, 1)))
        parts = [columns[: self.names]]
        for column in columns[self.names :]:
            taken = sum(least + GAP for _, least, _ in (*parts[-1], column))
            if self.has_head and taken > width and len(parts[-1]) > self.names:
                parts.append(columns[: self.names])
            parts[-1] = [*parts[-1], column]
        return parts

    def _drawn(self, cells: list[list[str]], part: list[_Column]) -> RichTable:
        """Return some columns as a table of rich."""
        from rich.box import SIMPLE_HEAD  # noqa: PLC0415  (a pipe needs none)
        from rich.table import Table as RichTable  # noqa: PLC0415
        from rich.text import Text  # noqa: PLC0415

        padding = (0, 0, 0, 1)
        drawn = RichTable(
            box=SIMPLE_HEAD, show_edge=False, padding=padding, show_header=self.has_head
        )
        for place, least, most in part:
            name = self.columns[place]
            if name.endswith(" "):
                drawn.add_column(name.strip(), min_width=least, max_width=most, overflow="fold")
            else:
                drawn.add_column(name, width=least, justify="right")
        for row in cells:
            drawn.add_row(*(Text(row[place]) for place, _, _ in part))
        return drawn
