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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

from slamfusion.json_values import plain

if TYPE_CHECKING:
    from rich.table import Table as RichTable

    from slamfusion.jobs.inputs import Progress

# Narrower terminals break the lines themselves.
LEAST_WIDTH = 40
# Without a terminal a line reports the progress of a long stage this often, seconds.
TOLD_EVERY_S = 10.0
# Share of a stage that must be done before it says how much is done and how long the rest takes.
LEAST_SHARE = 0.02
# A stage with up to this many steps shows their number, too: pairs, maps, logs.
MOST_COUNTED = 500


@dataclass
class Settings:
    """The common options of a command, also for the error handler.

    Attributes:
        printed: whether the JSON document was.
        results_path: file of ``--save-results``.
        tables: file that keeps the printed tables.
        arguments: the whole command line, without the program.
    """

    debug: bool = False
    as_json: bool = False
    verbose: bool = False
    printed: bool = False
    results_path: Path | None = None
    tables: list[Table] | None = None
    arguments: tuple[str, ...] = ()


def settings() -> Settings:
    """Return those of the running command; without one, those of no command."""
    context = click.get_current_context(silent=True)
    return Settings() if context is None else context.ensure_object(Settings)


def print_json(document: Any) -> None:
    """Print the run's one JSON document to stdout; NaN and infinity become null."""
    print(json.dumps(plain(document), indent=2, allow_nan=False))
    settings().printed = True


def print_if_json(document: Any) -> bool:
    """Print the document if the running command has ``--json``; return whether it has."""
    if settings().as_json:
        print_json(document)
    return settings().as_json


def is_verbose() -> bool:
    """Whether the running command has ``--verbose``."""
    return settings().verbose


def notice(*sentences: str, of: str = "") -> None:
    """Print sentences about this run to stderr, each on a line, after what they are about."""
    for text in sentences:
        print(wrapped(f"slamfusion: {of}{one_line(text)}", sys.stderr), file=sys.stderr)


def say(text: str, indent: int = 0) -> None:
    """Print a sentence to stdout; a terminal breaks it between words, further lines indented."""
    print(wrapped(text, sys.stdout, indent))


def wrapped(text: str, stream: TextIO, indent: int = 0) -> str:
    """Break a line between words where a terminal ends; paths stay whole, files unchanged."""
    if not stream.isatty():
        return text
    return textwrap.fill(
        text,
        _width(),
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _width() -> int:
    return max(LEAST_WIDTH, shutil.get_terminal_size().columns)


def print_facts(*facts: tuple[str, object]) -> None:
    """Print a line for each subject: a file, on a terminal a link, or a command; none for None."""
    for subject, text in facts:
        if text is None:
            continue
        shown = str(text)
        if isinstance(text, Path) and sys.stdout.isatty():
            shown = f"\x1b]8;;{text.absolute().as_uri()}\x1b\\{shown}\x1b]8;;\x1b\\"
        print(f"{f'{subject}:' if subject else '':<12}{shown}")


def map_server_facts(map_file: Path) -> list[tuple[str, object]]:
    """Return how nav2 and RViz load a map from its YAML file, for ``print_facts``."""
    where = shlex.quote(f"yaml_filename:={map_file.absolute()}")
    return [
        ("nav2, RViz", f"ros2 run nav2_map_server map_server --ros-args -p {where}"),
        ("", "(then: ros2 run nav2_util lifecycle_bringup map_server)"),
    ]


@contextlib.contextmanager
def progress_bar() -> Iterator[Progress]:
    """Give a callback (stage, done, total) that draws bars on a terminal, else prints lines."""
    if not sys.stderr.isatty():
        yield _lines()
        return
    from rich import progress as bars  # noqa: PLC0415
    from rich.console import Console  # noqa: PLC0415

    tasks: dict[str, bars.TaskID] = {}
    columns = (
        bars.TextColumn("{task.description}"),
        bars.BarColumn(bar_width=20),
        bars.TaskProgressColumn("{task.percentage:>3.0f} %"),
        bars.TimeElapsedColumn(),
        bars.TextColumn("left:"),
        bars.TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    # The stages of a run differ in speed; only its whole time so far says what is left.
    with bars.Progress(
        *columns, console=console, transient=True, speed_estimate_period=3600.0
    ) as bar:

        def report(stage: str, done: float, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=None)
            count = f": {int(done)} of {total}" if 1 < total <= MOST_COUNTED else ""
            total_known = total if done else None
            bar.update(tasks[stage], description=stage + count, completed=done, total=total_known)

        yield report


def _lines() -> Progress:
    """Return a callback that prints progress as lines on stderr, of a long stage alone."""
    told_s, begun_s = time.monotonic(), dict[str, float]()

    def report(stage: str, done: float, total: int) -> None:
        nonlocal told_s
        now_s = time.monotonic()
        taken_s = now_s - begun_s.setdefault(stage, now_s)
        if now_s - told_s < TOLD_EVERY_S:
            return
        told_s = now_s
        share = done / max(total, 1)
        shown = f"{100 * share:.0f} %, " if share >= LEAST_SHARE else ""
        is_known = LEAST_SHARE <= share < 1.0
        left = f", about {taken_s * (1.0 / share - 1.0):.0f} s left" if is_known else ""
        notice(f"{stage}: {shown}{taken_s:.0f} s{left}")

    return report


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
        columns: heads with their units, the most important first; one that ends in a space is of
            text, aligned left.
        notes: one for each row, e.g. a reason, or empty.
        title: a line above; empty for none.
        names: number of first columns that name the row; repeated in each part of a cut table.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()
    title: str = ""
    has_head: bool = True
    names: int = 1

    def print(self) -> None:
        """Print the table to stdout, fitted to a terminal or tab-separated."""
        kept = settings().tables
        if kept is not None and self.has_head:
            kept.append(self)
        if sys.stdout.isatty():
            text = self.fitted(_width(), is_whole=is_verbose())
        else:
            text = "\n".join(self.tabbed())
        print(f"{text}\n")

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

    def fitted(self, width: int, *, is_whole: bool = False) -> str:
        """Return the table in at most ``width`` places.

        Empty columns are left out; heads and text are wrapped; if that is not enough, the last
        columns are left out and named. Notes are below, with the row's name.
        """
        from rich.console import Console  # noqa: PLC0415  (a pipe needs none)

        cells, file = self.cells(), io.StringIO()
        console = Console(file=file, width=width, color_system=None, highlight=False)
        if self.title:
            console.print(one_line(self.title), markup=False)
        parts = self._parts(cells, width)
        for number, part in enumerate(parts if is_whole else parts[:1]):
            if number:
                console.print()
            console.print(self._drawn(cells, part, width))
        for row, note in zip(cells, self.notes, strict=bool(self.notes)):
            if note:
                console.print(f" {row[0]}: {one_line(note)}", markup=False)
        left = [self.columns[place] for part in parts[1:] for place, _, _ in part[self.names :]]
        if left and not is_whole:
            console.print(f" --verbose also shows: {', '.join(map(str.strip, left))}", markup=False)
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
            head = cell_len(name.strip()) if self.has_head else 1
            columns.append((place, max(words, least, 1), max(head, most, 1)))
        parts = [columns[: self.names]]
        for column in columns[self.names :]:
            taken = sum(least + GAP for _, least, _ in (*parts[-1], column))
            if self.has_head and taken > width and len(parts[-1]) > self.names:
                parts.append(columns[: self.names])
            parts[-1] = [*parts[-1], column]
        return parts

    def _drawn(self, cells: list[list[str]], part: list[_Column], width: int) -> RichTable:
        """Return some columns as a table of rich; heads are in one line where they fit."""
        from rich.box import SIMPLE_HEAD  # noqa: PLC0415  (a pipe needs none)
        from rich.table import Table as RichTable  # noqa: PLC0415
        from rich.text import Text  # noqa: PLC0415

        padding = (0, 0, 0, 1)
        drawn = RichTable(
            box=SIMPLE_HEAD, show_edge=False, padding=padding, show_header=self.has_head
        )
        is_wide = sum(most + GAP for _, _, most in part) <= width
        for place, least, most in part:
            name = self.columns[place]
            if name.endswith(" "):
                head = Text(name.strip())
                drawn.add_column(head, min_width=least, max_width=most, overflow="fold")
            else:
                drawn.add_column(Text(name), width=most if is_wide else least, justify="right")
        for row in cells:
            drawn.add_row(*(Text(row[place]) for place, _, _ in part))
        return drawn
