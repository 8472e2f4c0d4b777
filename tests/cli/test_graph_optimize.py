"""``graph optimize``: files in and out, and every refusal one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.cli.command import json_of, run

SQUARE = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.1 0 1.5
VERTEX_SE2 2 1 1.2 3.1
VERTEX_SE2 3 0 1 -1.6
EDGE_SE2 0 1 1 0 1.5707963267948966 100 0 0 100 0 400
EDGE_SE2 1 2 1 0 1.5707963267948966 100 0 0 100 0 400
EDGE_SE2 2 3 1 0 1.5707963267948966 100 0 0 100 0 400
EDGE_SE2 3 0 1 0 1.5707963267948966 100 0 0 100 0 400
"""


def test_a_square_is_straightened_and_written(tmp_path: Path):
    graph, out, tum = (tmp_path / name for name in ("square.g2o", "out.g2o", "out.tum"))
    graph.write_text(SQUARE)
    done = run("graph", "optimize", graph, "-o", out, "--tum", tum, "--json")
    assert done.returncode == 0, done.stderr
    json_of(done)
    again = run("graph", "optimize", out, "--json")
    assert again.returncode == 0
    corners = [line.split()[2:4] for line in out.read_text().splitlines() if "VERTEX" in line]
    wanted = [(0, 0), (1, 0), (1, 1), (0, 1)]
    np.testing.assert_allclose(np.array(corners, dtype=float), wanted, atol=1e-6)
    assert len(tum.read_text().splitlines()) >= 4
