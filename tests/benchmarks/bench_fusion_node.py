"""Latency of the fusion node over DDS: ``python -m tests.benchmarks.bench_fusion_node [SIDE ...]``.

Three maps of one building are published at 1 Hz from this process, each changed within a window of
20 m; the node runs in its own. Shown: what the node says of the time from a map's arrival to the
fused map's publication, and what it published. Options: sides in cells (800 4000).
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from nav_msgs.msg import OccupancyGrid

from slamfusion.ros import messages, qos
from tests.benchmarks.bench_live import NAMES, draw_maps, windowed
from tests.ros.live import Observer, Processes, free_domain, ros_environment, values

FUSION = "fusion: fusion"


def run(side: int, rounds: int) -> None:
    """Print the line of one side."""
    rng = np.random.default_rng(0)
    maps = draw_maps(side)
    with (
        free_domain() as domain,
        tempfile.TemporaryDirectory() as folder,
        Processes({**ros_environment(domain), "POCL_MAX_PTHREAD_COUNT": "2"}, Path(folder)) as run,
        Observer(domain) as observer,
    ):
        writers = {n: observer.publisher(OccupancyGrid, f"{n}/map", qos.MAP) for n in NAMES}
        fused = observer.collect(OccupancyGrid, "fused/map", qos.MAP)

        def send(changed: bool) -> None:
            for name, grid in maps.items():
                new = windowed(grid, rng) if changed else grid
                stamp = messages.to_stamp(time.time())
                writers[name].publish(messages.grid_to_message(new, f"{name}_map", stamp))

        run.node("fusion")
        send(changed=False)
        observer.wait_status(FUSION, "inputs vote", timeout_s=120.0)
        count = len(fused)
        for _ in range(rounds):
            began = time.monotonic()
            send(changed=True)
            observer.listen(max(0.05, 1.0 - (time.monotonic() - began)))
        observer.listen(3.0)
        told = values(observer.statuses()[FUSION])
        print(
            f"{side} x {side}: {rounds} rounds of three maps, {len(fused) - count} fused maps; "
            f"latency median {told['latency median [ms]']} ms, p95 {told['latency p95 [ms]']} ms; "
            f"{told['voters']} voters, {told['updates']} updates"
        )


if __name__ == "__main__":
    for word in sys.argv[1:] or ("800", "4000"):
        run(int(word), 20)
