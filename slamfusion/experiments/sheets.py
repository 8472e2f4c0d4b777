"""Tables of texts that experiments on fusion show, and the files that they are written to."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from slamfusion.evaluation import Row
from slamfusion.experiments.records import ErrorTableJson, RatiosJson, RealLogTableJson
from slamfusion.experiments.table import markdown_table
from slamfusion.io import AtomicFiles

__all__ = ["Sheet", "Tables", "write_error_table"]


@dataclass(frozen=True)
class Sheet:
    """A table of texts, shown on the console, in Markdown and in HTML.

    Attributes:
        title: above it.
        heading: a text for each column.
        rows: as many texts each.
        note: a sentence that explains it.
    """

    title: str
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def to_markdown(self) -> list[str]:
        """Return its lines."""
        lines = [f"## {self.title}", ""]
        if self.note:
            lines += [self.note, ""]
        return [*lines, *markdown_table(self.heading, self.rows), ""]


class Tables(Protocol):
    """What an experiment on fusion has to show: ``ErrorTable`` says what each means."""

    @property
    def title(self) -> str:
        """Of the experiment."""

    def overall(self) -> Mapping[str, RatiosJson]:
        """Return for each way to vote its error against the best inputs'."""

    def borne_out(self) -> frozenset[str]:
        """Return the ways to vote that are better than the best input in every test made."""

    def sheets(self, *, details: bool) -> list[Sheet]:
        """Return the tables."""

    def sentences(self) -> list[str]:
        """Return what they say."""

    def figure_rows(self) -> Sequence[Row]:
        """Return every map and path with its figures."""

    def to_csv(self) -> str:
        """Return every number."""

    def to_json(self) -> ErrorTableJson | RealLogTableJson:
        """Return everything."""


def write_error_table(
    folder: Path, stem: str, table: Tables, document: Mapping[str, Any], *, details: bool
) -> list[Path]:
    """Write ``stem.csv``, ``.md`` and ``.json``, all or none.

    Args:
        folder: made when missing; older files of the same names are replaced.
        stem: start of the file names.
        table: the errors, an ``ErrorTable`` for one.
        document: joins the JSON document; plain values without NaN.
        details: also the p-values of every condition in the Markdown.

    Raises:
        MapFileError: a file cannot be written.
    """
    lines = [f"# {table.title}", ""]
    for sheet in table.sheets(details=details):
        lines += sheet.to_markdown()
    lines += ["## In words", "", *(f"- {sentence}" for sentence in table.sentences()), ""]
    text = json.dumps({**table.to_json(), **document}, indent=2, allow_nan=False)
    contents = {
        f"{stem}.csv": table.to_csv(),
        f"{stem}.md": "\n".join(lines),
        f"{stem}.json": f"{text}\n",
    }
    with AtomicFiles() as files:
        for name, content in contents.items():
            files.add(folder / name, content.encode())
    return [folder / name for name in contents]
