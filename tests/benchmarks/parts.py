"""What the benchmarks of one producer have in common: their options, and a run of their parts."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from slamfusion.config import DeviceConfig, RunConfig
from slamfusion.slam.registry import load_config, open_producer_device
from tests.benchmarks.gmapping.bench import Bench
from tests.benchmarks.record import add_record_option, console_for

# Each part, told what it needs, and how many seeds it takes where none are asked for.
Parts = Mapping[str, tuple[Callable[..., None], int]]


def parser_of(parts: Parts, description: str | None, seeds: str) -> argparse.ArgumentParser:
    """Return the options that every one of them has.

    Args:
        parts: to choose from.
        description: of the benchmark.
        seeds: how many there are without the option, for help.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=tuple(parts), action="append", help="default: all")
    parser.add_argument("--seeds", type=int, help=f"default: {seeds}")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--maps", type=Path, metavar="DIR")
    parser.add_argument("--config", type=Path, metavar="FILE")
    parser.add_argument("--device")
    add_record_option(parser)
    return parser


def measure(
    parts: Parts, options: argparse.Namespace, producer: str, width: int, *more: Any
) -> None:
    """Run the parts that are asked for, or all, and print what each took.

    Args:
        parts: what can be asked for.
        options: of ``parser_of``.
        producer: is measured.
        width: of the tables, characters.
        more: told every part after its ``Bench``.
    """
    config = load_config(options.config) if options.config else RunConfig()
    if options.device:
        config = replace(config, device=DeviceConfig(options.device))
    device = open_producer_device(producer, config)
    for name in options.part or parts:
        part, count = parts[name]
        first = options.first_seed
        seeds = tuple(range(first, first + (options.seeds or count)))
        maps = None if options.maps is None else options.maps / name
        console = console_for(f"{producer}-{name}", options.record, width=width)
        began_s = time.perf_counter()
        part(Bench(producer, config, device, seeds, maps, console), *more)
        console.print(f"{name}: {time.perf_counter() - began_s:.0f} s in all\n", highlight=False)
