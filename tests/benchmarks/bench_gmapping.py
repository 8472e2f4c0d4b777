"""Measure gmapping, part by part: accuracy, time, memory, and what goes wrong with robots.

    python -m tests.benchmarks.bench_gmapping --part recordings --seeds 5 --maps out/bench_gmapping

Of a recorded drive the error is the mean translation over all its relations [K09]; of a simulated
one the root mean square of the absolute trajectory error. A simulated part drives another course
with every seed. With --maps the first seed's maps are written as PNG, to be looked at: --first-seed
chooses which. --config takes a YAML file of settings, as the command line does.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from slamfusion.compute import open_backend
from slamfusion.config import DeviceConfig, RunConfig, load_config
from slamfusion.slam.runner import PRODUCERS
from tests.benchmarks.gmapping.bench import PRODUCER, Bench
from tests.benchmarks.gmapping.large import memory
from tests.benchmarks.gmapping.recorded import no_odometry, particles, recordings
from tests.benchmarks.gmapping.simulated import (
    courses,
    outliers,
    person,
    standing,
    wrong_direction,
)

# Each part, and how many seeds it takes where none are asked for.
PARTS: dict[str, tuple[Callable[[Bench], None], int]] = {
    "recordings": (recordings, 5),
    "no-odometry": (no_odometry, 5),
    "particles": (particles, 5),
    "wrong-direction": (wrong_direction, 5),
    "courses": (courses, 5),
    "person": (person, 5),
    "outliers": (outliers, 5),
    "memory": (memory, 1),
    "standing": (standing, 1),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=tuple(PARTS), action="append", help="default: all")
    parser.add_argument(
        "--producer", choices=tuple(dict.fromkeys((PRODUCER, *PRODUCERS))), default=PRODUCER
    )
    parser.add_argument("--seeds", type=int, help="default: 5; memory and standing 1")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--maps", type=Path, metavar="DIR")
    parser.add_argument("--config", type=Path, metavar="FILE")
    parser.add_argument("--device")
    options = parser.parse_args()
    config = load_config(options.config) if options.config else RunConfig()
    if options.device:
        config = replace(config, device=DeviceConfig(options.device))
    backend = open_backend(config.device.device)
    console = Console(width=190)
    for name in options.part or PARTS:
        part, count = PARTS[name]
        first = options.first_seed
        seeds = tuple(range(first, first + (options.seeds or count)))
        maps = None if options.maps is None else options.maps / name
        began_s = time.perf_counter()
        part(Bench(options.producer, config, backend, seeds, maps, console))
        console.print(f"{name}: {time.perf_counter() - began_s:.0f} s in all\n", highlight=False)


if __name__ == "__main__":
    main()
