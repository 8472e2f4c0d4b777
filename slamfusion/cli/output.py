"""What commands print: one JSON document, or tables; progress on a terminal's stderr."""

from __future__ import annotations

import contextlib
import json
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from slamfusion.cli.tables import Table, one_line
from slamfusion.jobs.inputs import Progress
from slamfusion.json_values import plain

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
