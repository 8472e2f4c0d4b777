"""Table III of [H16]: does the occupancy estimator help tinySLAM on coarse cells?

Cell sizes times estimators times seeds, on every drive. The estimator tells the hit cell how much
of it lies behind the wall (``area``), instead of the same for every hit (``constant``).

Source: Huletski, Kartashov and Krinkin, *TinySLAM Improvements for Indoor Navigation*, 2016.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast, get_args

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.compute import ComputeDevice
from slamfusion.config import OccupancyEstimator, RunConfig
from slamfusion.experiments.drives import ATE, RELATIONS, Drive, run_errors
from slamfusion.experiments.records import VerdictJson
from slamfusion.experiments.table import Level, Results, measure_label, repeat
from slamfusion.jobs.documents import p_text
from slamfusion.slam.registry import settings_of
from slamfusion.slam.tinyslam import TinySlam

__all__ = ["COARSE_M", "ESTIMATORS", "NAME", "Verdict", "sweep_estimators", "verdicts"]

NAME = "occupancy-estimator"
TITLE = "Occupancy estimator of tinySLAM against cell size ([H16], Table III)"
FACTORS = ("drive", "cell size m", "estimator")
ESTIMATORS: tuple[OccupancyEstimator, ...] = get_args(OccupancyEstimator)
COARSE_M = 0.4
# A difference that chance makes more often than this is none.
SIGNIFICANT = 0.05


@dataclass(frozen=True)
class Verdict:
    """Whether the estimator helps on coarse cells of one drive.

    Attributes:
        drive: its name.
        measure: what was compared.
        sizes_m: the coarse cell sizes.
        ratio: mean over these of the error with ``area``, the error with ``constant`` being 1.
        p_value: how likely chance alone makes the ratio differ so much from 1, two-sided; None
            where a condition has a single run.
    """

    drive: str
    measure: str
    sizes_m: tuple[float, ...]
    ratio: float
    p_value: float | None

    @property
    def answer(self) -> Literal["helps", "harms", "no difference"]:
        """``helps``, ``harms``, or ``no difference``."""
        if self.p_value is None or self.p_value >= SIGNIFICANT:
            return "no difference"
        return "helps" if self.ratio < 1.0 else "harms"

    def sentence(self) -> str:
        """Return the answer in words, with the p-values."""
        sizes = ", ".join(f"{size:g}" for size in self.sizes_m)
        change = 100.0 * (self.ratio - 1.0)
        found = {
            "helps": "the estimator helps",
            "harms": "the estimator does harm",
            "no difference": "no effect of the estimator can be shown",
        }[self.answer]
        test = "a single run each, so nothing can be tested"
        if self.p_value is not None:
            test = f"p {p_text(self.p_value)}"
        return (
            f"{self.drive}, cells of {sizes} m, {measure_label(self.measure)}: {found}; the error "
            f"is {abs(change):.1f} % {'larger' if change > 0.0 else 'smaller'} with it; {test}."
        )

    def to_json(self) -> VerdictJson:
        """Return the verdict for a JSON document."""
        return {
            "drive": self.drive,
            "measure": self.measure,
            "sizes_m": list(self.sizes_m),
            "ratio": self.ratio,
            "p_value": self.p_value,
            "answer": self.answer,
            "sentence": self.sentence(),
        }


def sweep_estimators(
    drives: Sequence[Drive],
    config: RunConfig,
    device: ComputeDevice,
    *,
    keep: Callable[[Results], None] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Results:
    """Run tinySLAM with every cell size and estimator on every drive, with many seeds.

    Args:
        drives: their names differ.
        config: cell sizes and number of seeds in ``experiment.occupancy_estimator``; tinySLAM's
            other settings; the first seed.
        device: computes.
        keep: given the results so far after each condition.
        progress: told the runs that are done.

    Raises:
        SlamFusionError: a drive has no usable scan.
        TrajectoryError: a drive does not meet its relations or reference in time.
    """
    settings = config.experiment.occupancy_estimator
    by_name = {drive.name: drive for drive in drives}

    def once(levels: tuple[Level, ...], seed: int) -> dict[str, float]:
        name, size_m, estimator = levels
        tinyslam = replace(
            settings_of(config, "tinyslam"),
            resolution=float(size_m),
            occupancy_estimator=cast("OccupancyEstimator", estimator),
        )
        producer = TinySlam(tinyslam, device, seed)
        return run_errors(by_name[str(name)], producer, config.trajectory)

    return repeat(
        TITLE,
        FACTORS,
        list(itertools.product(by_name, settings.resolutions, ESTIMATORS)),
        range(config.seed, config.seed + settings.seeds),
        once,
        keep=keep,
        progress=progress,
    )


def verdicts(results: Results) -> list[Verdict]:
    """Return for each drive and error whether the estimator helps on cells from ``COARSE_M`` on.

    Errors grow with the cell, so on each size the difference of the means counts relative to the
    constant value's mean. The mean of these over the coarse sizes is tested as Welch's t-test
    tests one difference: variances add, degrees of freedom are Welch and Satterthwaite's.
    """
    found = []
    for drive, measure in itertools.product(results.levels(0), (RELATIONS, ATE)):
        pairs = {}
        for size in results.levels(1):
            pair = [
                np.array(results.values((drive, size, method), measure)) for method in ESTIMATORS
            ]
            # Against an error of 0 nothing is relative.
            if float(size) >= COARSE_M - 1e-9 and all(map(len, pair)) and pair[0].mean() > 0.0:
                pairs[float(size)] = [values / pair[0].mean() for values in pair]
        if pairs:
            change = float(np.mean([area.mean() - 1.0 for _, area in pairs.values()]))
            p_value = _p_value(change, list(pairs.values()))
            found.append(Verdict(str(drive), measure, tuple(pairs), 1.0 + change, p_value))
    return found


def _p_value(change: float, pairs: list[list[npt.NDArray[np.float64]]]) -> float | None:
    """Return the two-sided p-value of a mean of differences; None where a sample is single."""
    samples = [values for pair in pairs for values in pair]
    if min(map(len, samples)) < 2:
        return None
    freedom = np.array([len(values) - 1 for values in samples])
    variances = np.array([values.var(ddof=1) / len(values) for values in samples])
    variances /= len(pairs) ** 2
    total = float(variances.sum())
    if total == 0.0:
        return 1.0 if change == 0.0 else 0.0
    degrees = total**2 / float((variances**2 / freedom).sum())
    return float(2.0 * scipy.stats.t.sf(abs(change) / math.sqrt(total), degrees))
