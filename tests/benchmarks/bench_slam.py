"""Run a producer on every recorded and simulated drive, over several seeds.

    python -m tests.benchmarks.bench_slam --seeds 5 --maps out/bench_slam

Per drive: the error of the raw odometry and of the best trajectory in the folder (the floor), the
producer's error over the seeds (mean, deviation, worst), the time a scan takes, and the memory of
the map. Errors are the mean translation over the relations where there are some [K09], or else the
root mean square of the absolute trajectory error against the simulated truth. With --maps the map
of the first seed of each drive is written, to be looked at.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.table import Table

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import RunConfig
from slamfusion.config.sim import LidarName
from slamfusion.evaluation import Relations
from slamfusion.evaluation.odometry import match_odometry
from slamfusion.experiments.tinyslam import ATE, RELATIONS, Drive, read_drive
from slamfusion.io import open_log, read_trajectory, save_map
from slamfusion.jobs.map_log import LogFiles
from slamfusion.jobs.trajectory import Yardsticks
from slamfusion.sim.courses import named_course, with_overrides
from slamfusion.sim.simulate import simulate
from slamfusion.slam.common.runner import run_producer
from slamfusion.slam.registry import BUILT_IN, make_producer
from slamfusion.trajectory import Trajectory
from tests.benchmarks.producer_bench import over_seeds, shown
from tests.benchmarks.record import add_record_option, console_for
from tests.support.datasets import DATASETS

CSAIL, INTEL = DATASETS / "mit-csail", DATASETS / "intel"
MEASURED = (
    LogFiles(CSAIL / "mit-csail.clf.gz", CSAIL / "mit-csail.relations"),
    *(
        LogFiles(
            INTEL / f"intel-{count}-raw.log.gz",
            INTEL / "intel.relations",
            INTEL / "intel-odometry-13631.txt.gz",
        )
        for count in (2726, 910)
    ),
)
BEST = {
    "mit-csail": CSAIL / "mit-csail-reference-graph.log.gz",
    "intel-2726-raw": INTEL / "intel-estimate-11439.txt.gz",
    "intel-910-raw": INTEL / "intel-estimate-11439.txt.gz",
}
UNMEASURED = ("tinyslam/exp1.dat.gz", "tinyslam/exp2.dat.gz", "rosbags/test_turtlebot.bag")
SIMULATED: tuple[tuple[str, LidarName], ...] = (
    *(("office", "hokuyo"), ("office", "rplidar"), ("hall", "hokuyo"), ("hall", "rplidar")),
    *(("office", "kinect"), ("f16", "kinect")),
)


def drives(config: RunConfig, device: ComputeDevice) -> Iterator[Drive]:
    """Yield every drive; recorded ones first."""
    for files in MEASURED:
        if files.log.exists():
            yield read_drive(files, config)
    for name in UNMEASURED:
        if (DATASETS / name).exists():
            scans = tuple(open_log(DATASETS / name, config.log))
            yield Drive(Path(name).name.split(".")[0], scans, Yardsticks())
    for world, lidar in SIMULATED:
        course = named_course(world, config.seed)
        if world != "f16":
            course = with_overrides(course, replace(config.simulate, lidar=lidar))
        recording = simulate(course, device)
        yield Drive(f"{world}, {lidar}", recording.scans, Yardsticks(truth=recording.truth))


def within_floor(drive: Drive, config: RunConfig) -> Drive | None:
    """Return the drive with the relations alone that the best trajectory in the folder covers.

    That of Intel ends before the run does, and where it ends scans lie farther apart: a fair floor
    and a fair error are those on the same relations.
    """
    if drive.name not in BEST or drive.held.relations is None:
        return None
    best = read_trajectory(BEST[drive.name], config.log)
    known = drive.held.relations
    inside = known.stamps_s.max(axis=1) <= best.stamps_s[-1]
    part = Relations(known.stamps_s[inside], known.motions[inside])
    return replace(drive, held=replace(drive.held, relations=part))


def scan_odometry(drive: Drive) -> Trajectory:
    """Return the raw odometry of the scans of a drive."""
    known = [(item.scan.stamp_s, pose) for item in drive.scans if (pose := item.odometry)]
    rows = np.array([(pose.x, pose.y, pose.yaw_rad) for _, pose in known])
    return Trajectory(np.array([stamp_s for stamp_s, _ in known]), rows, drive.name)


def floor(drive: Drive, config: RunConfig) -> float | None:
    """Return the error of the best trajectory in the folder at the drive's scans."""
    part = within_floor(drive, config)
    if part is None:
        return None
    best = read_trajectory(BEST[drive.name], config.log)
    if drive.held.odometry is not None:
        own, scans = config.trajectory, scan_odometry(drive)
        matched = match_odometry(scans, drive.held.odometry)
        stamps_s = drive.held.odometry.stamps_s[matched]
        nearest, is_matched = best.matches(stamps_s, own.tolerance_s)
        known = (matched >= 0) & is_matched
        best = Trajectory(scans.stamps_s[known], best.poses[nearest[known]], best.name)
    return error(part, best, config)


def error(drive: Drive, trajectory: Trajectory | None, config: RunConfig) -> float | None:
    """Return the drive's own measure of a trajectory."""
    if trajectory is None or len(trajectory) == 0:
        return None
    found = drive.errors(trajectory, config)
    return found.get(RELATIONS, found.get(ATE))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--producer", choices=tuple(BUILT_IN), default="tinyslam")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--maps", type=Path)
    add_record_option(parser)
    options = parser.parse_args()
    config = RunConfig()
    device = open_device(options.device, small_kernels=True)
    columns = "scans, beams, odometry m, floor m, mean m, dev. m, worst m, ms, p95 ms, map MB"
    table = Table(title=f"{options.producer}, {options.seeds} seeds, {device.name}")
    for column in ("drive", *columns.split(", ")):
        table.add_column(column)
    for drive in drives(config, device):
        runs = [
            run_producer(
                make_producer(options.producer, replace(config, seed=seed), device), drive.scans
            )
            for seed in range(options.seeds)
        ]
        errors = [error(drive, run.trajectory, config) for run in runs]
        known = [value for value in errors if value is not None]
        figures = over_seeds(known) if known else ["-"] * 4
        times = [run.time_per_scan_ms() for run in runs]
        table.add_row(
            drive.name,
            str(len(drive.scans)),
            str(len(drive.scans[0].scan)),
            shown(error(drive, scan_odometry(drive), config)),
            shown(floor(drive, config)),
            *(figures[index] for index in (0, 1, 3)),
            f"{np.median([time['mean'] for time in times]):.2f}",
            f"{np.median([time['p95'] for time in times]):.2f}",
            f"{max(run.peak_memory_bytes for run in runs) / 1e6:.1f}",
        )
        if options.maps is not None:
            options.maps.mkdir(parents=True, exist_ok=True)
            save_map(runs[0].grid, options.maps / drive.name.replace(", ", "-"))
    console_for(options.producer, options.record, width=160).print(table)


if __name__ == "__main__":
    main()
