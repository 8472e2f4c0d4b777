"""Table I of [H16]: the trajectory errors of tinySLAM's two cell models, beside gmapping's.

Source: Huletski, Kartashov and Krinkin, *TinySLAM Improvements for Indoor Navigation*, 2016.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

from slamfusion.compute import ComputeDevice
from slamfusion.config import CellModel, RunConfig
from slamfusion.experiments.drives import ATE, RELATIONS, Drive, run_errors
from slamfusion.experiments.records import ComparisonJson
from slamfusion.experiments.table import Level, Results, measure_label, repeat
from slamfusion.jobs.documents import p_text
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.gmapping import Gmapping
from slamfusion.slam.registry import settings_of
from slamfusion.slam.tinyslam import TinySlam

__all__ = ["METHODS", "NAME", "compare_models", "model_sentences"]

NAME = "cell-models-trajectories"
TITLE = "Cell models of tinySLAM: errors of the trajectory ([H16], Table I)"
FACTORS = ("drive", "method")
SIGNIFICANT = 0.05
GMAPPING_CELL_M = 0.2


def _tinyslam(cell_model: CellModel) -> Callable[[RunConfig, ComputeDevice, int], Mapper]:
    """Return what makes a tinySLAM of a cell model; the quality is that model's default."""

    def make(config: RunConfig, device: ComputeDevice, seed: int) -> Mapper:
        return TinySlam(
            replace(settings_of(config, "tinyslam"), cell_model=cell_model), device, seed
        )

    return make


def _gmapping(config: RunConfig, device: ComputeDevice, seed: int) -> Mapper:
    """Return gmapping on the cells of [H16]."""
    return Gmapping(replace(settings_of(config, "gmapping"), delta=GMAPPING_CELL_M), device, seed)


# Every column of the table: how a fresh producer is made from configuration, device and seed.
METHODS: dict[str, Callable[[RunConfig, ComputeDevice, int], Mapper]] = {
    "tinyslam base": _tinyslam("base"),
    "tinyslam mean": _tinyslam("mean"),
    "gmapping": _gmapping,
}


def compare_models(
    drives: Sequence[Drive],
    config: RunConfig,
    device: ComputeDevice,
    *,
    keep: Callable[[Results], None] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Results:
    """Run every method on every drive, with many seeds.

    Args:
        drives: their names differ.
        config: number of seeds in ``experiment.cell_models_trajectories``; the methods' settings;
            the first seed.
        device: computes.
        keep: given the results so far after each condition.
        progress: told the runs that are done.

    Raises:
        SlamFusionError: a drive has no usable scan.
        TrajectoryError: a drive does not meet its relations or reference in time.
    """
    settings = config.experiment.cell_models_trajectories
    by_name = {drive.name: drive for drive in drives}

    def once(levels: tuple[Level, ...], seed: int) -> dict[str, float]:
        name, method = levels
        producer = METHODS[str(method)](config, device, seed)
        return run_errors(by_name[str(name)], producer, config.trajectory)

    return repeat(
        TITLE,
        FACTORS,
        list(itertools.product(by_name, METHODS)),
        range(config.seed, config.seed + settings.seeds),
        once,
        keep=keep,
        progress=progress,
    )


def model_sentences(results: Results) -> list[str]:
    """Return for each drive and error which of every two methods is better, with the p-value."""
    return [
        _sentence(item) for measure in (RELATIONS, ATE) for item in results.comparisons(measure)
    ]


def _sentence(item: ComparisonJson) -> str:
    first, second = item["methods"]
    where = f"{item['levels'][0]}, {measure_label(item['measure'])}"
    means = "{:.4f} against {:.4f}".format(*item["means"])
    if item["p_values"] is None:
        return f"{where}: {first} {means} of {second}, a single run each: nothing can be tested."
    p_value = item["p_values"]["welch"]
    if p_value >= SIGNIFICANT:
        found = f"no difference between {first} and {second} can be shown"
    else:
        better = first if item["means"][0] < item["means"][1] else second
        found = f"{better} is better"
    return f"{where}: {found} ({means}, p {p_text(p_value)})."
