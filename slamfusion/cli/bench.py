"""``slamfusion bench``: this machine against the plain search and the NumPy twins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from slamfusion.cli.options import common_options, with_config
from slamfusion.cli.output import number, print_json, print_table
from slamfusion.config import RunConfig

if TYPE_CHECKING:
    from slamfusion.jobs.tool_records import BenchEntryJson

__all__ = ["command", "print_entries"]


@click.command("bench")
@click.option("--quick", is_flag=True, help="Smaller maps and fewer repetitions.")
@with_config("device")
@common_options
def command(quick: bool, config: RunConfig, as_json: bool) -> int:
    """Time alignment, vote and the [F16] batch on this machine, as ratios."""
    from slamfusion.bench import bench_document, run_benchmarks  # noqa: PLC0415
    from slamfusion.compute import open_device  # noqa: PLC0415

    device = open_device(config.device.device)
    results = run_benchmarks(device, quick=quick)
    if as_json:
        print_json(bench_document(results, device))
    else:
        print_entries(results["entries"], device.name)
    return 0


def print_entries(entries: Sequence[BenchEntryJson], device: str) -> None:
    """Print a row for each measurement on a device."""
    print_table(COLUMNS, [_row(entry) for entry in entries], title=f"Benchmarks on {device}")


COLUMNS = ("work ", "s", "runs", "baseline ", "baseline s", "ratio", "must", "stretch", "reached ")


def _row(entry: BenchEntryJson) -> list[str]:
    """Return an entry's row; the target is of the seconds or of the ratio, as the entry says."""
    reached = "-"
    if entry["must"] is not None:
        reached = "stretch" if entry["meets_stretch"] else "must" if entry["meets_must"] else "NO"
    unit = "x" if entry["target_of"] == "ratio" else "s"
    targets = ["-" if x is None else f"{x:g} {unit}" for x in (entry["must"], entry["stretch"])]
    return [
        entry["name"],
        number(entry["seconds"], 4),
        str(entry["runs"]),
        entry["baseline"],
        number(entry["baseline_seconds"], 4),
        number(entry["ratio"], 4),
        *targets,
        reached,
    ]
