"""What the benchmarks of one SLAM share: options, runs, measures, maps to look at, and tables."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from slamfusion.compute import ComputeDevice
from slamfusion.config import DeviceConfig, RunConfig
from slamfusion.evaluation import (
    MapError,
    TrajectoryErrors,
    compare_to_truth,
    doubled_wall_share,
    trajectory_errors,
)
from slamfusion.geometry import compose_poses, invert_poses
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan, save_map
from slamfusion.slam.common.runner import ProducerRun, run_producer
from slamfusion.slam.registry import load_config, make_producer, open_producer_device, with_settings
from slamfusion.trajectory import Trajectory
from tests.benchmarks.record import add_record_option, console_for

PRODUCER = "gmapping"
OVER_SEEDS = ("mean", "dev.", "median", "worst")
WALLS = ("precision", "recall", "F1", "off m", "doubled %")


@dataclass(frozen=True)
class Judged:
    """A run and what it is worth against the truth.

    Attributes:
        run: of the producer.
        path: errors of its path.
        walls: errors of its map, moved onto the truth as the path is.
        doubled_share: of its walls.
        closure: error of the last pose seen from the first; metres, degrees.
    """

    run: ProducerRun
    path: TrajectoryErrors
    walls: MapError
    doubled_share: float
    closure: tuple[float, float]

    def wall_figures(self) -> tuple[float | None, ...]:
        """Return what ``WALLS`` names."""
        walls = self.walls
        off_m = walls.map_to_truth_m.mean if walls.map_to_truth_m else None
        shares = (walls.wall_precision, walls.wall_recall, walls.wall_f1)
        return (*shares, off_m, 100.0 * self.doubled_share)


@dataclass(frozen=True)
class Bench:
    """One call of the benchmark.

    Attributes:
        producer: which one is measured.
        config: its settings; parts change what they are about.
        device: where it runs.
        seeds: of the runs, and of the simulated courses.
        maps: folder for the first seed's maps; None: none are written.
        console: where tables go.
    """

    producer: str
    config: RunConfig
    device: ComputeDevice
    seeds: tuple[int, ...]
    maps: Path | None
    console: Console

    @property
    def is_filter(self) -> bool:
        """Whether the producer has gmapping's settings."""
        return self.producer == PRODUCER

    def configured(self, **settings: Any) -> RunConfig:
        """Return the configuration with settings of gmapping put in."""
        return with_settings(self.config, "gmapping", **settings)

    def run(
        self, scans: Iterable[LogScan], seed: int, config: RunConfig | None = None
    ) -> ProducerRun:
        """Run a fresh producer."""
        settings = replace(config or self.config, seed=seed)
        return run_producer(make_producer(self.producer, settings, self.device), scans)

    def run_without_odometry(self, scans: Sequence[LogScan], seed: int) -> ProducerRun:
        """Run on the laser alone: by the setting, or on scans without odometry."""
        if self.is_filter:
            return self.run(scans, seed, self.configured(odometry="none"))
        return self.run(without_odometry(scans), seed)

    def judge(self, run: ProducerRun, path: Trajectory, truth: OccupancyGrid) -> Judged:
        """Compare a run with the truth."""
        errors = trajectory_errors(run.trajectory, path, self.config.trajectory)
        walls = compare_to_truth(
            run.grid,
            truth,
            errors.pose_truth_estimate,
            normalize=self.config.fusion.normalize,
            tolerance_m=self.config.evaluate.tolerance_m,
        )
        closure = closure_error(run.trajectory, path)
        return Judged(run, errors, walls, doubled_wall_share(run.grid), closure)

    def keep_map(self, grid: OccupancyGrid, seed: int, *words: str) -> None:
        """Write a map of the first seed where maps are wanted."""
        if self.maps is not None and seed == self.seeds[0]:
            name = "-".join("-".join(words).replace(",", "").split())
            save_map(grid, self.maps / name, image_format="png")

    def table(self, title: str, *columns: str) -> Table:
        """Return an empty table that says what is measured and on what."""
        seeds = f"seeds {self.seeds[0]} to {self.seeds[-1]}"
        table = Table(title=f"{title}; {self.producer}, {seeds}, {self.device.name}")
        for column in columns:
            table.add_column(column, no_wrap=column == columns[0])
        return table


def over_seeds(values: Sequence[float], digits: int = 3) -> list[str]:
    """Return mean, deviation, median and worst as a table shows them."""
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    figures = (float(np.mean(values)), deviation, float(np.median(values)), max(values))
    return [shown(figure, digits) for figure in figures]


def shown(value: float | None, digits: int = 3) -> str:
    """Return a figure as a table shows it."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def mean_walls(judged: Sequence[Judged]) -> list[str]:
    """Return the means of what ``WALLS`` names."""
    rows = zip(*(item.wall_figures() for item in judged), strict=True)
    return [shown(_mean(row), 1 if name.endswith("%") else 3) for name, row in _named(rows)]


def times(runs: Sequence[ProducerRun]) -> list[str]:
    """Return mean and 95th percentile of the time for a scan, the median over runs, ms."""
    every = [run.time_per_scan_ms() for run in runs]
    return [f"{np.median([time[name] for time in every]):.2f}" for name in ("mean", "p95")]


def _named(rows: Iterable[Sequence[float | None]]) -> Iterator[tuple[str, Sequence[float | None]]]:
    return zip(WALLS, rows, strict=True)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def closure_error(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Return how wrong the last pose is, seen from the first: metres, degrees.

    Args:
        estimate: at the same times as the truth.
        truth: poses of the same body.
    """
    motions = [
        compose_poses(invert_poses(path.poses[0]), path.poses[-1]) for path in (truth, estimate)
    ]
    x, y, yaw_rad = compose_poses(invert_poses(motions[0]), motions[1])
    return float(np.hypot(x, y)), float(np.degrees(abs(yaw_rad)))


def without_odometry(scans: Sequence[LogScan]) -> tuple[LogScan, ...]:
    """Return scans of a log that has no odometry."""
    return tuple(replace(item, odometry=None) for item in scans)


# Each part, told what it needs, and how many seeds it takes where none are asked for.
Parts = Mapping[str, tuple[Callable[..., None], int]]


def parser_of(parts: Parts, description: str | None, seeds: str) -> argparse.ArgumentParser:
    """Return the options that every one of them has.

    Args:
        parts: to choose from.
        description: of the benchmark.
        seeds: how many there are without the option, for help.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=tuple(parts), action="append", help="default: all")
    parser.add_argument("--seeds", type=int, help=f"default: {seeds}")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--maps", type=Path, metavar="DIR")
    parser.add_argument("--config", type=Path, metavar="FILE")
    parser.add_argument("--device")
    add_record_option(parser)
    return parser


def measure(
    parts: Parts, options: argparse.Namespace, producer: str, width: int, *more: Any
) -> None:
    """Run the parts that are asked for, or all, and print what each took.

    Args:
        parts: what can be asked for.
        options: of ``parser_of``.
        producer: is measured.
        width: of the tables, characters.
        more: told every part after its ``Bench``.
    """
    config = load_config(options.config) if options.config else RunConfig()
    if options.device:
        config = replace(config, device=DeviceConfig(options.device))
    device = open_producer_device(producer, config)
    for name in options.part or parts:
        part, count = parts[name]
        first = options.first_seed
        seeds = tuple(range(first, first + (options.seeds or count)))
        maps = None if options.maps is None else options.maps / name
        console = console_for(f"{producer}-{name}", options.record, width=width)
        began_s = time.perf_counter()
        part(Bench(producer, config, device, seeds, maps, console), *more)
        console.print(f"{name}: {time.perf_counter() - began_s:.0f} s in all\n", highlight=False)
