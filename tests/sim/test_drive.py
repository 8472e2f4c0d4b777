"""Drives: wheels and truth, slip, scripts, ways, and what odometry makes of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamfusion.config import ActionConfig, DriveConfig, ObstacleConfig
from slamfusion.errors import SimulationError
from slamfusion.geometry import Pose2, wrap_angles
from slamfusion.sim.drive import (
    DRIVES,
    STEER_MAX_RAD,
    Motion,
    StuckError,
    follow_ways,
    read_odometry,
    run_script,
)
from slamfusion.sim.route import FreeSpace
from tests.sim.places import clearance_m, room, world_of

HALL = room(12.0, 8.0)
SPACE = FreeSpace(HALL, 0.2)
PERIOD_S = 0.1
EXACT = dict.fromkeys(
    (
        "travel_noise",
        "travel_turn_noise",
        "turn_noise",
        "turn_travel_noise",
        "travel_bias",
        "turn_bias",
        "turn_travel_bias",
    ),
    0.0,
)
NO_CHANCE = np.random.default_rng(0)


def script(
    *actions: ActionConfig,
    drive: DriveConfig = DRIVES["differential"],
    zones: tuple[ObstacleConfig, ...] = (),
) -> Motion:
    world = world_of(HALL, obstacles=zones)
    return run_script(world, SPACE, drive, Pose2(-2.0, 1.0, 0.0), actions, PERIOD_S)


def drive_to(
    model: str, *stops: tuple[float, float], zones: tuple[ObstacleConfig, ...] = ()
) -> Motion:
    here, ways = (-4.0, 0.0), []
    for stop in stops:
        ways.append(SPACE.way(here, stop))
        here = stop
    world = world_of(HALL, obstacles=zones)
    return follow_ways(world, SPACE, DRIVES[model], Pose2(-4.0, 0.0, 0.3), ways, PERIOD_S)


def test_a_full_turn_at_90_deg_a_second_takes_4_s_and_ends_where_it_began() -> None:
    motion = script(ActionConfig(turn_deg=360.0, speed_deg_s=90.0))
    assert (len(motion.poses) - 1) * motion.step_s == pytest.approx(4.0)
    assert motion.poses[-1] == pytest.approx([-2.0, 1.0, 0.0], abs=1e-9)
    second = motion.poses[round(1.0 / motion.step_s)]
    assert second[2] == pytest.approx(math.pi / 2)


def test_forward_takes_way_over_speed_and_waits_do_nothing() -> None:
    motion = script(ActionConfig(wait_s=1.0), ActionConfig(forward_m=2.0, speed_mps=0.5))
    assert (len(motion.poses) - 1) * motion.step_s == pytest.approx(5.0)
    assert motion.poses[-1] == pytest.approx([0.0, 1.0, 0.0])
    assert motion.wheels[:, 0].sum() == pytest.approx(2.0)


def test_script_into_a_wall_is_refused_with_time_and_place() -> None:
    with pytest.raises(SimulationError, match=r"into a wall after 15\.\d s at \(5\.\d+, 1\.00\)"):
        script(ActionConfig(forward_m=9.0))


def test_an_endless_script_is_refused() -> None:
    with pytest.raises(SimulationError, match="lasts 36000 s, more than the 21600 s"):
        script(*[ActionConfig(wait_s=3600.0)] * 10)


def test_a_bicycle_does_not_turn_on_the_spot() -> None:
    with pytest.raises(SimulationError, match="which a bicycle cannot; use the drive differential"):
        script(ActionConfig(turn_deg=90.0), drive=DRIVES["bicycle"])


def test_tracks_lose_a_constant_share_and_curve_to_the_slower_side() -> None:
    even = DriveConfig(model="tracks", slip_left=0.1, slip_right=0.1)
    motion = script(ActionConfig(forward_m=2.0), drive=even)
    assert motion.poses[-1] == pytest.approx([-2.0 + 1.8, 1.0, 0.0])
    odd = replace(even, slip_right=0.2)
    motion = script(ActionConfig(forward_m=1.0), drive=odd)
    # The right track makes 0.8 m, the left one 0.9 m, 0.4 m apart.
    assert motion.poses[-1, 2] == pytest.approx(-0.1 / 0.4)


def test_on_a_cable_wheels_slip_and_the_robot_turns_unseen() -> None:
    cable = ObstacleConfig(x_m=-1.0, y_m=1.0, across_m=0.5, slip_share=0.5, kick_rad_m=0.2)
    motion = script(ActionConfig(forward_m=2.0), zones=(cable,))
    turned = motion.poses[-1, 2]
    # 0.5 m on the cable take 1 m of the wheels, which turn it by 0.2 rad.
    assert turned == pytest.approx(0.2, abs=0.01)
    along = np.hypot(*np.diff(motion.poses[:, :2], axis=0).T).sum()
    assert along == pytest.approx(1.5, abs=0.02)
    assert motion.wheels.sum(axis=0) == pytest.approx([2.0, 0.0])


@pytest.mark.parametrize("model", DRIVES)
def test_ways_are_followed_off_the_walls_to_every_stop(model: str) -> None:
    stops = ((5.0, 3.0), (5.0, -3.0), (-5.0, 3.4))
    motion = drive_to(model, *stops)
    assert clearance_m(HALL, motion.poses[::5, :2]) >= 0.2
    reached = [np.hypot(*(motion.poses[:, :2] - stop).T).min() for stop in stops]
    assert max(reached) <= 0.26
    way = np.hypot(*np.diff(motion.poses[:, :2], axis=0).T)
    assert way.max() <= DRIVES[model].speed_mps * motion.step_s * 1.001
    assert (len(motion.poses) - 1) % round(PERIOD_S / motion.step_s) == 0


def test_a_bicycle_turns_no_tighter_than_its_steering_allows() -> None:
    motion = drive_to("bicycle", (5.0, 3.0), (-5.0, 3.0))
    drive = DRIVES["bicycle"]
    way, turn = motion.wheels[1:].T
    limit = math.tan(STEER_MAX_RAD) / drive.wheelbase_m
    assert np.abs(turn).max() > 0.0
    assert (np.abs(turn) <= np.abs(way) * limit + 1e-12).all()


def test_who_steers_sees_the_slip_and_arrives_all_the_same() -> None:
    cable = ObstacleConfig(x_m=0.0, y_m=0.0, along_m=8.0)
    motion = drive_to("tracks", (4.0, 0.0), zones=(cable,))
    assert motion.poses[-1, :2] == pytest.approx([4.0, 0.0], abs=0.07)


def test_a_robot_that_cannot_go_on_says_where(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slamfusion.sim.drive.STUCK_S", 1.0)
    through_the_wall = np.stack((np.linspace(-4.0, 9.0, 200), np.zeros(200)), axis=1)
    world = world_of(HALL)
    with pytest.raises(StuckError, match=r"cannot follow the way to waypoint 1 .* at \(5\.\d"):
        follow_ways(world, SPACE, DRIVES["differential"], Pose2(-4.0), [through_the_wall], 0.1)


def test_perfect_wheels_report_the_truth() -> None:
    motion = drive_to("differential", (5.0, 3.0), (0.0, -3.0))
    found = read_odometry(motion, replace(DRIVES["differential"], **EXACT), NO_CHANCE)
    assert found[:, :2] == pytest.approx(motion.poses[:, :2], abs=1e-9)
    assert wrap_angles(found[:, 2] - motion.poses[:, 2]) == pytest.approx(0.0, abs=1e-9)


def test_odometry_starts_at_the_truth_and_repeats_with_its_seed() -> None:
    motion = script(ActionConfig(forward_m=3.0))
    first, again, other = (
        read_odometry(motion, DRIVES["differential"], np.random.default_rng(seed))
        for seed in (1, 1, 2)
    )
    assert first[0].tolist() == motion.poses[0].tolist()
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != other.tobytes()


def test_biases_are_shares_of_way_and_turn() -> None:
    biased = replace(DRIVES["differential"], **{**EXACT, "travel_bias": 0.1})
    way = read_odometry(script(ActionConfig(forward_m=3.0)), biased, NO_CHANCE)
    assert way[-1, 0] - way[0, 0] == pytest.approx(3.3)
    biased = replace(DRIVES["differential"], **{**EXACT, "turn_bias": -0.1})
    turn = read_odometry(script(ActionConfig(turn_deg=90.0)), biased, NO_CHANCE)
    assert turn[-1, 2] == pytest.approx(math.radians(81.0))
    biased = replace(DRIVES["differential"], **{**EXACT, "turn_travel_bias": 0.1})
    both = read_odometry(script(ActionConfig(forward_m=3.0)), biased, NO_CHANCE)
    assert both[-1, 2] == pytest.approx(0.3)
