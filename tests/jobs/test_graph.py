"""``optimize_graph`` as a library."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.errors import GraphError
from slamfusion.jobs.graph import optimize_graph, save_optimized_graph
from slamfusion.json_values import plain
from tests.cli.test_graph_optimize import SQUARE
from tests.support.documents import check_document


def test_a_pose_graph_is_optimized_and_written(tmp_path: Path) -> None:
    (tmp_path / "square.g2o").write_text(SQUARE, encoding="utf-8")
    graph = optimize_graph(tmp_path / "square.g2o")
    assert graph.found.is_converged
    assert graph.outliers() == []
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    np.testing.assert_allclose(graph.trajectory().poses[:, :2], corners, atol=1e-6)
    document = save_optimized_graph(graph, tmp_path / "out.g2o", tum=tmp_path / "out.tum")
    check_document(plain(document), "graph optimize")
    again = optimize_graph(document["output"] or "")
    assert again.found.chi2_start == pytest.approx(0.0, abs=1e-9)


def test_a_pose_graph_that_is_none_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "bad.g2o").write_text("EDGE_SE2 0 1 nonsense\n", encoding="utf-8")
    with pytest.raises(GraphError, match=r"bad\.g2o"):
        optimize_graph(tmp_path / "bad.g2o")
