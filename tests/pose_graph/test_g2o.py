"""Claims about pose graphs in files: read as written, and what is none is refused in one line."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slamfusion.errors import GraphError
from slamfusion.pose_graph.g2o import read_g2o, write_g2o
from slamfusion.pose_graph.graph import PoseGraph
from tests.pose_graph.graphs import INFORMATION, drawn, laps
from tests.support.examples import examples

POSES = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.5\n"
EDGE = "EDGE_SE2 0 1 1 0 0.5 100 10 2 60 -3 400\n"
ARRAYS = ("poses", "edges", "motions", "information", "is_closure")


def written(folder: Path, text: str) -> Path:
    path = folder / "graph.g2o"
    path.write_text(text)
    return path


def same(one: PoseGraph, other: PoseGraph) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ARRAYS)


@pytest.mark.parametrize(
    "edge",
    ["EDGE_SE2 0 1 1 0 0.5 100 10 2 60 -3 400\n", "EDGE2 0 1 1 0 0.5 100 10 60 400 2 -3\n"],
    ids=["g2o", "TORO"],
)
def test_each_format_has_its_own_order_of_information(tmp_path: Path, edge: str) -> None:
    graph = read_g2o(written(tmp_path, POSES + edge)).graph
    assert graph.information[0].tolist() == INFORMATION.tolist()
    assert graph.motions.tolist() == [[1.0, 0.0, 0.5]]
    assert graph.edges.tolist() == [[0, 1]]


def test_ids_may_have_gaps_any_order_and_a_sign(tmp_path: Path) -> None:
    text = (
        "VERTEX_SE2 700 2 0 0\nEDGE_SE2 -3 40 1 0 0 1 0 0 1 0 1\n# a word\n\n"
        "VERTEX_SE2 -3 0 0 0\nEDGE_SE2 40 700 1 0 0 1 0 0 1 0 1\nVERTEX_SE2 40 1 0 0\nFIX 40 700\n"
    )
    file = read_g2o(written(tmp_path, text))
    assert file.ids.tolist() == [-3, 40, 700]
    assert file.graph.poses[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert file.graph.edges.tolist() == [[0, 1], [1, 2]]
    assert file.fixed == (1, 2)
    assert not file.skipped_lines
    assert file.has_poses


def test_lines_of_other_kinds_are_counted(tmp_path: Path) -> None:
    text = POSES + "LASER 1 2 3\n" + EDGE + "LASER 4\nPARAMS_SE2OFFSET 0 0 0 0\n\xff\xfe 1\n"
    path = tmp_path / "graph.g2o"
    path.write_bytes(text.encode("latin-1"))
    file = read_g2o(path)
    assert file.skipped_lines == {"LASER": 2, "PARAMS_SE2OFFSET": 1, r"\xff\xfe": 1}
    assert len(file.graph) == 2


def test_a_file_of_edges_alone_gets_poses_along_the_odometry(tmp_path: Path) -> None:
    graph = drawn(*laps(), noise=0.0)
    path = tmp_path / "graph.g2o"
    write_g2o(path, graph)
    lines = path.read_text().splitlines(keepends=True)
    edges = "".join(line for line in lines if line.startswith("EDGE"))
    file = read_g2o(written(tmp_path, edges))
    assert not file.has_poses
    assert file.fixed == (0,)
    assert file.graph.poses[:, :2] == pytest.approx(graph.poses[:, :2], abs=1e-9)
    assert file.graph.is_closure.tolist() == graph.is_closure.tolist()


@given(st.integers(0, 10_000))
@settings(
    max_examples=examples(25),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_what_is_written_reads_back_bit_by_bit(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = drawn(*laps(count=8, rounds=2), noise=1.0, seed=seed)
    scale = 10.0 ** rng.integers(-12, 12)
    graph = replace(graph, poses=graph.poses * scale, information=graph.information / scale)
    ids = np.sort(rng.choice(10**6, len(graph), replace=False))
    fixed = sorted(rng.choice(len(graph), 3, replace=False).tolist())
    for name in ("graph.g2o", "graph.g2o.gz"):
        write_g2o(tmp_path / name, graph, ids, fixed)
        file = read_g2o(tmp_path / name)
        assert same(file.graph, graph)
        assert file.ids.tolist() == ids.tolist()
        assert file.fixed == tuple(fixed)
    plain, packed = (tmp_path / name for name in ("graph.g2o", "graph.g2o.gz"))
    assert gzip.decompress(packed.read_bytes()) == plain.read_bytes()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty; wanted lines of VERTEX_SE2"),
        ("# nothing\n\n", "the file is empty"),
        ("hello 1\nhello 2\nyou\n", "no vertex and no edge; .* found 2 'hello', 1 'you'"),
        (POSES + "EDGE_SE2 0 1 1 0\n", "line 3: EDGE_SE2 wants 11 values, found 4"),
        (POSES + "VERTEX_SE2 2 0 0\n" + EDGE, "line 3: VERTEX_SE2 wants 4 values, found 3"),
        (POSES + EDGE.replace("100", "many"), "line 3: EDGE_SE2: no numbers: '0 1 1 0 0.5 many"),
        (POSES + EDGE.replace("0 1 ", "0 1.5 ", 1), "line 3: EDGE_SE2: no numbers"),
        (POSES + EDGE.replace("400", "nan"), "line 3: EDGE_SE2 0: a value is not finite"),
        (POSES + f"VERTEX_SE2 {10**18} 0 0 0\n", "line 3: VERTEX_SE2: an id has more than 18"),
        (POSES + POSES, "line 3: vertex 0 comes a second time"),
        (POSES + EDGE.replace("0 1", "0 7", 1), "line 3: edge from 0 to 7: there is no vertex 7"),
        (POSES + EDGE.replace("0 1", "1 1", 1), "line 3: edge from vertex 1 to itself"),
        (POSES + EDGE + "FIX 9\n", "FIX 9: there is no such vertex"),
        (POSES + EDGE.replace("60", "0"), "line 3: .* not positive definite; 1 such"),
        (POSES + EDGE + "VERTEX_SE2 2 0 0 0\n", "in 2 parts that no edge joins"),
        (POSES, "in 2 parts"),
    ],
)
def test_what_is_no_graph_is_refused_with_file_and_line(
    tmp_path: Path, text: str, words: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(GraphError, match=words) as raised:
        read_g2o(path)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message


def test_packed_data_that_end_early_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o.gz"
    write_g2o(path, drawn(*laps(), noise=1.0))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(GraphError, match="ends early or is damaged; copy it again"):
        read_g2o(path)
