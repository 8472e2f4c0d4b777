"""Both repeated experiments on a small room, and what they say in words."""

from __future__ import annotations

from pathlib import Path

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
from slamfusion.evaluation.measured import result_rows
from slamfusion.experiments.runs import Setup
from slamfusion.experiments.tinyslam import ATE, PAIRS, repeated_runs, sweep_estimators
from tests.experiments.drives import room_files

pytestmark = pytest.mark.once

CONFIG = RunConfig(
    seed=5,
    experiment=ExperimentConfig(
        OccupancyEstimatorConfig(seeds=2, resolutions=(0.1, 0.4), floors=0),
        CellModelsConfig(seeds=2),
    ),
)


@pytest.mark.parametrize(
    ("text", "sizes"),
    [
        ("0.1..0.6", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)),
        ("0.3..0.3", (0.3,)),
        ("0.05..0.3", (0.05, 0.15, 0.25)),
        ("0.2", (0.2,)),
        (0.2, (0.2,)),
        ("0.4, 0.05", (0.4, 0.05)),
    ],
)
def test_cell_sizes_are_read(text: str | float, sizes: tuple[float, ...]) -> None:
    config = from_mapping(OccupancyEstimatorConfig, {"resolutions": text})
    assert config.resolutions == sizes


@pytest.mark.parametrize(
    "text", ["", "a", "0.1..", "0.6..0.1", "0..1", "0.1..0.2..0.3", "0.1,2", "nan", "0.1,,0.2"]
)
def test_what_is_no_list_of_cell_sizes_is_refused(text: str) -> None:
    with pytest.raises(
        ConfigError, match=r"^config: resolutions: (wanted a list of float|must lie in)"
    ):
        from_mapping(OccupancyEstimatorConfig, {"resolutions": text})


def test_estimators_are_swept_over_cell_sizes_and_drives(tmp_path: Path) -> None:
    drives = [room_files(tmp_path), room_files(tmp_path, "hall", relations=False)]
    found = sweep_estimators(drives, Setup(CONFIG, open_device(), tmp_path / "out"))
    table = found.table[found.table["figure"] == ATE]
    cases = [f"{drive}, {size_m} m" for drive in ("room", "hall") for size_m in (0.1, 0.4)]
    assert list(table["case"].unique()) == cases
    assert list(table["method"].unique()) == ["constant", "area"]
    assert set(table["seed"]) == {"5", "6"}
    # The settings reach the producer: a condition differs from every other one.
    assert (
        table[table["case"].isin(cases[:2])].groupby(["case", "method"])["value"].first().nunique()
        == 4
    )
    starts = [sentence.split(":")[0] for sentence in found.sentences()]
    errors = ("relations mean [m]", "ATE rmse [m]")
    of_room = [f"{case}, {error}" for case in cases[:2] for error in errors]
    assert starts == [*of_room, *(f"{case}, ATE rmse [m]" for case in cases[2:])]
    again = sweep_estimators(drives[:1], Setup(CONFIG, open_device(), tmp_path / "b"))
    same = again.table[again.table["figure"] == ATE]["value"]
    assert list(same) == list(table["value"][: len(same)])


def test_the_better_model_is_named_with_its_p_value() -> None:
    rows = [
        row
        for method, error in (("tinyslam base", 0.5), ("tinyslam mean", 0.2))
        for seed in range(4)
        for row in result_rows("hall", str(seed), method, {ATE: error + 0.001 * seed})
    ]
    (sentence,) = repeated_runs("t", "t", rows, PAIRS).sentences()
    assert sentence == (
        "hall, ATE rmse [m]: tinyslam mean is better of tinyslam base and tinyslam mean "
        "(difference 0.3000, p <0.001)."
    )
