"""Table I of [H16]: the trajectory errors of tinySLAM's two cell models, and of gmapping.

Source: Huletski, Kartashov and Krinkin, *TinySLAM Improvements for Indoor Navigation*, 2016.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from slamfusion.evaluation import figure_of
from slamfusion.experiments.drives import ATE, RELATIONS, TIME, DriveFiles, DriveRun, run_on_drives
from slamfusion.experiments.page import SIGNIFICANT, Experiment
from slamfusion.experiments.runs import Setup
from slamfusion.jobs.documents import p_text
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.gmapping import Gmapping
from slamfusion.slam.registry import settings_of
from slamfusion.slam.tinyslam import TinySlam

METHODS = ("tinyslam base", "tinyslam mean", "gmapping")
PAIRS = list(itertools.combinations(METHODS, 2))
# The cells of [H16].
GMAPPING_CELL_M = 0.2


def compare_models(
    recorded: Sequence[DriveFiles], floors: Sequence[int], setup: Setup
) -> Experiment:
    """Run every method on every drive, with many seeds.

    Args:
        recorded, floors: see ``run_on_drives``.
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
    return replace(experiment, remarks=model_sentences(experiment))


def model_sentences(experiment: Experiment) -> list[str]:
    """Say for each drive and error which of every two methods is better, with the p-value."""
    tests = experiment.comparisons
    return [_sentence(test) for _, test in tests[tests["figure"] != TIME].iterrows()]


def _sentence(test: pd.Series) -> str:
    """Say which of two methods is better, with the p-value."""
    where = f"{test['case']}, {figure_of(test['figure']).label}"
    both = f"{test['first']} and {test['second']}"
    if pd.isna(test["p_t"]):
        return f"{where}: no test of {both}, whose runs are single or do not vary."
    if test["p_t"] >= SIGNIFICANT:
        found = f"no difference between {both} can be shown"
    else:
        found = f"{test['first' if test['difference'] < 0.0 else 'second']} is better of {both}"
    return f"{where}: {found} (difference {test['difference']:.4f}, p {p_text(test['p_t'])})."
