"""Fuse three large maps of one building with the installed command: processor time and memory.

    python -m tests.benchmarks.bench_large --cells 4000
    python -m tests.benchmarks.bench_large --runs 3 --record

A building is drawn, as large as the maps, and three maps of it are cut, turned by some degrees and
with three in a thousand of the free cells drawn as walls. Each run is a process of its own: its
processor time (user and system, the interpreter's start included), wall clock and peak of memory
are medians over the runs.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from rich.table import Table

from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.io import save_map
from slamfusion.sim import draw_building
from tests.benchmarks.record import add_record_option, console_for

RESOLUTION = 0.05
YAWS_RAD = (0.0, 0.05, -0.08)
# Side of the building, in sides of a map; share of the free cells that are drawn as walls.
BUILDING, SPECKS = 0.975, 0.003


@dataclass(frozen=True)
class Run:
    """One fusion.

    Attributes:
        fused: how many maps were.
        doubled: share of the fused walls that are doubled.
        cpu_s, wall_s: of the process.
        peak_mib: of the process, mebibytes.
    """

    fused: int
    doubled: float
    cpu_s: float
    wall_s: float
    peak_mib: float


def draw_maps(folder: Path, cells: int, seed: int) -> list[Path]:
    """Draw the maps of a building; return their YAML files."""
    rng = np.random.default_rng(seed)
    side_m = BUILDING * cells * RESOLUTION
    building = draw_building(rng, side_m, side_m, RESOLUTION).cells
    files = []
    for number, yaw_rad in enumerate(YAWS_RAD):
        turn = np.array(
            [[math.cos(yaw_rad), -math.sin(yaw_rad)], [math.sin(yaw_rad), math.cos(yaw_rad)]]
        )
        middle = np.array(building.shape[::-1]) / 2.0
        shift = middle - turn @ np.full(2, cells / 2.0)
        turned = cv2.warpAffine(
            building.view(np.uint8),
            np.column_stack((turn, shift)),
            (cells, cells),
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=int(np.int8(UNKNOWN).view(np.uint8)),
        )
        drawn = np.asarray(turned).view(np.int8)
        drawn[(rng.random(drawn.shape, dtype=np.float32) < SPECKS) & (drawn == FREE)] = OCCUPIED
        files.append(folder / f"large_{number}.yaml")
        save_map(OccupancyGrid(drawn, RESOLUTION, Pose2()), files[-1].with_suffix(""))
    return files


def fuse(files: list[Path], out: Path) -> Run:
    """Fuse the maps in a process of its own."""
    words = [sys.executable, "-m", "slamfusion", "fuse", *map(str, files), "-o", str(out), "--json"]
    began = time.perf_counter()
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        document = json.loads(process.stdout.read())
        _, _, usage = os.wait4(process.pid, 0)
        process.returncode = 0
    return Run(
        document["fused_count"],
        document["doubled_wall_share"]["fused"],
        usage.ru_utime + usage.ru_stime,
        time.perf_counter() - began,
        usage.ru_maxrss / 1024.0,
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--cells", type=int, default=8000, help="cells on a side of a map")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=5)
    add_record_option(parser)
    asked = parser.parse_args()
    table = Table(title=f"Three maps of {asked.cells} x {asked.cells} cells")
    for name in ("maps", "fused", "doubled walls %", "CPU s", "wall s", "peak MiB"):
        table.add_column(name, justify="right")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # A peak of memory counts what the parent held when it started the process: nothing large.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as artist:
            files = artist.submit(draw_maps, folder, asked.cells, asked.seed).result()
        runs = [fuse(files, folder / "fused") for _ in range(asked.runs)]
    table.add_row(
        f"3 of {asked.cells} x {asked.cells}",
        str(min(run.fused for run in runs)),
        f"{100.0 * runs[0].doubled:.2f}",
        f"{median(run.cpu_s for run in runs):.1f}",
        f"{median(run.wall_s for run in runs):.1f}",
        f"{median(run.peak_mib for run in runs):.0f}",
    )
    console_for("large", asked.record).print(table)


if __name__ == "__main__":
    main()
