"""Hypotheses about a kidnapped robot: the right one outlives look-alikes, and none wins early."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.geometry import Pose2
from slamfusion.slam.graph.loop_closure import (
    CONFIRMED_M,
    CONFIRMED_NODES,
    MISSES,
    PendingClosure,
    Relocalization,
)
from slamfusion.slam.graph.map_graph import Constraint

pytestmark = pytest.mark.once

HERE = Pose2(3.0, -2.0, 0.5)
TRUE, TWIN = Pose2(4.0, 1.0, 1.0), Pose2(-6.0, 2.0, -2.0)


def hit(node: int, correction: Pose2, step_m: float = 1.0) -> PendingClosure:
    """A closure of a node, ``step_m`` metres after the node before it."""
    edge = Constraint(0, node, np.zeros(3), np.eye(3), is_closure=True)
    return PendingClosure(edge, correction, step_m * node, "anywhere")


def told(hypotheses: Relocalization, correction: Pose2, nodes: range, step_m: float = 1.0) -> None:
    for node in nodes:
        hypotheses.add(hit(node, correction, step_m), HERE)


def test_a_hypothesis_is_believed_after_enough_hits_over_a_distance():
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


def test_of_two_places_that_look_alike_none_is_believed_until_one_fails():
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
