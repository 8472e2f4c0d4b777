"""Align recorded maps to degraded copies of themselves and print how many come out right.

    python -m tests.benchmarks.bench_drawn --per-base 40 --seed 1

Any yaw, shift up to half the map, 0 to 5 % flipped cells, crops down to half, walls thinned or
thickened by a cell, resolutions 0.04, 0.05 and 0.1, origin yaw. Right: the centre within one cell
and the yaw within half a degree.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.config import FusionConfig
from slamfusion.fusion import align_grids
from tests.benchmarks.record import add_record_option, console_for
from tests.support.drawn import BASES, case_error, drawn_cases

COLUMNS = ("right", "right, rejected", "wrong, rejected", "wrong, accepted")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--per-base", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="auto")
    add_record_option(parser)
    arguments = parser.parse_args()
    device = open_device(arguments.device)
    config = FusionConfig()
    counts: Counter[tuple[str, str]] = Counter()
    seconds = []
    for case in drawn_cases(arguments.per_base, arguments.seed):
        began = time.perf_counter()
        alignment = align_grids(case.truth, case.moving, config, device)
        seconds.append(time.perf_counter() - began)
        cells, degrees = case_error(case, alignment)
        is_right = cells <= 1.0 and degrees <= 0.5
        outcome = ("right" if is_right else "wrong") + ", " * (
            not alignment.accepted or not is_right
        )
        outcome += "rejected" if not alignment.accepted else "" if is_right else "accepted"
        counts[case.base, outcome] += 1
        if outcome != "right":
            print(case.base, outcome, f"{cells:.2f} cells {degrees:.2f} deg", alignment.reason)
            print("   ", case.degradation)
    table = Table("map", *COLUMNS, title=f"drawn cases on {device.name}")
    for base in BASES:
        table.add_row(base, *(str(counts[base, column]) for column in COLUMNS))
    totals = [sum(counts[base, column] for base in BASES) for column in COLUMNS]
    table.add_row("all", *map(str, totals))
    console_for("drawn", arguments.record).print(table)
    print(f"median {sorted(seconds)[len(seconds) // 2]:.3f} s, {sum(seconds):.1f} s in all")


if __name__ == "__main__":
    main()
