"""Errors of trajectories, as a library."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import RunConfig
from slamfusion.evaluation.measured import GroundTruth, measure_trajectory
from slamfusion.io import read_trajectory
from slamfusion.json_values import plain
from slamfusion.trajectory import Trajectory


def test_a_trajectory_is_measured_by_hand(place: Path) -> None:
    truth = read_trajectory(place / "truth.tum")
    shifted = Trajectory(truth.stamps_s, truth.poses + np.array([0.3, 0.4, 0.0]))
    held = GroundTruth.read(RunConfig(), relations=place / "flat.relations")
    assert held.odometry is None
    plain_config = replace(RunConfig().trajectory, alignment="none")
    found = measure_trajectory(shifted, plain_config, relations=held.relations, truth=truth)
    assert found.truth is not None
    assert found.truth.ate.rmse == pytest.approx(0.5)
    assert found.relations is not None
    assert found.relations.translation.mean == pytest.approx(0.0, abs=1e-6)
    assert plain(measure_trajectory(shifted)) == {}
