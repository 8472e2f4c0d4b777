"""Fuse a site that exceeds memory into a Zarr store.

    python -m tests.benchmarks.bench_fleet site --maps 60 --cells 3500 --parts 1 --folder DIR

``site`` draws maps of one building that overlap by 20 to 60 % into a folder, each turned by any
angle, then fuses them with the installed command, and prints the size of the union, how many maps
lie in their places, the time, and the peak of memory of each process. Further options go to that
command.
"""

from __future__ import annotations

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

import numpy as np
import psutil
from rich.table import Table

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.io import save_map
from tests.benchmarks.bench_many import RIGHT_M
from tests.benchmarks.record import bench_parser, console_for
from tests.support import sites
from tests.support.sites import ManyMaps

LOOK_S = 0.2


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
    parser = bench_parser(__doc__)
    parser.add_argument("what", choices=("site", "draw"))
    parser.add_argument("--maps", type=int, default=40)
    parser.add_argument("--cells", type=int, default=700, help="on a side of a map")
    parser.add_argument("--parts", type=int, default=4, help="of a drawn cell, on its side")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path("out/site"))
    asked, more = parser.parse_known_args()
    if asked.what == "draw":
        draw_maps(asked.folder, asked.maps, asked.cells, asked.parts, asked.seed)
    else:
        site(asked.maps, asked.cells, asked.parts, asked.seed, asked.folder, more, asked.record)


if __name__ == "__main__":
    os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", "1")
    main()
