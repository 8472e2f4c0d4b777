"""Both repeated experiments on a small room, and what they say in words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import open_device
from slamfusion.config import (
    CellModelsConfig,
    ExperimentConfig,
    OccupancyEstimatorConfig,
    RunConfig,
    from_mapping,
)
from slamfusion.errors import ConfigError
from slamfusion.evaluation import Row, result_rows
from slamfusion.experiments.drives import ATE
from slamfusion.experiments.page import Experiment
from slamfusion.experiments.runs import Setup
from slamfusion.experiments.tinyslam import (
    PAIRS,
    case_of,
    model_sentences,
    sweep_estimators,
    verdicts,
)
from tests.experiments.drives import room_files

pytestmark = pytest.mark.once

CONFIG = RunConfig(
    seed=5,
    experiment=ExperimentConfig(
        OccupancyEstimatorConfig(seeds=2, resolutions=(0.1, 0.4)), CellModelsConfig(seeds=2)
    ),
)


@pytest.mark.parametrize(
    ("text", "sizes"),
    [
        ("0.1..0.6", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)),
        ("0.3..0.3", (0.3,)),
        ("0.05..0.3", (0.05, 0.15, 0.25)),
        ("0.2", (0.2,)),
        ("0.4, 0.05", (0.4, 0.05)),
    ],
)
def test_cell_sizes_are_read(text: str, sizes: tuple[float, ...]) -> None:
    config = from_mapping(OccupancyEstimatorConfig, {"resolutions": text})
    assert config.resolutions == sizes


@pytest.mark.parametrize(
    "text", ["", "a", "0.1..", "0.6..0.1", "0..1", "0.1..0.2..0.3", "0.1,2", "nan", "0.1,,0.2"]
)
def test_what_is_no_list_of_cell_sizes_is_refused(text: str) -> None:
    with pytest.raises(
        ConfigError, match=r"resolutions(: wanted a list of float| must lie in| must be like)"
    ):
        from_mapping(OccupancyEstimatorConfig, {"resolutions": text})


def test_estimators_are_swept_over_cell_sizes_and_drives(tmp_path: Path) -> None:
    drives = [room_files(tmp_path), room_files(tmp_path, "hall", relations=False)]
    found = sweep_estimators(drives, [], Setup(CONFIG, open_device(), tmp_path / "out"))
    table = found.table[found.table["figure"] == ATE]
    cases = [case_of(drive, size_m) for drive in ("room", "hall") for size_m in (0.1, 0.4)]
    assert list(table["case"].unique()) == cases
    assert list(table["method"].unique()) == ["constant", "area"]
    assert set(table["seed"]) == {"5", "6"}
    # The settings reach the producer: a condition differs from every other one.
    assert (
        table[table["case"].isin(cases[:2])].groupby(["case", "method"])["value"].first().nunique()
        == 4
    )
    starts = [sentence.split(":")[0] for sentence in found.sentences()]
    assert starts == [
        "room, cells of 0.4 m, relations m",
        "room, cells of 0.4 m, ATE rmse m",
        "hall, cells of 0.4 m, ATE rmse m",
    ]
    again = sweep_estimators(drives[:1], [], Setup(CONFIG, open_device(), tmp_path / "b"))
    same = again.table[again.table["figure"] == ATE]["value"]
    assert list(same) == list(table["value"][: len(same)])


def drawn(factor: float, spread: float = 0.05, runs: int = 10, seed: int = 1) -> list[Row]:
    """Errors of 0.1 m on fine and 1 m on coarse cells; on these ``area`` has ``factor`` of it."""
    rng = np.random.default_rng(seed)
    rows: list[Row] = []
    for size_m, error in ((0.1, 0.1), (0.4, 1.0), (0.6, 3.0)):
        for method in ("constant", "area"):
            share = factor if method == "area" and size_m >= 0.4 else 1.0
            for number in range(runs):
                value = error * share * (1.0 + spread * rng.standard_normal())
                rows += result_rows(case_of("hall", size_m), str(number), method, {ATE: value})
    return rows


def verdict(rows: list[Row], sizes_m: tuple[float, ...] = (0.1, 0.4, 0.6)) -> list[str]:
    return verdicts(Experiment("t", "t", rows, (ATE,)), sizes_m)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (0.7, "the estimator helps; the error is 2"),
        (1.4, "the estimator does harm; the error is 4"),
        (1.0, "no effect of the estimator can be shown"),
    ],
)
def test_the_verdict_is_of_the_coarse_cells(factor: float, words: str) -> None:
    (sentence,) = verdict(drawn(factor))
    assert sentence.startswith("hall, cells of 0.4, 0.6 m, ATE rmse m: ")
    assert words in sentence


def test_what_cannot_be_tested_has_no_verdict_or_no_p_value() -> None:
    (sentence,) = verdict(drawn(0.5, runs=1))
    assert "no effect of the estimator can be shown" in sentence
    assert sentence.endswith("p -.")
    # Without coarse cells, or where the error is 0.
    assert verdict(drawn(0.5), (0.1,)) == []
    assert verdict([(*row[:4], 0.0, *row[5:]) for row in drawn(1.0)]) == []


def test_the_better_model_is_named_with_its_p_value() -> None:
    rows = [
        row
        for method, error in (("tinyslam base", 0.5), ("tinyslam mean", 0.2))
        for seed in range(4)
        for row in result_rows("hall", str(seed), method, {ATE: error + 0.001 * seed})
    ]
    experiment = Experiment("t", "t", rows, (ATE,), {ATE: PAIRS}, is_paired=False)
    (sentence,) = model_sentences(experiment)
    assert sentence == (
        "hall, ATE rmse m: tinyslam mean is better of tinyslam base and tinyslam mean (difference "
        "0.3000, p <0.001)."
    )
