"""The tables of [H16] on tinySLAM: cell models, and the occupancy estimator on coarse cells.

Source: Huletski, Kartashov and Krinkin, *TinySLAM Improvements for Indoor Navigation*, 2016.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast, get_args

import pandas as pd

from slamfusion.config import CellModel, OccupancyEstimator, RunConfig
from slamfusion.errors import LogError, counted
from slamfusion.evaluation.measured import GroundTruth, Row, figure_of, result_rows
from slamfusion.experiments.page import Experiment
from slamfusion.experiments.runs import Inputs, RunResult, Setup, Tell, run_all
from slamfusion.io import LogScan, open_log
from slamfusion.io.lines import strip_gz
from slamfusion.io.log import odometry_path
from slamfusion.jobs.compare import SIGNIFICANT
from slamfusion.jobs.inputs import LogFiles
from slamfusion.jobs.records import p_text
from slamfusion.sim import named_course, simulate
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.common.runner import run_producer
from slamfusion.slam.gmapping.slam import Gmapping
from slamfusion.slam.registry import settings_of
from slamfusion.slam.tinyslam.slam import FREE_VALUE, OCCUPIED_VALUE, TinySlam, cell_value
from slamfusion.trajectory import Trajectory

RELATIONS, ATE, TIME = FIGURES = ("relations_mean_m", "ate_rmse_m", "time_per_scan_ms")
# Table I: the methods, their pairs, and the cell size of gmapping in [H16].
METHODS = ("tinyslam base", "tinyslam mean", "gmapping")
PAIRS = list(itertools.combinations(METHODS, 2))
GMAPPING_CELL_M = 0.2
OBSERVATIONS = 12
OCCUPIED_COUNTS = (3, 6, 9)
QUALITY = {"base": 0.2, "mean": 1.0}
# "Forward": the occupied observations come first; "backward": the free ones.
PAPER: dict[tuple[CellModel, str], tuple[float, ...]] = {
    ("base", "forward"): (0.105, 0.225, 0.460),
    ("base", "backward"): (0.502, 0.737, 0.858),
    ("mean", "forward"): (0.245, 0.480, 0.715),
    ("mean", "backward"): (0.245, 0.480, 0.715),
}
# Table III: ``area`` counts the part of a hit cell behind the wall, ``constant`` none.
ESTIMATORS: tuple[OccupancyEstimator, ...] = get_args(OccupancyEstimator)


def table_two() -> Experiment:
    """Compute Table II: the cell models after twelve observations in two orders.

    Deterministic: a cell starts at 0.5 and receives 12 values, of which 3, 6 or 9 are occupied
    (0.95) and the others free (0.01). Base has quality 0.2, mean (the paper's modified model)
    quality 1. It fails if a value differs from the paper's.
    """
    rows: list[Row] = []
    different = []
    for (model, order), printed in PAPER.items():
        for occupied, paper in zip(OCCUPIED_COUNTS, printed, strict=True):
            observed = [OCCUPIED_VALUE] * occupied + [FREE_VALUE] * (OBSERVATIONS - occupied)
            if order == "backward":
                observed.reverse()
            value = cell_value(model, observed, QUALITY[model])
            case = f"{order}, {occupied} occupied"
            rows += result_rows(case, "", model, {"value": value})
            rows += result_rows(case, "", f"{model} [H16]", {"value": paper})
            if f"{value:.3f}" != f"{paper:.3f}":
                different.append(f"{model}, {case}: found {value:.3f}, wanted {paper:.3f}")
    count = counted(len(different), "value", "differ")
    failure = f"{count} from Table II of [H16]: {'; '.join(different)}"
    return Experiment(
        "cell-models",
        "A cell after 12 observations ([H16], Table II)",
        rows,
        ("value",),
        failure=failure if different else "",
    )


def compare_models(recorded: Sequence[LogFiles], setup: Setup) -> Experiment:
    """Compute Table I: run every method on every drive, with many seeds."""
    config, device = setup.config, setup.device
    settings = config.experiment.cell_models_trajectories
    seeds = range(config.seed, config.seed + settings.seeds)

    def plan(drive: str) -> list[DriveRun]:
        return [DriveRun(drive, *own) for own in itertools.product(METHODS, [drive], seeds)]

    def make(run: DriveRun) -> Mapper:
        if run.method == "gmapping":
            gmapping = replace(settings_of(config, "gmapping"), delta=GMAPPING_CELL_M)
            return Gmapping(gmapping, device, run.seed)
        # The quality is the cell model's default.
        model = "base" if run.method == "tinyslam base" else "mean"
        tinyslam = replace(settings_of(config, "tinyslam"), cell_model=model)
        return TinySlam(tinyslam, device, run.seed)

    return repeated_runs(
        "cell-models-trajectories",
        "Cell models of tinySLAM: errors of the trajectory ([H16], Table I)",
        run_on_drives(plan, make, recorded, settings.floors, setup),
        PAIRS,
        drive_inputs(recorded),
    )


def sweep_estimators(recorded: Sequence[LogFiles], setup: Setup) -> Experiment:
    """Compute Table III: tinySLAM with every cell size and estimator on every drive and seed."""
    config, device = setup.config, setup.device
    settings = config.experiment.occupancy_estimator
    seeds = range(config.seed, config.seed + settings.seeds)

    def plan(drive: str) -> list[DriveRun]:
        wanted = itertools.product(settings.resolutions, ESTIMATORS, seeds)
        return [
            DriveRun(f"{drive}, {size_m:g} m", method, drive, seed, size_m)
            for size_m, method, seed in wanted
        ]

    def make(run: DriveRun) -> Mapper:
        tinyslam = replace(
            settings_of(config, "tinyslam"),
            resolution=run.cell_m,
            occupancy_estimator=cast("OccupancyEstimator", run.method),
        )
        return TinySlam(tinyslam, device, run.seed)

    return repeated_runs(
        "occupancy-estimator",
        "Occupancy estimator of tinySLAM against cell size ([H16], Table III)",
        run_on_drives(plan, make, recorded, settings.floors, setup),
        [("constant", "area")],
        drive_inputs(recorded),
    )


def repeated_runs(
    name: str, title: str, rows: Sequence[Row], pairs: Sequence[tuple[str, str]], read: Inputs = ()
) -> Experiment:
    """Return an experiment with a sentence for each drive, error and pair of methods."""
    tests = dict.fromkeys(FIGURES, pairs)
    experiment = Experiment(name, title, rows, FIGURES, tests, is_paired=False, read=read)
    sentences = []
    for _, test in experiment.comparisons.query("figure != @TIME").iterrows():
        where = f"{test['case']}, {figure_of(test['figure']).label}"
        both = f"{test['first']} and {test['second']}"
        numbers = f"(difference {test['difference']:.4f}, p {p_text(test['p_t'])})"
        if pd.isna(test["p_t"]):
            found = f"no test of {both}, whose runs are single or do not vary"
        elif test["p_t"] >= SIGNIFICANT:
            found = f"no difference between {both} can be shown {numbers}"
        else:
            better = test["first" if test["difference"] < 0.0 else "second"]
            found = f"{better} is better of {both} {numbers}"
        sentences.append(f"{where}: {found}.")
    return replace(experiment, remarks=sentences)


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive in memory."""

    name: str
    scans: tuple[LogScan, ...]
    ground_truth: GroundTruth

    def errors(self, path: Trajectory, config: RunConfig) -> dict[str, float]:
        """Return the errors of a path by name, as far as they can be measured."""
        found = self.ground_truth.measure(path, config).figures()
        return {name: found[name] for name in (RELATIONS, ATE) if name in found}


@dataclass(frozen=True)
class DriveRun:
    """One run of a producer; ``case`` names the drive and everything that is not compared."""

    case: str
    method: str
    drive: str
    seed: int
    cell_m: float = 0.0

    @property
    def key(self) -> str:
        """Name of its file."""
        return f"{self.case}-{self.method}-s{self.seed}".replace(" ", "-").replace(",", "")


def drive_inputs(recorded: Sequence[LogFiles]) -> Inputs:
    """Return role, drive and path of each file of recorded drives."""
    return [file for own in recorded if own.log for file in own.inputs(own.log.stem)]


def read_drive(files: LogFiles, config: RunConfig) -> Drive:
    """Read a recorded drive with relations, a reference path, or both."""
    if files.relations is None and files.truth is None:
        message = f"{files.log}: nothing to measure it by; give relations, a reference, or both"
        raise LogError(message)
    path = files.log or Path()
    log = open_log(path, config.log)
    scans = tuple(log)
    if not scans:
        reasons = "; ".join(log.skips.sentences())
        raise LogError(f"{files.log}: no scan of it can be used: {reasons}")
    name = Path(strip_gz(path.name)).stem
    ground_truth = GroundTruth.read(config, files.relations, files.odometry, files.truth)
    if ground_truth.odometry is not None:
        ground_truth = replace(ground_truth, scans=odometry_path(scans, name))
    return Drive(name, scans, ground_truth)


def run_on_drives(
    plan: Callable[[str], Sequence[DriveRun]],
    make: Callable[[DriveRun], Mapper],
    recorded: Sequence[LogFiles],
    floors: int,
    setup: Setup,
) -> list[Row]:
    """Run producers on recorded drives and simulated office floors; return the rows of all runs."""
    config = setup.config
    drives: list[Drive] = []
    for files in recorded:
        drive = read_drive(files, config)
        twins = sum(other.name.split("#")[0] == drive.name for other in drives)
        drives.append(replace(drive, name=f"{drive.name}#{twins + 1}") if twins else drive)
    for seed in range(1, floors + 1):
        course = replace(named_course("office", seed), name=f"office-{seed}")
        recording = simulate(course, setup.device, setup.progress)
        drives.append(Drive(course.name, recording.scans, GroundTruth(truth=recording.truth)))
    by_name = {drive.name: drive for drive in drives}

    def work(run: DriveRun, _: RunConfig, tell: Tell) -> RunResult:
        drive = by_name[run.drive]
        scans = drive.scans
        made = run_producer(make(run), scans, progress=lambda done: tell(done / len(scans)))
        figures = {**drive.errors(made.trajectory, config), TIME: made.time_per_scan_ms.mean}
        return RunResult(result_rows(run.case, str(run.seed), run.method, figures))

    tasks = {run.key: run for drive in drives for run in plan(drive.name)}
    found = run_all(tasks, work, setup, drive_inputs(recorded))
    return [row for result in found for row in result.rows]
