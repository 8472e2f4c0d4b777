"""``slamfusion info``: what a log, a bag, a map or a run holds."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from slamfusion import jobs
from slamfusion.cli import options
from slamfusion.cli.help import Command
from slamfusion.cli.output import NOTHING, Table, print_if_json, progress_bar, say
from slamfusion.cli.paths import FILE
from slamfusion.config import RunConfig

UNITS = {"s": "s", "m": "m", "m2": "m2", "hz": "Hz", "deg": "deg", "percent": "%", "mb": "MB"}


@click.command(
    "info",
    cls=Command,
    examples=["info drive.log.gz", "info drive.bag --json", "info out/fused.yaml", "info out"],
)
@click.argument("path", metavar="LOG|BAG|MAP|RUN", type=FILE)
@options.resolution
@options.settings("log", "map_files")
@options.common
def command(path: Path, resolution: float | None, config: RunConfig) -> None:
    """Describe a log, a bag, a map or a run.

    Shows duration, scans, laser, odometry and topics of a log or bag, and the time and memory that
    `run` will take for it; size and area of a map; the recommendation of a run. Then what is odd,
    and what to do.
    """
    with progress_bar() as progress:
        found = jobs.info.describe(path, config, progress, resolution=resolution)
    if print_if_json(found):
        return
    (record,) = (item for item in (found.log, found.map, found.run) if item is not None)
    rows = [_row(field.name, getattr(record, field.name)) for field in fields(record)]
    rows = [row for row in rows if row[1]]
    Table((" ", " "), rows, title=str(found.file), has_head=False).print()
    for sentence in found.remarks:
        say(f"- {sentence}", indent=2)


def _row(name: str, value: Any) -> list[str]:
    """Return a key of a record and its value as people read them: ``duration_s`` in seconds."""
    words, _, unit = name.rpartition("_")
    if words and unit in UNITS:
        name = f"{words} [{UNITS[unit]}]"
    if isinstance(value, float):
        value = f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        value = "; ".join(map(str, value))
    return [name.replace("_", " "), NOTHING if value is None else str(value)]
