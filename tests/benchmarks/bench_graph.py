"""Measure the graph SLAM, part by part: accuracy, time, more buildings, loops, events.

    python -m tests.benchmarks.bench_graph --part recordings --seeds 5 --maps out/bench_graph

recordings: mean translation over all relations [K09] at the end, as first reported, and of the best
trajectory in the folder (the floor); the relations at scans apart; times.
logs: gmapping-corrected logs of more buildings, driven by their reconstructed odometry. With --maps
a map and a report of each, to be looked at: there is no truth.
floors: simulated loops of 100 m and 300 m and places that look alike; closures that join what is
over 0.5 m or 0.1 rad apart are false.
events: an hour without a scan, a robot that is carried away, a log that starts in mid-loop.

A simulated part drives another course with every seed. With --maps the first seed's maps are
written as PNG, to be looked at: --first-seed chooses which. --config takes a YAML file of settings,
as the command line does.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from slamfusion.compute import open_backend
from slamfusion.config import DeviceConfig, RunConfig, load_config
from tests.benchmarks.gmapping.bench import Bench
from tests.benchmarks.graph.recorded import logs, recordings
from tests.benchmarks.graph.simulated import events, floors

PRODUCER = "graph"
# Each part, and how many seeds it takes where none are asked for.
PARTS: dict[str, tuple[Callable[[Bench, Sequence[str]], None], int]] = {
    "recordings": (recordings, 5),
    "logs": (logs, 1),
    "floors": (floors, 5),
    "events": (events, 3),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=tuple(PARTS), action="append", help="default: all")
    parser.add_argument(
        "--only", action="append", metavar="NAME", help="drive, log, floor or event"
    )
    parser.add_argument("--seeds", type=int, help="default: 5; events 3, logs 1")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--maps", type=Path, metavar="DIR")
    parser.add_argument("--config", type=Path, metavar="FILE")
    parser.add_argument("--device")
    options = parser.parse_args()
    config = load_config(options.config) if options.config else RunConfig()
    if options.device:
        config = replace(config, device=DeviceConfig(options.device))
    backend = open_backend(config.device.device)
    console = Console(width=230)
    for name in options.part or PARTS:
        part, count = PARTS[name]
        first = options.first_seed
        seeds = tuple(range(first, first + (options.seeds or count)))
        maps = None if options.maps is None else options.maps / name
        began_s = time.perf_counter()
        part(Bench(PRODUCER, config, backend, seeds, maps, console), options.only or ())
        console.print(f"{name}: {time.perf_counter() - began_s:.0f} s in all\n", highlight=False)


if __name__ == "__main__":
    main()
