"""``slamfusion bench``: this machine against the plain search and the NumPy twins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import click

from slamfusion.cli.options import common_options, with_config
from slamfusion.cli.output import number, plain, print_json, print_table, versions
from slamfusion.config import RunConfig

__all__ = ["command"]


@click.command("bench")
@click.option("--quick", is_flag=True, help="Smaller maps and fewer repetitions.")
@with_config("device")
@common_options
def command(quick: bool, config: RunConfig, as_json: bool) -> int:
    """Time alignment, vote and the [F16] batch on this machine, as ratios."""
    from slamfusion.bench import run_benchmarks  # noqa: PLC0415
    from slamfusion.compute import open_backend  # noqa: PLC0415

    backend = open_backend(config.device.device)
    results: dict[str, Any] = run_benchmarks(backend, quick=quick)
    if as_json:
        print_json({**results, "device": backend.name, "versions": versions()})
    else:
        rows = [[key, _cell(value)] for key, value in _leaves(plain(results))]
        print_table(("measure ", "value"), rows, title=f"Benchmarks on {backend.name}")
    return 0


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every number or text with its dotted place."""
    if isinstance(value, Mapping):
        items = [(str(key), item) for key, item in value.items()]
    elif isinstance(value, list):
        items = [(str(index), item) for index, item in enumerate(value)]
    else:
        yield path, value
        return
    for key, item in items:
        yield from _leaves(item, f"{path}.{key}".lstrip("."))


def _cell(value: Any) -> str:
    return number(value, 4) if isinstance(value, float) else str(value)
