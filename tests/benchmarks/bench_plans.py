"""Floor plans of unknown scale: the sensor maps of four buildings on the plans of all four.

    python -m tests.benchmarks.bench_plans --record

A map belongs on its own plan, and on no other, and not on the mirror image of its own. The error is
that of the corners which a person marked on the map and on the plan. Figures, but for the time, do
not depend on the machine's load.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from rich.progress import track
from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.grid import OccupancyGrid
from slamfusion.io.map_server import load_map
from slamfusion.jobs.align import align_plan
from tests.benchmarks.record import bench_parser, console_for
from tests.support.halmstad import CELL_M
from tests.support.plans import maps_of, marked_error_m, places, plan_of

OWN, OTHER, MIRRORED = "own plan", "plan of another building", "own plan, mirrored"


@dataclass
class Row:
    """What came out for one place and kind of plan."""

    pairs: int = 0
    accepted: int = 0
    errors_m: list[float] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)


def pairs(kinds: list[str], only: list[str]) -> Iterator[tuple[str, str, Path, OccupancyGrid]]:
    """Yield the kind, the place, the map and the plan of each pair."""
    plans = {place: plan_of(place) for place in places()}
    for place in only or places():
        for path in maps_of(place):
            own = plans[place]
            if OWN in kinds:
                yield OWN, place, path, own
            if MIRRORED in kinds:
                image = np.ascontiguousarray(own.cells[:, ::-1])
                yield MIRRORED, place, path, replace(own, cells=image)
            if OTHER in kinds:
                for other in plans.values():
                    if other is not own:
                        yield OTHER, place, path, other


def main() -> None:
    """Read the options and run."""
    parser = bench_parser(__doc__)
    parser.add_argument("--kinds", nargs="+", default=[OWN, OTHER, MIRRORED])
    parser.add_argument("--places", nargs="+", default=[])
    options = parser.parse_args()
    device = open_device()
    rows: dict[tuple[str, str], Row] = {}
    todo = list(pairs(options.kinds, options.places))
    for kind, place, path, plan in track(todo, disable=not sys.stderr.isatty()):
        row = rows.setdefault((kind, place), Row())
        seen = load_map(path, resolution=CELL_M)
        began = time.process_time()
        found = align_plan(seen, plan, device=device)
        row.times_s.append(time.process_time() - began)
        row.pairs += 1
        if found.alignment.accepted:
            row.accepted += 1
            if kind == OWN:
                where = found.alignment.transform
                row.errors_m.append(marked_error_m(seen.name, found.plan, where))
    table = Table(
        "maps on", "place", "pairs", "accepted", "within 1 m", "median error m", "CPU s a pair"
    )
    for (kind, place), row in sorted(rows.items()):
        within = str(sum(error < 1.0 for error in row.errors_m)) if kind == OWN else "-"
        error = f"{np.median(row.errors_m):.2f}" if row.errors_m else "-"
        numbers = (str(row.pairs), str(row.accepted), within, error)
        table.add_row(kind, place, *numbers, f"{np.median(row.times_s):.1f}")
    console_for("plans", options.record, width=120).print(table)


if __name__ == "__main__":
    main()
