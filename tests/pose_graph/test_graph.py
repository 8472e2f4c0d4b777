"""Claims about ``PoseGraph``: what it refuses, what a closure is, poses along the odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamfusion.errors import GraphError
from slamfusion.pose_graph.graph import chained_poses, loop_closing
from tests.pose_graph.graphs import chi2_of, drawn, laps, ring


def test_arrays_cannot_be_changed() -> None:
    graph = drawn(*ring())
    for name in ("poses", "edges", "motions", "information", "is_closure"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(graph, name)[0] = 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"poses": np.zeros((0, 3))}, "no pose"),
        ({"poses": np.full((20, 3), np.nan)}, "pose 0 is not finite; 20"),
        ({"poses": np.zeros((19, 3))}, "edge 18 from 18 to 19 leads to no pose"),
        ({"edges": np.zeros((20, 2), np.int64)}, "edge 0 from 0 to 0 joins a pose to itself"),
        ({"motions": np.full((20, 3), np.inf)}, "edge 0 from 0 to 1 is not finite; 20"),
        ({"information": np.tile(-np.eye(3), (20, 1, 1))}, "positive definite; 20"),
        ({"information": np.tile(np.arange(9.0).reshape(3, 3), (20, 1, 1))}, "not symmetric"),
        ({"is_closure": np.zeros(3, bool)}, "3 closure flags"),
    ],
)
def test_what_is_no_graph_is_refused(change: dict[str, np.ndarray], words: str) -> None:
    with pytest.raises(GraphError, match=words):
        replace(drawn(*ring()), **change)


def test_closures_are_the_edges_that_close_a_loop() -> None:
    edges = np.array([[0, 1], [2, 1], [0, 2], [2, 4], [5, 0], [4, 5], [3, 4], [0, 2]])
    # 2 to 4 is not consecutive, but nothing else joins the two parts so far.
    assert loop_closing(edges[[0, 1, 2, 3, 5, 6]], 6).tolist() == [
        False, False, True, False, False, False,
    ]  # fmt: skip
    assert loop_closing(edges, 6).tolist() == [
        False, False, True, False, True, False, False, True,
    ]  # fmt: skip


def test_chained_poses_fit_odometry_exactly() -> None:
    graph = drawn(*laps(), noise=1.0)
    turned_round = graph.edges.copy()
    turned_round[3] = turned_round[3, ::-1]
    graph = replace(graph, edges=turned_round)
    for root in (0, 57):
        chained = chained_poses(graph, root)
        errors = chi2_of(graph, chained)
        assert errors[~graph.is_closure].max() < 1e-12
        assert errors[graph.is_closure].max() > 1.0
        assert chained[root] == pytest.approx(graph.poses[root])
