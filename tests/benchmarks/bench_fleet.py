"""What a fleet costs and saves: Dask against processes, and a site that exceeds memory.

    python -m tests.benchmarks.bench_fleet overhead --maps 40 --workers 2
    python -m tests.benchmarks.bench_fleet site --maps 60 --cells 3500 --parts 1 --folder DIR

``overhead`` fuses the maps of a simulated site (``tests.support.sites``) on so many processes and
on as many workers of a Dask cluster, in turn, after a warm-up of each, and prints wall clock and
the processor time of the caller and of the workers. ``site`` draws maps of one building that
overlap by 20 to 60 % into a folder, each turned by any angle, then fuses them into a Zarr store
with the installed command, and prints the size of the union, how many maps lie in their places, the
time, and the peak of memory of each process. Further options go to that command.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
import psutil
from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.fleet import executor_for
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import save_map
from slamfusion.jobs.fuse import fuse_maps
from tests.benchmarks.bench_many import CONFIG, RIGHT_M
from tests.benchmarks.record import add_record_option, console_for
from tests.support import sites
from tests.support.sites import ManyMaps, many_maps

LOOK_S = 0.2


# --- Dask against processes -------------------------------------------------------------------


def overhead(maps: int, workers: int, cells: int, runs: int, record: Path | None) -> None:
    """Print the table of times."""
    device = open_device()
    grids = list(many_maps(maps, 1, cells).grids)
    table = Table(title=f"{maps} maps of {cells} x {cells} on {workers} workers")
    for name in ("tasks on", "wall s", "CPU s here", "CPU s of workers", "CPU s in all"):
        table.add_column(name, justify="left" if name == "tasks on" else "right")
    found: dict[str, list[tuple[float, float, float]]] = {}
    with executor_for(processes=workers) as processes, executor_for(f"local:{workers}") as cluster:
        executors = {"processes": processes, "Dask": cluster}
        for executor in executors.values():
            fuse_maps(grids, CONFIG, device, executor=executor)
        for _ in range(runs):
            for name, executor in executors.items():
                began_s, began = time.perf_counter(), cpu_of_all()
                fuse_maps(grids, CONFIG, device, executor=executor)
                here, others = (b - a for a, b in zip(began, cpu_of_all(), strict=True))
                wall_s = time.perf_counter() - began_s
                found.setdefault(name, []).append((wall_s, here, others))
    rows = {
        name: [*map(median, zip(*times, strict=True)), median(map(sum, (t[1:] for t in times)))]
        for name, times in found.items()
    }
    for name, row in rows.items():
        table.add_row(name, *(f"{value:.2f}" for value in row))
    ratios = [dask / pool for dask, pool in zip(rows["Dask"], rows["processes"], strict=True)]
    table.add_row("Dask over processes", *(f"{value:.3f}" for value in ratios))
    console_for("fleet", record).print(table)


def cpu_of_all() -> tuple[float, float]:
    """Return the processor time so far of this process, and of all that it started."""
    own = psutil.Process()
    others = 0.0
    for child in own.children(recursive=True):
        try:
            times = child.cpu_times()
        except psutil.Error:
            continue
        others += times.user + times.system
    times = own.cpu_times()
    return times.user + times.system, others


# --- a site that exceeds memory ---------------------------------------------------------------


def draw_maps(folder: Path, count: int, cells: int, parts: int, seed: int) -> None:
    """Draw maps of one building, one file each, and keep where they lie.

    Args:
        folder: for the files.
        count: maps.
        cells: on a side of a map.
        parts: each drawn cell of 0.05 m becomes so many by so many.
        seed: of everything.
    """
    rng = np.random.default_rng((seed, count, cells))
    facts = []
    for index, (coarse, pose, _) in enumerate(sites.maps_of(0, count, cells // parts, rng)):
        split = np.kron(coarse.cells, np.ones((parts, parts), dtype=np.int8))
        grid = OccupancyGrid(split, coarse.resolution / parts, coarse.origin)
        save_map(grid, folder / f"map_{index}")
        facts.append((grid.origin, grid.cells.shape, grid.resolution, pose))
    (folder / "truth.pickle").write_bytes(pickle.dumps(facts))


def site(
    count: int,
    cells: int,
    parts: int,
    seed: int,
    folder: Path,
    more: Sequence[str],
    record: Path | None,
) -> None:
    """Draw a site where it is not drawn yet, fuse it, and print the table."""
    if not (folder / "truth.pickle").exists():
        folder.mkdir(parents=True, exist_ok=True)
        # In a process of its own: what it takes is no memory of this one.
        wanted = {"maps": count, "cells": cells, "parts": parts, "seed": seed, "folder": folder}
        options = [f"--{name}={value}" for name, value in wanted.items()]
        subprocess.run([sys.executable, "-m", __spec__.name, "draw", *options], check=True)
    store = Path(tempfile.mkdtemp(dir=folder)) / "site.zarr"
    names = [f"map_{index}" for index in range(count)]
    words = [str(folder / f"{name}.yaml") for name in names]
    command = [sys.executable, "-m", "slamfusion", "fuse", *words, "-o", str(store), "--json"]
    command += ["--mode", "consensus", *more]
    began_s = time.perf_counter()
    with (folder / "fuse.json").open("wb") as out:
        process = subprocess.Popen(command, stdout=out)
        peaks = watch(process)
    wall_s = time.perf_counter() - began_s
    if process.returncode:
        sys.exit(process.returncode)
    document = json.loads((folder / "fuse.json").read_text(encoding="utf-8"))
    arrays = json.loads((store / "fused" / ".zarray").read_text(encoding="utf-8"))
    size_mb = sum(path.stat().st_size for path in store.rglob("*") if path.is_file()) / 1e6
    shutil.rmtree(store.parent)
    errors = errors_m(folder, document)
    table = Table(title=f"{count} maps of {cells} x {cells} into a Zarr store")
    columns = ("union", "fused", "right", "worst m", "wall s", "store MB", "peak MiB, each process")
    for name in columns:
        table.add_column(name, justify="right")
    table.add_row(
        " x ".join(map(str, arrays["shape"])),
        str(document["fused_count"]),
        str(sum(error <= RIGHT_M for error in errors)),
        f"{max(errors):.2f}",
        f"{wall_s:.0f}",
        f"{size_mb:.1f}",
        ", ".join(f"{peak:.0f}" for peak in sorted(peaks, reverse=True)),
    )
    console_for("fleet-site", record, width=120).print(table)


def errors_m(folder: Path, document: dict[str, object]) -> list[float]:
    """Return how far the maps that were fused are from their places; see ``ManyMaps``."""
    facts = pickle.loads((folder / "truth.pickle").read_bytes())  # noqa: S301 - our own
    # Places ask for the shape of a map, and where it lies: one cell of memory will do.
    grids = tuple(
        OccupancyGrid(
            np.broadcast_to(np.zeros(1, np.int8), shape).copy(), resolution, origin, f"map_{index}"
        )
        for index, (origin, shape, resolution, _) in enumerate(facts)
    )
    truth = ManyMaps(grids, (0,) * len(facts), tuple(fact[3] for fact in facts), {})
    rows: object = document["inputs"]
    assert isinstance(rows, list)
    found = {
        row["name"]: Pose2(row["dx_m"], row["dy_m"], row["yaw_rad"])
        for row in rows
        if row["accepted"]
    }
    return list(truth.errors_m(str(document["reference"]), found).values())


def watch(process: subprocess.Popen[bytes]) -> list[float]:
    """Wait for a process; return the peak of memory of it and of all that it started, MiB."""
    peaks: dict[int, float] = {}
    while process.poll() is None:
        try:
            family = [psutil.Process(process.pid)]
            family += family[0].children(recursive=True)
        except psutil.Error:
            continue
        for member in family:
            peak = _high_water_mib(member.pid)
            if not math.isnan(peak):
                peaks[member.pid] = max(peak, peaks.get(member.pid, 0.0))
        time.sleep(LOOK_S)
    return list(peaks.values())


def _high_water_mib(pid: int) -> float:
    """Return the most memory that a process ever had resident, as the kernel counts it."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return math.nan
    peaks = [float(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM:")]
    return peaks[0] if peaks else math.nan


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", choices=("overhead", "site", "draw"))
    parser.add_argument("--maps", type=int, default=40)
    parser.add_argument("--cells", type=int, default=700, help="on a side of a map")
    parser.add_argument("--parts", type=int, default=4, help="of a drawn cell, on its side")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=Path("out/site"))
    add_record_option(parser)
    asked, more = parser.parse_known_args()
    if asked.what == "overhead":
        overhead(asked.maps, asked.workers, asked.cells, asked.runs, asked.record)
    elif asked.what == "draw":
        draw_maps(asked.folder, asked.maps, asked.cells, asked.parts, asked.seed)
    else:
        site(asked.maps, asked.cells, asked.parts, asked.seed, asked.folder, more, asked.record)


if __name__ == "__main__":
    os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", "1")
    main()
