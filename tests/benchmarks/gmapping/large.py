"""The part on memory: a place of 200 m by 200 m, of which most is seen."""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from slamfusion.compute import open_device
from slamfusion.config import RunConfig, WorldConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.io import LogScan, save_map
from slamfusion.sim import Course, Recording, simulate
from slamfusion.sim.canvas import Canvas
from slamfusion.sim.drive import DRIVES
from slamfusion.sim.lidar import LIDARS
from slamfusion.slam.common.runner import ProducerRun, run_producer
from slamfusion.slam.registry import make_producer
from tests.benchmarks.gmapping.bench import Bench, shown

SIDE_M = 200.0
# The truth's own cells; those of the filter's map are set by its configuration.
TRUTH_CELL_M = 0.25
CONTAINERS = 450
LANES_M = (20.0, 60.0, 100.0, 140.0, 180.0)
STOP_EVERY_M = 32.0
ROOM_M = 3.0
SHELL_M = 0.5
# So that neighbouring scans lie at most 1.3 m and half a radian apart.
SPEED_MPS, TURN_RAD_S = 2.0, 0.7
SCANS_HZ = 1.6
PARTICLES = (30, 80)


class Large(NamedTuple):
    """A run in a process of its own, and the most bytes that the process has held at once.

    Before the first scan, up to the last one, and with the finished map.
    """

    run: ProducerRun
    filter: dict[str, Any] | None
    peaks: tuple[int, ...]


def draw_grounds(seed: int) -> tuple[OccupancyGrid, list[tuple[float, float]]]:
    """Draw fenced grounds with containers at any angle, and the stops of a drive along the lanes.

    Args:
        seed: of the drawing.

    Returns:
        The truth, zero of its frame at the first stop; and the stops, metres, the last one the
        first again.
    """
    rng = np.random.default_rng(seed)
    canvas = Canvas(SIDE_M, SIDE_M, TRUTH_CELL_M)
    canvas.fill((0.0, 0.0, SIDE_M, SIDE_M), FREE)
    canvas.outline((0.0, 0.0, SIDE_M, SIDE_M))
    for _ in range(CONTAINERS):
        centre = (rng.uniform(3.0, SIDE_M - 3.0), rng.uniform(3.0, SIDE_M - 3.0))
        size = (rng.uniform(2.0, 6.0), rng.uniform(0.5, 2.5))
        yaw_rad = rng.uniform(0.0, np.pi)
        canvas.turned_box(centre, size, yaw_rad, OCCUPIED)
        inside = (size[0] - 2.0 * SHELL_M, size[1] - 2.0 * SHELL_M)
        if min(inside) > SHELL_M:
            canvas.turned_box(centre, inside, yaw_rad, UNKNOWN)
    along = np.arange(LANES_M[0], LANES_M[-1] + 1.0, STOP_EVERY_M)
    stops = [
        (float(x), y)
        for number, y in enumerate(LANES_M)
        for x in (along if number % 2 == 0 else along[::-1])
    ]
    for stop in stops:
        canvas.disc(stop, ROOM_M, FREE)
    x0, y0 = stops[0]
    grid = OccupancyGrid(canvas.cells, TRUTH_CELL_M, Pose2(-x0, -y0), "grounds")
    return grid, [(x - x0, y - y0) for x, y in (*stops[1:], stops[0])]


def drive_grounds(bench: Bench, seed: int) -> Recording:
    """Simulate a drive along all lanes and back to the start."""
    grid, stops = draw_grounds(seed)
    with tempfile.TemporaryDirectory() as folder:
        save_map(grid, Path(folder) / "grounds")
        course = Course(
            name="grounds",
            seed=seed,
            world=WorldConfig(name="map", map="grounds.yaml"),
            lidar=replace(LIDARS["hokuyo"], rate_hz=SCANS_HZ),
            drive=replace(DRIVES["differential"], speed_mps=SPEED_MPS, turn_rate_rad_s=TURN_RAD_S),
            start=Pose2(),
            waypoints=tuple(stops),
            folder=Path(folder),
        )
        return simulate(course, bench.device)


def run_alone(producer: str, config: RunConfig, on_device: str, scans: Sequence[LogScan]) -> Large:
    """Run a producer; called in a process that holds nothing else."""
    device = make_producer(producer, config, open_device(on_device))
    peaks = [process_peak()]

    def note(done: int) -> None:
        if done == len(scans):
            peaks.append(process_peak())

    run = run_producer(device, scans, progress=note)
    return Large(run, run.health.to_json().get("filter"), (*peaks, process_peak()))


def process_peak() -> int:
    """Return the most bytes that this process has held at once (Linux).

    Not ``getrusage``: its figure counts what the process that started this one held.
    """
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (peak,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return 1024 * int(peak)


def memory(bench: Bench) -> None:
    """Peak memory of filter and process, and the tiles that particles share and own."""
    table = bench.table(
        f"{SIDE_M:g} m x {SIDE_M:g} m; MB of 10^6 bytes",
        "particles",
        "seed",
        "scans",
        "path m",
        "map",
        "truth seen %",
        "map and filter MB",
        "process MB: before",
        "feeding",
        "with the map",
        "ms",
        "p95 ms",
        "ATE m",
    )
    device = bench.config.device.device
    filters = []
    context = multiprocessing.get_context("spawn")  # the child holds none of this process
    for seed in bench.seeds:
        recording = drive_grounds(bench, seed)
        bench.keep_map(recording.world.grid, seed, "grounds", "truth")
        for count in PARTICLES if bench.is_filter else PARTICLES[:1]:
            config = replace(bench.configured(particles=count), seed=seed)
            with ProcessPoolExecutor(1, mp_context=context) as pool:
                job = pool.submit(run_alone, bench.producer, config, device, recording.scans)
                found = job.result()
            run = found.run
            judged = bench.judge(run, recording.truth, recording.world.grid)
            bench.keep_map(run.grid, seed, "grounds", f"{count} particles")
            time = run.time_per_scan_ms()
            known = int(np.count_nonzero(run.grid.cells != UNKNOWN))
            table.add_row(
                str(count),
                str(seed),
                str(run.scans),
                f"{recording.truth.path_length_m():.0f}",
                f"{run.grid.width} x {run.grid.height}, {known / 1e6:.1f} M known",
                f"{100.0 * judged.walls.coverage:.1f}",
                f"{run.peak_memory_bytes / 1e6:.1f}",
                *(f"{peak / 1e6:.0f}" for peak in found.peaks),
                f"{time['mean']:.2f}",
                f"{time['p95']:.2f}",
                shown(judged.path.ate.rmse),
            )
            filters.append(f"{count} particles, seed {seed}: filter {found.filter}")
    bench.console.print(table)
    for line in filters:
        bench.console.print(line, highlight=False, soft_wrap=True)
