"""Maps drawn at fused paths against producers' own, and against votes, on kept simulated drives.

    python -m tests.benchmarks.bench_drawn_maps --drives DIR --worlds 1,101 --lidars rplidar,hokuyo

Drives are those of ``bench_evidence``, which makes them, but kidnappings. Each producer's map, its
own path drawn by the sensor model of the drawn map, the consensus, and the map that ``run --mode
drawn`` gives, each laid on the truth where it fits best. Means over the drives;
*best* is that of each drive in hindsight. Nothing here depends on the machine's load.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.progress import track
from rich.table import Table

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import RunConfig
from slamfusion.evaluation.map_error import MapError
from slamfusion.experiments.fusions import (
    FUSED_PATH,
    DriveMaps,
    against_truth,
    drawn_at,
    fuse_in_every_way,
)
from slamfusion.io import load_map
from slamfusion.jobs.inputs import RUN_VOTE
from slamfusion.jobs.outputs import DRAWN
from slamfusion.slam.registry import BUILT_IN
from tests.benchmarks.record import add_record_option, console_for
from tests.support.evidence_drives import read_drive

BEST, BEST_DRAWN = "best map", "best drawn"
COLUMNS = (*(*BUILT_IN, BEST), *(*map(drawn_at, BUILT_IN), BEST_DRAWN), *(RUN_VOTE, DRAWN))
FACES_M = 0.1


def faces(error: MapError) -> float:
    """F1 of the faces; 0 without any."""
    return error.faces.f1(FACES_M) or 0.0


# Name, what is measured, its form, and the better of several.
ROWS: tuple[tuple[str, Callable[[MapError], float], str, Callable[..., float]], ...] = (
    ("faces F1 at 0.1 m", faces, "{:.3f}", max),
    ("doubled walls", lambda error: error.doubled_wall_share, "{:.3f}", min),
    ("known outside of the truth, m2", lambda error: error.outside_m2, "{:.2f}", min),
    ("[F16] error", lambda error: error.error, "{:.1f}", min),
)


def measure(folder: Path, device: ComputeDevice) -> tuple[dict[str, MapError], dict[str, float]]:
    """Return the errors of every map of a drive, and of its paths, metres."""
    config = RunConfig()
    drive = read_drive(folder)
    truth = load_map(folder / "truth.yaml")
    maps = {name: load_map(folder / f"{name}.yaml").with_name(name) for name in drive.paths}
    made = fuse_in_every_way(
        DriveMaps(maps, drive.paths), drive.scans, config, device, drawn_cell_m=truth.resolution
    )
    errors = {
        name: against_truth(grid, truth, config, device, same_heading=True)
        for name, grid in made.maps.items()
    }
    return errors, made.path_errors(drive.truth)


def chosen(folder: Path, worlds: Sequence[str], lidars: Sequence[str]) -> list[Path]:
    """Return the drives of some worlds and lasers, kidnappings left out."""
    found = []
    for path in sorted(folder.glob("*/drive.json")):
        course, rest = path.parent.name.split(",")
        lidar, world, _ = rest.split("-")
        if world[1:] in worlds and lidar in lidars and not course.startswith("kidnapping"):
            found.append(path.parent)
    return found


def tables(measured: Sequence[tuple[dict[str, MapError], dict[str, float]]]) -> list[Table]:
    """Return the means of every map, and what the drawn map gains over each."""
    shown = Table("", *COLUMNS)
    values: dict[str, dict[str, list[float]]] = {}
    for title, figure, form, better in ROWS:
        columns: dict[str, list[float]] = {name: [] for name in COLUMNS}
        for errors, _ in measured:
            known = {name: figure(error) for name, error in errors.items()}
            for column, group in ((BEST, BUILT_IN), (BEST_DRAWN, tuple(map(drawn_at, BUILT_IN)))):
                known[column] = better(known[name] for name in group if name in known)
            for name in COLUMNS:
                columns[name].append(known.get(name, np.nan))
        values[title] = columns
        shown.add_row(title, *(form.format(np.nanmean(columns[name])) for name in COLUMNS))
    gains = Table(
        "faces F1 of the drawn map less that of", "mean", "5th percentile", "least", "95 %"
    )
    rng = np.random.default_rng(0)
    for name in COLUMNS[:-1]:
        gain = np.subtract(values["faces F1 at 0.1 m"][DRAWN], values["faces F1 at 0.1 m"][name])
        again = rng.choice(gain, (2000, len(gain))).mean(axis=1)
        low, high = np.percentile(again, (2.5, 97.5))
        numbers = (gain.mean(), np.percentile(gain, 5), gain.min())
        gains.add_row(name, *(f"{value:+.3f}" for value in numbers), f"{low:+.3f} to {high:+.3f}")
    ratios = []
    for _, ate in measured:
        own = [ate[name] for name in BUILT_IN if name in ate]
        if FUSED_PATH in ate:
            ratios.append(ate[FUSED_PATH] / min(own))
    paths = Table("ATE of the fused path over the best in hindsight", "")
    paths.add_row("geometric mean", f"{np.exp(np.mean(np.log(ratios))):.2f}")
    paths.add_row("90th percentile", f"{np.percentile(ratios, 90):.2f}")
    paths.add_row("largest", f"{max(ratios):.2f}")
    return [shown, gains, paths]


def main() -> None:
    """Read the options and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drives", type=Path, required=True)
    parser.add_argument("--worlds", default="1,101")
    parser.add_argument("--lidars", default="rplidar,hokuyo")
    parser.add_argument("--name", default="drawn-map", help="of the tables that --record keeps")
    add_record_option(parser)
    options = parser.parse_args()
    folders = chosen(options.drives, options.worlds.split(","), options.lidars.split(","))
    device = open_device()
    measured = [
        measure(folder, device) for folder in track(folders, disable=not sys.stderr.isatty())
    ]
    console = console_for(options.name, options.record, width=160)
    print(f"{len(measured)} drives")
    for table in tables(measured):
        console.print(table)


if __name__ == "__main__":
    main()
