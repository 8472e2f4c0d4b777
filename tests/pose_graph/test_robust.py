"""Claims about false closures: they are found, and bend nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.geometry import compose_poses, invert_poses
from slamfusion.pose_graph import PoseGraph, Robust, optimize, read_g2o
from slamfusion.pose_graph.graph import chained_poses
from slamfusion.pose_graph.measurements import Measurements
from slamfusion.pose_graph.normal_equations import NormalEquations
from slamfusion.pose_graph.robust import truncated_weights
from slamfusion.pose_graph.uncertainty import Uncertainty
from tests.pose_graph.graphs import (
    ABSENT,
    POSE_GRAPHS,
    apart,
    between,
    drawn,
    laps,
    ring,
    with_false_closures,
)

Array = npt.NDArray[np.float64]
ROBUST: tuple[Robust, ...] = ("consensus", "gnc", "dcs")


def drift(seed: int = 0) -> PoseGraph:
    """Four noisy laps, where they are along the odometry."""
    graph = drawn(*laps(), noise=1.0, seed=seed)
    return graph.with_poses(chained_poses(graph))


@pytest.mark.parametrize("robust", ROBUST)
def test_true_closures_are_believed(robust: Robust) -> None:
    graph = drift()
    plain, found = optimize(graph), optimize(graph, robust=robust)
    assert not found.is_outlier.any()
    assert apart(plain.poses, found.poses) < 2e-3
    if robust != "dcs":  # which weakens whatever errs
        assert found.chi2 == pytest.approx(plain.chi2, rel=1e-4)


@pytest.mark.parametrize("robust", ROBUST)
def test_a_false_closure_bends_the_plain_graph_and_not_the_robust_one(robust: Robust) -> None:
    graph = drift()
    clean = optimize(graph)
    false_too = with_false_closures(graph.with_poses(clean.poses), 0.1, 3, "random")
    plain, found = optimize(false_too), optimize(false_too, robust=robust)
    true = len(graph.edges)
    assert apart(clean.poses, plain.poses) > 0.1
    assert apart(clean.poses, found.poses) < 0.01
    assert found.is_outlier[true:].all()
    assert not found.is_outlier[:true].any()
    assert found.chi2 < 1.2 * clean.chi2
    assert found.chi2_all > 10.0 * found.chi2


@pytest.mark.parametrize("kind", ["shuffled", "random"])
@pytest.mark.parametrize("seed", range(4))
def test_consensus_bears_as_many_false_closures_as_true_ones(kind: str, seed: int) -> None:
    graph = drift(seed)
    clean = optimize(graph)
    false_too = with_false_closures(graph.with_poses(clean.poses), 1.0, seed, kind)
    found = optimize(false_too, robust="consensus")
    assert apart(clean.poses, found.poses) < 0.02
    assert not found.is_outlier[: len(graph.edges)].any()


KEEPING: tuple[Robust, ...] = ("consensus", "gnc")


@pytest.mark.parametrize("robust", KEEPING)
def test_an_earlier_verdict_stands_without_a_search(robust: Robust) -> None:
    graph = drift()
    clean = optimize(graph)
    false_too = with_false_closures(graph.with_poses(clean.poses), 0.3, 1, "random")
    first = optimize(false_too, robust=robust, start="given")
    again = optimize(
        false_too.with_poses(first.poses), robust=robust, start="given", weights=first.weights
    )
    assert again.iterations <= 2
    if robust == "gnc":  # the other searches among the closures, not among poses
        assert first.iterations > 10
    assert again.weights.tolist() == first.weights.tolist()
    assert apart(first.poses, again.poses) < 1e-4


@pytest.mark.parametrize("robust", KEEPING)
def test_an_earlier_verdict_is_mended_where_poses_speak_against_it(robust: Robust) -> None:
    graph = drift()
    clean = optimize(graph)
    nothing_believed = np.where(graph.is_closure, 0.0, 1.0)
    found = optimize(
        graph.with_poses(clean.poses), robust=robust, start="given", weights=nothing_believed
    )
    assert not found.is_outlier.any()
    assert found.chi2 == pytest.approx(clean.chi2, rel=1e-4)


@pytest.mark.parametrize("robust", KEEPING)
def test_new_closures_are_judged_after_an_earlier_verdict(robust: Robust) -> None:
    graph = drift()
    clean = optimize(graph)
    false_too = with_false_closures(graph.with_poses(clean.poses), 0.2, 1, "random")
    # The last true and the last false closures come later.
    true, added = len(graph.edges), len(false_too.edges) - len(graph.edges)
    late = np.zeros(true + added, np.bool_)
    late[true - 6 : true] = late[-2:] = True
    order = np.concatenate((np.flatnonzero(~late), np.flatnonzero(late)))
    whole = part(false_too, order)
    early = part(false_too, order[: -late.sum()])
    before = optimize(early, robust=robust, start="given")
    found = optimize(
        whole.with_poses(before.poses), robust=robust, start="given", weights=before.weights
    )
    assert found.is_outlier.tolist() == (order >= true).tolist()
    assert apart(clean.poses, found.poses) < 0.01


def part(graph: PoseGraph, edges: npt.NDArray[np.int64]) -> PoseGraph:
    """The graph with some of its edges, in their order."""
    arrays = (graph.edges, graph.motions, graph.information, graph.is_closure)
    return PoseGraph(graph.poses, *(array[edges] for array in arrays))


def test_odometry_is_never_an_outlier() -> None:
    graph = drift()
    wrong = graph.motions.copy()
    wrong[50] = (3.0, 1.0, 1.0)
    bent = PoseGraph(graph.poses, graph.edges, wrong, graph.information, graph.is_closure)
    for robust in ROBUST:
        found = optimize(bent, robust=robust)
        assert (found.weights[~graph.is_closure] == 1.0).all()


def test_a_closure_that_alone_joins_two_parts_is_no_outlier() -> None:
    poses, edges = ring()
    cut = np.delete(edges, (9, 19), axis=0)  # two arcs
    bridges = np.array([[2, 15], [4, 13]])
    graph = drawn(poses, np.concatenate((cut, bridges)))
    assert graph.is_closure.sum() == 1
    everything = PoseGraph(
        graph.poses, graph.edges, graph.motions, graph.information, np.ones(len(graph.edges), bool)
    )
    for robust in ROBUST:
        found = optimize(everything, robust=robust)
        assert apart(poses, found.poses) < 1e-4


def test_one_closure_alone_is_believed_as_far_as_odometry_allows() -> None:
    """No other closure bears it out; what decides is how far the odometry may have drifted."""
    poses, edges = ring(60, 10.0)
    graph = drawn(poses, edges, noise=1.0)
    for robust in ("consensus", "gnc"):
        assert not optimize(graph, robust=robust).is_outlier.any()
    motions = graph.motions.copy()
    motions[-1] += (30.0, 0.0, 0.0)
    false = PoseGraph(graph.poses, graph.edges, motions, graph.information, graph.is_closure)
    for robust in ("consensus", "gnc"):
        found = optimize(false, robust=robust)
        assert found.is_outlier.nonzero()[0].tolist() == [59]
        assert found.chi2 < 1e-9


def astray(seed: int = 0) -> PoseGraph:
    """Four laps, tied to each other, then a long way off with nothing but bad odometry."""
    poses, edges = laps(rounds=4, every=2)
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0.0, 0.15, 120))
    way = np.cumsum(np.stack((np.cos(yaw), np.sin(yaw)), axis=1), axis=0)
    off = np.column_stack((poses[-1, :2] + way, yaw))
    steps = np.arange(len(poses) - 1, len(poses) + len(off) - 1)
    edges = np.concatenate((edges, np.stack((steps, steps + 1), axis=1)))
    graph = drawn(np.concatenate((poses, off)), edges, noise=1.0, seed=seed)
    information = graph.information.copy()
    information[-len(steps) :] *= 0.1
    graph = replace(graph, information=information)
    return graph.with_poses(optimize(graph).poses)


def deviating(graph: PoseGraph, pairs: list[tuple[int, int]], deviations: float) -> PoseGraph:
    """The graph and closures that are off, by so many deviations of what it knows of the first."""
    ends = np.array(pairs)
    measured = Measurements(graph.edges, graph.motions, graph.information)
    equations = NormalEquations(measured, len(graph), (0,))
    covariance = Uncertainty(equations, graph.poses).relative(ends[:1])[0]
    error = np.linalg.cholesky(covariance) @ np.full(3, deviations)
    moved = graph.poses.copy()
    last = graph.poses[ends[:, 1]]
    rigid = compose_poses(compose_poses(last[0], error), invert_poses(last[0]))
    moved[ends[:, 1]] = compose_poses(rigid, last)
    return with_closures(graph, ends, between(moved, ends))


def with_closures(graph: PoseGraph, ends: npt.NDArray[np.int64], motions: Array) -> PoseGraph:
    """The graph with more closures, (K, 2) and (K, 3)."""
    return PoseGraph(
        graph.poses,
        np.concatenate((graph.edges, ends)),
        np.concatenate((graph.motions, motions)),
        np.concatenate((graph.information, graph.information[: len(ends)])),
        np.append(graph.is_closure, np.ones(len(ends), np.bool_)),
    )


@pytest.mark.parametrize("seed", range(4))
def test_consensus_knows_that_some_of_many_false_closures_agree_by_chance(seed: int) -> None:
    """Where only odometry leads, one that agrees tells little when many others do not."""
    graph = astray(seed)
    alone = deviating(graph, [(50, 279)], 0.6)
    true = len(graph.edges)
    believed = optimize(alone, robust="consensus")
    assert not believed.is_outlier.any()  # nothing speaks against it
    assert apart(graph.poses, believed.poses) > 0.03
    false_too = with_false_closures(alone, 0.5, seed, "random")
    found = optimize(false_too, robust="consensus")
    assert found.is_outlier[true]
    assert not found.is_outlier[:true].any()
    assert apart(graph.poses, found.poses) < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_consensus_believes_two_that_bear_each_other_out_among_many_false_ones(seed: int) -> None:
    """The same closure as above, and one next to it that says the same."""
    pair = deviating(astray(seed), [(50, 279), (51, 278)], 0.6)
    true = len(pair.edges)
    false_too = with_false_closures(pair, 0.5, seed, "random")
    found = optimize(false_too, robust="consensus")
    assert not found.is_outlier[:true].any()
    assert apart(optimize(pair).poses, found.poses) < 0.01


@given(st.floats(1e-9, 1e3), st.floats(1.0, 100.0))
def test_truncated_weights_fall_from_one_to_nothing(hardness: float, limit: float) -> None:
    squares = np.geomspace(1e-3, 1e15, 400) * limit
    weights = truncated_weights(squares, hardness, limit)
    assert ((weights >= 0.0) & (weights <= 1.0)).all()
    assert (np.diff(weights) <= 1e-12).all()
    share = hardness / (hardness + 1.0)
    assert (weights[squares < 0.999 * share * limit] == 1.0).all()
    assert (weights[squares > 1.001 * limit / share] == 0.0).all()
    between = (squares > 1.001 * share * limit) & (squares < 0.999 * limit / share)
    assert ((weights[between] > 0.0) & (weights[between] < 1.0)).all()


@pytest.mark.skipif(not POSE_GRAPHS.is_dir(), reason=ABSENT)
@pytest.mark.parametrize("name", ["CSAIL", "intel", "MIT", "INTEL_1228"])
@pytest.mark.parametrize(("share", "kind"), [(0.0, ""), (0.1, "random"), (0.3, "shuffled")])
def test_public_graphs_stay_where_they_are(name: str, share: float, kind: str) -> None:
    graph = read_g2o(POSE_GRAPHS / f"{name}.g2o.gz").graph
    clean = optimize(graph)
    graph = graph.with_poses(clean.poses)
    false_too = with_false_closures(graph, share, 1, kind) if share else graph
    nowhere = false_too.with_poses(np.zeros_like(graph.poses))
    found = optimize(nowhere, robust="consensus")
    assert apart(clean.poses, found.poses) < 0.01
    if not share:
        assert not found.is_outlier.any()
        assert found.chi2 == pytest.approx(clean.chi2, rel=1e-4)
