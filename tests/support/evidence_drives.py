"""Simulated drives with the producers' paths and maps, made once and kept in a folder.

Each drive is a folder; ``README`` in the folder of all of them says what a drive holds.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import FailuresConfig, RunConfig
from slamfusion.experiments.fusions import produce_maps
from slamfusion.experiments.trials import FAILURES, FAULTS, Trial, failure_trials
from slamfusion.geometry import Pose2
from slamfusion.io import LogScan, read_trajectory
from slamfusion.io.map_server import save_map
from slamfusion.io.trajectories import write_tum
from slamfusion.scan import LaserScan
from slamfusion.sim.simulate import simulate
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory

README = """\
Simulated drives of the `failures` experiment, made by tests/support/evidence_drives.py.

A folder a drive, named CONDITION[-HARMED],LASER-wWORLD-sSEED:
  drive.json            condition, lidar, world, seed, fault, harmed
  scans.npz             what the robot recorded, as `load_scans` reads it: stamps_s (N,), ranges
                        (N, B) float32, odometry (N, 3), and the laser's geometry
  truth.tum             the true path
  truth.yaml/.pgm       the true map
  NAME.tum              the path of each producer (absent: it made none)
  NAME.yaml/.pgm        its map
Where a fault befalls one producer (`harmed`), only that one was fed other scans than scans.npz; a
kidnapping befalls all, and scans.npz holds what all were fed, truth.tum the true path in it.
A drive is whole when drive.json is there: it is written last.
"""


@dataclass(frozen=True, eq=False)
class Drive:
    """A simulated drive as it is kept.

    Attributes:
        key: name of its folder.
        trial: the record of it: condition, lidar, world, seed, fault, harmed.
        scans: what the robot recorded.
        truth: the true path.
        paths: by producer.
        folder: where it lies.
    """

    key: str
    trial: dict[str, str]
    scans: tuple[LogScan, ...]
    truth: Trajectory
    paths: dict[str, Trajectory]
    folder: Path


def drive_trials(
    worlds: Sequence[int],
    courses: Sequence[str] = tuple(FAILURES),
    lidars: Sequence[str] = ("kinect", "hokuyo", "rplidar"),
    seed: int = 1,
) -> Iterator[Trial]:
    """Yield the drives of ``failures``: each fault of one producer befalls each of them in turn.

    Each course has seeds of its own.
    """
    for world, (index, course) in itertools.product(worlds, enumerate(FAILURES)):
        if course not in courses:
            continue
        failures = FailuresConfig(
            repetitions=1,
            first_world=world,
            courses=(course,),
            lidars=tuple(name for name in ("kinect", "hokuyo", "rplidar") if name in lidars),
        )
        config = RunConfig(seed=seed + 10 * index)
        config = replace(config, experiment=replace(config.experiment, failures=failures))
        for trial in failure_trials(config):
            for harmed in BUILT_IN if trial.harmed else ("",):
                yield replace(trial, harmed=harmed)


def key_of(trial: Trial) -> str:
    """Return the name of a drive's folder."""
    course, lidar = trial.condition.split(", ")
    name = f"{course} {trial.harmed}".strip().replace(" ", "-")
    return f"{name},{lidar}-w{trial.course.world.seed}-s{trial.course.seed}"


def save_scans(path: Path, scans: Sequence[LogScan]) -> None:
    """Write scans of one laser, each with odometry, as npz."""
    first = scans[0].scan
    mount = first.mount
    np.savez_compressed(
        path,
        stamps_s=np.array([item.scan.stamp_s for item in scans]),
        ranges=np.stack([item.scan.ranges for item in scans]),
        odometry=np.array([(p.x, p.y, p.yaw_rad) for item in scans if (p := item.odometry)]),
        geometry=np.array(
            [
                *(first.angle_min_rad, first.angle_increment_rad),
                *(first.range_min_m, first.range_max_m),
                *(mount.x, mount.y, mount.yaw_rad),
            ]
        ),
    )


def load_scans(path: Path) -> tuple[LogScan, ...]:
    """Read what ``save_scans`` wrote."""
    with np.load(path) as held:
        stamps, ranges, odometry = held["stamps_s"], held["ranges"], held["odometry"]
        angle_min, step, low, high, *mount = (float(value) for value in held["geometry"])
    return tuple(
        LogScan(
            LaserScan(float(stamp), row, angle_min, step, low, high, Pose2(*mount)),
            Pose2(*(float(value) for value in pose)),
            line,
        )
        for line, (stamp, row, pose) in enumerate(zip(stamps, ranges, odometry, strict=True), 1)
    )


def make_drive(trial: Trial, folder: Path, device: ComputeDevice) -> Path:
    """Simulate a drive, run the producers on it and keep everything; does nothing where it is.

    Returns:
        The drive's folder.
    """
    target = folder / key_of(trial)
    if (target / "drive.json").exists():
        return target
    target.mkdir(parents=True, exist_ok=True)
    (folder / "README").write_text(README, encoding="utf-8")
    recording = simulate(trial.course, device)
    scans = faulty = recording.scans
    if trial.fault:
        faulty = FAULTS[trial.fault](scans)
    truth = recording.truth
    if not trial.harmed:
        # A kidnapping cuts out a part; the lines say which scans stayed.
        stayed = [item.line for item in faulty]
        index = {item.line: number for number, item in enumerate(scans)}
        rows = [index[line] for line in stayed]
        stamps_s = np.array([item.scan.stamp_s for item in faulty])
        truth = Trajectory(stamps_s, truth.poses[rows], "truth")
        scans = faulty
    fed = {name: faulty if trial.harmed in {"", name} else scans for name in BUILT_IN}
    made = _produced(trial, fed, folder, device)
    save_scans(target / "scans.npz", scans)
    write_tum(target / "truth.tum", truth)
    save_map(recording.world.grid, target / "truth")
    for name, path in made.items():
        write_tum(target / f"{name}.tum", path)
    course, lidar = trial.condition.split(", ")
    record = {
        "condition": course,
        "lidar": lidar,
        "world": str(trial.course.world.seed),
        "seed": str(trial.course.seed),
        "fault": trial.fault,
        "harmed": trial.harmed,
    }
    (target / "drive.json").write_text(json.dumps(record), encoding="utf-8")
    return target


def _produced(
    trial: Trial, fed: dict[str, tuple[LogScan, ...]], folder: Path, device: ComputeDevice
) -> dict[str, Trajectory]:
    """Run the producers; those that no fault befalls are taken from a drive that has them."""
    target = folder / key_of(trial)
    paths: dict[str, Trajectory] = {}
    for name in BUILT_IN:
        twin = None
        if trial.harmed and name != trial.harmed:
            others = [other for other in BUILT_IN if other not in {name, trial.harmed}]
            folders = [folder / key_of(replace(trial, harmed=other)) for other in others]
            twin = next((place for place in folders if (place / "drive.json").exists()), None)
        if twin is not None:
            if (twin / f"{name}.tum").exists():
                for file in (f"{name}.yaml", f"{name}.pgm"):
                    (target / file).write_bytes((twin / file).read_bytes())
                paths[name] = read_trajectory(twin / f"{name}.tum")
            continue
        made = produce_maps({name: fed[name]}, RunConfig(seed=trial.course.seed), device)
        grid = made.maps[name]
        if grid is not None:
            save_map(grid, target / name)
            paths[name] = made.paths[name]
    return paths


def read_drive(folder: Path) -> Drive:
    """Read a drive that is kept.

    Raises:
        OSError, zipfile.BadZipFile: it is not whole.
    """
    trial = json.loads((folder / "drive.json").read_text(encoding="utf-8"))
    paths = {
        name: replace_name(read_trajectory(folder / f"{name}.tum"), name)
        for name in BUILT_IN
        if (folder / f"{name}.tum").exists()
    }
    truth = read_trajectory(folder / "truth.tum")
    return Drive(folder.name, trial, load_scans(folder / "scans.npz"), truth, paths, folder)


def replace_name(path: Trajectory, name: str) -> Trajectory:
    """Return a path under another name."""
    return Trajectory(path.stamps_s, path.poses, name)
