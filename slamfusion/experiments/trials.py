"""Trials: one drive, three producers, their fusions, and the [F16] error of every map.

Trials do not depend on each other: many run at once, each in a process of its own.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamfusion.compute import ComputeDevice, shared_device
from slamfusion.config import FailuresConfig, GroundObstacleConfig, RunConfig
from slamfusion.cores import usable_cores
from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import Row, result_rows
from slamfusion.experiments.drive_paths import (
    CHOICE,
    FUSED_PATH,
    HINDSIGHT,
    WeighedPaths,
    draw_paths,
    drawn_at,
    drive_layers,
    judge_scans,
    path_errors,
    weigh_paths,
)
from slamfusion.experiments.examples import Example
from slamfusion.experiments.faults import FAULTS
from slamfusion.experiments.page import Experiment, percent
from slamfusion.experiments.runs import RunResult, Setup, run_all
from slamfusion.experiments.voting import FUSIONS, against_truth, vote_every_way
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.jobs.defaults import RUN_VOTE
from slamfusion.jobs.fuse_drive import produce_maps
from slamfusion.jobs.outputs import DRAWN
from slamfusion.sim.courses import Course
from slamfusion.sim.simulate import Recording, simulate
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory

# Faces this near to true ones are right, metres.
FACES_M = 0.1


@dataclass(frozen=True)
class Trial:
    """One repetition.

    Attributes:
        condition: the case of its rows: a course, or a course with an obstacle.
        course: with its own seed for everything that chance decides on the drive.
        world: seed of the place.
        seed: of the drive and of the producers.
        fault: of ``FAULTS``, done to the scans; empty: none.
        harmed: the producer that the fault befalls; empty: all of them.
        is_example: keep its maps' differences to the truth, to be shown.
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
        return f"{self.condition.replace(' ', '-')}-{self.repetition}"

    @property
    def repetition(self) -> str:
        """The seed of its rows: world and seed."""
        return f"w{self.world}-s{self.seed}"


def alone(fusion: str) -> str:
    """Return the name of a vote from which the harmed producer is left out beforehand."""
    return f"{fusion}, others alone"


def run_trials(
    name: str,
    title: str,
    trials: Sequence[Trial],
    settings: GroundObstacleConfig | FailuresConfig,
    setup: Setup,
) -> Experiment:
    """Run trials, several at the same time, and return the experiment.

    Args:
        name, title: see ``Experiment``.
        trials: their keys differ.
        settings: trials at the same time, and whether maps are drawn.
        setup: where and how.

    Raises:
        SlamFusionError: a course that cannot be driven, or a process that died.
    """
    setup = replace(setup, processes=settings.processes or usable_cores())
    found = run_all({trial.key: trial for trial in trials}, _work, setup)
    results = [(trial.condition, own) for trial, own in zip(trials, found, strict=True)]
    return fusion_experiment(name, title, results, draws=settings.draw)


def fusion_experiment(
    name: str, title: str, results: Sequence[tuple[str, RunResult]], *, draws: bool = False
) -> Experiment:
    """Return the experiment on fusion of trials.

    Every two of the producers and fusions are compared by their [F16] errors; the fused path with
    the producers' paths; the faces of the drawn map, or else of the vote of ``run``, with those of
    the producers' maps.

    Args:
        name, title: see ``Experiment``.
        results: condition and result of each trial.
        draws: whether maps were drawn.
    """
    best = [CHOICE, HINDSIGHT]
    drawn = [*map(drawn_at, (*BUILT_IN, HINDSIGHT))]
    ours, others = (DRAWN, [RUN_VOTE, *drawn]) if draws else (RUN_VOTE, [])
    experiment = Experiment(
        name,
        title,
        [row for _, result in results for row in result.rows],
        ("error", "ate_rmse_m", "faces_f1"),
        {
            "error": list(itertools.combinations((*BUILT_IN, *FUSIONS), 2)),
            "ate_rmse_m": [(FUSED_PATH, other) for other in (*BUILT_IN, *best)],
            "faces_f1": [(ours, other) for other in (*BUILT_IN, *best, *others)],
        },
        inputs=BUILT_IN,
        fusions=FUSIONS,
        notes=[(condition, result.notes) for condition, result in results],
    )
    means = experiment.summaries["mean"].xs("error", level="figure")
    remarks = [
        f"{case}: {fusion} {percent(means[case, fusion] / means[case, alone(fusion)])} against "
        "fusing the others alone."
        for case in means.index.unique("case")
        for fusion in FUSIONS
        if (case, alone(fusion)) in means.index
    ]
    return replace(experiment, remarks=remarks)


def _work(trial: Trial, config: RunConfig) -> RunResult:
    """Run a trial in a worker."""
    try:
        return measure_trial(trial, config, shared_device(config.device.device))
    except SlamFusionError as error:
        message = f"{trial.key}: {error}"
        raise SlamFusionError(message) from None


def measure_trial(trial: Trial, config: RunConfig, device: ComputeDevice) -> RunResult:
    """Drive, run the producers, fuse their maps in every way, and measure all maps.

    Each map is placed on the truth where its [F16] error is smallest: in the frame that drive and
    truth share, or at the best or next best place that the alignment search finds, turned by a
    quarter at most. Where no two maps agree, the fallback map that ``run`` names counts alone. A
    producer without a map, and a fusion of none, has the error of a map that knows nothing.

    Args:
        trial: what to drive.
        config: settings of producers and fusion; its seed gives way to the trial's.
        device: computes.

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
    ate_m = path_errors(weighed, _true_path(recording, seen))
    faces = {name: item.faces.f1(FACES_M) or 0.0 for name, item in found.items()}
    figures: dict[str, dict[str, float]] = {
        name: {"error": item.error, "wall_f1": item.wall_f1 or 0.0, "faces_f1": faces[name]}
        for name, item in found.items()
    }
    for name, error_m in {**ate_m, **_best(ate_m, weighed.choice, min)}.items():
        figures.setdefault(name, {})["ate_rmse_m"] = error_m
    for name, share in _best(faces, weighed.choice, max).items():
        figures.setdefault(name, {})["faces_f1"] = share
    rows: list[Row] = []
    for name, own in figures.items():
        rows += result_rows(trial.condition, trial.repetition, name, own)
    example = None
    if trial.is_example:
        differences = {name: item.difference for name, item in found.items()}
        example = Example(differences, trial.course.world.resolution).packed()
    return RunResult(rows, notes, example)


def _best(
    known: Mapping[str, float], choice: str, best: Callable[[Sequence[float]], float]
) -> dict[str, float]:
    """Return the figure of the producer that the scans choose, and of the best in hindsight."""
    found = {}
    if choice in known:
        found[CHOICE] = known[choice]
    for name, names in ((HINDSIGHT, BUILT_IN), (drawn_at(HINDSIGHT), map(drawn_at, BUILT_IN))):
        own = [known[method] for method in names if method in known]
        if own:
            found[name] = best(own)
    return found


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
    align = replace(config.fusion.align, step=None)
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
