"""Claims about ``IncrementalGraph``: as good as all at once, cheap between closures."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.errors import GraphError
from slamfusion.geometry import compose_poses, invert_poses
from slamfusion.pose_graph import IncrementalGraph, PoseGraph, Robust, optimize
from slamfusion.pose_graph.measurements import Measurements
from slamfusion.pose_graph.normal_equations import NormalEquations
from slamfusion.pose_graph.uncertainty import Uncertainty
from tests.pose_graph.graphs import INFORMATION, apart, drawn, laps, ring, with_false_closures


def grown(graph: PoseGraph, robust: Robust = "consensus") -> IncrementalGraph:
    """Drive along a graph: each pose by its first edge, an update after each."""
    growing = IncrementalGraph(robust)
    growing.add_pose(graph.poses[0])
    last = graph.edges.max(axis=1)
    for pose in range(1, len(graph)):
        arriving = np.flatnonzero(last == pose)
        odometry = arriving[~graph.is_closure[arriving]][0]
        growing.add_pose(compose_poses(growing.poses[pose - 1], graph.motions[odometry]))
        for edge in arriving:
            start, end = graph.edges[edge].tolist()
            growing.add_edge(
                start,
                end,
                graph.motions[edge],
                graph.information[edge],
                is_closure=bool(graph.is_closure[edge]),
            )
        growing.update()
    return growing


@pytest.mark.parametrize("robust", ["none", "gnc", "consensus"])
def test_a_growing_graph_ends_where_one_optimisation_of_all_does(robust: Robust) -> None:
    graph = drawn(*laps(count=24, rounds=3), noise=1.0)
    growing = grown(graph, robust)
    assert len(growing) == len(graph)
    assert apart(optimize(graph).poses, growing.poses) < 1e-3
    assert (growing.weights == 1.0).all()


@pytest.mark.parametrize("robust", ["gnc", "consensus"])
@pytest.mark.parametrize("seed", range(2))
def test_false_closures_are_left_out_as_they_come(robust: Robust, seed: int) -> None:
    graph = drawn(*laps(count=24, rounds=3), noise=1.0, seed=seed)
    clean = optimize(graph)
    false_too = with_false_closures(graph.with_poses(clean.poses), 0.3, seed, "random")
    growing = grown(false_too, robust)
    assert apart(clean.poses, growing.poses) < 0.02
    arriving = np.argsort(false_too.edges.max(axis=1), kind="stable")
    is_false = arriving >= len(graph.edges)
    assert ((growing.weights < 0.5) == is_false).mean() > 0.98


def test_edges_that_only_carry_on_move_nothing() -> None:
    graph = drawn(ring()[0], ring()[1][:-1], noise=1.0)
    growing = grown(graph)
    for start, end in graph.edges:
        motion = growing.poses[end]
        carried = compose_poses(growing.poses[start], graph.motions[start])
        assert motion == pytest.approx(carried)


def test_a_second_edge_moves_the_newest_poses_and_no_others() -> None:
    poses = np.stack((np.arange(60.0), np.zeros(60), np.zeros(60)), axis=1)
    edges = np.stack((np.arange(59), np.arange(1, 60)), axis=1)
    growing = grown(drawn(poses, edges, noise=1.0))
    before = growing.poses
    motion = compose_poses(invert_poses(before[57]), before[59]) + np.array([0.1, 0.0, 0.0])
    growing.add_edge(57, 59, motion, INFORMATION)
    assert growing.update() is None
    away = np.abs(growing.poses - before).max(axis=1)
    assert away[59] > 1e-3
    assert (away[:47] == 0.0).all()
    assert np.isfinite(growing.poses).all()


def test_edges_from_long_past_call_for_all_poses() -> None:
    poses, edges = ring(140, 20.0)
    growing = grown(drawn(poses, edges[:-1], noise=1.0))
    growing.add_edge(139, 0, drawn(poses, edges).motions[139], INFORMATION)
    found = growing.update()
    assert found is not None
    assert found.is_converged
    assert growing.poses == pytest.approx(found.poses)
    assert growing.update() is None


def test_what_comes_while_a_snapshot_is_optimised_is_carried_along() -> None:
    graph = drawn(*laps(count=24, rounds=3), noise=1.0)
    growing = grown(graph)
    snapshot = growing.snapshot()
    drifted = snapshot.with_poses(snapshot.poses + np.array([0.0, 0.0, 0.001]))
    optimized = optimize(drifted, robust="gnc", start="given")
    way = np.array([1.0, 0.2, 0.3])
    growing.add_pose(compose_poses(growing.poses[-1], way))
    growing.add_edge(len(graph) - 1, len(graph), way, INFORMATION)
    growing.apply(optimized)
    expected = compose_poses(optimized.poses[-1], way)
    assert growing.poses[:-1] == pytest.approx(optimized.poses)
    assert growing.poses[-1] == pytest.approx(expected)
    assert growing.weights.tolist() == [*optimized.weights, 1.0]


def test_relative_covariance_is_that_of_the_whole_graph() -> None:
    graph = drawn(*laps(count=24, rounds=3), noise=1.0)
    growing = grown(graph)
    growing.optimize()
    snapshot = growing.snapshot()
    measured = Measurements(snapshot.edges, snapshot.motions, snapshot.information)
    uncertainty = Uncertainty(NormalEquations(measured, len(snapshot), (0,)), growing.poses)
    for pair in ((0, 71), (30, 55), (55, 30)):
        expected = uncertainty.relative([pair])[0]
        assert growing.relative_covariance(*pair) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_relative_covariance_goes_on_along_new_edges() -> None:
    poses, edges = ring()
    graph = drawn(poses, edges[:-1], noise=1.0)
    growing = grown(graph)
    growing.relative_covariance(0, 1)  # what is known now
    for pose, motion in zip((20, 21, 22), graph.motions[:3], strict=True):
        growing.add_pose(compose_poses(growing.poses[-1], motion))
        growing.add_edge(pose - 1, pose, motion, INFORMATION)
    snapshot = growing.snapshot()
    measured = Measurements(snapshot.edges, snapshot.motions, snapshot.information)
    uncertainty = Uncertainty(NormalEquations(measured, 23, (0,)), snapshot.poses)
    for pair in ((3, 22), (22, 3), (20, 22), (0, 21)):
        expected = uncertainty.relative([pair])[0]
        assert growing.relative_covariance(*pair) == pytest.approx(expected, rel=1e-5, abs=1e-9)
    assert np.abs(growing.relative_covariance(21, 21)).max() < 1e-12


def test_what_does_not_belong_is_refused() -> None:
    growing = IncrementalGraph()
    growing.add_pose((0.0, 0.0, 0.0))
    with pytest.raises(GraphError, match="pose 1 is not finite"):
        growing.add_pose((np.nan, 0.0, 0.0))
    with pytest.raises(GraphError, match="leads to no pose"):
        growing.add_edge(0, 1, (1.0, 0.0, 0.0), INFORMATION)
    growing.add_pose((1.0, 0.0, 0.0))
    with pytest.raises(GraphError, match="positive definite"):
        growing.add_edge(0, 1, (1.0, 0.0, 0.0), -INFORMATION)
    with pytest.raises(GraphError, match="2 parts"):
        growing.optimize()
    with pytest.raises(GraphError, match="no edge joins"):
        growing.relative_covariance(0, 1)
    assert len(growing.snapshot().edges) == 0
