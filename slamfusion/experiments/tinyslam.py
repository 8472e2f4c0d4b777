"""The tables of [H16] on tinySLAM: cell models, and the occupancy estimator on coarse cells.

Source: Huletski, Kartashov and Krinkin, *TinySLAM Improvements for Indoor Navigation*, 2016.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import cast, get_args

import pandas as pd

from slamfusion.config import OccupancyEstimator
from slamfusion.evaluation import Row, figure_of, result_rows
from slamfusion.experiments.drives import ATE, RELATIONS, TIME, DriveRun, run_on_drives
from slamfusion.experiments.page import SIGNIFICANT, Experiment
from slamfusion.experiments.runs import Setup
from slamfusion.jobs.documents import p_text
from slamfusion.jobs.map_log import LogFiles
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.gmapping import Gmapping
from slamfusion.slam.registry import settings_of
from slamfusion.slam.tinyslam import TinySlam
from slamfusion.slam.tinyslam.slam import CELL_MODELS

# Table I: the methods that are compared, each two of them, and the cells of gmapping in [H16].
METHODS = ("tinyslam base", "tinyslam mean", "gmapping")
PAIRS = list(itertools.combinations(METHODS, 2))
GMAPPING_CELL_M = 0.2
# Table II.
OBSERVATIONS = 12
OCCUPIED_COUNTS = (3, 6, 9)
OCCUPIED_VALUE, FREE_VALUE = 0.95, 0.01
QUALITY = {"base": 0.2, "mean": 1.0}
# "Forward": the occupied observations come first; "backward": the free ones.
PAPER = {
    ("base", "forward"): (0.105, 0.225, 0.460),
    ("base", "backward"): (0.502, 0.737, 0.858),
    ("mean", "forward"): (0.245, 0.480, 0.715),
    ("mean", "backward"): (0.245, 0.480, 0.715),
}

# Table III: ``area`` counts how much of a hit cell is behind the wall, ``constant`` nothing of it.
ESTIMATORS: tuple[OccupancyEstimator, ...] = get_args(OccupancyEstimator)


def table_two() -> Experiment:
    """Compute Table II: what the cell models make of twelve observations in two orders.

    Deterministic: a cell starts at 0.5 and receives 12 values, of which 3, 6 or 9 are occupied
    (0.95) and the others free (0.01). Base has quality 0.2, mean (the paper's modified model)
    quality 1. It fails where a value is not the paper's.
    """
    rows: list[Row] = []
    different = []
    for (model, order), printed in PAPER.items():
        for occupied, paper in zip(OCCUPIED_COUNTS, printed, strict=True):
            observed = [OCCUPIED_VALUE] * occupied + [FREE_VALUE] * (OBSERVATIONS - occupied)
            if order == "backward":
                observed.reverse()
            value = float(CELL_MODELS[model](observed, QUALITY[model])[-1])
            case = f"{order}, {occupied} occupied"
            rows += result_rows(case, "", model, {"value": value})
            rows += result_rows(case, "", f"{model} [H16]", {"value": paper})
            if f"{value:.3f}" != f"{paper:.3f}":
                different.append(f"{model}, {case}: found {value:.3f}, wanted {paper:.3f}")
    failure = f"{len(different)} values differ from Table II of [H16]: {'; '.join(different)}"
    return Experiment(
        "cell-models",
        "A cell after 12 observations ([H16], Table II)",
        rows,
        ("value",),
        failure=failure if different else "",
    )


def compare_models(recorded: Sequence[LogFiles], floors: Sequence[int], setup: Setup) -> Experiment:
    """Compute Table I: run every method on every drive, with many seeds.

    Args:
        setup: has the number of seeds in ``experiment.cell_models_trajectories``, the methods'
            settings and the first seed.
    """
    config, device = setup.config, setup.device
    seeds = range(config.seed, config.seed + config.experiment.cell_models_trajectories.seeds)

    def plan(drive: str) -> list[DriveRun]:
        return [DriveRun(drive, *own) for own in itertools.product(METHODS, [drive], seeds)]

    def make(run: DriveRun) -> Mapper:
        if run.method == "gmapping":
            settings = replace(settings_of(config, "gmapping"), delta=GMAPPING_CELL_M)
            return Gmapping(settings, device, run.seed)
        # The quality is the cell model's default.
        model = "base" if run.method == "tinyslam base" else "mean"
        settings = replace(settings_of(config, "tinyslam"), cell_model=model)
        return TinySlam(settings, device, run.seed)

    experiment = Experiment(
        "cell-models-trajectories",
        "Cell models of tinySLAM: errors of the trajectory ([H16], Table I)",
        run_on_drives(plan, make, recorded, floors, setup),
        (RELATIONS, ATE, TIME),
        dict.fromkeys((RELATIONS, ATE, TIME), PAIRS),
        is_paired=False,
    )
    return replace(experiment, remarks=method_sentences(experiment))


def method_sentences(experiment: Experiment) -> list[str]:
    """Say for each drive and error which of every two methods is better, with the p-value."""
    tests = experiment.comparisons
    sentences = []
    for _, test in tests[tests["figure"] != TIME].iterrows():
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
    return sentences


def sweep_estimators(
    recorded: Sequence[LogFiles], floors: Sequence[int], setup: Setup
) -> Experiment:
    """Compute Table III: tinySLAM with every cell size and estimator on every drive and seed.

    Args:
        setup: has the cell sizes and the number of seeds in ``experiment.occupancy_estimator``,
            tinySLAM's other settings and the first seed.
    """
    config, device = setup.config, setup.device
    settings = config.experiment.occupancy_estimator
    seeds = range(config.seed, config.seed + settings.seeds)

    def plan(drive: str) -> list[DriveRun]:
        wanted = itertools.product(settings.resolutions, ESTIMATORS, seeds)
        return [
            DriveRun(case_of(drive, size_m), method, drive, seed, size_m)
            for size_m, method, seed in wanted
        ]

    def make(run: DriveRun) -> Mapper:
        tinyslam = replace(
            settings_of(config, "tinyslam"),
            resolution=run.setting,
            occupancy_estimator=cast("OccupancyEstimator", run.method),
        )
        return TinySlam(tinyslam, device, run.seed)

    experiment = Experiment(
        "occupancy-estimator",
        "Occupancy estimator of tinySLAM against cell size ([H16], Table III)",
        run_on_drives(plan, make, recorded, floors, setup),
        (RELATIONS, ATE, TIME),
        {figure: [("constant", "area")] for figure in (RELATIONS, ATE, TIME)},
        is_paired=False,
    )
    return replace(experiment, remarks=method_sentences(experiment))


def case_of(drive: str, size_m: float) -> str:
    """Return the case of a cell size on a drive."""
    return f"{drive}, {size_m:g} m"
