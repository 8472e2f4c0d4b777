"""Trials of the fusion experiments: what they measure, and how they go on after an interruption."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import open_device
from slamfusion.config import (
    ExperimentConfig,
    FailuresConfig,
    GroundObstacleConfig,
    RunConfig,
    from_mapping,
)
from slamfusion.errors import ConfigError, FleetError, SlamFusionError
from slamfusion.experiments import failure_trials, obstacle_trials, read_example
from slamfusion.experiments import trials as module
from slamfusion.experiments.drive_paths import DRAWN, FUSED_PATH, drawn_at
from slamfusion.experiments.failures import FAILURES
from slamfusion.experiments.faults import FAULTS
from slamfusion.experiments.trials import Trial, TrialRecord, alone, run_trials
from slamfusion.experiments.voting import FUSIONS, against_truth, vote_every_way
from slamfusion.fleet import open_scheduler
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.partial import Layers
from slamfusion.sim import COURSES, simulate
from slamfusion.slam.registry import BUILT_IN, with_settings
from slamfusion.trajectory import Trajectory
from tests.fusion.drawings import building, fusion_config

pytestmark = pytest.mark.once

PARTICLES = 5


def small(config: RunConfig = RunConfig()) -> RunConfig:  # noqa: B008 - frozen
    """Few particles, one drive."""
    return replace(
        with_settings(config, "gmapping", particles=PARTICLES),
        experiment=ExperimentConfig(
            ground_obstacle=GroundObstacleConfig(repetitions=1, worlds=1),
            failures=FailuresConfig(repetitions=1),
        ),
    )


def short(trial: Trial) -> Trial:
    """The same trial with a turn of 90 degrees and a metre of way."""
    turn, forward, _ = trial.course.script
    script = (replace(turn, turn_deg=90.0), replace(forward, forward_m=1.0))
    return replace(trial, course=replace(trial.course, script=script))


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Trial], list[TrialRecord]]:
    """Both conditions, run once; in the second one gmapping is lost."""
    folder = tmp_path_factory.mktemp("trials")
    trials = [short(trial) for trial in obstacle_trials(small())]
    trials[0] = replace(trials[0], draws=True)
    trials[1] = replace(trials[1], fault="lose", harmed="gmapping")
    return folder, trials, run_trials(trials, small(), folder, processes=1)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "trials").iterdir()}


def test_every_method_has_an_error(
    done: tuple[Path, list[Trial], list[TrialRecord]],
) -> None:
    _, _, (plain, harmed) = done
    drawn = [*map(drawn_at, BUILT_IN), DRAWN]
    assert list(plain.errors) == [*BUILT_IN, *FUSIONS, *drawn]
    assert list(harmed.errors) == [*BUILT_IN, *FUSIONS, *map(alone, FUSIONS)]
    assert all(0.0 < error < 200.0 for item in (plain, harmed) for error in item.errors.values())
    assert (plain.condition, harmed.condition) == ("no obstacle", "obstacle")
    assert min(plain.wall_f1.values()) > 0.1
    for item in (plain, harmed):
        assert list(item.faces_f1) == list(item.errors)
        assert list(item.ate_m) == [*BUILT_IN, FUSED_PATH]
        assert item.choice in BUILT_IN
    # Nobody was lost: every path is right within a cell or two, and the fused one no worse.
    assert plain.ate_m[FUSED_PATH] < 1.5 * max(plain.ate_m[name] for name in BUILT_IN) < 0.3
    assert harmed.choice != "gmapping"


def test_the_same_seeds_give_the_same_bytes_in_other_processes(
    done: tuple[Path, list[Trial], list[TrialRecord]], tmp_path: Path
) -> None:
    folder, trials, records = done
    told: list[tuple[int, int]] = []
    again = run_trials(
        trials, small(), tmp_path, processes=2, progress=lambda _, n, of: told.append((n, of))
    )
    assert again == records
    assert files(tmp_path) == files(folder)
    assert told == [(0, 2), (1, 2), (2, 2)]


@pytest.mark.full
def test_the_workers_of_a_cluster_give_the_same_bytes_too(
    done: tuple[Path, list[Trial], list[TrialRecord]], tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="Dask comes with the fleet extra")
    folder, trials, records = done
    with open_scheduler("local:2") as scheduler:
        assert run_trials(trials, small(), tmp_path, scheduler=scheduler) == records
    assert files(tmp_path) == files(folder)


def test_what_is_done_is_not_run_again_and_the_rest_is(
    done: tuple[Path, list[Trial], list[TrialRecord]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder, trials, records = done
    (tmp_path / "trials").mkdir()
    for name, data in files(folder).items():
        (tmp_path / "trials" / name).write_bytes(data)
    ran: list[str] = []

    def work(trial: Trial, _: RunConfig) -> tuple[TrialRecord, bytes | None]:
        ran.append(trial.key)
        return records[trials.index(trial)], files(folder)[f"{trial.key}.npz"]

    monkeypatch.setattr(module, "_work", work)
    assert run_trials(trials, small(), tmp_path, processes=1) == records
    assert ran == []
    # A missing file, a damaged one, a lost picture: only that trial is run.
    for path in ("json", "npz"):
        (tmp_path / "trials" / f"{trials[0].key}.{path}").unlink()
        run_trials(trials, small(), tmp_path, processes=1)
        assert ran == [trials[0].key]
        ran.clear()
    (tmp_path / "trials" / f"{trials[1].key}.json").write_text('{"half', encoding="utf-8")
    assert run_trials(trials, small(), tmp_path, processes=1) == records
    assert ran == [trials[1].key]


def test_other_settings_are_run_anew(
    done: tuple[Path, list[Trial], list[TrialRecord]], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, trials, _ = done

    class RanError(Exception):
        pass

    def work(*_: object) -> None:
        raise RanError

    monkeypatch.setattr(module, "_work", work)
    config = small()
    other = with_settings(config, "gmapping", particles=PARTICLES + 1)
    with pytest.raises(RanError):
        run_trials(trials, other, folder, processes=1)
    # Nor is what another program made believed.
    with monkeypatch.context() as patch:
        patch.setattr(module, "_program", lambda: "another")
        with pytest.raises(RanError):
            run_trials(trials, config, folder, processes=1)
    # How many repetitions there are in all does not matter to one of them.
    run_trials(trials, replace(config, experiment=ExperimentConfig()), folder, processes=1)


def test_an_example_keeps_its_maps(done: tuple[Path, list[Trial], list[TrialRecord]]) -> None:
    folder, trials, records = done
    example = read_example(folder, trials[0].key)
    assert list(example.differences) == list(records[0].errors)
    assert example.resolution == trials[0].course.world.resolution
    squares = np.array([0, 0, 0, 1, 1, 1, 1])  # at least, for each code of a difference
    for method, codes in example.differences.items():
        assert math.sqrt(squares[codes].sum()) <= records[0].errors[method]


def test_a_trial_that_fails_is_named(tmp_path: Path) -> None:
    trial = obstacle_trials(small())[0]
    turn, forward, _ = trial.course.script
    course = replace(trial.course, script=(replace(forward, forward_m=100.0), turn))
    with pytest.raises(SlamFusionError, match="no-obstacle-w1-s0: "):
        run_trials([replace(trial, course=course)], small(), tmp_path, processes=1)


def test_where_processes_died_the_way_to_go_on_is_told(tmp_path: Path) -> None:
    (trial, *_) = failure_trials(small())
    with open_scheduler(processes=2) as pool:
        with pytest.raises(FleetError, match="a process died"):
            pool.submit(os._exit, 1).result()
        with pytest.raises(SlamFusionError, match=r"a process died .* stays done: start .* again"):
            run_trials([trial], small(), tmp_path, scheduler=pool)


def test_where_fewer_than_two_maps_are_made_the_one_counts_alone(
    done: tuple[Path, list[Trial], list[TrialRecord]], tmp_path: Path
) -> None:
    _, trials, _ = done
    config = small()
    blind = with_settings(config, "gmapping", maxUrange=0.1)
    blind = with_settings(blind, "tinyslam", usable_range_m=0.1)
    (record,) = run_trials(trials[:1], blind, tmp_path, processes=1)
    assert set(record.notes) == {"tinyslam", "gmapping", "majority"}
    assert record.notes["majority"] == "graph alone: it made the only map"
    assert {record.errors[name] for name in FUSIONS} == {record.errors["graph"]}
    # The others count as a map that knows nothing, which is worse.
    (nothing,) = {record.errors[name] for name in ("tinyslam", "gmapping")}
    assert nothing > record.errors["graph"]
    assert record.wall_f1["tinyslam"] == 0.0


def test_where_no_two_maps_agree_the_fallback_map_counts_alone() -> None:
    device = open_device()
    grids = [building(seed, 8.0, 7.5).with_name(name) for seed, name in enumerate(BUILT_IN)]
    paths = {
        name: Trajectory(np.arange(2.0), np.array([[0, 0, 0], [9.0 * index, 0, 0]]))
        for index, name in enumerate(BUILT_IN)
    }
    notes: dict[str, str] = {}
    config = replace(RunConfig(), fusion=fusion_config())
    fused = vote_every_way(Layers.as_made(grids, paths), config, device, notes)
    (grid,) = {id(item): item for item in fused.values()}.values()
    assert grid is not None
    assert notes["majority"].startswith(f"{grid.name} alone: no two of the inputs")
    nobody = Layers.as_made([], {})
    assert vote_every_way(nobody, config, device, notes) == dict.fromkeys(FUSIONS)


def test_drives_are_paired_and_worlds_are_numbered() -> None:
    settings = GroundObstacleConfig(repetitions=2, worlds=2, first_world=7)
    config = RunConfig(seed=3, experiment=ExperimentConfig(ground_obstacle=settings))
    trials = obstacle_trials(config)
    assert len({trial.key for trial in trials}) == len(trials) == 8
    assert {trial.world for trial in trials} == {7, 8}
    assert {trial.course.world.seed for trial in trials} == {7, 8}
    assert {trial.seed for trial in trials} == {3, 4}
    assert sum(trial.is_example for trial in trials) == 2
    without, over = trials[0].course, trials[4].course
    assert (without.obstacles, over.obstacles) == (False, True)
    assert replace(over, obstacles=False) == without


def test_failures_are_courses_times_lasers() -> None:
    trials = failure_trials(small())
    assert len(trials) == 3 * len(FAILURES)
    assert len({trial.key for trial in trials}) == len(trials)
    assert {trial.course.lidar.model for trial in trials} == {"kinect", "hokuyo", "rplidar"}
    assert {trial.harmed for trial in trials} == {"", "gmapping", "tinyslam"}
    for failure in FAILURES.values():
        assert failure.course in COURSES
        assert failure.fault in {"", *FAULTS}
        assert failure.harmed in {"", *BUILT_IN}
    places = {trial.condition: trial.course.world.name for trial in trials}
    assert places["slip, kinect"] == "atrium"
    assert (places["slip, hokuyo"], places["corridor loop, kinect"]) == ("office", "corridor")
    few = FailuresConfig(courses=("slip", "glass"), lidars=("hokuyo",), repetitions=2)
    config = RunConfig(experiment=ExperimentConfig(failures=few))
    assert [trial.condition for trial in failure_trials(config)] == (
        ["slip, hokuyo"] * 2 + ["glass, hokuyo"] * 2
    )


def test_an_unknown_course_or_laser_is_refused() -> None:
    settings = FailuresConfig(courses=("glas",))
    config = RunConfig(experiment=ExperimentConfig(failures=settings))
    with pytest.raises(ConfigError, match=r"no course 'glas'; wanted some of"):
        failure_trials(config)
    with pytest.raises(ConfigError, match=r"lidars must be one of kinect, .*, found 'sonar'"):
        from_mapping(FailuresConfig, {"lidars": "kinect,sonar"})


@pytest.mark.parametrize("name", ["loop", "glass", "crowd", "slip"])
def test_failing_courses_are_driven(name: str) -> None:
    trials = [item for item in failure_trials(small()) if item.course.name == name]
    for trial in trials[:1]:
        recording = simulate(trial.course, open_device())
        assert recording.truth.path_length_m() > 30.0
        assert 200 < len(recording.scans) < 1500


def test_a_map_is_not_turned_round_where_the_drive_heads_as_the_world_does() -> None:
    device, config = open_device(), RunConfig()
    truth = building(seed=3)
    # What was mapped looks like the true map turned round, but for some walls.
    turned = OccupancyGrid(truth.cells[::-1, ::-1].copy(), truth.resolution, truth.origin, "turned")
    free = against_truth(turned, truth, config, device)
    assert abs(free.transform.yaw_rad) == pytest.approx(math.pi, abs=0.02)
    held = against_truth(turned, truth, config, device, same_heading=True)
    assert abs(held.transform.yaw_rad) <= 0.5 * math.pi
    assert held.error > free.error
