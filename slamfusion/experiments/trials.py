"""Trials: one drive, three producers, their fusions, and the [F16] error of every map.

Trials do not depend on each other: many run at once, each in a process of its own, and each one
that is done is a small JSON file. What is there already is not run again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

import slamfusion
from slamfusion.compute import ComputeDevice
from slamfusion.compute.program import kernel_folder
from slamfusion.config import RunConfig, to_mapping
from slamfusion.cores import usable_cores
from slamfusion.errors import FleetError, SlamFusionError
from slamfusion.evaluation import MapError
from slamfusion.experiments.drive_paths import (
    WeighedPaths,
    draw_paths,
    drive_layers,
    judge_scans,
    path_errors,
    weigh_paths,
)
from slamfusion.experiments.examples import FOLDER, Example
from slamfusion.experiments.faults import FAULTS
from slamfusion.experiments.records import TrialJson
from slamfusion.experiments.voting import FUSIONS, PATIENCE_S, against_truth, vote_every_way
from slamfusion.fleet import Scheduler, open_scheduler
from slamfusion.fleet.worker import worker_device
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.io.atomic import AtomicFiles
from slamfusion.jobs.fuse_drive import produce_maps
from slamfusion.sim.courses import Course, course_to_mapping
from slamfusion.sim.simulate import Recording, simulate
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory

__all__ = [
    "Trial",
    "TrialRecord",
    "alone",
    "measure_trial",
    "run_trials",
]

# Of the files: others are not believed.
FORMAT = 4
# Faces this near to true ones are right, metres.
FACES_M = 0.1
# What of the package has no say in a trial: its faces.
FACES = {"cli", "page", "report", "ros", "viewer"}


@dataclass(frozen=True)
class Trial:
    """One repetition.

    Attributes:
        condition: what the table compares under: a course, or a course with an obstacle.
        course: with its own seed for everything that chance decides on the drive.
        world: seed of the place.
        seed: of the drive and of the producers.
        fault: of ``FAULTS``, done to the scans; empty: none.
        harmed: the producer that the fault befalls; empty: all of them.
        is_example: keep its maps' differences to the truth, to be drawn.
        draws: also draw maps from the scans: at each producer's path, and at the fused one.
    """

    condition: str
    course: Course
    world: int
    seed: int
    fault: str = ""
    harmed: str = ""
    is_example: bool = False
    draws: bool = False

    @property
    def key(self) -> str:
        """Name of its files: condition, world and seed."""
        return f"{self.condition.replace(' ', '-')}-w{self.world}-s{self.seed}"


@dataclass(frozen=True)
class TrialRecord:
    """What came of one repetition.

    Attributes:
        condition, world, seed: of the trial.
        errors: [F16] error of each producer's map and each fused map, by method.
        wall_f1: harmonic mean of the walls' precision and recall, by method; 0 without a map.
        notes: what went wrong, by method: no map, a producer left out.
        faces_f1: F1 of the walls' faces within ``FACES_M`` of the true ones, by method; 0 without
            a map.
        ate_m: absolute error of the path of each producer that has one, and of the fused path, by
            name; metres.
        choice: the producer whose path is taken, see ``choose_path``; empty where the scans
            cannot tell.
    """

    condition: str
    world: int
    seed: int
    errors: Mapping[str, float]
    wall_f1: Mapping[str, float]
    notes: Mapping[str, str]
    faces_f1: Mapping[str, float] = field(default_factory=dict)
    ate_m: Mapping[str, float] = field(default_factory=dict)
    choice: str = ""

    def to_json(self) -> TrialJson:
        """Return the record for a JSON document."""
        return {
            "condition": self.condition,
            "world": self.world,
            "seed": self.seed,
            "errors": dict(self.errors),
            "wall_f1": dict(self.wall_f1),
            "notes": dict(self.notes),
            "faces_f1": dict(self.faces_f1),
            "ate_m": dict(self.ate_m),
            "choice": self.choice,
        }


def alone(fusion: str) -> str:
    """Return what a way to vote is called where the harmed producer is left out beforehand."""
    return f"{fusion}, others alone"


# --- one trial -----------------------------------------------------------------------------------


def measure_trial(
    trial: Trial, config: RunConfig, device: ComputeDevice
) -> tuple[TrialRecord, dict[str, MapError]]:
    """Drive, run the producers, fuse their maps in every way, and measure all maps.

    Each map is laid on the truth where its [F16] error is smallest: in the frame that drive and
    truth share, or at the best or next best place that the alignment search finds, turned by a
    quarter at most. Where no two maps agree, what counts is what ``run`` then names: the fallback
    map alone. A producer without a map, and a fusion of none, has the error of a map that knows
    nothing.

    Args:
        trial: what to drive.
        config: settings of producers and fusion; its seed gives way to the trial's.
        device: computes.

    Returns:
        The record, and each map's error with its difference to the truth.

    Raises:
        SimulationError: the course cannot be driven.
    """
    config = replace(config, seed=trial.seed)
    recording = simulate(trial.course, device)
    faulty = FAULTS[trial.fault](recording.scans) if trial.fault else recording.scans
    fed = {name: faulty if trial.harmed in {"", name} else recording.scans for name in BUILT_IN}
    made = produce_maps(fed, config, device)
    notes = dict(made.reasons)
    # What befalls all of them befalls the robot.
    seen = recording.scans if trial.harmed else faulty
    weighed = weigh_paths(judge_scans(seen, notes), made.paths, device, notes)
    fused = _fuse(trial, made.grids, weighed, seen, fed, config, device, notes)
    if trial.draws:
        fused |= draw_paths(seen, weighed, recording.world.grid.resolution, device)
    truth = recording.world.grid
    found = {
        name: against_truth(grid, truth, config, device, same_heading=True)
        for name, grid in {**made.maps, **fused}.items()
    }
    record = TrialRecord(
        trial.condition,
        trial.world,
        trial.seed,
        {name: item.error for name, item in found.items()},
        {name: item.wall_f1 or 0.0 for name, item in found.items()},
        notes,
        {name: item.faces.f1(FACES_M) or 0.0 for name, item in found.items()},
        path_errors(weighed, _true_path(recording, seen)),
        weighed.choice,
    )
    return record, found


def _true_path(recording: Recording, scans: Sequence[LogScan]) -> Trajectory:
    """Return the true poses of the scans that a fault has left, which may have other stamps."""
    rows = {item.line: row for row, item in enumerate(recording.scans)}
    stamps_s = np.array([item.scan.stamp_s for item in scans])
    kept = [rows[item.line] for item in scans]
    return Trajectory(stamps_s, recording.truth.poses[kept], "truth")


def _fuse(
    trial: Trial,
    grids: Sequence[OccupancyGrid],
    weighed: WeighedPaths,
    seen: Sequence[LogScan],
    fed: Mapping[str, Sequence[LogScan]],
    config: RunConfig,
    device: ComputeDevice,
    notes: dict[str, str],
) -> dict[str, OccupancyGrid | None]:
    """Fuse as ``run`` does: the plain vote decides who votes, then the same maps vote otherwise."""
    align = replace(config.fusion.align, step=None, deadline_s=PATIENCE_S)
    config = replace(config, fusion=replace(config.fusion, align=align))
    layers = drive_layers(grids, weighed, seen, fed, device)
    fused = vote_every_way(layers, config, device, notes)
    if trial.harmed:
        rest = [grid for grid in grids if grid.name != trial.harmed]
        own_notes: dict[str, str] = {}
        others_weighed = weighed.without(trial.harmed, device, own_notes)
        layers = drive_layers(rest, others_weighed, seen, fed, device)
        others = vote_every_way(layers, config, device, own_notes)
        fused |= {alone(mode): others[mode] for mode in FUSIONS}
        notes |= {f"{name}, others alone": reason for name, reason in own_notes.items()}
    return fused


# --- many trials ---------------------------------------------------------------------------------


def run_trials(
    trials: Sequence[Trial],
    config: RunConfig,
    folder: Path,
    *,
    processes: int | None = None,
    scheduler: Scheduler | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[TrialRecord]:
    """Run the trials that no file of an earlier run holds, several at a time.

    Args:
        trials: their keys differ.
        config: settings of everything; a file that was made with others is not believed.
        folder: each trial that is done is at once a JSON file in its folder ``trials``.
        processes: trials at the same time; None: as many as cores.
        scheduler: runs them instead; it stays open.
        progress: told the trials that are done.

    Returns:
        The records in the order of the trials: the same whether made now or before.

    Raises:
        SlamFusionError: a course that cannot be driven, or a process that died. What is done stays
            done: started again, the rest is run.
    """
    folder = folder / FOLDER
    marks = {trial.key: _fingerprint(trial, config) for trial in trials}
    done = {
        trial.key: record
        for trial in trials
        if (record := _read(folder, trial, marks[trial.key])) is not None
    }
    missing = [trial for trial in trials if trial.key not in done]

    def tell() -> None:
        if progress is not None:
            progress("drives", len(done), len(trials))

    tell()
    with ExitStack() as ends:
        if scheduler is None:
            count = min(processes or usable_cores(), len(missing))
            scheduler = ends.enter_context(open_scheduler(processes=count))
        for trial, (record, pictures) in _run(missing, config, scheduler):
            _write(folder, trial, marks[trial.key], record, pictures)
            done[trial.key] = record
            tell()
    return [done[trial.key] for trial in trials]


Done = tuple[TrialRecord, bytes | None]


def _run(
    trials: Sequence[Trial], config: RunConfig, scheduler: Scheduler
) -> Iterator[tuple[Trial, Done]]:
    """Yield each trial with what came of it, in the order in which they end."""
    try:
        jobs = {scheduler.submit(_work, trial, config): trial for trial in trials}
        for job in scheduler.completed(list(jobs)):
            yield jobs[job], job.result()
    except FleetError as error:
        message = f"{error}; what is done stays done: start the experiment again, it goes on"
        raise SlamFusionError(message) from None


def _work(trial: Trial, config: RunConfig) -> Done:
    """Run a trial."""
    return _done(trial, config, worker_device(config.device.device))


def _done(trial: Trial, config: RunConfig, device: ComputeDevice) -> Done:
    """Run a trial, and pack what an example shows."""
    try:
        record, found = measure_trial(trial, config, device)
    except SlamFusionError as error:
        message = f"{trial.key}: {error}"
        raise SlamFusionError(message) from None
    if not trial.is_example:
        return record, None
    differences = {name: item.difference for name, item in found.items()}
    return record, Example(differences, trial.course.world.resolution).packed()


# --- files ---------------------------------------------------------------------------------------


@cache
def _program() -> str:
    """Return a hash of the sources that a trial runs: of the package and of its kernels."""
    package = Path(slamfusion.__file__).parent
    sources = [
        path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in FACES
    ]
    digest = hashlib.sha256()
    for path in (*sorted(sources), *sorted(kernel_folder().glob("*.[ch]*"))):
        digest.update(f"{path.name}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _fingerprint(trial: Trial, config: RunConfig) -> str:
    """Return what tells trials apart that have one name but other settings or another program."""
    settings = to_mapping(replace(config, seed=trial.seed))
    for unrelated in ("experiment", "live", "log", "graph_optimizer", "simulate"):
        del settings[unrelated]
    course = course_to_mapping(trial.course)
    versions = [FORMAT, slamfusion.__version__, _program(), FUSIONS]
    kind = [trial.fault, trial.harmed, trial.is_example, trial.draws]
    facts = [course, *kind, settings, versions]
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def _read(folder: Path, trial: Trial, mark: str) -> TrialRecord | None:
    """Return what an earlier run left of a trial; None where it is missing, damaged or another."""
    try:
        values = json.loads((folder / f"{trial.key}.json").read_text(encoding="utf-8"))
        if values.pop("fingerprint") != mark:
            return None
        if trial.is_example and not (folder / f"{trial.key}.npz").is_file():
            return None
        return TrialRecord(**values)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _write(
    folder: Path, trial: Trial, mark: str, record: TrialRecord, pictures: bytes | None
) -> None:
    """Write what came of a trial, whole or not at all; the same trial gives the same bytes."""
    text = json.dumps({"fingerprint": mark, **record.to_json()}, indent=1, allow_nan=False)
    with AtomicFiles() as files:
        files.add(folder / f"{trial.key}.json", f"{text}\n".encode())
        if pictures is not None:
            files.add(folder / f"{trial.key}.npz", pictures)
