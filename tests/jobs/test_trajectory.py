"""Errors of trajectories, as a library."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import RunConfig
from slamfusion.errors import TrajectoryError
from slamfusion.io import read_trajectory
from slamfusion.jobs.trajectory import (
    TrajectoryFiles,
    Yardsticks,
    measure_trajectory,
    measure_trajectory_file,
    write_trajectory,
)
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory
from tests.support.documents import check_document


def test_a_trajectory_is_measured_by_hand(place: Path) -> None:
    truth = read_trajectory(place / "truth.tum")
    shifted = Trajectory(truth.stamps_s, truth.poses + np.array([0.3, 0.4, 0.0]))
    held = Yardsticks.read(RunConfig(), relations=place / "flat.relations")
    assert held.odometry is None
    plain_config = replace(RunConfig().trajectory, alignment="none")
    found = measure_trajectory(shifted, plain_config, relations=held.relations, truth=truth)
    assert found.truth is not None
    assert found.truth.ate.rmse == pytest.approx(0.5)
    assert found.relations is not None
    assert found.relations.translation.mean == pytest.approx(0.0, abs=1e-6)
    assert measure_trajectory(shifted).to_json() == {}


def test_a_trajectory_file_is_measured_and_reported(place: Path, tmp_path: Path) -> None:
    files = TrajectoryFiles(
        place / "truth.tum", place / "flat.relations", place / "flat.log", place / "flat.log",
        place / "truth.tum",
    )  # fmt: skip
    found = measure_trajectory_file(files)
    document = found.to_json()
    check_document(plain(document), "trajectory")
    assert document["ate"].rmse == pytest.approx(0.0, abs=1e-9)
    assert write_trajectory(found, tmp_path / "report").exists()


def test_trajectories_that_never_meet_are_an_error(place: Path) -> None:
    truth = read_trajectory(place / "truth.tum")
    later = Trajectory(truth.stamps_s + 1e6, truth.poses)
    with pytest.raises(TrajectoryError):
        measure_trajectory(later, truth=truth)
