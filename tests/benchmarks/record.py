"""Keep what a benchmark printed: its tables as JSON, of which the pages' tables are made.

A benchmark with the option ``--record`` writes ``docs/benchmarks/data/NAME.json``, one file
for each table; ``python -m docs.generate`` then writes them into the pages that name them.
"""

from __future__ import annotations

import argparse
import datetime as dt
import itertools
import platform
import re
import shlex
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from docs.generate.benchmarks import FOLDER, Measurement
from docs.generate.provenance import commit, cores
from slamfusion.compute import open_device


class RecordingConsole(Console):
    """A console that also keeps the tables which it prints.

    Attributes:
        name: of the first table; those after it have a number from 2 behind it.
        folder: where they are kept.
        kept: files written so far.
    """

    def __init__(self, name: str, folder: Path, **options: Any) -> None:
        super().__init__(**options)
        self.name = name
        self.folder = folder
        self.kept: list[Path] = []

    def print(self, *objects: Any, **options: Any) -> None:
        """Print, and keep what is a table."""
        super().print(*objects, **options)
        for item in objects:
            if isinstance(item, Table):
                number = len(self.kept) + 1
                name = self.name if number == 1 else f"{self.name}-{number}"
                measured = measurement(name, item)
                self.folder.mkdir(parents=True, exist_ok=True)
                path = self.folder / measured.file_name
                path.write_text(measured.to_json(), encoding="utf-8")
                self.kept.append(path)
                super().print(f"kept as {path}", highlight=False, soft_wrap=True)


def bench_parser(text: str | None) -> argparse.ArgumentParser:
    """Return a parser with ``--record``, whose help shows a text as it is written."""
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--record",
        nargs="?",
        type=Path,
        const=FOLDER,
        metavar="DIR",
        help="keep the tables as JSON; default folder: docs/benchmarks/data",
    )
    return parser


def console_for(name: str, folder: Path | None, **options: Any) -> Console:
    """Return the console of a benchmark: one that keeps its tables where a folder is given."""
    return Console(**options) if folder is None else RecordingConsole(name, folder, **options)


def measurement(name: str, table: Table) -> Measurement:
    """Return a table as it is kept, with when, where and how it came to be."""
    cells = [[_plain(cell) for cell in column.cells] for column in table.columns]
    return Measurement(
        name=name,
        date=dt.datetime.now(dt.timezone.utc).date().isoformat(),
        commit=commit(),
        machine=machine(),
        command=command(),
        columns=tuple(_plain(column.header) for column in table.columns),
        rows=tuple(zip(*cells, strict=True)),
    )


def machine() -> str:
    """Return what speed depends on, in words."""
    versions = f"Python {platform.python_version()}, NumPy {version('numpy')}"
    return f"{cores()}{open_device().name}, {versions}"


def command() -> str:
    """Return the command line that this process was started with, without its folders."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    start = ["python", "-m", spec.name] if spec is not None else [Path(sys.argv[0]).name]
    words = [re.sub("^--record=.*", "--record", word) for word in sys.argv[1:]]
    is_folder = [
        before == "--record" and not word.startswith("-")
        for before, word in itertools.pairwise(["", *sys.argv[1:]])
    ]
    kept = [word for word, leave in zip(words, is_folder, strict=True) if not leave]
    # Where things lie on this machine is nothing to keep.
    kept = ["DIR" if Path(word).is_absolute() else word for word in kept]
    return shlex.join([*start, *kept])


def _plain(cell: Any) -> str:
    return Text.from_markup(cell).plain if isinstance(cell, str) else str(cell)
