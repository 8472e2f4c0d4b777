"""Table of vote times: ``python -m tests.benchmarks.bench_vote_time``.

Each row is a mode and a number of inputs: medians of the copy of the grids and of the vote, and
their ratio.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from statistics import median

import numpy as np
from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.config import VoteConfig
from slamfusion.fusion.vote import vote_grids
from tests.benchmarks.record import add_record_option, console_for

RUNS = 7


def run(side: int, record: Path | None) -> None:
    """Print the table."""
    device = open_device()
    rng = np.random.default_rng(0)
    columns = ("mode", "inputs", "copy ms", "vote ms", "ratio")
    table = Table(*columns, title=f"{side} x {side} on {device.name}")
    for mode in ("majority", "weighted", "log-odds"):
        for count in (1, 2, 3, 4, 8, 12):
            percents = [rng.integers(-1, 101, (side, side)).astype(np.int8) for _ in range(count)]
            grids = [np.where(p < 0, -1, p > 50).astype(np.int8) for p in percents]
            targets = [np.zeros_like(grid) for grid in grids]
            weights = [1.0 / (n + 1) for n in range(count)]
            copies, votes = [], []
            for _ in range(RUNS + 1):
                began = time.perf_counter()
                for grid, target in zip(grids, targets, strict=True):
                    np.copyto(target, grid)
                copied = time.perf_counter()
                vote_grids(grids, VoteConfig(mode=mode), device, weights=weights, percents=percents)
                copies.append(copied - began)
                votes.append(time.perf_counter() - copied)
            copy_s, vote_s = median(copies[1:]), median(votes[1:])
            times = (1e3 * copy_s, 1e3 * vote_s, vote_s / copy_s)
            table.add_row(mode, str(count), *(f"{number:.2f}" for number in times))
    console_for("vote-time", record, width=100).print(table)


def main() -> None:
    """Read the options and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("side", type=int, nargs="?", default=2000, help="of the grids, cells")
    add_record_option(parser)
    options = parser.parse_args()
    run(options.side, options.record)


if __name__ == "__main__":
    main()
