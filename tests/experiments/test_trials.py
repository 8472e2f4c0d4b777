"""Trials of the fusion experiments: what they measure, and how they go on after an interruption."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamfusion.compute import open_device
from slamfusion.config import (
    COURSES,
    ExperimentConfig,
    FailuresConfig,
    GroundObstacleConfig,
    RunConfig,
)
from slamfusion.errors import SlamFusionError
from slamfusion.experiments.fusions import (
    CHOICE,
    FUSED_PATH,
    FUSIONS,
    HINDSIGHT,
    against_truth,
    alone,
    drawn_at,
    vote_every_way,
)
from slamfusion.experiments.runs import RunResult, Setup
from slamfusion.experiments.trials import (
    FAILURES,
    FAULTS,
    Trial,
    failure_trials,
    measure_trial,
    obstacle_trials,
    run_trials,
)
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.outputs import DRAWN
from slamfusion.slam.registry import BUILT_IN, with_settings
from slamfusion.trajectory import Trajectory
from tests.fusion.drawings import building, fusion_config

pytestmark = pytest.mark.once


def small() -> RunConfig:
    """Few particles, one drive."""
    return replace(
        with_settings(RunConfig(), "gmapping", particles=5),
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
def done() -> tuple[list[Trial], list[RunResult]]:
    """Both conditions, run once; in the second one gmapping is lost."""
    trials = [short(trial) for trial in obstacle_trials(small())]
    trials[0] = replace(trials[0], draws=True)
    trials[1] = replace(trials[1], fault="lose", harmed="gmapping")
    return trials, [measure_trial(trial, small(), open_device()) for trial in trials]


def figures(result: RunResult, figure: str) -> dict[str, float]:
    """Return a figure by method."""
    return {row[2]: row[4] for row in result.rows if row[3] == figure}


def test_every_method_has_an_error(done: tuple[list[Trial], list[RunResult]]) -> None:
    trials, (plain, harmed) = done
    drawn = [*map(drawn_at, BUILT_IN), DRAWN]
    assert list(figures(plain, "error")) == [*BUILT_IN, *FUSIONS, *drawn]
    assert list(figures(harmed, "error")) == [*BUILT_IN, *FUSIONS, *map(alone, FUSIONS)]
    for trial, own in zip(trials, (plain, harmed), strict=True):
        assert all(0.0 < error < 200.0 for error in figures(own, "error").values())
        assert {row[:2] for row in own.rows} == {(trial.condition, "w1-s0")}
        faces, ate_m = figures(own, "faces_f1"), figures(own, "ate_rmse_m")
        assert figures(own, "error").keys() <= faces.keys()
        assert {*BUILT_IN, FUSED_PATH, CHOICE} < ate_m.keys()
        assert ate_m[HINDSIGHT] == min(ate_m[name] for name in BUILT_IN)
        assert faces[HINDSIGHT] == max(faces[name] for name in BUILT_IN)
    assert min(figures(plain, "wall_f1").values()) > 0.1
    # Nobody was lost: every path is right within a cell or two, and the fused one no worse.
    ate_m = figures(plain, "ate_rmse_m")
    assert ate_m[FUSED_PATH] < 1.5 * max(ate_m[name] for name in BUILT_IN) < 0.3
    ate_m = figures(harmed, "ate_rmse_m")
    assert ate_m[CHOICE] < ate_m["gmapping"]


def test_a_trial_that_fails_is_named(tmp_path: Path) -> None:
    trial = obstacle_trials(small())[0]
    turn, forward, _ = trial.course.script
    course = replace(trial.course, script=(replace(forward, forward_m=100.0), turn))
    setup = Setup(small(), open_device(), tmp_path)
    with pytest.raises(SlamFusionError, match="no-obstacle-w1-s0: "):
        run_trials("t", "t", [replace(trial, course=course)], setup)


@pytest.mark.full
def test_where_fewer_than_two_maps_are_made_the_one_counts_alone(
    done: tuple[list[Trial], list[RunResult]],
) -> None:
    blind = with_settings(small(), "gmapping", maxUrange=0.1)
    blind = with_settings(blind, "tinyslam", usable_range_m=0.1)
    result = measure_trial(done[0][0], blind, open_device())
    assert set(result.notes) == {"tinyslam", "gmapping", "majority"}
    assert result.notes["majority"] == "graph alone: a vote needs at least 2 maps, found 1"
    errors = figures(result, "error")
    assert {errors[name] for name in FUSIONS} == {errors["graph"]}
    # The others count as a map that knows nothing, which is worse.
    (nothing,) = {errors[name] for name in ("tinyslam", "gmapping")}
    assert nothing > errors["graph"]
    assert figures(result, "wall_f1")["tinyslam"] == 0.0


def test_where_no_two_maps_agree_the_fallback_map_counts_alone() -> None:
    device = open_device()
    grids = [building(seed, 8.0, 7.5).with_name(name) for seed, name in enumerate(BUILT_IN)]
    paths = {
        name: Trajectory(np.arange(2.0), np.array([[0, 0, 0], [9.0 * index, 0, 0]]))
        for index, name in enumerate(BUILT_IN)
    }
    notes: dict[str, str] = {}
    config = replace(RunConfig(), fusion=fusion_config())
    fused = vote_every_way(grids, paths, config, device, notes)
    (grid,) = {id(item): item for item in fused.values()}.values()
    assert notes["majority"].startswith(f"{grid.name} alone: no two of the inputs")
    assert vote_every_way([], {}, config, device, notes) == dict.fromkeys(FUSIONS)


def test_failures_are_courses_times_lasers() -> None:
    trials = failure_trials(small())
    assert len(trials) == 3 * len(FAILURES)
    assert len({trial.key for trial in trials}) == len(trials)
    assert {trial.course.lidar.model for trial in trials} == {"kinect", "hokuyo", "rplidar"}
    assert {trial.harmed for trial in trials} == {"", "gmapping", "tinyslam"}
    for course, fault, harmed in FAILURES.values():
        assert course in COURSES
        assert fault in {"", *FAULTS}
        assert harmed in {"", *BUILT_IN}
    places = {trial.condition: trial.course.world.name for trial in trials}
    assert places["slip, kinect"] == "atrium"
    assert (places["slip, hokuyo"], places["corridor loop, kinect"]) == ("office", "corridor")
    few = FailuresConfig(courses=("slip", "glass"), lidars=("hokuyo",), repetitions=2)
    config = RunConfig(experiment=ExperimentConfig(failures=few))
    assert [trial.condition for trial in failure_trials(config)] == (
        ["slip, hokuyo"] * 2 + ["glass, hokuyo"] * 2
    )


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
