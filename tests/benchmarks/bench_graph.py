"""Measure the graph SLAM, part by part: accuracy, time, more buildings, loops.

    python -m tests.benchmarks.bench_graph --part recordings --seeds 5 --maps out/bench_graph

recordings: mean translation over all relations [K09] at the end, as first reported, and of the best
trajectory in the folder (the floor), which ends early on Intel: ours is given on its relations too;
the relations at scans apart; times.
logs: gmapping-corrected logs of more buildings, driven by their reconstructed odometry. With --maps
a map and a report of each, to be looked at: there is no truth.
floors: simulated loops of 100 m and 300 m and places that look alike; closures that join what is
over 0.5 m or 0.1 rad apart are false.

A simulated part drives another course with every seed. With --maps the first seed's maps are
written as PNG, to be looked at: --first-seed chooses which. --config takes a YAML file of settings,
as the command line does.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.config import RunConfig
from slamfusion.evaluation import (
    doubled_wall_share,
    errors_at_scans,
    mean_interval,
    trajectory_errors,
)
from slamfusion.experiments.tinyslam import RELATIONS
from slamfusion.experiments.tinyslam import Drive as RecordedDrive
from slamfusion.geometry import Pose2, compose_poses, invert_poses, wrap_angles
from slamfusion.io import LogScan, open_log, read_trajectory
from slamfusion.sim import named_course
from slamfusion.slam.common.runner import ProducerRun, run_producer
from slamfusion.slam.graph import GraphSlam
from slamfusion.slam.registry import settings_of, with_settings
from slamfusion.trajectory import Trajectory
from tests.benchmarks.bench_gmapping import PATHS, drive_course, judge, path_figures, recorded
from tests.benchmarks.bench_slam import error, floor, scan_odometry, within_floor
from tests.benchmarks.producer_bench import (
    OVER_SEEDS,
    WALLS,
    Bench,
    Judged,
    Parts,
    mean_walls,
    measure,
    over_seeds,
    parser_of,
    shown,
)
from tests.support.datasets import ABSENT, DATASETS

# A closure that is off by more joins two places that are not one.
FALSE_M, FALSE_RAD = 0.5, 0.1
# Ties of neighbouring nodes are no loops.
LOOP_S = 5.0

Drive = tuple[tuple[LogScan, ...], Trajectory]


class ClosureLike(Protocol):
    """What a graph says of two scans; see ``slamfusion.slam.common.mapper.Closure``."""

    @property
    def start_s(self) -> float: ...
    @property
    def end_s(self) -> float: ...
    @property
    def motion(self) -> Pose2: ...
    @property
    def weight(self) -> float: ...


def closure_errors(closures: Sequence[ClosureLike], truth: Trajectory) -> npt.NDArray[np.float64]:
    """Return how far closures are from the truth, (N, 2): metres, radians.

    Args:
        closures: at stamps of the truth.
        truth: the true poses.

    Raises:
        ValueError: a closure has a stamp that the truth has not.
    """
    if not closures:
        return np.zeros((0, 2))
    stamps_s = np.array([(item.start_s, item.end_s) for item in closures])
    nearest = truth.nearest(stamps_s)
    if np.abs(truth.stamps_s[nearest] - stamps_s).max() > 1e-6:
        raise ValueError("a closure joins times at which the truth has no pose")
    first, second = truth.poses[nearest[:, 0]], truth.poses[nearest[:, 1]]
    true = compose_poses(invert_poses(first), second)
    said = np.array([(m.x, m.y, m.yaw_rad) for m in (item.motion for item in closures)])
    left = compose_poses(invert_poses(true), said)
    return np.stack((np.hypot(left[:, 0], left[:, 1]), np.abs(wrap_angles(left[:, 2]))), axis=1)


def loops(closures: Iterable[ClosureLike]) -> list[ClosureLike]:
    """Return the closures that join two visits of a place, not two moments of one."""
    return [item for item in closures if abs(item.end_s - item.start_s) > LOOP_S]


def is_false(errors: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return which closures are false, (N,), from their errors (N, 2) in metres and radians."""
    return np.asarray((errors[:, 0] > FALSE_M) | (errors[:, 1] > FALSE_RAD))


def _odometry(item: LogScan) -> Pose2:
    """Return the odometry of a scan.

    Raises:
        ValueError: it has none.
    """
    if item.odometry is None:
        raise ValueError(f"scan {item.line} has no odometry")
    return item.odometry


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
            shown(error(drive, scan_odometry(drive), bench.config)),
            shown(least, 4),
            *over_seeds(errors, 4),
            shown(same, 4),
            shown(None if least is None or same is None else same - least, 4),
            shown(float(np.mean(online)), 4),
            shown(max(online), 4),
            *times(runs),
        )
        rows = [_at_scans(drive, paths) for paths in ([r.trajectory for r in runs], _onlines(runs))]
        own.add_row(drive.name, str(rows[0][0]), *(text for _, row in rows for text in row))
    bench.console.print(table)
    bench.console.print(own)


def _relations_m(bench: Bench, drive: RecordedDrive, path: Trajectory) -> float:
    return drive.errors(path, bench.config)[RELATIONS]


def _online(run: ProducerRun) -> Trajectory:
    """Return the path as first reported; the final one where the producer keeps no other."""
    return run.online_path() or run.trajectory


def _onlines(runs: list[ProducerRun]) -> list[Trajectory]:
    return [_online(run) for run in runs]


def _at_scans(drive: RecordedDrive, paths: list[Trajectory]) -> tuple[int, list[str]]:
    """Return how many relations lie at scans; and mean and interval of their error.

    Args:
        drive: with relations.
        paths: one a seed; a relation's error is the mean over them.
    """
    if drive.held.relations is None:
        return 0, ["-", "-", "-"]
    found = [errors_at_scans(path, drive.held.relations) for path in paths]
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
    for sentence in (*run.health.skips.sentences("scan"), *run.warnings()):
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
    shown = replace(run, other_paths=(*run.other_paths, beside))
    write_slam_report(folder, shown, config=config)


FLOORS = ("ring-100", "ring-300", "wings", "pillars", "rooms", "corridor", "office")


@dataclass(frozen=True)
class Loops:
    """What a graph's closures are worth against the truth.

    Attributes:
        believed: how many have at least half of their weight.
        false: of these, how many join two places that are not one.
        doubted_false: the false ones that have less.
        worst_m: greatest error of a believed one, metres; NaN without one.
    """

    believed: int
    false: int
    doubted_false: int
    worst_m: float

    @classmethod
    def of(cls, slam: GraphSlam, truth: Trajectory) -> Loops:
        """Hold a graph's closures against the truth."""
        closures = loops(slam.closures())
        errors = closure_errors(closures, truth)
        believed = np.array([item.weight >= BELIEVED for item in closures], dtype=np.bool_)
        false = is_false(errors)
        return cls(
            int(believed.sum()),
            int((believed & false).sum()),
            int((~believed & false).sum()),
            float(errors[believed, 0].max()) if believed.any() else float("nan"),
        )


def run_graph(bench: Bench, drive: Drive, seed: int) -> tuple[ProducerRun, Loops]:
    """Run a fresh graph on a drive, and judge its closures."""
    slam = GraphSlam(settings_of(bench.config, "graph"), bench.device, seed)
    scans, truth = drive
    return run_producer(slam, scans), Loops.of(slam, truth)


def floors(bench: Bench, only: Sequence[str] = ()) -> None:
    """Errors of path and map, and closures that are false: another course with every seed."""
    table = bench.table(
        "simulated floors",
        *("floor", "path m", "odometry, ATE m", *PATHS, "online, mean"),
        *("closures", "false", "of a seed", "false, doubted", "worst m", *WALLS, *TIMES),
    )
    for name in chosen(FLOORS, only):
        judged: list[Judged] = []
        found: list[Loops] = []
        odometry, online = [], []
        for seed in bench.seeds:
            recording = drive_course(bench, named_course(name, seed))
            run, seen = run_graph(bench, (recording.scans, recording.truth), seed)
            judged.append(judge(bench, recording, run))
            found.append(seen)
            bench.keep_map(run.grid, seed, name)
            config = bench.config.trajectory
            paths = (recording.odometry(), run.online_path() or run.trajectory)
            ates = [trajectory_errors(path, recording.truth, config).ate.rmse for path in paths]
            odometry.append(ates[0])
            online.append(ates[1])
        table.add_row(
            name,
            f"{recording.truth.path_length_m():.0f}",
            shown(float(np.mean(odometry))),
            *path_figures(judged),
            shown(float(np.mean(online))),
            str(sum(item.believed for item in found)),
            str(sum(item.false for item in found)),
            " ".join(str(item.false) for item in found),
            str(sum(item.doubted_false for item in found)),
            shown(float(np.nanmax([item.worst_m for item in found], initial=0.0)), 2),
            *mean_walls(judged),
            *times([item.run for item in judged]),
        )
    bench.console.print(table)


PRODUCER = "graph"
PARTS: Parts = {"recordings": (recordings, 5), "logs": (logs, 1), "floors": (floors, 5)}


def main() -> None:
    parser = parser_of(PARTS, __doc__, "5; logs 1")
    parser.add_argument("--only", action="append", metavar="NAME", help="drive, log or floor")
    options = parser.parse_args()
    measure(PARTS, options, PRODUCER, 230, options.only or ())


if __name__ == "__main__":
    main()
