"""Drives that experiments repeat a producer on: recorded logs and simulated floors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import LogError
from slamfusion.evaluation import Row, path_figures, result_rows
from slamfusion.experiments.runs import RunResult, Setup, Tell, run_all
from slamfusion.io import LogScan, open_log
from slamfusion.io.lines import strip_gz
from slamfusion.jobs.inputs import Progress
from slamfusion.jobs.map_log import LogFiles
from slamfusion.jobs.results import input_records
from slamfusion.jobs.trajectory import Yardsticks
from slamfusion.sim import named_course, simulate
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.common.runner import run_producer
from slamfusion.trajectory import Trajectory

# The figures of a run; the names end in the unit.
RELATIONS, ATE, TIME = "relations_mean_m", "ate_rmse_m", "time_per_scan_ms"


def drive_inputs(recorded: Sequence[LogFiles]) -> list[tuple[str, str, Path]]:
    """Return role, drive and path of each file of recorded drives."""
    roles = ("log", "relations", "odometry", "truth")
    return [
        (role, files.log.stem, path)
        for files in recorded
        for role, path in zip(roles, astuple(files), strict=False)
        if path is not None
    ]


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive, held in memory because it is run many times."""

    name: str
    scans: tuple[LogScan, ...]
    held: Yardsticks

    def errors(self, path: Trajectory, config: RunConfig) -> dict[str, float]:
        """Return the errors of a path, by name: what there is something to measure with.

        Raises:
            TrajectoryError: it does not meet the relations or the truth in time.
        """
        scans = None if self.held.odometry is None else self.scan_odometry()
        measures = self.held.measure(path, config, scans)
        found = path_figures(measures.truth, measures.relations)
        return {name: found[name] for name in (RELATIONS, ATE) if name in found}

    def scan_odometry(self) -> Trajectory:
        """Return the raw odometry of the scans that have some."""
        known = [(item.scan.stamp_s, pose) for item in self.scans if (pose := item.odometry)]
        rows = np.array([(pose.x, pose.y, pose.yaw_rad) for _, pose in known])
        return Trajectory(np.array([stamp_s for stamp_s, _ in known]), rows, self.name)


def read_drive(files: LogFiles, config: RunConfig) -> Drive:
    """Read a recorded drive.

    Args:
        files: with relations, a true or the best known path, or both.

    Raises:
        LogError: the log cannot be read, has no usable scan, or there is nothing to measure by.
        TrajectoryError: relations, odometry or truth cannot be read.
        OSError: a file cannot be opened.
    """
    if files.relations is None and files.truth is None:
        message = f"{files.log}: nothing to measure it by; give relations, a reference, or both"
        raise LogError(message)
    log = open_log(files.log, config.log)
    scans = tuple(log)
    if not scans:
        reasons = "; ".join(log.skips.sentences())
        raise LogError(f"{files.log}: no scan of it can be used: {reasons}")
    held = Yardsticks.read(config, files.relations, files.odometry, files.truth)
    return Drive(Path(strip_gz(files.log.name)).stem, scans, held)


def simulated_office(seed: int, device: ComputeDevice, progress: Progress | None = None) -> Drive:
    """Simulate a drive through every room of an office floor with a Hokuyo; the truth is known."""
    course = replace(named_course("office", seed), name=f"office-{seed}")
    recording = simulate(course, device, progress)
    return Drive(course.name, recording.scans, Yardsticks(truth=recording.truth))


@dataclass(frozen=True)
class DriveRun:
    """One run of a producer on a drive.

    Attributes:
        case: of its rows: the drive, and what else is not compared.
    """

    case: str
    method: str
    drive: str
    seed: int
    setting: float = 0.0

    @property
    def key(self) -> str:
        """The name of its file."""
        return f"{self.case}-{self.method}-s{self.seed}".replace(" ", "-").replace(",", "")


def run_on_drives(
    plan: Callable[[str], Sequence[DriveRun]],
    make: Callable[[DriveRun], Mapper],
    recorded: Sequence[LogFiles],
    floors: Sequence[int],
    setup: Setup,
) -> list[Row]:
    """Run producers on recorded drives and on simulated office floors, one after the other.

    Returns:
        The rows of all runs.

    Raises:
        SlamFusionError: a drive has no usable scan, or a path does not meet its relations in time.
        OSError: a file cannot be opened.
    """
    config, device = setup.config, setup.device
    drives: list[Drive] = []
    for files in recorded:
        drive = read_drive(files, config)
        twins = sum(other.name.split("#")[0] == drive.name for other in drives)
        drives.append(replace(drive, name=f"{drive.name}#{twins + 1}") if twins else drive)
    drives += [simulated_office(seed, device, setup.progress) for seed in floors]
    by_name = {drive.name: drive for drive in drives}

    def work(run: DriveRun, _: RunConfig, tell: Tell) -> RunResult:
        scans = by_name[run.drive].scans
        made = run_producer(make(run), scans, progress=lambda done: tell(done / len(scans)))
        errors = by_name[run.drive].errors(made.trajectory, config)
        figures = {**errors, TIME: made.time_per_scan_ms()["mean"]}
        return RunResult(result_rows(run.case, str(run.seed), run.method, figures))

    runs = [run for drive in drives for run in plan(drive.name)]
    inputs = drive_inputs(recorded)
    facts = [record["sha256"] for file in inputs for record in input_records(*file)]
    facts.append(device.name)
    tasks = {run.key: run for run in runs}
    return [row for result in run_all(tasks, work, setup, facts) for row in result.rows]
