"""Parts on recorded drives: those with known relations, and corrected logs of more buildings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.config import RunConfig
from slamfusion.evaluation import (
    Summary,
    doubled_wall_share,
    errors_at_scans,
    mean_interval,
    trajectory_errors,
)
from slamfusion.experiments.drives import RELATIONS, Drive
from slamfusion.io import open_log, read_trajectory
from slamfusion.slam.common.runner import ProducerRun, run_producer, skipped_scans
from slamfusion.slam.graph import GraphSlam
from slamfusion.slam.registry import settings_of, with_settings
from slamfusion.trajectory import Trajectory
from tests.benchmarks.bench_slam import error, floor, within_floor
from tests.benchmarks.gmapping.bench import OVER_SEEDS, Bench, over_seeds, shown
from tests.benchmarks.gmapping.recorded import recorded
from tests.support.datasets import ABSENT, DATASETS
from tests.support.events import closure_errors, loops

DRIVES = ("mit-csail", "intel-910-raw", "intel-2726-raw")
# Of a closure's weight; and how far off the corrected path one is worth a look.
BELIEVED = 0.5
OFF_M, OFF_RAD = 1.0, 0.2
TIMES = ("ms", "p95 ms", "p99.9 ms", "longest ms")


@dataclass(frozen=True)
class CorrectedLog:
    """A log that holds what gmapping made of a drive.

    Attributes:
        name: what tables call it.
        log: scans with gmapping's poses.
        odometry: reconstructed, beside it; None where there is none.
    """

    name: str
    log: Path
    odometry: Path | None


def corrected_logs() -> list[CorrectedLog]:
    """Return the corrected logs of the folder, those without any other measure."""
    found = []
    for folder in ("radish-corrected", "mit-killian"):
        for log in sorted((DATASETS / folder).glob("*-corrected.log.gz")):
            name = log.name.removesuffix("-corrected.log.gz")
            odometry = log.with_name(f"{name}.odom.csv.gz")
            found.append(CorrectedLog(name, log, odometry if odometry.exists() else None))
    return found


def chosen(names: Iterable[str], only: Sequence[str]) -> list[str]:
    """Return the names that are asked for; all where none is."""
    return [name for name in names if not only or name in only]


def times(runs: list[ProducerRun]) -> list[str]:
    """Return what ``TIMES`` names: medians over the runs, and of the longest the longest."""
    every = [run.time_per_scan_ms() for run in runs]
    medians = [np.median([time[name] for time in every]) for name in ("mean", "p95", "p999")]
    return [f"{value:.2f}" for value in (*medians, max(time["max"] for time in every))]


def recordings(bench: Bench, only: Sequence[str] = ()) -> None:
    """Errors on the relations, at the end and as first reported, against the floor; times."""
    table = bench.table(
        "relations, metres",
        "drive",
        "scans",
        "odometry m",
        "floor m",
        *OVER_SEEDS,
        "where the floor is",
        "over floor",
        "online, mean",
        "worst",
        *TIMES,
    )
    own = bench.table(
        "relations whose both ends are scans, metres; errors averaged over the seeds",
        *("drive", "relations", "mean", "from (95 %)", "to", "online, mean", "from", "to"),
    )
    for name in chosen(DRIVES, only):
        drive = recorded(bench, name)
        runs = [bench.run(drive.scans, seed) for seed in bench.seeds]
        for seed, run in zip(bench.seeds, runs, strict=True):
            bench.keep_map(run.grid, seed, drive.name)
        errors = [_relations_m(bench, drive, run.trajectory) for run in runs]
        online = [_relations_m(bench, drive, _online(run)) for run in runs]
        least, part = floor(drive, bench.config), within_floor(drive, bench.config)
        same = None
        if part is not None:
            same = float(np.mean([_relations_m(bench, part, run.trajectory) for run in runs]))
        table.add_row(
            drive.name,
            str(len(drive.scans)),
            shown(error(drive, drive.scan_odometry(), bench.config)),
            shown(least, 4),
            *over_seeds(errors, 4),
            shown(same, 4),
            shown(None if least is None or same is None else same - least, 4),
            shown(Summary.of(online).mean, 4),
            shown(max(online), 4),
            *times(runs),
        )
        rows = [_at_scans(drive, paths) for paths in ([r.trajectory for r in runs], _onlines(runs))]
        own.add_row(drive.name, str(rows[0][0]), *(text for _, row in rows for text in row))
    bench.console.print(table)
    bench.console.print(own)


def _relations_m(bench: Bench, drive: Drive, path: Trajectory) -> float:
    return drive.errors(path, bench.config.trajectory)[RELATIONS]


def _online(run: ProducerRun) -> Trajectory:
    """Return the path as first reported; the final one where the producer keeps no other."""
    return run.online_path() or run.trajectory


def _onlines(runs: list[ProducerRun]) -> list[Trajectory]:
    return [_online(run) for run in runs]


def _at_scans(drive: Drive, paths: list[Trajectory]) -> tuple[int, list[str]]:
    """Return how many relations lie at scans; and mean and interval of their error.

    Args:
        drive: with relations.
        paths: one a seed; a relation's error is the mean over them.
    """
    if drive.relations is None:
        return 0, ["-", "-", "-"]
    found = [errors_at_scans(path, drive.relations) for path in paths]
    each = np.array([errors.translation_m for errors in found if errors is not None])
    if not each.size:
        return 0, ["-", "-", "-"]
    errors = each.mean(axis=0)
    figures = (float(errors.mean()), *mean_interval(errors))
    return len(errors), [shown(value, 4) for value in figures]


def logs(bench: Bench, only: Sequence[str] = ()) -> None:
    """Corrected logs by reconstructed odometry: health, and how far from gmapping's answer.

    With --maps a report of each is written beside its map. gmapping's answer is no truth; a closure
    that is over 1 m or 0.2 rad off it is worth a look.
    """
    known = {item.name: item for item in corrected_logs()}
    if not known:
        raise SystemExit(ABSENT)
    table = bench.table(
        "corrected logs; distance to the corrected path, aligned: rms and farthest, metres",
        *("log", "odometry", "scans", "restarts", "closures", "doubted", "off", "low", "in a row"),
        *("to corrected m", "farthest", "online m", "odometry m", "doubled %", "s in all", *TIMES),
    )
    for name in chosen(known, only):
        for seed in bench.seeds:
            table.add_row(*_log_row(bench, known[name], seed))
    bench.console.print(table)


def _log_row(bench: Bench, item: CorrectedLog, seed: int) -> list[str]:
    """Run on a corrected log and say how it went."""
    config = replace(bench.config, seed=seed)
    if item.odometry is None:
        config = with_settings(config, "graph", odometry="none")
    log = open_log(item.log, config.log, item.odometry)
    slam = GraphSlam(settings_of(config, "graph"), bench.device, seed)
    run = run_producer(slam, log, log=log)
    corrected = read_trajectory(item.log, config.log)
    bench.keep_map(run.grid, seed, item.name)
    if bench.maps is not None and seed == bench.seeds[0]:
        _report(bench.maps / item.name, run, corrected, config)
    graph = run.health.to_json()["graph"]
    bench.console.print(f"{item.name}: {graph}", highlight=False, soft_wrap=True)
    for sentence in (*skipped_scans(run.health), *run.warnings()):
        bench.console.print(f"{item.name}: {sentence}", highlight=False, soft_wrap=True)

    def away(path: Trajectory | None, *, farthest: bool = False) -> str:
        if path is None:
            return "-"
        ate = trajectory_errors(path, corrected, config.trajectory).ate
        return shown(ate.max if farthest else ate.rmse, 2)

    return [
        item.name,
        "none" if item.odometry is None else "reconstructed",
        str(run.scans),
        *(str(graph[k]) for k in ("restarts", "closures_accepted", "closures_doubted")),
        _off(slam, corrected),
        str(run.health.low_scores),
        str(run.low_in_a_row),
        away(run.trajectory),
        away(run.trajectory, farthest=True),
        away(_online(run)),
        "-" if item.odometry is None else away(run.odometry),
        f"{100.0 * doubled_wall_share(run.grid):.1f}",
        f"{run.time_s:.0f}",
        *times([run]),
    ]


def _off(slam: GraphSlam, corrected: Trajectory) -> str:
    """Return how many believed closures are far from the corrected path, of how many."""
    believed = [item for item in loops(slam.closures()) if item.weight >= BELIEVED]
    errors = closure_errors(believed, corrected)
    off = (errors[:, 0] > OFF_M) | (errors[:, 1] > OFF_RAD)
    return f"{np.count_nonzero(off)} of {len(believed)}"


def _report(folder: Path, run: ProducerRun, corrected: Trajectory, config: RunConfig) -> None:
    """Write the report of a run, with the corrected path beside its own."""
    from slamfusion.report import write_slam_report  # noqa: PLC0415  (loads matplotlib)

    moved = trajectory_errors(corrected, run.trajectory, config.trajectory).pose_truth_estimate
    poses = [moved.compose(corrected.pose(number)) for number in range(len(corrected))]
    rows = np.array([(pose.x, pose.y, pose.yaw_rad) for pose in poses])
    beside = Trajectory(corrected.stamps_s, rows, "the corrected log, aligned")
    shown = replace(run, other_paths=(*run.other_paths, beside), closures=())
    if settings_of(config, "graph").odometry != "poses":
        shown = replace(shown, odometry=None)
    write_slam_report(folder, shown, config=config)
