"""Both repeated experiments on a small room, and what they say in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
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
from slamfusion.evaluation import compare_samples
from slamfusion.experiments import (
    Results,
    compare_models,
    model_sentences,
    sweep_estimators,
    verdicts,
)
from slamfusion.experiments.drives import ATE, RELATIONS
from slamfusion.experiments.occupancy_estimator import FACTORS
from tests.experiments.drives import room

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


def test_no_cell_size_at_all_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"resolutions must be like 0\.1\.\.0\.6"):
        OccupancyEstimatorConfig(resolutions=())


def test_estimators_are_swept_over_cell_sizes_and_drives() -> None:
    kept: list[int] = []
    results = sweep_estimators(
        [room(drift=0.3), room("hall", drift=0.3, relations=False)],
        CONFIG,
        open_device(),
        keep=lambda so_far: kept.append(len(so_far.runs)),
    )
    assert kept == list(range(2, 17, 2))
    assert results.levels(0) == ["room", "hall"]
    assert results.levels(1) == [0.1, 0.4]
    assert results.levels(2) == ["constant", "area"]
    assert set(results.runs["seed"]) == {5, 6}
    # The settings reach the producer: a condition differs from every other one.
    assert len(set(results.runs[ATE][:8:2])) == 4
    assert {(item.drive, item.measure) for item in verdicts(results)} == {
        ("room", RELATIONS),
        ("room", ATE),
        ("hall", ATE),
    }


def test_one_seed_gives_one_result() -> None:
    first, again = (sweep_estimators([room(drift=0.3)], CONFIG, open_device()) for _ in range(2))
    assert list(first.runs[ATE]) == list(again.runs[ATE])


def drawn(factor: float, spread: float = 0.05, runs: int = 10, seed: int = 1) -> Results:
    """Errors of 0.1 m on fine and 1 m on coarse cells; on these ``area`` has ``factor`` of it."""
    rng = np.random.default_rng(seed)
    made = []
    for size, error in ((0.1, 0.1), (0.4, 1.0), (0.6, 3.0)):
        for method in ("constant", "area"):
            share = factor if method == "area" and size >= 0.4 else 1.0
            for number in range(runs):
                value = error * share * (1.0 + spread * rng.standard_normal())
                made.append(("hall", size, method, number, value))
    runs_made = pd.DataFrame(made, columns=[*FACTORS, "seed", ATE])
    return Results("drawn", FACTORS, runs_made, len(made))


@pytest.mark.parametrize(
    ("factor", "answer", "words"),
    [
        (0.7, "helps", "the estimator helps; the error is 2"),
        (1.4, "harms", "the estimator does harm; the error is 4"),
        (1.0, "no difference", "no effect of the estimator can be shown"),
    ],
)
def test_the_verdict_is_of_the_coarse_cells(factor: float, answer: str, words: str) -> None:
    (verdict,) = verdicts(drawn(factor))
    assert verdict.sizes_m == (0.4, 0.6)
    assert verdict.ratio == pytest.approx(factor, rel=0.05)
    assert verdict.answer == answer
    assert words in verdict.sentence()
    assert verdict.to_json()["answer"] == answer


def test_on_one_coarse_size_the_test_is_welch_s() -> None:
    results = drawn(0.9, spread=0.2)
    runs = results.runs[results.runs["cell size m"] != 0.6]
    (verdict,) = verdicts(replace(results, runs=runs))
    samples = [results.values(("hall", 0.4, method), ATE) for method in ("constant", "area")]
    difference = compare_samples(*samples)
    assert difference is not None
    assert verdict.p_value == pytest.approx(difference["welch"])


def test_runs_that_never_vary_are_equal_or_not() -> None:
    (same,), (other,) = (verdicts(drawn(factor, spread=0.0)) for factor in (1.0, 0.9))
    assert (same.p_value, other.p_value) == (1.0, 0.0)


def test_chance_alone_seldom_makes_a_verdict() -> None:
    answers = [verdicts(drawn(1.0, spread=0.3, seed=seed))[0].answer for seed in range(200)]
    # One in twenty is expected; 25 of 200 are over four deviations more.
    assert answers.count("no difference") >= 175


def test_an_error_of_nothing_gives_no_verdict() -> None:
    results = drawn(1.0)
    runs = results.runs.assign(**{ATE: 0.0})
    assert verdicts(replace(results, runs=runs)) == []


def test_a_single_run_proves_nothing() -> None:
    (verdict,) = verdicts(drawn(0.5, runs=1))
    assert verdict.answer == "no difference"
    assert "nothing can be tested" in verdict.sentence()


def test_without_coarse_cells_there_is_no_verdict() -> None:
    results = drawn(0.5)
    fine = results.runs[results.runs["cell size m"] == 0.1]
    assert verdicts(replace(results, runs=fine)) == []


def test_cell_models_are_compared_on_every_drive() -> None:
    results = compare_models(
        [room(drift=0.3), room("hall", drift=0.3, relations=False)], CONFIG, open_device()
    )
    assert results.is_complete
    assert results.levels(1) == ["tinyslam base", "tinyslam mean", "gmapping"]
    assert len(results.runs) == 12
    base, mean, gmapping = (results.values(("room", method), ATE) for method in results.levels(1))
    assert base != mean != gmapping
    sentences = model_sentences(results)
    assert len(sentences) == 9
    assert sentences[0].startswith("room, relations mean in m: ")


def test_the_better_model_is_named_with_its_p_value() -> None:
    runs = [
        ("hall", method, seed, error + 0.001 * seed)
        for method, error in (("tinyslam base", 0.5), ("tinyslam mean", 0.2))
        for seed in range(4)
    ]
    table = pd.DataFrame(runs, columns=["drive", "method", "seed", ATE])
    results = Results("drawn", ("drive", "method"), table, len(runs))
    (sentence,) = model_sentences(results)
    assert sentence == (
        "hall, ate rmse in m: tinyslam mean is better (0.5015 against 0.2015, p <0.001)."
    )
