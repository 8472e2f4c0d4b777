"""The optimiser on drawn graphs: exact where nothing errs, and not bent by false closures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.geometry import compose_poses, wrap_angles
from slamfusion.pose_graph import PoseGraph, chi2_of, optimize
from tests.pose_graph.graphs import POSE_GRAPHS, drawn, laps, ring


def farthest(one: np.ndarray, other: np.ndarray) -> float:
    """Return the greatest distance of two sets of poses, a radian counting as a metre."""
    away = one - other
    away[:, 2] = wrap_angles(away[:, 2])
    return float(np.abs(away).max())


def disturbed(graph: PoseGraph, spread: float, seed: int = 0) -> PoseGraph:
    """Return the graph with poses beside the true ones; the first stays."""
    noise = spread * np.random.default_rng(seed).normal(size=graph.poses.shape)
    noise[0] = 0.0
    return replace(graph, poses=graph.poses + noise)


@pytest.mark.parametrize("start", ["given", "chordal", "best"])
def test_a_ring_without_errors_is_found_exactly(start: str):
    poses, edges = ring()
    graph = drawn(poses, edges)
    found = optimize(disturbed(graph, 0.2), start=start)
    assert farthest(found.poses, poses) < 1e-6
    assert found.chi2 < 1e-9
    assert found.is_converged


def test_the_least_is_one_from_every_start():
    poses, edges = laps()
    graph = drawn(poses, edges, noise=1.0, seed=3)
    found = [optimize(disturbed(graph, 0.1, seed)) for seed in range(3)]
    for other in found[1:]:
        assert other.chi2 == pytest.approx(found[0].chi2, rel=1e-4)
        assert farthest(other.poses, found[0].poses) < 1e-2
    assert found[0].chi2 < float(chi2_of(graph).sum())


def test_a_rigid_motion_of_all_poses_changes_no_error():
    poses, edges = laps()
    graph = drawn(poses, edges, noise=1.0, seed=1)
    moved = replace(graph, poses=compose_poses(np.array([[7.0, -3.0, 2.0]]), graph.poses))
    assert optimize(moved).chi2 == pytest.approx(optimize(graph).chi2, rel=1e-6)


@pytest.mark.parametrize("robust", ["consensus", "gnc"])
@pytest.mark.parametrize("seed", [0, 1])
def test_false_closures_are_left_out(robust: str, seed: int):
    poses, edges = laps()
    graph = drawn(poses, edges, noise=1.0, seed=seed)
    clean = optimize(graph)
    rng = np.random.default_rng(seed)
    count = int(0.3 * graph.is_closure.sum())
    pairs = np.sort(rng.choice(len(poses) // 2, (count, 2)) * [1, 1] + [0, len(poses) // 2], axis=1)
    lies = rng.normal(0.0, [4.0, 4.0, 1.5], (count, 3))
    spoiled = PoseGraph(
        poses=graph.poses,
        edges=np.concatenate((graph.edges, pairs)),
        motions=np.concatenate((graph.motions, lies)),
        information=np.concatenate((graph.information, graph.information[:count])),
        is_closure=np.concatenate((graph.is_closure, np.ones(count, dtype=np.bool_))),
    )
    found = optimize(spoiled, robust=robust)
    assert (found.weights[-count:] < 0.5).mean() > 0.9
    assert farthest(found.poses, clean.poses) < 0.5
    assert farthest(optimize(spoiled).poses, clean.poses) > 0.5


@pytest.mark.skipif(not POSE_GRAPHS.exists(), reason=f"no recorded pose graphs at {POSE_GRAPHS}")
@pytest.mark.parametrize(("name", "least"), [("intel", 45.005), ("CSAIL", 40.555), ("MIT", 41.163)])
def test_recorded_graphs_come_to_their_least(name: str, least: float):
    from slamfusion.pose_graph import read_g2o  # noqa: PLC0415

    graph = read_g2o(POSE_GRAPHS / f"{name}.g2o.gz").graph
    assert optimize(graph).chi2 == pytest.approx(least, rel=1e-3)
