"""Guesses about a lost robot: the right one outlives look-alikes, none is believed early."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.geometry import Pose2
from slamfusion.slam.graph.closure_search import Waiting
from slamfusion.slam.graph.constraints import Constraint
from slamfusion.slam.graph.relocalization import (
    HITS,
    MISSES,
    MOST_GUESSES,
    TESTED,
    WAY_M,
    Relocation,
)

pytestmark = pytest.mark.once

HERE = Pose2(3.0, -2.0, 0.5)
TRUE, TWIN = Pose2(4.0, 1.0, 1.0), Pose2(-6.0, 2.0, -2.0)


def hit(node: int, correction: Pose2, way_m: float = 1.0) -> Waiting:
    """A closure of a node, ``way_m`` metres after the node before it."""
    edge = Constraint(0, node, np.zeros(3), np.eye(3), is_closure=True)
    return Waiting(edge, correction, way_m * node, "anywhere")


def told(relocation: Relocation, correction: Pose2, nodes: range, way_m: float = 1.0) -> None:
    for node in nodes:
        relocation.add(hit(node, correction, way_m), HERE)


def test_a_guess_is_believed_after_enough_hits_on_a_way():
    relocation = Relocation()
    for node in range(HITS - 1):
        relocation.add(hit(node, TRUE), HERE)
        assert relocation.winner() is None
    relocation.add(hit(HITS, TRUE), HERE)
    winner = relocation.winner()
    assert winner is not None
    assert [one.edge.end for one in winner.hits] == [*range(HITS - 1), HITS]


def test_a_robot_that_hardly_drives_is_not_found():
    relocation = Relocation()
    told(relocation, TRUE, range(5 * HITS), way_m=0.9 * WAY_M / (5 * HITS))
    assert relocation.winner() is None


def test_closures_of_one_node_count_once():
    relocation = Relocation()
    for _ in range(HITS):
        told(relocation, TRUE, range(0, 2 * HITS - 2, 2))
    assert relocation.winner() is None


def test_of_two_places_that_look_alike_none_is_believed_until_one_fails():
    relocation = Relocation()
    for node in range(4 * HITS):
        relocation.add(hit(node, TRUE), HERE)
        twin = relocation.add(hit(node, TWIN), HERE)
        assert relocation.winner() is None
    for _ in range(MISSES - 1):
        relocation.miss(twin)
        assert relocation.winner() is None
    relocation.miss(twin)
    winner = relocation.winner()
    assert winner is not None
    assert winner.correction == TRUE


def test_misses_count_in_a_row():
    relocation = Relocation()
    told(relocation, TRUE, range(2))
    guess = relocation.guesses[0]
    for _ in range(3):
        for _ in range(MISSES - 1):
            relocation.miss(guess)
        told(relocation, TRUE, range(2, 3))
    assert relocation.guesses == [guess]
    for _ in range(MISSES):
        relocation.miss(guess)
    relocation.miss(guess)  # of one that is given up already
    assert relocation.guesses == []


def test_a_false_lead_that_cannot_be_tested_does_not_stand_in_the_way_forever():
    relocation = Relocation()
    told(relocation, TWIN, range(8))
    told(relocation, TRUE, range(8, 16))
    assert relocation.winner() is None
    told(relocation, TRUE, range(16, 40))
    winner = relocation.winner()
    assert winner is not None
    assert winner.correction == TRUE


@pytest.mark.parametrize(("away", "guesses"), [((0.1, 0.1, 0.02), 1), ((0.5, 0.0, 0.0), 2)])
def test_hits_that_say_the_same_are_one_guess(away: tuple[float, float, float], guesses: int):
    """The same at the robot; what a correction does at the frame's origin is no matter."""
    relocation = Relocation()
    place = TRUE.compose(HERE)
    other = Pose2(place.x + away[0], place.y + away[1], place.yaw_rad + away[2])
    relocation.add(hit(0, TRUE), HERE)
    relocation.add(hit(1, other.compose(HERE.inverse())), HERE)
    assert len(relocation.guesses) == guesses


def test_few_are_tested_at_a_node_and_each_in_its_turn():
    relocation = Relocation()
    for number in range(5):
        relocation.add(hit(0, Pose2(3.0 * number, 0.0)), HERE)
    tested = []
    for node in range(3):
        chosen = relocation.to_test()
        assert len(chosen) == TESTED
        for guess in chosen:
            guess.tested = node
            tested.append(round(guess.correction.x))
    assert tested[:5] == [0, 3, 6, 9, 12]


def test_the_least_supported_guess_makes_room():
    relocation = Relocation()
    told(relocation, TRUE, range(3))
    for number in range(2 * MOST_GUESSES):
        relocation.add(hit(0, Pose2(30.0 + 3.0 * number, 0.0)), HERE)
    assert len(relocation.guesses) == MOST_GUESSES
    assert relocation.guesses[0].correction == TRUE
