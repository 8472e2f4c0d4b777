"""Claims about false closures: they are found, and bend nothing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.pose_graph.g2o import read_g2o
from slamfusion.pose_graph.graph import PoseGraph, chained_poses
from slamfusion.pose_graph.optimize import Robust, optimize
from tests.pose_graph.graphs import (
    ABSENT,
    POSE_GRAPHS,
    apart,
    drawn,
    laps,
    ring,
    with_false_closures,
)

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
@pytest.mark.parametrize("seed", range(2))
def test_consensus_bears_as_many_false_closures_as_true_ones(kind: str, seed: int) -> None:
    graph = drift(seed)
    clean = optimize(graph)
    false_too = with_false_closures(graph.with_poses(clean.poses), 1.0, seed, kind)
    found = optimize(false_too, robust="consensus")
    assert apart(clean.poses, found.poses) < 0.02
    assert not found.is_outlier[: len(graph.edges)].any()


KEEPING: tuple[Robust, ...] = ("consensus", "gnc")


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


@pytest.mark.skipif(not POSE_GRAPHS.is_dir(), reason=ABSENT)
@pytest.mark.parametrize("name", ["CSAIL", "intel"])
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
