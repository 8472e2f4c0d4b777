"""Closures that would move the robot wait until others say the same."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.geometry import Pose2
from slamfusion.slam.graph.loop_closure import (
    ODOMETRY_NODES,
    How,
    PendingClosure,
    confirmed_by_others,
)
from slamfusion.slam.graph.map_graph import Constraint

pytestmark = pytest.mark.once


def closure_of(number: int, correction: Pose2, how: How = "known") -> PendingClosure:
    """Return a closure of a node; every node is a metre on."""
    edge = Constraint(0, number, np.zeros(3), np.eye(3), is_closure=True)
    return PendingClosure(edge, correction, float(number), how)


HERE = Pose2(3.0, -2.0, 0.5)
BIG = Pose2(2.0, 1.0, 0.0)


def moving(x: float, y: float, yaw_rad: float) -> Pose2:
    """Return a correction that moves a robot at ``HERE`` so, along the map's axes."""
    moved = Pose2(HERE.x + x, HERE.y + y, HERE.yaw_rad + yaw_rad)
    return moved.compose(HERE.inverse())


def test_a_big_step_waits_for_one_that_says_the_same():
    pending: list[PendingClosure] = []
    first, second = closure_of(7, BIG), closure_of(9, BIG)
    assert confirmed_by_others(pending, first, HERE) == []
    assert confirmed_by_others(pending, second, HERE) == [second, first]
    assert pending == []
    # The next one starts from nothing.
    assert confirmed_by_others(pending, closure_of(10, BIG), HERE) == []


def told(ones: list[tuple[int, Pose2]]) -> list[int]:
    """Return how many closures of a lost robot were believed, after each of them."""
    pending: list[PendingClosure] = []
    return [
        len(confirmed_by_others(pending, closure_of(number, correction, "odometry"), HERE))
        for number, correction in ones
    ]


def row(correction: Pose2, first: int, count: int) -> list[tuple[int, Pose2]]:
    """Return closures of nodes that follow each other and say the same."""
    return [(first + index, correction) for index in range(count)]


@pytest.mark.parametrize("correction", [BIG, moving(0.0, 0.0, 0.0)])
def test_a_lost_robot_is_found_when_enough_nodes_agree(correction: Pose2):
    """Also where it happens to be where odometry has it: no step is small then."""
    wanted = ODOMETRY_NODES
    assert told(row(correction, 7, wanted)) == [0] * (wanted - 1) + [wanted]


def test_a_lost_robot_is_not_found_where_as_many_say_otherwise():
    """The last of six, say, has five before it that agree: five that do not are too many."""
    wanted = ODOMETRY_NODES
    others = [(number, moving(-5.0 - number, 2.0, 1.0)) for number in range(wanted - 1)]
    agreeing = row(BIG, wanted, wanted)
    assert told([*others[1:], *agreeing])[-1] == wanted
    assert told([*others, *agreeing])[-1] == 0
    assert told([*others, *agreeing, (2 * wanted, BIG)])[-1] == wanted + 1
