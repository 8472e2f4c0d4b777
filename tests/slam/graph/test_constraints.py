"""The poses that fit what is known best: exact, along the right axes, and no false closure."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.geometry import F64, Pose2, compose_poses, invert_poses, pose_of, wrap_angles
from slamfusion.pose_graph.least_squares import at_once
from slamfusion.slam.graph.map_graph import Constraint, GraphHealth, MapGraph, solve_constraints
from slamfusion.slam.graph.node_map import Node
from tests.support.examples import examples

solve = at_once(solve_constraints)
STEP_SIGMAS = (0.05, 0.05, 0.02)
CLOSURE_SIGMAS = (0.02, 0.02, 0.01)


def known(sigmas: tuple[float, ...]) -> F64:
    """Return (3, 3) the information of these deviations."""
    return np.diag(np.array(sigmas) ** -2.0)


def seen_from(poses: F64, start: int, end: int) -> F64:
    """Return (3,) the true motion."""
    motion = compose_poses(invert_poses(poses[start, None]), poses[end, None])[0]
    motion[2] = wrap_angles(motion[2])
    return motion


def true_ring(count: int = 16) -> F64:
    """Return (N, 3) a way once around a circle of 3 m."""
    angles = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)
    return np.column_stack((3.0 * np.cos(angles), 3.0 * np.sin(angles), angles + 0.5 * math.pi))


def chain(poses: F64) -> list[Constraint]:
    """Return the true steps from one to the next."""
    return [
        Constraint(index, index + 1, seen_from(poses, index, index + 1), known(STEP_SIGMAS))
        for index in range(len(poses) - 1)
    ]


def closure(poses: F64, start: int, end: int, wrong: F64 | None = None) -> Constraint:
    """Return a closure, true or off by a motion (3,) at its end."""
    motion = seen_from(poses, start, end) + (0.0 if wrong is None else wrong)
    return Constraint(start, end, motion, known(CLOSURE_SIGMAS), is_closure=True)


def drifted(constraints: list[Constraint], first: F64, bias: F64) -> F64:
    """Return (N, 3) where steps that are all wrong by a bias would lead."""
    poses = [first]
    for one in constraints:
        poses.append(compose_poses(poses[-1][None], (one.motion + bias)[None])[0])
    return np.array(poses)


def off(poses: F64, truth: F64) -> float:
    """Return the greatest difference, metres or radians."""
    away = poses - truth
    away[:, 2] = wrap_angles(away[:, 2])
    return float(np.abs(away).max())


@given(
    x=st.floats(-1e4, 1e4),
    y=st.floats(-1e4, 1e4),
    yaw_rad=st.floats(-math.pi, math.pi),
    turn_bias=st.floats(-0.03, 0.03),
)
@settings(max_examples=examples(40), deadline=None)
def test_a_ring_without_noise_is_exact_in_any_frame(
    x: float, y: float, yaw_rad: float, turn_bias: float
):
    frame = np.broadcast_to(np.array([x, y, yaw_rad]), (16, 3))
    truth = compose_poses(frame, true_ring())
    steps = chain(truth)
    start = drifted(steps, truth[0], np.array([0.01, -0.01, turn_bias]))
    solved = solve(start, [*steps, closure(truth, 0, 15), closure(truth, 2, 14)])
    assert off(solved.poses, truth) < 1e-5
    assert solved.chi2 < 1e-4
    assert not solved.is_outlier.any()
    np.testing.assert_allclose(solved.poses[0], start[0], atol=1e-9)  # the first is held


# -- false closures --------------------------------------------------------------------------------


@pytest.mark.parametrize("is_right", [False, True])
def test_a_weak_tie_gives_way_to_closures_that_agree(*, is_right: bool):
    """A lost robot: odometry is a closure that may be false beside a tie of next to nothing."""
    truth = true_ring(10)
    steps = chain(truth)
    carried = np.zeros(3) if is_right else np.array([4.0, -3.0, 1.0])
    told = steps[4].motion + carried
    steps[4:5] = [
        Constraint(4, 5, told, known((10.0, 10.0, 3.0))),
        Constraint(4, 5, told, known((0.3, 0.3, 0.2)), is_closure=True),
    ]
    seen = [closure(truth, *ends) for ends in ((0, 8), (1, 9), (2, 7))]
    solved = solve(truth, [*steps, *seen])
    assert off(solved.poses, truth) < (1e-5 if is_right else 0.02)
    assert (solved.weights[5] > 0.5) == is_right
    np.testing.assert_array_equal(solved.weights[-3:], 1.0)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_new_closures_that_contradict_are_left_out_until_they_are_too_many(count: int):
    """A false closure was believed while it was alone; then true ones say otherwise."""
    truth = true_ring()
    steps = chain(truth)
    false = closure(truth, 3, 12, np.array([0.5, 0.2, 0.05]))
    first = solve(truth, [*steps, false])
    assert first.weights[15] == 1.0
    true = [closure(truth, *ends) for ends in ((2, 13), (4, 11), (1, 14), (0, 15))][:count]
    later = [*steps, false, *true]
    stands = solve(first.poses, later, first.weights, tolerated=count)
    assert not stands.is_reevaluated
    assert stands.weights[15] == 1.0
    np.testing.assert_array_equal(stands.weights[16:], 0.0)
    again = solve(first.poses, later, first.weights, tolerated=count - 1)
    assert again.is_reevaluated
    assert again.weights[15] == 0.0
    assert off(again.poses, truth) < 1e-6


def test_a_match_that_the_odometry_contradicts_is_uncertain_along_the_difference():
    """By its match the robot has come 1 m, by the odometry 2 m, and has turned to the left."""
    graph, empty = MapGraph(GraphHealth()), np.zeros((0, 2), dtype=np.float32)
    left = math.pi / 2.0
    graph.add_node(Node(empty, empty, 0.0, Pose2()), Pose2())
    graph.add_node(Node(empty, empty, 1.0, Pose2(2.0, 0.0, left)), Pose2(1.0, 0.0, left))
    match = Constraint(0, 1, np.array([1.0, 0.0, left]), 1e4 * np.eye(3))
    graph.add_matches(1, [match], Pose2(1.0, 0.0, left))
    (found,) = graph.constraints
    covariance = np.linalg.inv(found.information)
    np.testing.assert_allclose(covariance, np.diag([1.0001, 1e-4, 1e-4]), atol=1e-9)


# -- a solution beside the scans -------------------------------------------------------------------


def add_node(graph: MapGraph, pose: Pose2) -> int:
    empty = np.zeros((0, 2), dtype=np.float32)
    return graph.add_node(Node(empty, empty, 0.0, None), pose)


def begun_graph(rounds: int = 120) -> MapGraph:
    """Return a graph of many rounds, some of whose closures are false, that has begun to solve."""
    truth = np.concatenate([true_ring()] * rounds)
    rng = np.random.default_rng(3)
    graph = MapGraph(GraphHealth())
    graph.constraints += chain(truth)
    for pose in drifted(graph.constraints, truth[0], np.array([0.001, 0.0, 0.0005])):
        add_node(graph, pose_of(pose))
    for end in range(16, len(truth), 2):
        wrong = rng.normal(0.0, 2.0, 3) if end % 12 == 0 else None
        graph.add_closures([closure(truth, end - 16, end, wrong)])
    graph.go_on()
    graph.solve_if_due(len(truth) - 1)
    return graph


@pytest.mark.parametrize("back", [1, 20])
def test_a_long_solution_is_taken_over_some_scans_later_with_the_nodes_that_came_since(back: int):
    """A later node keeps its place relative to the node that it was matched to."""
    graph = begun_graph()
    before, count = graph.poses.copy(), len(graph.poses)
    whole = solve(before, graph.constraints, np.zeros(0), 3)
    step, anchor = Pose2(0.5, 0.1, 0.2), count - back
    added = add_node(graph, graph.pose(anchor).compose(step))
    graph.constraints.append(Constraint(anchor, added, np.array([0.5, 0.1, 0.2]), np.eye(3)))
    scans = 0
    while np.array_equal(graph.poses[:count], before):
        graph.go_on()
        scans += 1
    assert scans > 1
    np.testing.assert_array_equal(graph.poses[:count], whole.poses)
    moved = graph.pose(anchor).inverse().compose(graph.pose(added))
    np.testing.assert_allclose((moved.x, moved.y, moved.yaw_rad), (0.5, 0.1, 0.2), atol=1e-9)


def test_a_state_saved_while_a_solution_is_under_way_goes_on_with_it():
    graph = begun_graph()
    graph.go_on()
    other = MapGraph(GraphHealth())
    other.restore(graph.to_state())
    for _ in range(200):
        graph.go_on()
        other.go_on()
        np.testing.assert_array_equal(graph.poses, other.poses)
    assert not np.array_equal(graph.poses, begun_graph().poses)


def test_nodes_that_are_moved_while_a_solution_is_under_way_stay_there_until_the_next():
    graph = begun_graph()
    graph.move_nodes(np.ones(len(graph.poses), dtype=np.bool_), Pose2(1.0, 0.0, 0.0))
    moved = graph.poses.copy()
    for _ in range(200):
        graph.go_on()
    np.testing.assert_array_equal(graph.poses, moved)
    graph.solve_if_due(len(moved) + 30)
    while np.array_equal(graph.poses, moved):
        graph.go_on()
