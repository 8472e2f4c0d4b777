"""Table of vote times: ``python -m tests.benchmarks.bench_vote_time``.

Each row is a mode and a number of inputs: medians of the copy of the grids and of the vote with all
that it takes, and their ratio.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from statistics import median
from typing import get_args

import numpy as np
from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.config import VoteConfig, VoteMode
from slamfusion.grid import CellBox
from slamfusion.vote.boxes import slices
from slamfusion.vote.tiles import TileVoter
from tests.benchmarks.record import add_record_option, console_for

RUNS = 7


def run(side: int, record: Path | None) -> None:
    """Print the table."""
    device = open_device()
    rng = np.random.default_rng(0)
    columns = ("mode", "inputs", "copy ms", "vote ms", "ratio")
    table = Table(*columns, title=f"{side} x {side} on {device.name}")
    whole = CellBox(0, 0, side, side)
    for mode in get_args(VoteMode):
        for count in (1, 2, 3, 4, 8, 12):
            cells = rng.integers(-1, 2, (side, side)).astype(np.int8)
            grids = {f"map {n}": np.roll(cells, n, axis=1) for n in range(count)}
            voter = TileVoter(whole, VoteConfig(mode), 0.05, tuple(grids))
            copies, votes = [], []
            for _ in range(RUNS + 1):
                began = time.perf_counter()
                for grid in grids.values():
                    grid.copy()
                copied = time.perf_counter()
                shown = {
                    name: voter.prepare(whole, lambda box, grid=grid: grid[slices(box, 0, 0)])
                    for name, grid in grids.items()
                }
                trusted = voter
                if voter.weighs:
                    trusted = voter.trusting(voter.count(whole, shown))
                trusted.decide(whole, shown, device)
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
