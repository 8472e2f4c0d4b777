"""Table III of [H16]: does the occupancy estimator help tinySLAM on coarse cells?

Cell sizes times estimators times seeds, on every drive. The estimator tells the hit cell how much
of it is behind the wall (``area``), instead of the same for every hit (``constant``).

Source: Huletski, Kartashov and Krinkin, *TinySLAM Improvements for Indoor Navigation*, 2016.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import cast, get_args

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.config import OccupancyEstimator
from slamfusion.evaluation import figure_of
from slamfusion.experiments.drives import ATE, RELATIONS, TIME, DriveFiles, DriveRun, run_on_drives
from slamfusion.experiments.page import SIGNIFICANT, Experiment
from slamfusion.experiments.runs import Setup
from slamfusion.jobs.documents import p_text
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.registry import settings_of
from slamfusion.slam.tinyslam import TinySlam

ESTIMATORS: tuple[OccupancyEstimator, ...] = get_args(OccupancyEstimator)
COARSE_M = 0.4

F64 = npt.NDArray[np.float64]


def sweep_estimators(
    recorded: Sequence[DriveFiles], floors: Sequence[int], setup: Setup
) -> Experiment:
    """Run tinySLAM with every cell size and estimator on every drive, with many seeds.

    Args:
        recorded, floors: see ``run_on_drives``.
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
    return replace(experiment, remarks=verdicts(experiment, settings.resolutions))


def case_of(drive: str, size_m: float) -> str:
    """Return the case of a cell size on a drive."""
    return f"{drive}, {size_m:g} m"


def verdicts(experiment: Experiment, sizes_m: Sequence[float]) -> list[str]:
    """Say for each drive and error whether the estimator helps on cells from ``COARSE_M`` on.

    Errors grow with the cell, so on each size the difference of the means counts relative to the
    constant value's mean. The mean of these over the coarse sizes is tested as Welch's t-test
    tests one difference: variances add, degrees of freedom are Welch and Satterthwaite's.
    """
    values = experiment.table.groupby(["case", "figure", "method"], sort=False)["value"].agg(
        np.array
    )
    drives = dict.fromkeys(case.rpartition(", ")[0] for case in values.index.unique("case"))
    found = []
    for drive, figure in itertools.product(drives, (RELATIONS, ATE)):
        pairs: dict[str, list[F64]] = {}
        for size_m in sizes_m:
            keys = [(case_of(drive, size_m), figure, method) for method in ESTIMATORS]
            # Against an error of 0 nothing is relative.
            if size_m >= COARSE_M - 1e-9 and keys[0] in values and values[keys[0]].mean() > 0.0:
                base = values[keys[0]].mean()
                pairs[f"{size_m:g}"] = [values[key] / base for key in keys]
        if not pairs:
            continue
        change = float(np.mean([area.mean() - 1.0 for _, area in pairs.values()]))
        p_value = change_p_value(change, [own for pair in pairs.values() for own in pair])
        answer = "no effect of the estimator can be shown"
        if p_value < SIGNIFICANT:
            answer = f"the estimator {'helps' if change < 0.0 else 'does harm'}"
        found.append(
            f"{drive}, cells of {', '.join(pairs)} m, {figure_of(figure).label}: {answer}; the "
            f"error is {100.0 * abs(change):.1f} % {'larger' if change > 0.0 else 'smaller'} with "
            f"it; p {p_text(p_value)}."
        )
    return found


def change_p_value(change: float, samples: Sequence[F64]) -> float:
    """Return the two-sided p-value of a mean of differences; NaN where it cannot be tested.

    Args:
        change: the mean difference, over half as many sizes as there are samples.
        samples: of both methods on each size.
    """
    if min(map(len, samples)) < 2:
        return float("nan")
    freedom = np.array([len(own) - 1 for own in samples])
    variances = np.array([own.var(ddof=1) / len(own) for own in samples])
    variances /= (len(samples) / 2) ** 2
    total = variances.sum()
    if total == 0.0:
        return float("nan")
    degrees = total**2 / (variances**2 / freedom).sum()
    return float(2.0 * scipy.stats.t.sf(abs(change) / np.sqrt(total), degrees))
