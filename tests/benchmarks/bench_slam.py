"""Measure a SLAM on recorded drives, simulated courses and corrected logs: accuracy and time.

    python -m tests.benchmarks.bench_slam graph --part recordings --seeds 5

recordings: mean translation over all relations [K09] of the final path and of the path as first
reported, of the raw odometry, and of the best trajectory in the folder (the floor). That of Intel
ends early: ours is given on its relations too.
courses: simulated drives, another course with every seed: absolute trajectory error, error of the
last pose seen from the first, walls against the truth, and closures. A closure that joins what is
over 0.5 m or 0.1 rad apart is false.
logs: gmapping-corrected logs of more buildings, driven by their reconstructed odometry. Distances
are to gmapping's answer, which is no truth.

--config takes a YAML file of settings, as the command line does, e.g. gmapping's published profile;
its name is then part of that of the recorded table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from rich.table import Table

from slamfusion.compute import ComputeDevice
from slamfusion.config import NormalizeConfig, RunConfig
from slamfusion.config.run import LidarName
from slamfusion.evaluation.doubled_walls import doubled_wall_share
from slamfusion.evaluation.map_error import compare_to_truth
from slamfusion.evaluation.odometry import match_odometry
from slamfusion.evaluation.relations import Relations
from slamfusion.evaluation.trajectory_error import trajectory_errors
from slamfusion.experiments.tinyslam import RELATIONS, Drive, read_drive
from slamfusion.geometry import F64, compose_poses, invert_poses, row_of, wrap_angles
from slamfusion.io import LogScan, open_log, read_trajectory
from slamfusion.io.log import odometry_path
from slamfusion.sim import named_course, simulate, with_overrides
from slamfusion.slam.common.mapper import Closure
from slamfusion.slam.common.runner import ProducerRun, run_producer
from slamfusion.slam.registry import BUILT_IN, load_config, make_producer, open_producer_device
from slamfusion.trajectory import Trajectory
from tests.benchmarks.record import bench_parser, console_for
from tests.support.datasets import ABSENT, CSAIL, DATASETS, INTEL, MEASURED

# Of the cells of walls.
THRESHOLDS = NormalizeConfig()
BEST = {
    "mit-csail": CSAIL / "mit-csail-reference-graph.log.gz",
    "intel-2726-raw": INTEL / "intel-estimate-11439.txt.gz",
    "intel-910-raw": INTEL / "intel-estimate-11439.txt.gz",
}
LIDARS = ("hokuyo", "rplidar", "kinect")
# Courses by the question that a SLAM's page asks; a lidar other than the course's after a comma.
COURSES = {
    "tinyslam": (*(f"{place}, {own}" for place in ("office", "hall") for own in LIDARS), "f16"),
    "gmapping": ("yard-tracks", "yard", "office"),
    "graph": ("ring-100", "ring-300", "wings", "pillars", "rooms", "corridor", "office"),
}
# A closure that is off by more joins two places that are not one; ties of neighbours are no loops.
FALSE_M, FALSE_RAD, LOOP_S = 0.5, 0.1, 5.0
# One that is off a corrected path by more is worth a look.
OFF_M, OFF_RAD = 1.0, 0.2
# A closure of less weight is an outlier.
USED_FROM = 0.5

Row = dict[str, Any]


@dataclass(frozen=True)
class Bench:
    """One part of the benchmark.

    Attributes:
        config: settings of the producer, and of the measures.
        seeds: of the runs, and of the simulated courses.
        only: names of drives, courses or logs; empty: all of them.
    """

    producer: str
    config: RunConfig
    device: ComputeDevice
    seeds: range
    only: Sequence[str]

    def chosen(self, names: Iterable[str]) -> list[str]:
        """Return the names that are asked for."""
        return [name for name in names if not self.only or name in self.only]

    def run(self, scans: Iterable[LogScan], seed: int, **more: Any) -> ProducerRun:
        """Run a fresh producer."""
        mapper = make_producer(self.producer, replace(self.config, seed=seed), self.device)
        return run_producer(mapper, scans, **more)

    def ate(self, path: Trajectory | None, truth: Trajectory) -> float:
        """Return the absolute trajectory error, rms in metres; NaN without a path."""
        if path is None or not len(path):
            return np.nan
        return trajectory_errors(path, truth, self.config.trajectory).ate.rmse


def online(run: ProducerRun) -> Trajectory:
    """Return the path as first reported; the final one where the producer keeps no other."""
    return run.online_path() or run.trajectory


def cost(run: ProducerRun) -> Row:
    """Return the times of a scan, and the memory of the map."""
    times = run.time_per_scan_ms
    return {"ms": times.mean, "p95 ms": times.p95, "map MB": run.peak_memory_mb}


# --- recordings ----------------------------------------------------------------------------------


def recorded(bench: Bench) -> Iterator[Drive]:
    """Yield the recorded drives that are asked for."""
    if not DATASETS.is_dir():
        raise SystemExit(ABSENT)
    for files in MEASURED:
        if bench.chosen([files.log.name.split(".")[0]]):
            yield read_drive(files, bench.config)


def within_floor(drive: Drive, best: Trajectory) -> Drive:
    """Return the drive with the relations alone that the best trajectory covers.

    Where that of Intel ends, scans lie farther apart: a fair floor and a fair error are those on
    the same relations.
    """
    known = drive.ground_truth.relations
    inside = known.stamps_s.max(axis=1) <= best.stamps_s[-1]
    part = Relations(known.stamps_s[inside], known.motions[inside])
    return replace(drive, ground_truth=replace(drive.ground_truth, relations=part))


def at_scans(drive: Drive, path: Trajectory, config: RunConfig) -> Trajectory:
    """Return the poses of the best trajectory at the drive's scans."""
    if drive.ground_truth.odometry is None:
        return path
    scans = odometry_path(drive.scans, drive.name)
    matched = match_odometry(scans, drive.ground_truth.odometry)
    stamps_s = drive.ground_truth.odometry.stamps_s[matched]
    nearest, is_matched = path.matches(stamps_s, config.trajectory.tolerance_s)
    known = (matched >= 0) & is_matched
    return Trajectory(scans.stamps_s[known], path.poses[nearest[known]], path.name)


def recordings(bench: Bench) -> Iterator[Row]:
    """Errors on the relations, of the final path and as first reported, and the floor; times."""

    def error(drive: Drive, path: Trajectory) -> float:
        return drive.errors(path, bench.config)[RELATIONS]

    for drive in recorded(bench):
        row: Row = {"drive": drive.name, "scans": len(drive.scans)}
        row["beams"] = len(drive.scans[0].scan)
        row["odometry m"] = error(drive, odometry_path(drive.scans, drive.name))
        best = read_trajectory(BEST[drive.name], bench.config.log)
        part = within_floor(drive, best)
        row["floor m"] = error(part, at_scans(drive, best, bench.config))
        for seed in bench.seeds:
            run = bench.run(drive.scans, seed)
            row["error m"] = error(drive, run.trajectory)
            row["on the floor's relations m"] = error(part, run.trajectory)
            row["online m"] = error(drive, online(run))
            yield row | cost(run)


# --- courses -------------------------------------------------------------------------------------


def loops(closures: Iterable[Closure]) -> list[Closure]:
    """Return the closures that join two visits of a place, not two moments of one."""
    return [item for item in closures if abs(item.end_s - item.start_s) > LOOP_S]


def closure_errors(closures: Sequence[Closure], truth: Trajectory) -> F64:
    """Return how far closures at stamps of the truth are from it, (N, 2): metres, radians."""
    if not closures:
        return np.zeros((0, 2))
    nearest = truth.nearest([(item.start_s, item.end_s) for item in closures])
    first, second = truth.poses[nearest[:, 0]], truth.poses[nearest[:, 1]]
    said = np.array([row_of(item.motion) for item in closures])
    left = compose_poses(invert_poses(compose_poses(invert_poses(first), second)), said)
    return np.stack((np.hypot(left[:, 0], left[:, 1]), np.abs(wrap_angles(left[:, 2]))), axis=1)


def closed(run: ProducerRun, truth: Trajectory) -> Row:
    """Return how many loop closures are used, and how many of these are false."""
    own = loops(run.closures)
    errors = closure_errors(own, truth)
    is_used = np.array([item.weight >= USED_FROM for item in own], dtype=np.bool_)
    is_false = (errors[:, 0] > FALSE_M) | (errors[:, 1] > FALSE_RAD)
    return {"closures": int(is_used.sum()), "false": int((is_used & is_false).sum())}


def end_error_m(estimate: Trajectory, truth: Trajectory) -> float:
    """Return how far off the last pose is, seen from the first, in metres."""
    motions = [
        compose_poses(invert_poses(own.poses[0]), own.poses[-1]) for own in (truth, estimate)
    ]
    x, y, _ = compose_poses(invert_poses(motions[0]), motions[1])
    return float(np.hypot(x, y))


def courses(bench: Bench) -> Iterator[Row]:
    """Errors of path, map and closures on simulated courses."""
    known = dict.fromkeys(name for own in COURSES.values() for name in own)
    for name in bench.chosen(known) if bench.only else COURSES[bench.producer]:
        place, _, lidar = name.partition(", ")
        for seed in bench.seeds:
            course = named_course(place, seed)
            if lidar:
                settings = bench.config.simulate
                course = with_overrides(course, replace(settings, lidar=cast("LidarName", lidar)))
            recording = simulate(course, bench.device)
            truth, grid = recording.truth, recording.world.grid
            run = bench.run(recording.scans, seed)
            errors = trajectory_errors(run.trajectory, truth, bench.config.trajectory)
            row: Row = {"course": name, "path m": truth.path_length_m()}
            row["odometry m"] = bench.ate(recording.odometry(), truth)
            row["ATE m"] = errors.ate.rmse
            row["online m"] = bench.ate(online(run), truth)
            row["end m"] = end_error_m(run.trajectory, truth)
            walls = compare_to_truth(run.grid, grid, errors.alignment.transform, bench.config)
            row["precision"], row["recall"] = walls.wall_precision, walls.wall_recall
            row["F1"] = walls.wall_f1
            row["doubled %"] = 100.0 * doubled_wall_share(
                run.grid.classified(THRESHOLDS).cells == 1
            )
            if run.closures:
                row |= closed(run, truth)
            yield row | cost(run)


# --- corrected logs ------------------------------------------------------------------------------


def logs(bench: Bench) -> Iterator[Row]:
    """Health on corrected logs by reconstructed odometry, and distance to gmapping's answer."""
    found = {
        log.name.removesuffix("-corrected.log.gz"): log
        for folder in ("radish-corrected", "mit-killian")
        for log in sorted((DATASETS / folder).glob("*-corrected.log.gz"))
    }
    if not found:
        raise SystemExit(ABSENT)
    for name in bench.chosen(found):
        beside = found[name].with_name(f"{name}.odom.csv.gz")
        odometry = beside if beside.exists() else None
        corrected = read_trajectory(found[name], bench.config.log)
        for seed in bench.seeds:
            log = open_log(found[name], bench.config.log, odometry)
            items = log if odometry else (replace(item, odometry=None) for item in log)
            run = bench.run(items, seed, log=log)
            for sentence in (*run.health.skips.sentences("scan"), *run.warnings):
                print(f"{name}: {sentence}")
            used = [item for item in loops(run.closures) if item.weight >= USED_FROM]
            off = closure_errors(used, corrected) > (OFF_M, OFF_RAD)
            row: Row = {"log": name, "scans": run.scans}
            row["way m"] = corrected.path_length_m()
            row["closures"], row["off"] = len(used), int(off.any(axis=1).sum())
            row["low scores"] = run.health.low_scores
            row["to corrected m"] = bench.ate(run.trajectory, corrected)
            row["online m"] = bench.ate(online(run), corrected)
            row["odometry m"] = bench.ate(run.odometry if odometry else None, corrected)
            row["doubled %"] = 100.0 * doubled_wall_share(
                run.grid.classified(THRESHOLDS).cells == 1
            )
            yield row | cost(run)


# --- tables --------------------------------------------------------------------------------------

# Figures of which more than the mean over the seeds is shown.
SHOWN = {
    "error m": ("mean", "std", "max"),
    "ATE m": ("mean", "std", "max"),
    "end m": ("mean", "max"),
    **dict.fromkeys(("closures", "false"), ("sum",)),
    **dict.fromkeys(("ms", "p95 ms"), ("median",)),
    "map MB": ("max",),
}


def table_of(rows: Iterable[Row], title: str) -> Table:
    """Return the figures of runs as a table, joined over the seeds of each drive."""
    frame = pd.DataFrame(rows)
    name = frame.columns[0]
    groups = frame.groupby(name, sort=False)
    table = Table(name, title=title)
    columns = []
    for figure in frame.columns[1:]:
        joined = SHOWN.get(figure, ("mean",))
        for how in joined:
            table.add_column(figure if len(joined) == 1 else f"{figure}, {how}")
            columns.append([shown(value) for value in groups[figure].agg(how)])
    for own, *cells in zip(groups.groups, *columns, strict=True):
        table.add_row(str(own), *cells)
    return table


def shown(value: float) -> str:
    """Return a figure with three digits, of lengths at most the tenth of a millimetre."""
    if np.isnan(value) or value == round(value):
        return "-" if np.isnan(value) else f"{value:.0f}"
    return np.format_float_positional(round(value, 4), 3, fractional=False, trim="-")


# Each part, and how many seeds it takes where none are asked for.
PARTS: dict[str, tuple[Callable[[Bench], Iterator[Row]], int]] = {
    "recordings": (recordings, 5),
    "courses": (courses, 5),
    "logs": (logs, 1),
}


def main() -> None:
    parser = bench_parser(__doc__)
    parser.add_argument("producer", choices=BUILT_IN)
    parser.add_argument("--part", choices=PARTS, action="append", help="default: all")
    parser.add_argument("--only", action="append", metavar="NAME", help="drive, course or log")
    parser.add_argument("--seeds", type=int, help="default: 5; logs 1")
    parser.add_argument("--config", type=Path, metavar="FILE")
    options = parser.parse_args()
    config = load_config(options.config) if options.config else RunConfig()
    stem = options.config.stem if options.config else ""
    device = open_producer_device(options.producer, config)
    for name in options.part or PARTS:
        part, count = PARTS[name]
        bench = Bench(
            options.producer, config, device, range(options.seeds or count), options.only or ()
        )
        title = f"{name}; {options.producer}, {len(bench.seeds)} seeds, {device.name}"
        kept_as = "-".join((options.producer, name, *filter(None, [stem])))
        console = console_for(kept_as, options.record, width=220)
        console.print(table_of(part(bench), title))


if __name__ == "__main__":
    main()
