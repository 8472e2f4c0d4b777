"""Claims about covariances: those of a dense inverse, and as large as the noise makes errors."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.geometry import F64, compose_poses, invert_poses, wrap_angles
from slamfusion.pose_graph.graph import PoseGraph
from slamfusion.pose_graph.least_squares import Measurements, NormalEquations
from slamfusion.pose_graph.optimize import optimize
from slamfusion.pose_graph.uncertainty import gates, relative_covariances, turned
from tests.pose_graph.graphs import INFORMATION, between, drawn, laps
from tests.pose_graph.gtsam_oracle import GtsamGraph, has_gtsam


def solved(seed: int = 0) -> tuple[PoseGraph, NormalEquations]:
    """A small graph at its least, and its normal equations there."""
    graph = drawn(*laps(count=10, rounds=2, every=3), noise=1.0, seed=seed)
    graph = graph.with_poses(optimize(graph).poses)
    measured = Measurements(graph.edges, graph.motions, graph.information)
    equations = NormalEquations(measured, len(graph), (0,))
    equations.linearise(graph.poses)
    return graph, equations


def dense_relative(graph: PoseGraph, equations: NormalEquations, pair: tuple[int, int]) -> F64:
    """Covariance of the second pose in the frame of the first, by differences and an inverse."""
    inverse = np.linalg.inv(equations.matrix().toarray())
    whole = np.zeros((3 * len(graph), 3 * len(graph)))
    places = (3 * equations.free[:, None] + np.arange(3)).ravel()
    whole[np.ix_(places, places)] = inverse
    columns = []
    for index in range(graph.poses.size):
        step = np.zeros(graph.poses.size)
        step[index] = 1e-6
        ahead, behind = (graph.poses + sign * step.reshape(-1, 3) for sign in (1.0, -1.0))
        change = relative(ahead, pair) - relative(behind, pair)
        change[2] = wrap_angles(change[2])
        columns.append(change / 2e-6)
    jacobian = np.stack(columns, axis=1)
    in_axes_of_first = jacobian @ whole @ jacobian.T
    turn = graph.poses[pair[0], 2] - graph.poses[pair[1], 2]
    return turned(in_axes_of_first[None], np.array([turn]))[0]


def covariance_of(equations: NormalEquations, poses: F64, pair: tuple[int, int]) -> F64:
    """Return (3, 3) the covariance of a pair's second pose, in its axes, seen from the first."""
    in_world = relative_covariances(equations, poses, np.array([pair]))
    return turned(in_world, -poses[[pair[1]], 2])[0]


def relative(poses: F64, pair: tuple[int, int]) -> F64:
    return compose_poses(invert_poses(poses[[pair[0]]]), poses[[pair[1]]])[0]


@pytest.mark.parametrize("pair", [(3, 4), (4, 3), (0, 19), (19, 0), (2, 13), (17, 6)])
def test_relative_covariances_are_those_of_a_dense_inverse(pair: tuple[int, int]) -> None:
    graph, equations = solved()
    expected = dense_relative(graph, equations, pair)
    found = covariance_of(equations, graph.poses, pair)
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_covariance_is_as_large_as_the_noise_makes_the_error() -> None:
    poses, edges = laps(count=10, rounds=2, every=3)
    pair = (3, 16)
    errors, covariance = [], np.zeros((3, 3))
    for seed in range(60):
        graph = drawn(poses, edges, noise=0.1, seed=seed)
        found = optimize(graph, start="given").poses
        error = compose_poses(
            invert_poses(relative(poses, pair)[None]), relative(found, pair)[None]
        )[0]
        errors.append(error)
        measured = Measurements(graph.edges, graph.motions, graph.information)
        equations = NormalEquations(measured, len(graph), (0,))
        covariance += 0.01 * covariance_of(equations, found, pair) / 60.0
    squared = np.einsum("ki,ij,kj->k", errors, np.linalg.inv(covariance), errors)
    # Mean of chi-square with 3 degrees; its deviation over 60 draws is 0.3.
    assert squared.mean() == pytest.approx(3.0, abs=0.8)


def test_gate_is_by_how_much_chi2_rises_with_the_edge() -> None:
    graph, equations = solved()
    pairs = np.array([(2, 13), (17, 6), (0, 11)])
    motions = compose_poses(between(graph.poses, pairs), np.full((3, 3), 0.02))
    candidates = Measurements(pairs, motions, np.tile(INFORMATION, (3, 1, 1)))
    before = optimize(graph, tolerance=1e-9).chi2
    for gate, pair, motion in zip(
        gates(equations, graph.poses, candidates).errors, pairs, motions, strict=True
    ):
        more = PoseGraph(
            graph.poses,
            np.concatenate((graph.edges, pair[None])),
            np.concatenate((graph.motions, motion[None])),
            np.concatenate((graph.information, INFORMATION[None])),
            np.append(graph.is_closure, True),
        )
        assert optimize(more, tolerance=1e-9).chi2 - before == pytest.approx(gate, rel=0.02)
    assert len(gates(equations, graph.poses, candidates.chosen(np.zeros(3, bool))).errors) == 0


@pytest.mark.skipif(not has_gtsam(), reason="GTSAM, a test oracle, is not installed")
@pytest.mark.parametrize("pair", [(3, 4), (4, 3), (2, 13), (17, 6)])
def test_gtsam_knows_as_much(pair: tuple[int, int]) -> None:
    graph, equations = solved()
    expected = GtsamGraph(graph, like_g2o=True).relative_covariance(graph.poses, *pair)
    found = covariance_of(equations, graph.poses, pair)
    assert found == pytest.approx(expected, rel=1e-3, abs=1e-7)
