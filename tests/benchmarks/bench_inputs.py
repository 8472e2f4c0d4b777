"""Latency of the live fusion of many inputs: ``python -m tests.benchmarks.bench_inputs [N ...]``.

Every input is a map of one building in a frame of its own and changes once a second within another
window of 20 m (2 % of its cells flipped, walls too: more than a robot changes). Time is virtual:
maps come at their seconds, and work takes the processor time of this process, so that other
programs on the machine add nothing. Shown for the seconds after the first fusion: the time from a
map's coming to the publication of the first fused map that was made after it, and what the work
cost a second. What ROS adds is not in it.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.config import RunConfig
from slamfusion.fusion.live import LiveFusion
from slamfusion.fusion.live.session import FusedMap, FusionSession, warm_up
from slamfusion.grid import OccupancyGrid
from tests.benchmarks.bench_live import draw_maps, windowed
from tests.benchmarks.record import add_record_option, console_for

PERIOD_S, TURN_S = 1.0, 0.02
FIRST_S = 300.0


class Clock:
    """Processor time since it was made, and what was waited."""

    def __init__(self) -> None:
        self.waited_s = -time.process_time()

    def __call__(self) -> float:
        return self.waited_s + time.process_time()


class Desk:
    """Hands the session the maps whose second has come, whenever it looks at the clock."""

    def __init__(self, live: LiveFusion, clock: Clock) -> None:
        self.live, self.clock = live, clock
        self.coming: list[tuple[float, OccupancyGrid]] = []
        self.unshown_s: list[float] = []
        self.latencies_s: list[float] = []
        self.fused = 0

    def now_s(self) -> float:
        """Return the time, after what came until then was put."""
        now_s = self.clock()
        while self.coming and self.coming[0][0] <= now_s:
            arrived_s, grid = self.coming.pop(0)
            self.live.put(grid.name, grid, arrived_s)
            self.unshown_s.append(arrived_s)
        return now_s

    def publish(self, _: FusedMap) -> None:
        """Count a fused map."""
        self.fused += 1
        self.latencies_s += [self.clock() - came_s for came_s in self.unshown_s]
        self.unshown_s.clear()


def run(count: int, side: int, rounds: int) -> list[str]:
    """Return the row of one count of inputs."""
    rng = np.random.default_rng(0)
    maps = draw_maps(side, tuple(f"robot{number}" for number in range(count)))
    config, device, clock = RunConfig(), open_device(), Clock()
    warm_up(config, device)
    desk = Desk(LiveFusion(config, device), clock)
    session = FusionSession(
        desk.live,
        5.0,
        publish=desk.publish,
        publish_agreement=lambda _: None,
        stamp_s=lambda _: 0.0,
        on_vote=lambda _: None,
        clock=desk.now_s,
    )

    def voters() -> int:
        return sum(record.accepted for record in session.snapshot.inputs.values())

    began_s = clock()
    desk.coming = [(began_s, grid) for grid in maps.values()]
    while voters() < count and clock() - began_s < FIRST_S:
        session.turn()
        clock.waited_s += TURN_S
    first_s = clock() - began_s
    desk.latencies_s.clear()
    desk.fused = 0
    began_s, spent_s = clock(), time.process_time()
    for number in range(rounds):
        for name in maps:
            maps[name] = windowed(maps[name], rng)
            desk.coming.append((began_s + (number + rng.random()) * PERIOD_S, maps[name]))
    desk.coming.sort(key=lambda item: item[0])
    clock.waited_s -= time.process_time() - spent_s  # drawing them took no time
    spent_s = time.process_time()
    while desk.coming or session.waiting is not None:
        session.turn()
        if not desk.live.has_news:
            clock.waited_s += TURN_S
    spent_s = (time.process_time() - spent_s) / (rounds * PERIOD_S)
    times_ms = 1e3 * np.percentile(desk.latencies_s, (50.0, 95.0, 100.0))
    figures = (*(f"{value:.0f}" for value in times_ms), f"{spent_s:.2f}", f"{first_s:.1f}")
    return [str(count), str(side), str(desk.fused), *figures, str(voters())]


COLUMNS = (
    "inputs", "side", "fused maps", "median ms", "p95", "worst", "CPU a second, s",
    "all vote after s", "voters",
)  # fmt: skip


def main() -> None:
    """Print a table of all counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("counts", type=int, nargs="*", default=[3, 10, 20], help="of inputs")
    parser.add_argument("--side", type=int, default=600, help="in cells")
    parser.add_argument("--rounds", type=int, default=6, help="seconds")
    add_record_option(parser)
    options = parser.parse_args()
    table = Table(*COLUMNS, title=f"inputs at 1 Hz on {open_device().name}")
    for count in options.counts:
        table.add_row(*run(count, options.side, options.rounds))
    console_for("inputs", options.record, width=160).print(table)


if __name__ == "__main__":
    main()
