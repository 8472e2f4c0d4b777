"""Measure how processor time and memory grow with maps, scans, beams and particles.

    python -m tests.benchmarks.bench_growth --part cells
    python -m tests.benchmarks.bench_growth --runs 3 --record

Each figure is of one command in a process of its own: its processor time (user and system) and its
peak of memory, medians over the runs. The first size of a series is so small that it shows what
the command costs in itself; this cost is subtracted before an exponent is fitted: time grows with
size to the power of the exponent.

cells, inputs: `fuse` on maps of one drawn building, each turned by some degrees, with three in a
thousand of the free cells drawn as walls. scans, beams, particles: `slam` on a simulated office.
"""

from __future__ import annotations

import gzip
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from rich.table import Table

from slamfusion.compute import open_device
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slamfusion.io import save_map
from slamfusion.sim import draw_building, named_course, write_recording
from slamfusion.sim.simulate import simulate
from slamfusion.slam.registry import BUILT_IN
from tests.benchmarks.record import bench_parser, console_for

RESOLUTION = 0.05
# Side of the building, in sides of a map; share of the free cells that are drawn as walls.
BUILDING, SPECKS = 0.975, 0.003
SEED = 5

Point = tuple[float, list[str]]
Series = tuple[str, str, list[Point]]


def draw_maps(folder: Path, cells: int, count: int) -> list[str]:
    """Draw maps of a building; return their YAML files."""
    rng = np.random.default_rng(SEED)
    side_m = BUILDING * cells * RESOLUTION
    building = draw_building(rng, side_m, side_m, RESOLUTION).cells
    files = []
    for number in range(count):
        yaw_rad = 0.05 * ((number * 3) % 7 - 3) if number else 0.0
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
        save_map(OccupancyGrid(drawn, RESOLUTION, Pose2()), folder / f"{cells}_{number}")
        files.append(str(folder / f"{cells}_{number}.yaml"))
    return files


def draw_log(folder: Path, beams: int) -> Path:
    """Simulate an office with a laser of ``beams`` beams; return the log."""
    course = named_course("office", SEED)
    course = replace(course, lidar=replace(course.lidar, beams=beams))
    recording = simulate(course, open_device("auto"))
    write_recording(recording, folder / str(beams))
    return next((folder / str(beams)).glob("*.log.gz"))


def first_scans(log: Path, count: int) -> str:
    """Write a log that ends after some scans of another; return its name."""
    path = log.with_name(f"first-{count}.log.gz")
    with gzip.open(log, "rt") as whole, gzip.open(path, "wt") as part:
        for line in whole:
            count -= line.startswith("ROBOTLASER1")
            if count < 0:
                break
            part.write(line)
    return str(path)


def cells(folder: Path) -> Iterator[Series]:
    """Three maps of more and more cells."""
    sizes = (160, 1000, 2000, 4000, 8000)
    yield (
        "fuse 3 maps",
        "cells of a map",
        [
            (side**2, ["fuse", *draw_maps(folder, side, 3), "-o", str(folder / "fused")])
            for side in sizes
        ],
    )


def inputs(folder: Path) -> Iterator[Series]:
    """More and more maps of 800 x 800 cells; two of 160 x 160 show the cost of the command."""
    files = draw_maps(folder, 800, 16)
    words = [(2, draw_maps(folder, 160, 2)), *((n, files[:n]) for n in (2, 4, 8, 16))]
    yield (
        "fuse 800 x 800 cells",
        "maps",
        [(n, ["fuse", *some, "-o", str(folder / "fused")]) for n, some in words],
    )


def slam_words(folder: Path, name: str, log: str, *more: str) -> list[str]:
    return ["slam", name, log, "-o", str(folder / "map"), *more]


def scans(folder: Path) -> Iterator[Series]:
    """The first scans of a drive through an office."""
    log = draw_log(folder, 541)
    logs = [(count, first_scans(log, count)) for count in (5, 300, 600, 1200, 2400)]
    for name in BUILT_IN:
        yield f"slam {name}", "scans", [(n, slam_words(folder, name, log)) for n, log in logs]


def beams(folder: Path) -> Iterator[Series]:
    """The first 400 scans of the office, by lasers of more and more beams."""
    logs = [(count, draw_log(folder, count)) for count in (91, 181, 361, 721, 1441)]
    short = first_scans(logs[0][1], 5)
    points = [(91, short), *((count, first_scans(log, 400)) for count, log in logs)]
    for name in BUILT_IN:
        yield (
            f"slam {name}, 400 scans",
            "beams",
            [(n, slam_words(folder, name, log)) for n, log in points],
        )


def particles(folder: Path) -> Iterator[Series]:
    """The first 400 scans of the office, with more and more particles."""
    log = draw_log(folder, 541)
    points = [(8, first_scans(log, 5)), *((n, first_scans(log, 400)) for n in (8, 16, 32, 64, 128))]
    yield (
        "slam gmapping, 400 scans",
        "particles",
        [(n, slam_words(folder, "gmapping", log, "--particles", str(n))) for n, log in points],
    )


PARTS: dict[str, Callable[[Path], Iterator[Series]]] = {
    "cells": cells,
    "inputs": inputs,
    "scans": scans,
    "beams": beams,
    "particles": particles,
}


def measured(words: Sequence[str]) -> tuple[float, float]:
    """Run the command; return its processor time in seconds and its peak of memory in MiB."""
    command = [sys.executable, "-m", "slamfusion", *words, "--json"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        said = process.stderr.read().decode()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(words)}: {said}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0


def exponent(sizes: Sequence[float], figures: Sequence[float]) -> str:
    """Return the power with which figures, less the first, grow; "-" where they do not."""
    known = [(n, figure - figures[0]) for n, figure in zip(sizes, figures, strict=True)][1:]
    if any(figure <= 0 for _, figure in known):
        return "-"
    slope, _ = np.polyfit(*np.log(np.array(known).T), 1)
    return f"{slope:.2f}"


def rows(series: Series, runs: int) -> list[tuple[str, ...]]:
    """Measure every size of a series."""
    work, unit, points = series
    found = [[measured(words) for _ in range(runs)] for _, words in points]
    cpu_s, peak_mib = (
        [median(run[kind] for run in of_size) for of_size in found] for kind in (0, 1)
    )
    sizes = [size for size, _ in points]
    powers = exponent(sizes, cpu_s), exponent(sizes, peak_mib)
    shown = [
        " / ".join(f"{value:{form}}" for value in values)
        for values, form in ((sizes[1:], ",.0f"), (cpu_s[1:], ".3g"), (peak_mib[1:], ".0f"))
    ]
    own = f"{cpu_s[0]:.2g} s, {peak_mib[0]:.0f} MiB"
    return [(work, unit, shown[0], shown[1], powers[0], shown[2], powers[1], own)]


def main() -> None:
    """Measure and print."""
    parser = bench_parser(__doc__)
    parser.add_argument("--part", choices=tuple(PARTS), action="append", help="default: all")
    parser.add_argument("--runs", type=int, default=1)
    asked = parser.parse_args()
    columns = ("work", "size", "sizes", "CPU s", "power", "peak MiB", "power", "command alone")
    table = Table(*columns, title="growth")
    for part in asked.part or PARTS:
        with tempfile.TemporaryDirectory() as name:
            # A peak of memory counts what the parent held when it started the process.
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as artist:
                every = artist.submit(drawn, part, Path(name)).result()
            for series in every:
                for row in rows(series, asked.runs):
                    table.add_row(*row)
    console_for("growth", asked.record, width=200).print(table)


def drawn(part: str, folder: Path) -> list[Series]:
    """Draw the maps or logs of a part; return its series."""
    return list(PARTS[part](folder))


if __name__ == "__main__":
    main()
