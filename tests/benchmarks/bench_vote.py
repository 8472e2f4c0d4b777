"""Table of vote times over modes and numbers of inputs: ``python -m tests.benchmarks.bench_vote``.

Each row: median seconds, and the ratio to copying the same grids. Options: side in cells (2000).
"""

from __future__ import annotations

import sys
import time
from statistics import median

import numpy as np

from slamfusion.compute import open_device
from slamfusion.config import VoteConfig
from slamfusion.fusion.vote import vote_grids

RUNS = 7


def main(side: int) -> None:
    """Print the table."""
    device = open_device()
    rng = np.random.default_rng(0)
    print(f"{side} x {side} on {device.name}")
    print(f"{'mode':10} {'inputs':>6} {'copy ms':>9} {'vote ms':>9} {'ratio':>7}")
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
            row = f"{1e3 * copy_s:9.2f} {1e3 * vote_s:9.2f} {vote_s / copy_s:7.2f}"
            print(f"{mode:10} {count:6} {row}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
