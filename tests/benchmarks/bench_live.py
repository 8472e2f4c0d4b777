"""Map in to fused map out, live: ``python -m tests.benchmarks.bench_live [SIDE ...]``.

With ``--drive office slip f16 LOG:RELATIONS`` whole drives are fused live instead, scan by scan,
and compared with ``run``; see ``live_drives``.

Three maps of one building, each in a frame of its own, grow as a robot drives through: every round
all three change around it, by a window of 20 m, and are put one after the other, each followed by
its update. Then every cell of all three is shaken in every round (2 % flipped), which is the worst
that can come. ``idle`` is the mean time a round that was spent on what may wait (an update without
a new map).
"""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.progress import track
from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.config import RunConfig
from slamfusion.fusion.live import LiveFusion, LiveUpdate
from slamfusion.grid import UNKNOWN, CellBox, OccupancyGrid
from slamfusion.sim import draw_building
from slamfusion.slam.registry import BUILT_IN
from tests.benchmarks.live_drives import CASES, drive_table
from tests.benchmarks.record import bench_parser, console_for
from tests.support.degrade import Degradation, degrade_map

RESOLUTION = 0.05
WINDOW_M = 20.0
Maps = dict[str, OccupancyGrid]


def draw_maps(side: int, names: Sequence[str] = BUILT_IN) -> Maps:
    """Return faulty maps of one building, three unless named, a frame each."""
    rng = np.random.default_rng(2016)
    truth = draw_building(rng, side * RESOLUTION, side * RESOLUTION, RESOLUTION)
    maps = {}
    for name in names:
        faults = Degradation(
            yaw_rad=float(rng.uniform(-math.pi, math.pi)), flip_share=0.005, speckle_share=0.01
        )
        grid, _ = degrade_map(truth, rng, faults)
        row, col = max(0, grid.height - side) // 2, max(0, grid.width - side) // 2
        box = CellBox(row, col, min(row + side, grid.height), min(col + side, grid.width))
        maps[name] = grid.crop(box).with_name(name)
    return maps


def revealed(grid: OccupancyGrid, share: float) -> OccupancyGrid:
    """Return the middle of the map, a share of its side; the rest is unknown."""
    cells = np.full_like(grid.cells, UNKNOWN)
    row, col = (int(size * (1.0 - share) / 2.0) for size in grid.cells.shape)
    window = np.s_[row : grid.height - row, col : grid.width - col]
    cells[window] = grid.cells[window]
    return OccupancyGrid(cells, grid.resolution, grid.origin, grid.name)


def windowed(grid: OccupancyGrid, rng: np.random.Generator) -> OccupancyGrid:
    """Return the map with 2 % of the cells flipped in one window."""
    window = int(WINDOW_M / RESOLUTION)
    row, col = (int(rng.integers(0, max(1, size - window))) for size in grid.cells.shape)
    return shaken(grid, rng, np.s_[row : row + window, col : col + window])


def shaken(
    grid: OccupancyGrid, rng: np.random.Generator, window: tuple[slice, slice] = np.s_[:, :]
) -> OccupancyGrid:
    """Return the map with 2 % of the cells of a window flipped."""
    cells = grid.cells.copy()
    part = cells[window]
    flip = rng.random(part.shape, dtype=np.float32) < 0.02
    part[flip & (part >= 0)] = 100 - part[flip & (part >= 0)]
    return OccupancyGrid(cells, grid.resolution, grid.origin, grid.name)


@dataclass
class Row:
    """What one kind of rounds took.

    Attributes:
        name: of the kind.
        spent: wall time of each update with a new map, seconds.
        cpu: processor time of the same, all threads.
        idle: wall time of each round's updates without one.
        updates: what they did.
    """

    name: str
    spent: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    idle: list[float] = field(default_factory=list)
    updates: list[LiveUpdate] = field(default_factory=list)

    def put(self, live: LiveFusion, grids: list[OccupancyGrid], clock: float) -> None:
        """Put maps and time the update."""
        began, cpu = time.perf_counter(), time.process_time()
        for grid in grids:
            live.put(grid.name, grid, clock)
        update = live.update(clock)
        self.spent.append(time.perf_counter() - began)
        self.cpu.append(time.process_time() - cpu)
        if update is not None:
            self.updates.append(update)

    def rest(self, live: LiveFusion, clock: float) -> None:
        """Time what could wait."""
        began = time.perf_counter()
        while live.update(clock) is not None:
            pass
        self.idle.append(time.perf_counter() - began)

    def cells(self) -> list[str]:
        """Return what the table says of it."""
        ms = 1e3 * np.array(self.spent)
        steps = Counter[str]()
        for update in self.updates:
            steps.update(update.time_s)
        parts = ", ".join(f"{k} {1e3 * s / len(self.updates):.0f}" for k, s in steps.items())
        searches = sum(update.is_full_search for update in self.updates)
        voters = min(sum(r.accepted for r in update.inputs) for update in self.updates)
        idle = 1e3 * np.mean(self.idle) if self.idle else 0.0
        times = (np.median(ms), np.percentile(ms, 95), ms.max(), 1e3 * np.mean(self.cpu), idle)
        shown = [f"{number:.0f}" for number in times]
        return [self.name, *shown, parts, str(searches), str(voters)]


KINDS = (
    "grows",
    "a window of 20 m, one each",
    "a window of 20 m, three at once",
    "every cell, one each",
    "every cell, three at once",
)


def new_maps(kind: str, maps: Maps, rng: np.random.Generator, done: float) -> list[OccupancyGrid]:
    """Return the maps of a round; ``done`` is the share of the rounds so far."""
    if kind == "grows":
        return [revealed(grid, 0.6 + 0.4 * done) for grid in maps.values()]
    change = shaken if "every" in kind else windowed
    return [change(grid, rng) for grid in maps.values()]


COLUMNS = (
    "side", "changed", "median ms", "p95", "worst", "CPU", "idle", "of it", "searches",
    "fewest voters",
)  # fmt: skip


def run(side: int, rounds: int, table: Table) -> None:
    """Put the rows of one side into the table."""
    rng = np.random.default_rng(0)
    maps = draw_maps(side)
    live = LiveFusion(RunConfig(), open_device())
    clock = 0.0
    first = Row("first fusion")
    first.put(live, [revealed(grid, 0.6) for grid in maps.values()], clock)
    table.add_row(str(side), *first.cells())
    for kind in track(KINDS, f"{side} x {side}", disable=not sys.stderr.isatty()):
        row = Row(kind)
        for number in range(rounds):
            clock += 1.0
            batch = new_maps(kind, maps, rng, (number + 1) / rounds)
            step = len(batch) if "at once" in kind else 1
            for index in range(0, len(batch), step):
                row.put(live, batch[index : index + step], clock)
            row.rest(live, clock)
        table.add_row(str(side), *row.cells())


def main() -> None:
    """Print a table of all sides."""
    parser = bench_parser(__doc__)
    parser.add_argument("sides", type=int, nargs="*", default=[800, 4000], help="in cells")
    parser.add_argument("--rounds", type=int, help="default: 20, of 2000 cells and more 6")
    parser.add_argument("--drive", nargs="+", default=[], metavar="COURSE|LOG:RELATIONS")
    parser.add_argument("--case", nargs="+", type=int, default=range(len(CASES)), help="of CASES")
    parser.add_argument("--keep", type=Path, help="a folder that keeps what producers told")
    options = parser.parse_args()
    if options.drive:
        shown = drive_table(options.drive, options.keep, options.case, open_device())
        console_for("live-drives", options.record, width=200).print(shown)
        return
    table = Table(*COLUMNS, title=f"three maps on {open_device().name}")
    for side in options.sides:
        run(side, options.rounds or (20 if side < 2000 else 6), table)
    console_for("live", options.record, width=200).print(table)


if __name__ == "__main__":
    main()
