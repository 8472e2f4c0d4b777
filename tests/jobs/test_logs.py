"""Jobs on logs and trajectories, used as a library: measure, map, run, and what they write."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import RunConfig
from slamfusion.errors import ConfigError, LogError, SlamFusionError, TrajectoryError
from slamfusion.io import load_map, read_trajectory, write_carmen, write_tum
from slamfusion.jobs.defaults import RUN_DEFAULTS
from slamfusion.jobs.documents import plain
from slamfusion.jobs.fuse_drive import produce_maps
from slamfusion.jobs.map_log import map_log, save_mapped_log
from slamfusion.jobs.run import run_log
from slamfusion.jobs.run_files import save_run
from slamfusion.jobs.trajectory import (
    TrajectoryFiles,
    Yardsticks,
    measure_trajectory,
    measure_trajectory_file,
    write_trajectory,
)
from slamfusion.trajectory import Trajectory
from tests.cli.command import tree
from tests.slam.drives import drive
from tests.support.documents import check_document
from tests.support.producers import room_drive

DEVICE = NumpyDevice()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short drive, its true path and one known relation."""
    folder = tmp_path_factory.mktemp("place")
    scans, truth = drive(32)
    write_carmen(folder / "flat.log", scans)
    stamps = np.array([item.scan.stamp_s for item in scans])
    poses = np.array([(pose.x, pose.y, pose.yaw_rad) for pose in truth])
    write_tum(folder / "truth.tum", Trajectory(stamps, poses, "truth"))
    motion = truth[0].inverse().compose(truth[30])
    line = f"0.0 3.0 {motion.x} {motion.y} 0 0 0 {motion.yaw_rad}\n"
    (folder / "flat.relations").write_text(line, encoding="utf-8")
    return folder


# --- trajectories -----------------------------------------------------------------------------


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
    assert document["ate"]["rmse"] == pytest.approx(0.0, abs=1e-9)
    assert write_trajectory(found, tmp_path / "report").exists()


def test_trajectories_that_never_meet_are_an_error(place: Path) -> None:
    truth = read_trajectory(place / "truth.tum")
    later = Trajectory(truth.stamps_s + 1e6, truth.poses)
    with pytest.raises(TrajectoryError):
        measure_trajectory(later, truth=truth)


# --- one producer -----------------------------------------------------------------------------


def test_a_log_is_mapped_measured_saved_and_gone_on_with(place: Path, tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    begun = map_log(
        place / "flat.log", "graph", limit=20, truth=place / "truth.tum",
        relations=place / "flat.relations", progress=lambda *words: told.append(words),
    )  # fmt: skip
    assert begun.failure is not None  # the relation ends after the last scan of these
    assert begun.notices()[0].startswith("stopped after 20 scans, as asked for")
    assert told[0][0] == "graph"
    assert told[-1][1] <= told[-1][2]
    record = save_mapped_log(begun, tmp_path / "begun", state=tmp_path / "state")
    assert record["producers"][0]["files"] == [
        str(tmp_path / f"begun{end}") for end in (".yaml", ".pgm", ".tum", ".json")
    ] + [str(tmp_path / "state")]

    ended = map_log(
        place / "flat.log", "graph", truth=str(place / "truth.tum"),
        relations=place / "flat.relations", truth_map=tmp_path / "begun.yaml",
        resume=tmp_path / "state",
    )  # fmt: skip
    assert ended.failure is None
    assert ended.result.run.known_scans == 20
    assert len(ended.trajectory) == 32
    document = save_mapped_log(ended, tmp_path / "end" / "map", report=tmp_path / "report")
    check_document(plain(document), "slam")
    assert document["producers"][0]["ate"]["rmse"] < 0.1
    assert document["producers"][0]["map_error"] is not None
    assert (tmp_path / "report" / "report.html").exists()
    assert load_map(tmp_path / "end" / "map.yaml").cells.shape == ended.grid.cells.shape


def test_what_cannot_be_mapped_is_an_error(place: Path, tmp_path: Path) -> None:
    with pytest.raises(SlamFusionError, match="no producer 'nobody'"):
        map_log(place / "flat.log", "nobody", device=DEVICE)
    (tmp_path / "empty.log").write_text("nothing\n", encoding="utf-8")
    with pytest.raises(LogError, match=r"empty\.log"):
        map_log(tmp_path / "empty.log", "tinyslam", device=DEVICE)


def test_a_state_that_cannot_be_saved_leaves_nothing(place: Path, tmp_path: Path) -> None:
    mapped = map_log(place / "flat.log", "tinyslam", limit=3)
    with pytest.raises(SlamFusionError, match="tinyslam cannot save its state"):
        save_mapped_log(mapped, tmp_path / "map", state=tmp_path / "state")
    assert not tree(tmp_path)


def test_a_producer_that_fails_is_named_and_the_others_go_on() -> None:
    scans = room_drive(6)
    told: list[str] = []
    made = produce_maps(
        {"tinyslam": scans, "graph": []}, RunConfig(), DEVICE, lambda *words: told.append(words[0])
    )
    assert [grid.name for grid in made.grids] == ["tinyslam"]
    assert made.maps["graph"] is None
    assert "graph could use none of 0 scans" in made.reasons["graph"]
    assert set(made.paths) == {"tinyslam"}
    assert told == ["tinyslam"] * 6


# --- the main job -----------------------------------------------------------------------------


def test_the_main_job_from_a_log_to_files(place: Path, tmp_path: Path) -> None:
    config = replace(RUN_DEFAULTS, run=replace(RUN_DEFAULTS.run, producers=("tinyslam", "graph")))
    prepared: list[bool] = []
    told: list[str] = []
    run = run_log(
        place / "flat.log", config, truth=place / "truth.tum",
        progress=lambda *words: told.append(words[0]), prepare=lambda: prepared.append(True),
    )  # fmt: skip
    assert prepared == [True]
    assert {"tinyslam", "graph"} <= set(told)
    assert [grid.name for grid in run.grids] == ["tinyslam", "graph"]
    assert run.failure is None
    assert run.grid is not None
    saved = save_run(run, tmp_path / "out")
    check_document(plain(saved.document), "run")
    assert saved.folder == tmp_path / "out"
    assert list(saved.stages) == ["producers", "fusion", "errors", "report"]
    assert load_map(tmp_path / "out" / "fused.yaml").cells.tolist() == run.grid.cells.tolist()

    # One without a fused map goes beside it, and says why there is none.
    before = tree(tmp_path / "out")
    alone = run_log(
        place / "flat.log", replace(config, run=replace(config.run, producers=("tinyslam",)))
    )
    assert "1 of 1 maps was made, at least 2 are needed" in str(alone.failure)
    assert (alone.grid, alone.usable) == (None, None)
    failed = save_run(alone, tmp_path / "out")
    check_document(plain(failed.document), "run")
    assert failed.folder == tmp_path / "out" / "failed"
    assert failed.document["best_founded"] == "tinyslam"
    after = tree(tmp_path / "out")
    assert {name: after[name] for name in before} == before


def test_a_main_job_that_cannot_begin_is_an_error(place: Path, tmp_path: Path) -> None:
    nobody = replace(RUN_DEFAULTS, run=replace(RUN_DEFAULTS.run, producers=("nobody",)))
    with pytest.raises(ConfigError, match="nobody"):
        run_log(place / "flat.log", nobody)
    with pytest.raises(OSError, match=r"absent\.log"):
        run_log(tmp_path / "absent.log")


def test_what_goes_wrong_while_preparing_ends_the_run(place: Path) -> None:
    def prepare() -> None:
        message = "no plots here"
        raise SlamFusionError(message)

    with pytest.raises(SlamFusionError, match="no plots here"):
        run_log(place / "flat.log", prepare=prepare)
