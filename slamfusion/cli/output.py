"""What commands print: one JSON document, or tables; progress on a terminal's stderr."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import math
import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

__all__ = [
    "Progress",
    "Settings",
    "notice",
    "number",
    "one_line",
    "path_text",
    "plain",
    "print_json",
    "print_table",
    "progress_bar",
    "versions",
]

Progress = Callable[[str, int, int], None]
# Tables in a pipe or file are never squeezed to a terminal's width.
PIPE_WIDTH = 240
DISTRIBUTIONS = ("numpy", "scipy", "opencv-python-headless", "pyopencl", "PyYAML", "click", "rich")


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


def plain(value: Any) -> Any:
    """Return nested values as JSON has them: no NumPy, no paths, no NaN, no infinity."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def path_text(path: Path | None) -> str | None:
    """Return a path as a JSON document has it; None where no file was named."""
    return None if path is None else str(path)


def one_line(text: str) -> str:
    """Return the text without line breaks and control characters."""
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in " ".join(text.split())
    )


def notice(text: str) -> None:
    """Print one line about this run to stderr."""
    print(f"slamfusion: {one_line(text)}", file=sys.stderr)


def number(value: float | None, digits: int = 3) -> str:
    """Return a number for a table; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.{digits}f}"


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
    console = Console(file=sys.stdout, width=width, markup=False, highlight=False)
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


def versions() -> dict[str, str | None]:
    """Return the versions that decide a result; None where a package is absent."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    return found | {name: _version(name) for name in ("slamfusion", *DISTRIBUTIONS)}


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
