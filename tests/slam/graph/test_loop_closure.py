"""Closures that would move the robot wait for others; of a kidnapped one the right place wins."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.geometry import Pose2
from slamfusion.slam.graph.loop_closure import (
    CONFIRMED_M,
    CONFIRMED_NODES,
    MISSES,
    ODOMETRY_NODES,
    How,
    PendingClosure,
    Relocalization,
    confirmed_by_others,
)
from slamfusion.slam.graph.map_graph import Constraint

pytestmark = pytest.mark.once

HERE = Pose2(3.0, -2.0, 0.5)
TRUE, TWIN = Pose2(4.0, 1.0, 1.0), Pose2(-6.0, 2.0, -2.0)


def hit(node: int, correction: Pose2, step_m: float = 1.0, how: How = "anywhere") -> PendingClosure:
    """A closure of a node, ``step_m`` metres after the node before it."""
    edge = Constraint(0, node, np.zeros(3), np.eye(3), is_closure=True)
    return PendingClosure(edge, correction, step_m * node, how)


def told(hypotheses: Relocalization, correction: Pose2, nodes: range, step_m: float = 1.0) -> None:
    for node in nodes:
        hypotheses.add(hit(node, correction, step_m), HERE)


def test_a_hypothesis_is_accepted_after_enough_hits_over_a_distance():
    hypotheses = Relocalization()
    for node in range(CONFIRMED_NODES - 1):
        hypotheses.add(hit(node, TRUE), HERE)
        assert hypotheses.winner() is None
    hypotheses.add(hit(CONFIRMED_NODES, TRUE), HERE)
    winner = hypotheses.winner()
    assert [one.constraint.end for one in winner.hits] == [
        *range(CONFIRMED_NODES - 1),
        CONFIRMED_NODES,
    ]


def test_a_robot_that_hardly_drives_is_not_found():
    hypotheses = Relocalization()
    told(
        hypotheses,
        TRUE,
        range(5 * CONFIRMED_NODES),
        step_m=0.9 * CONFIRMED_M / (5 * CONFIRMED_NODES),
    )
    assert hypotheses.winner() is None


def test_of_two_places_that_look_alike_none_is_accepted_until_one_fails():
    hypotheses = Relocalization()
    for node in range(4 * CONFIRMED_NODES):
        hypotheses.add(hit(node, TRUE), HERE)
        twin = hypotheses.add(hit(node, TWIN), HERE)
        assert hypotheses.winner() is None
    for _ in range(MISSES - 1):
        hypotheses.miss(twin)
        assert hypotheses.winner() is None
    hypotheses.miss(twin)
    winner = hypotheses.winner()
    assert winner.correction == TRUE


BIG = Pose2(2.0, 1.0, 0.0)


def moving(x: float, y: float, yaw_rad: float) -> Pose2:
    """Return a correction that moves a robot at ``HERE`` so, along the map's axes."""
    moved = Pose2(HERE.x + x, HERE.y + y, HERE.yaw_rad + yaw_rad)
    return moved.compose(HERE.inverse())


def test_a_big_step_waits_for_one_that_says_the_same():
    pending: list[PendingClosure] = []
    first, second = hit(7, BIG, how="known"), hit(9, BIG, how="known")
    assert confirmed_by_others(pending, first, HERE) == []
    assert confirmed_by_others(pending, second, HERE) == [second, first]
    assert pending == []
    # The next one starts from nothing.
    assert confirmed_by_others(pending, hit(10, BIG, how="known"), HERE) == []


def answers(ones: list[tuple[int, Pose2]]) -> list[int]:
    """Return how many closures of a lost robot were accepted, after each of them."""
    pending: list[PendingClosure] = []
    return [
        len(confirmed_by_others(pending, hit(number, correction, how="odometry"), HERE))
        for number, correction in ones
    ]


def row(correction: Pose2, first: int, count: int) -> list[tuple[int, Pose2]]:
    """Return closures of nodes that follow each other and say the same."""
    return [(first + index, correction) for index in range(count)]


@pytest.mark.parametrize("correction", [BIG, moving(0.0, 0.0, 0.0)])
def test_a_lost_robot_is_found_when_enough_nodes_agree(correction: Pose2):
    """Also where it happens to be where odometry has it: no step is small then."""
    wanted = ODOMETRY_NODES
    assert answers(row(correction, 7, wanted)) == [0] * (wanted - 1) + [wanted]


def test_a_lost_robot_is_not_found_where_as_many_say_otherwise():
    """The last of six, say, has five before it that agree: five that do not are too many."""
    wanted = ODOMETRY_NODES
    others = [(number, moving(-5.0 - number, 2.0, 1.0)) for number in range(wanted - 1)]
    agreeing = row(BIG, wanted, wanted)
    assert answers([*others[1:], *agreeing])[-1] == wanted
    assert answers([*others, *agreeing])[-1] == 0
    assert answers([*others, *agreeing, (2 * wanted, BIG)])[-1] == wanted + 1
