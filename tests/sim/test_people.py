"""People walk between their places, around walls, and wait for the robot."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.config import PersonConfig
from slamfusion.errors import SimulationError
from slamfusion.sim.people import PERSON_RADIUS_M, draw_people, walk
from slamfusion.sim.route import FreeSpace
from tests.sim.places import room

SPACE = FreeSpace(room(10.0, 6.0), PERSON_RADIUS_M)
STEP_S = 0.1
AWAY = np.tile([100.0, 100.0], (200, 1))


def test_a_body_walks_there_and_back_at_its_speed() -> None:
    person = PersonConfig(((-4.0, 0.0), (4.0, 0.0)), speed_mps=1.0, body="disc")
    discs, radii = walk((person,), SPACE, AWAY, STEP_S)
    assert discs.shape == (200, 1, 2)
    assert radii.shape == (1,)
    assert discs[0, 0].tolist() == [-4.0, 0.0]
    steps = np.hypot(*np.diff(discs[:, 0], axis=0).T)
    assert np.median(steps) == pytest.approx(0.1, rel=0.02)
    assert discs[80, 0] == pytest.approx([4.0, 0.0], abs=0.1)
    assert discs[160, 0] == pytest.approx([-4.0, 0.0], abs=0.2)


def test_legs_are_two_and_stay_near_each_other() -> None:
    discs, radii = walk((PersonConfig(((-4.0, 0.0), (4.0, 0.0))),), SPACE, AWAY, STEP_S)
    assert discs.shape == (200, 2, 2)
    apart = np.hypot(*(discs[:, 0] - discs[:, 1]).T)
    assert apart.min() >= 2.0 * radii[0] - 1e-9
    assert 0.3 < apart.max() < 0.6


def test_nobody_walks_into_the_robot() -> None:
    robot = np.tile([0.0, 0.0], (200, 1))
    robot[120:] = (0.0, 2.5)
    person = PersonConfig(((-4.0, 0.0), (4.0, 0.0)), body="disc")
    discs, _ = walk((person,), SPACE, robot, STEP_S)
    away = np.hypot(*(discs[:, 0] - robot).T)
    assert away.min() >= 0.7 - 1e-9
    assert discs[119, 0] == pytest.approx([-0.7, 0.0], abs=0.15)
    assert discs[120:, 0, 0].max() > 3.8, "walks on when the robot is gone"


def test_a_place_in_a_wall_is_refused_by_the_persons_number() -> None:
    people = (PersonConfig(((0.0, 0.0), (5.0, 0.0))),)
    with pytest.raises(SimulationError, match="waypoint of person 1"):
        walk(people, SPACE, AWAY, STEP_S)


def test_drawn_people_repeat_and_have_somewhere_to_go() -> None:
    first, again = (draw_people(SPACE, 5, np.random.default_rng(2)) for _ in range(2))
    assert first == again
    assert len(first) == 5
    assert all(np.hypot(*np.subtract(*person.waypoints)) >= 3.0 for person in first)
