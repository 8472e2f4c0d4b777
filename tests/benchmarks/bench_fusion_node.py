"""Latency of the fusion node over DDS: ``python -m tests.benchmarks.bench_fusion_node``.

Maps of one building, three unless ``--inputs`` says otherwise, are published at 1 Hz from this
process, each changed within another window of 20 m every round; the node runs in its own. Shown,
for the rounds after the first fusion: the time from before a round's maps are sent to the fused map
of its last stamp heard here, both ways through DDS; and what the node says of the time from a map's
arrival to its publication, the first fusion's full search with it. Changes add up: small maps are
noise after twenty rounds.

The way through DDS is much of it, and its tail all of it on a busy machine: see it with and without
FASTRTPS_DEFAULT_PROFILES_FILE=launch_scripts/fastdds-large-maps.xml.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from nav_msgs.msg import OccupancyGrid
from rich.table import Table

from slamfusion.ros import messages, qos
from tests.benchmarks.bench_live import NAMES, draw_maps, windowed
from tests.benchmarks.record import add_record_option, console_for
from tests.ros.live import Observer, Processes, free_domain, ros_environment, values

FUSION = "fusion: fusion"
# A round whose fused map has not come by then is lost.
MOST_S = 8.0


COLUMNS = (
    "inputs", "side", "rounds", "lost", "fused maps", "sent to heard, ms: median", "p95",
    "the node says, ms: median", "p95", "voters", "updates",
)  # fmt: skip


def run(side: int, rounds: int, inputs: int) -> list[str]:
    """Return the row of one side."""
    rng = np.random.default_rng(0)
    names = NAMES if inputs == len(NAMES) else [f"robot{number + 1}" for number in range(inputs)]
    maps = draw_maps(side, names)
    with (
        free_domain() as domain,
        tempfile.TemporaryDirectory() as folder,
        Processes({**ros_environment(domain), "POCL_MAX_PTHREAD_COUNT": "2"}, Path(folder)) as run,
        Observer(domain) as observer,
    ):
        writers = {n: observer.publisher(OccupancyGrid, f"{n}/map", qos.MAP) for n in names}
        fused = observer.collect(OccupancyGrid, "fused/map", qos.MAP)

        def send(*, changed: bool) -> float:
            stamp = messages.to_stamp(0.0)
            for name, grid in maps.items():
                maps[name] = windowed(grid, rng) if changed else grid
                stamp = messages.to_stamp(time.time())
                writers[name].publish(messages.grid_to_message(maps[name], f"{name}_map", stamp))
            return stamp.sec + 1e-9 * stamp.nanosec

        topics = ",".join(f"{name}/map" for name in names)
        run.node("fusion", "-p", f"inputs:=[{topics}]")
        send(changed=False)
        observer.wait_status(FUSION, "inputs vote", timeout_s=120.0)
        observer.wait_status(FUSION, f"all {inputs} inputs vote", timeout_s=120.0)
        observer.listen(3.0)
        count = len(fused)
        latencies_ms, lost = [], 0
        for _ in range(rounds):
            began = time.monotonic()
            last_s = send(changed=True)
            while time.monotonic() - began < 1.0 or messages.stamp_s(fused[-1]) < last_s - 1e-6:
                if time.monotonic() - began > MOST_S:
                    lost += 1
                    break
                before = messages.stamp_s(fused[-1])
                observer.listen(0.01)
                if before < last_s - 1e-6 <= messages.stamp_s(fused[-1]):
                    latencies_ms.append(1e3 * (time.monotonic() - began))
        observer.listen(1.5)
        told = values(observer.statuses()[FUSION])
        median, p95 = np.percentile(latencies_ms, (50.0, 95.0))
        told_of = ("latency median [ms]", "latency p95 [ms]", "voters", "updates")
        counts = (inputs, side, rounds, lost, len(fused) - count)
        heard = (f"{median:.0f}", f"{p95:.0f}")
        return [*map(str, counts), *heard, *(told[key] for key in told_of)]


def main() -> None:
    """Print a table of all sides."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sides", type=int, nargs="*", default=[800, 4000], help="in cells")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--inputs", type=int, default=3)
    add_record_option(parser)
    options = parser.parse_args()
    table = Table(*COLUMNS, title="maps at 1 Hz over DDS")
    for side in options.sides:
        table.add_row(*run(side, options.rounds, options.inputs))
    console_for("fusion-node", options.record, width=160).print(table)


if __name__ == "__main__":
    main()
