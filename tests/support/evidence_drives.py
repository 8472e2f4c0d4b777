"""Simulated drives of the ``failures`` experiment with the producers' paths and maps, kept.

A drive is a folder, named CONDITION[-HARMED],LASER-wWORLD-sSEED: scans.pickle, what the robot
recorded; truth.tum, truth.yaml; NAME.tum and NAME.yaml of each producer that made a map; and
drive.json, which is written last. Where a fault befalls one producer (``harmed``), only that one
was fed other scans; a kidnapping befalls all.
"""

from __future__ import annotations

import itertools
import json
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import FailuresConfig, RunConfig
from slamfusion.experiments.fusions import produce_maps
from slamfusion.experiments.trials import FAILURES, FAULTS, Trial, failure_trials
from slamfusion.io import LogScan, read_trajectory
from slamfusion.io.map_server import save_map
from slamfusion.io.trajectories import write_tum
from slamfusion.sim.simulate import simulate
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Drive:
    """A simulated drive as it is kept.

    Attributes:
        key: name of its folder.
        trial: the record of it: condition, lidar, world, seed, fault, harmed.
        scans: what the robot recorded.
        truth: the true path.
        paths: by producer.
    """

    key: str
    trial: dict[str, str]
    scans: tuple[LogScan, ...]
    truth: Trajectory
    paths: dict[str, Trajectory]


def drive_trials(worlds: Sequence[int], lidars: Sequence[str]) -> Iterator[Trial]:
    """Yield the drives of ``failures``: each fault of one producer befalls each of them in turn.

    Each course has seeds of its own.
    """
    for world, (index, course) in itertools.product(worlds, enumerate(FAILURES)):
        failures = FailuresConfig(
            repetitions=1,
            first_world=world,
            courses=(course,),
            lidars=tuple(name for name in ("kinect", "hokuyo", "rplidar") if name in lidars),
        )
        config = RunConfig(seed=1 + 10 * index)
        config = replace(config, experiment=replace(config.experiment, failures=failures))
        for trial in failure_trials(config):
            for harmed in BUILT_IN if trial.harmed else ("",):
                yield replace(trial, harmed=harmed)


def key_of(trial: Trial) -> str:
    """Return the name of a drive's folder."""
    course, lidar = trial.condition.split(", ")
    name = f"{course} {trial.harmed}".strip().replace(" ", "-")
    return f"{name},{lidar}-w{trial.course.world.seed}-s{trial.course.seed}"


def make_drive(trial: Trial, folder: Path, device: ComputeDevice) -> Path:
    """Simulate a drive, run the producers on it and keep everything; does nothing where it is.

    Returns:
        The drive's folder.
    """
    target = folder / key_of(trial)
    if (target / "drive.json").exists():
        return target
    target.mkdir(parents=True, exist_ok=True)
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
    made = produce_maps(fed, RunConfig(seed=trial.course.seed), device)
    (target / "scans.pickle").write_bytes(pickle.dumps(scans))
    write_tum(target / "truth.tum", truth)
    save_map(recording.world.grid, target / "truth")
    for name, grid in made.maps.items():
        if grid is not None:
            save_map(grid, target / name)
            write_tum(target / f"{name}.tum", made.paths[name])
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


def read_drive(folder: Path) -> Drive:
    """Read a drive that is kept; OSError: it is not whole."""
    trial = json.loads((folder / "drive.json").read_text(encoding="utf-8"))
    paths = {
        name: replace(read_trajectory(folder / f"{name}.tum"), name=name)
        for name in BUILT_IN
        if (folder / f"{name}.tum").exists()
    }
    scans = pickle.loads((folder / "scans.pickle").read_bytes())  # noqa: S301  (our own)
    return Drive(folder.name, trial, scans, read_trajectory(folder / "truth.tum"), paths)
