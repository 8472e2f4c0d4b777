"""Tables of benchmarks, from the JSON files in ``docs/benchmarks/data``.

Each file is the last measurement of one table, ``NAME.json``, with what was run, when, on which
machine and at which commit. ``tests.benchmarks.record`` writes them; do not edit them.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from docs.generate.markdown import table

__all__ = ["FOLDER", "Measurement", "benchmark_table", "benchmark_tables", "measurements"]

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks" / "data"


@dataclass(frozen=True)
class Measurement:
    """One measured table.

    Attributes:
        name: of the table, as its files and its part of a page are called.
        date: ISO, of the measurement.
        commit: the program's, short; with ``+`` where it had changes that were not committed.
        machine: cores, device, versions, load: what speed depends on.
        command: that was run.
        columns: headings.
        rows: cells as they are shown, as many as columns.
        note: how it came here, where not by ``command`` alone.
    """

    name: str
    date: str
    commit: str
    machine: str
    command: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                message = f"{self.name}: a row of {len(row)} cells, {len(self.columns)} columns"
                raise ValueError(message)

    @property
    def file_name(self) -> str:
        """The file that holds it."""
        return f"{self.name}.json"

    def to_json(self) -> str:
        """Return the file's text."""
        return json.dumps(asdict(self), indent=1, ensure_ascii=False) + "\n"

    @classmethod
    def read(cls, path: Path) -> Measurement:
        """Return the measurement in a file.

        Raises:
            ValueError: the file is not called as what it holds, or a row has not its columns.
        """
        told = json.loads(path.read_text(encoding="utf-8"))
        rows = tuple(tuple(row) for row in told.pop("rows"))
        found = cls(columns=tuple(told.pop("columns")), rows=rows, **told)
        if path.name != found.file_name:
            message = f"{path}: holds {found.name}; call it {found.file_name}"
            raise ValueError(message)
        return found


def measurements(folder: Path = FOLDER) -> dict[str, Measurement]:
    """Return every measurement by its name."""
    return {path.stem: Measurement.read(path) for path in sorted(folder.glob("*.json"))}


def benchmark_table(item: Measurement) -> str:
    """Return a measurement as a Markdown table, with what was run, when and where below it."""
    told = f"{item.date}, commit {item.commit}, {item.machine}: `{item.command}`."
    return "\n".join(
        [table(item.columns, item.rows), "", f"*{told}{' ' * bool(item.note)}{item.note}*"]
    )


def benchmark_tables() -> dict[str, Callable[[], str]]:
    """Return what writes each table, by the name of its part."""
    return {
        f"benchmark {name}": functools.partial(benchmark_table, item)
        for name, item in measurements().items()
    }
