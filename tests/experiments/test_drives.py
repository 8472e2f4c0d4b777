"""Experiments on tinySLAM: what is measured of a drive, drives in files, and Table II of [H16]."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import RunConfig, TrajectoryConfig
from slamfusion.errors import LogError
from slamfusion.evaluation.measured import GroundTruth
from slamfusion.experiments import tinyslam
from slamfusion.experiments.tinyslam import ATE, RELATIONS, read_drive, table_two
from slamfusion.io import write_carmen, write_tum
from slamfusion.jobs.inputs import LogFiles
from slamfusion.trajectory import Trajectory
from tests.experiments.drives import room

CONFIG = RunConfig(trajectory=TrajectoryConfig(alignment="none"))


def shifted(drive_name: str = "room") -> Trajectory:
    """The truth of the room with its last pose 0.3 m off."""
    truth = room(drive_name).ground_truth.truth
    poses = truth.poses.copy()
    poses[-1, 0] += 0.3
    return Trajectory(truth.stamps_s, poses)


def test_errors_by_hand() -> None:
    errors = room().errors(shifted(), CONFIG)
    assert errors == {RELATIONS: pytest.approx(0.3), ATE: pytest.approx(np.sqrt(0.3**2 / 12))}


def test_only_what_is_known_is_measured() -> None:
    drive = room(relations=False)
    assert set(drive.errors(shifted(), CONFIG)) == {ATE}
    known = GroundTruth(room().ground_truth.relations)
    assert set(replace(room(), ground_truth=known).errors(shifted(), CONFIG)) == {RELATIONS}


def test_odometry_carries_poses_to_relations_between_the_scans() -> None:
    # The odometry of the room is the truth.
    drive, whole = room(), room().ground_truth.truth
    estimate = Trajectory(whole.stamps_s[::3], whole.poses[::3])
    held = replace(drive.ground_truth, odometry=whole, scans=estimate)
    every_third = replace(drive, ground_truth=held)
    # The relation ends at the last scan of the whole drive, which the estimate does not have.
    assert whole.stamps_s[-1] not in estimate.stamps_s
    assert every_third.errors(estimate, CONFIG)[RELATIONS] == pytest.approx(0.0, abs=1e-9)


def test_a_drive_is_read_from_its_files(tmp_path: Path) -> None:
    drive = room()
    write_carmen(tmp_path / "room.log.gz", drive.scans)
    write_tum(tmp_path / "truth.tum", drive.ground_truth.truth)
    (tmp_path / "room.relations").write_text("0.0 1.1 0.5 0 0 0 0 0.2\n", encoding="utf-8")
    found = read_drive(
        LogFiles(
            tmp_path / "room.log.gz",
            tmp_path / "room.relations",
            tmp_path / "room.log.gz",
            tmp_path / "truth.tum",
        ),
        RunConfig(),
    )
    assert found.name == "room"
    assert len(found.scans) == 12
    assert len(found.ground_truth.relations) == 1
    np.testing.assert_allclose(
        found.ground_truth.truth.poses, drive.ground_truth.truth.poses, atol=1e-8
    )
    assert len(found.ground_truth.odometry) == 12


def test_a_drive_that_nothing_measures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="nothing to measure it by"):
        read_drive(LogFiles(tmp_path / "a.log"), RunConfig())


# --- Table II of [H16] ----------------------------------------------------------------------------


def test_a_last_digit_off_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(tinyslam.PAPER, ("base", "forward"), (0.104, 0.225, 0.460))
    failure = table_two().failure
    assert failure.startswith("1 value differs from Table II of [H16]: base, forward, 3 occupied: ")
    assert failure.endswith("found 0.105, wanted 0.104")
