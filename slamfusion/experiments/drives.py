"""Drives that experiments repeat a producer on: recorded logs and simulated floors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig, TrajectoryConfig
from slamfusion.errors import LogError
from slamfusion.evaluation import Relations
from slamfusion.io import LogScan, open_log
from slamfusion.io.lines import strip_gz
from slamfusion.jobs.trajectory import Yardsticks, measure_trajectory
from slamfusion.sim import named_course, simulate
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.common.runner import run_producer
from slamfusion.trajectory import Trajectory

__all__ = [
    "ATE",
    "RELATIONS",
    "TIME",
    "Drive",
    "DriveFiles",
    "gather_drives",
    "read_drive",
    "run_errors",
    "simulated_office",
]

# What a run is measured by; the names end in the unit.
RELATIONS = "relations_mean_m"
ATE = "ate_rmse_m"
TIME = "time_per_scan_ms"


@dataclass(frozen=True)
class DriveFiles:
    """Where a recorded drive lies.

    Attributes:
        log: scans with odometry.
        relations: known motions between pairs of times; None: none.
        odometry: raw odometry of the whole run, to carry poses on to the relations' times.
        reference: the best known trajectory; None: none.
    """

    log: Path
    relations: Path | None = None
    odometry: Path | None = None
    reference: Path | None = None


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive, held in memory because it is run many times.

    Attributes:
        name: what tables call it.
        scans: in the order of time.
        relations: known motions between pairs of times; None: none.
        odometry: raw odometry of the whole run; None: poses are taken as they are.
        reference: the truth or the best known trajectory; None: none.
    """

    name: str
    scans: tuple[LogScan, ...]
    relations: Relations | None = None
    odometry: Trajectory | None = None
    reference: Trajectory | None = None

    def errors(self, trajectory: Trajectory, config: TrajectoryConfig) -> dict[str, float]:
        """Return the errors of a trajectory, by name: what there is something to measure with.

        Raises:
            TrajectoryError: it does not meet the relations or the reference in time.
        """
        measures = measure_trajectory(
            trajectory,
            config,
            relations=self.relations,
            odometry=self.odometry,
            scans=None if self.odometry is None else self.scan_odometry(),
            truth=self.reference,
        )
        found = {}
        if measures.relations is not None:
            found[RELATIONS] = measures.relations.translation.mean
        if measures.truth is not None:
            found[ATE] = measures.truth.ate.rmse
        return found

    def scan_odometry(self) -> Trajectory:
        """Return the raw odometry of the scans that have some."""
        known = [(item.scan.stamp_s, pose) for item in self.scans if (pose := item.odometry)]
        rows = np.array([(pose.x, pose.y, pose.yaw_rad) for _, pose in known])
        return Trajectory(np.array([stamp_s for stamp_s, _ in known]), rows, self.name)


def read_drive(files: DriveFiles, config: RunConfig) -> Drive:
    """Read a recorded drive.

    Args:
        files: with relations, a reference, or both.
        config: how logs are read.

    Raises:
        LogError: the log cannot be read, has no usable scan, or there is nothing to measure by.
        TrajectoryError: relations, odometry or reference cannot be read.
        OSError: a file cannot be opened.
    """
    if files.relations is None and files.reference is None:
        message = f"{files.log}: nothing to measure it by; give relations, a reference, or both"
        raise LogError(message)
    log = open_log(files.log, config.log)
    scans = tuple(log)
    if not scans:
        reasons = "; ".join(log.skips.sentences())
        message = f"{files.log}: no scan of it can be used: {reasons}"
        raise LogError(message)
    held = Yardsticks.read(
        config, relations=files.relations, odometry=files.odometry, truth=files.reference
    )
    return Drive(
        name=Path(strip_gz(files.log.name)).stem,
        scans=scans,
        relations=held.relations,
        odometry=held.odometry,
        reference=held.truth,
    )


def gather_drives(
    recorded: Sequence[DriveFiles],
    floors: Sequence[int],
    config: RunConfig,
    device: ComputeDevice,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[Drive]:
    """Return recorded drives, then simulated office floors; their names differ.

    Args:
        recorded: files of each recorded drive.
        floors: seed of each simulated one.
        config: how logs are read.
        device: simulates.
        progress: told of the simulation.

    Raises:
        LogError, TrajectoryError, OSError: see ``read_drive``.
    """
    drives: list[Drive] = []
    for files in recorded:
        drive = read_drive(files, config)
        twins = sum(other.name.split("#")[0] == drive.name for other in drives)
        drives.append(replace(drive, name=f"{drive.name}#{twins + 1}") if twins else drive)
    return drives + [simulated_office(seed, device, progress) for seed in floors]


def simulated_office(
    seed: int, device: ComputeDevice, progress: Callable[[str, int, int], None] | None = None
) -> Drive:
    """Simulate a drive through every room of an office floor with a Hokuyo; the truth is known.

    Args:
        seed: of the floor and the drive.
        device: casts the rays.
        progress: told the scans that are done.
    """
    name = f"office-{seed}"
    course = replace(named_course("office", seed), name=name)
    recording = simulate(course, device, progress)
    return Drive(name, recording.scans, reference=recording.truth)


def run_errors(drive: Drive, producer: Mapper, config: TrajectoryConfig) -> dict[str, float]:
    """Run a fresh producer on a drive and return its errors and the mean time for a scan.

    Raises:
        SlamFusionError: no scan could be used.
        TrajectoryError: the trajectory does not meet relations or reference in time.
    """
    run = run_producer(producer, drive.scans)
    return {**drive.errors(run.trajectory, config), TIME: run.time_per_scan_ms()["mean"]}
