"""Pose graphs in files: g2o's and TORO's plain text in, g2o's out.

``VERTEX_SE2 id x y yaw``, ``EDGE_SE2 from to dx dy dyaw I11 I12 I13 I22 I23 I33``, ``FIX id ...``;
TORO's ``VERTEX2`` is the same, its ``EDGE2`` ends in ``I11 I12 I22 I33 I13 I23``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamfusion.errors import GraphError
from slamfusion.geometry import I64
from slamfusion.io.files import write_atomic
from slamfusion.io.lines import packed_by_name, text_lines
from slamfusion.pose_graph.graph import (
    PoseGraph,
    chained_poses,
    check_connected,
    is_positive_definite,
    loop_closing,
)

# Places of an edge's last six numbers in the information matrix, in the file's order.
_G2O_ORDER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_TORO_ORDER = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
_VERTICES = (b"VERTEX_SE2", b"VERTEX2")
_EDGES: Mapping[bytes, tuple[tuple[int, int], ...]] = {
    b"EDGE_SE2": _G2O_ORDER,
    b"EDGE2": _TORO_ORDER,
}
_FIX = b"FIX"
# Bytes of an edge as Python numbers, with its tables.
LINE_BYTES = 1500
_LARGEST_ID = 10**18 - 1
_WANTED = "VERTEX_SE2, EDGE_SE2 and FIX (g2o), VERTEX2 and EDGE2 (TORO)"


@dataclass(frozen=True, eq=False)
class GraphFile:
    """A pose graph and the other contents of its file.

    Attributes:
        graph: poses in the order of their ids, chained along the odometry if the file has none.
        ids: (N,) int64, the poses' names in the file, rising.
        fixed: indices of the poses of FIX; the first pose without FIX.
    """

    graph: PoseGraph = field(repr=False)
    ids: I64 = field(repr=False)
    fixed: tuple[int, ...] = field(repr=False)
    has_poses: bool
    """Whether the file gave the vertices poses; else they were laid along the odometry."""
    skipped_lines: dict[str, int] = field(default_factory=dict)
    """Lines that were not understood, by kind."""


def read_g2o(path: str | Path) -> GraphFile:
    """Read a graph, plain or gzip; g2o's and TORO's lines may be mixed.

    Raises:
        GraphError: the file has no edge and no vertex, a line has too few or too many numbers or
            one that is none, a vertex or FIX comes twice or leads nowhere, an information is not
            positive definite, or the graph is in several parts; in one line, with the place.
    """
    target = Path(path)
    lines = _Lines(target)
    if not lines.vertices and not lines.edges:
        message = f"the file is empty; wanted lines of {_WANTED}"
        if lines.skipped:
            kinds = lines.skipped.most_common(3)
            found = ", ".join(f"{count} {kind[:40]!r}" for kind, count in kinds)
            message = f"no vertex and no edge; wanted lines of {_WANTED}, found {found}"
        raise GraphError(f"{target}: {message}")
    names = lines.vertices or {name: () for edge in lines.edges for name in edge[:2]}
    ids = np.array(sorted(names), np.int64)
    index = {name: place for place, name in enumerate(ids.tolist())}
    lines.check(index)
    edges = np.array([(index[one], index[two]) for one, two in lines.edges], np.int64)
    edges = edges.reshape(-1, 2)
    check_connected(edges, len(ids), f"{target}: ")
    poses = np.array([names[name] or (0.0, 0.0, 0.0) for name in ids.tolist()], np.float64)
    graph = PoseGraph(
        poses=poses,
        edges=edges,
        motions=np.array(lines.motions).reshape(-1, 3),
        information=np.array(lines.information).reshape(-1, 3, 3),
        is_closure=loop_closing(edges, len(ids)),
    )
    fixed = tuple(sorted(index[name] for name in lines.fixed)) or (0,)
    if not lines.vertices:
        graph = graph.with_poses(chained_poses(graph, fixed[0]))
    return GraphFile(graph, ids, fixed, bool(lines.vertices), dict(lines.skipped))


def write_g2o(
    path: str | Path, graph: PoseGraph, ids: I64 | None = None, fixed: Sequence[int] = (0,)
) -> None:
    """Write a graph as g2o's text with all digits, packed if the path ends in ``.gz``.

    ``ids`` (N,) names the poses, by default by index.
    MapFileError: the file cannot be written.
    """
    names = np.arange(len(graph)) if ids is None else ids
    data = "".join(_text(graph, names.tolist(), fixed)).encode()
    target = Path(path)
    write_atomic(target, packed_by_name(target, data))


def _text(graph: PoseGraph, names: list[int], fixed: Sequence[int]) -> Iterator[str]:
    for name, pose in zip(names, graph.poses.tolist(), strict=True):
        yield f"VERTEX_SE2 {name} {_numbers(pose)}\n"
    for place in fixed:
        yield f"FIX {names[place]}\n"
    upper = np.stack([graph.information[:, row, column] for row, column in _G2O_ORDER], axis=1)
    for (start, end), motion, information in zip(
        graph.edges.tolist(), graph.motions.tolist(), upper.tolist(), strict=True
    ):
        ends = f"{names[start]} {names[end]}"
        yield f"EDGE_SE2 {ends} {_numbers(motion)} {_numbers(information)}\n"


def _numbers(values: list[float]) -> str:
    return " ".join(map(repr, values))


class _Lines:
    """The parsed lines of a file; ``skipped`` counts unknown lines by kind."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._edge_lines: list[int] = []
        self.vertices: dict[int, tuple[float, ...]] = {}
        self.edges: list[tuple[int, int]] = []
        self.motions: list[tuple[float, ...]] = []
        self.information: list[list[list[float]]] = []
        self.fixed: set[int] = set()
        self.skipped: Counter[str] = Counter()
        for number, line in text_lines(path, GraphError, kept_bytes=LINE_BYTES):
            words = line.split()
            if words and not words[0].startswith(b"#"):
                self._take(number, words)

    def check(self, index: Mapping[int, int]) -> None:
        """Refuse edges and FIX without a vertex, and invalid information."""
        for place, (start, end) in enumerate(self.edges):
            lost = next((name for name in (start, end) if name not in index), None)
            if lost is not None:
                message = f"edge from {start} to {end}: there is no vertex {lost}"
                raise self._error(self._edge_lines[place], message)
            if start == end:
                raise self._error(self._edge_lines[place], f"edge from vertex {start} to itself")
        lost = next((name for name in sorted(self.fixed) if name not in index), None)
        if lost is not None:
            raise GraphError(f"{self._path}: FIX {lost}: there is no such vertex")
        bad = np.flatnonzero(~is_positive_definite(np.array(self.information).reshape(-1, 3, 3)))
        if len(bad):
            start, end = self.edges[bad[0]]
            raise self._error(
                self._edge_lines[bad[0]],
                f"edge from {start} to {end}: its information is not positive definite; "
                f"{len(bad)} such edges",
            )

    def _take(self, number: int, words: list[bytes]) -> None:
        kind = words[0]
        if kind in _VERTICES:
            (name,), pose = self._values(number, words, ids=1, numbers=3)
            if name in self.vertices:
                raise self._error(number, f"vertex {name} comes a second time")
            self.vertices[name] = pose
        elif kind in _EDGES:
            (start, end), values = self._values(number, words, ids=2, numbers=9)
            matrix = [[0.0] * 3 for _ in range(3)]
            for (row, column), value in zip(_EDGES[kind], values[3:], strict=True):
                matrix[row][column] = matrix[column][row] = value
            self.edges.append((start, end))
            self._edge_lines.append(number)
            self.motions.append(values[:3])
            self.information.append(matrix)
        elif kind == _FIX:
            self.fixed.update(self._values(number, words, ids=len(words) - 1, numbers=0)[0])
        else:
            self.skipped[kind.decode(errors="backslashreplace")] += 1

    def _values(
        self, number: int, words: list[bytes], *, ids: int, numbers: int
    ) -> tuple[tuple[int, ...], tuple[float, ...]]:
        """Return a line's ids and its finite numbers."""
        kind = words[0].decode()
        if len(words) != 1 + ids + numbers:
            wanted, found = ids + numbers, len(words) - 1
            raise self._error(number, f"{kind} wants {wanted} values, found {found}")
        try:
            names = tuple(int(word) for word in words[1 : 1 + ids])
            values = tuple(float(word) for word in words[1 + ids :])
        except ValueError:
            text = b" ".join(words[1:]).decode(errors="backslashreplace")
            raise self._error(number, f"{kind}: no numbers: {text[:80]!r}") from None
        if any(abs(name) > _LARGEST_ID for name in names):
            raise self._error(number, f"{kind}: an id has more than 18 digits")
        if not all(map(math.isfinite, values)):
            raise self._error(number, f"{kind} {names[0]}: a value is not finite")
        return names, values

    def _error(self, number: int, text: str) -> GraphError:
        return GraphError(f"{self._path}: line {number}: {text}")
