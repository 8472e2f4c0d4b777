"""``PoseGraph``: poses and relative measurements between them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.errors import GraphError
from slamfusion.geometry import B8, F64, I32, I64, compose_poses, invert_poses


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses in the plane and relative measurements between them; immutable.

    Attributes:
        poses: (N, 3) float64 x, y in metres and yaw in radians, all in one frame.
        edges: (M, 2) int64, from and to, indices of ``poses``.
        motions: (M, 3) float64, measured pose of ``to`` in the frame of ``from``.
        information: (M, 3, 3) float64, inverse covariance of the motion, in the frame of the
            measured pose (as g2o has it); symmetric, positive definite.
        is_closure: (M,) bool; only these may be outliers of a robust optimisation.

    Raises:
        GraphError: shapes that do not fit, values that are not finite, an edge to a pose that is
            not there or from a pose to itself, an information that is not positive definite.
    """

    poses: F64
    edges: I64
    motions: F64
    information: F64
    is_closure: B8

    def __post_init__(self) -> None:
        poses = np.array(self.poses, np.float64).reshape(-1, 3)
        edges = np.array(self.edges, np.int64).reshape(-1, 2)
        motions = np.array(self.motions, np.float64).reshape(-1, 3)
        information = np.array(self.information, np.float64).reshape(-1, 3, 3)
        is_closure = np.array(self.is_closure, np.bool_).reshape(-1)
        sizes = {len(edges), len(motions), len(information), len(is_closure)}
        if len(sizes) != 1:
            raise GraphError(
                f"{len(edges)} edges do not fit {len(motions)} motions, {len(information)} "
                f"information matrices and {len(is_closure)} closure flags"
            )
        if len(poses) == 0:
            raise GraphError("the graph has no pose")
        is_there = ((edges >= 0) & (edges < len(poses))).all(axis=1)
        is_finite = np.isfinite(motions).all(axis=1) & np.isfinite(information).all(axis=(1, 2))
        _refuse("pose", ~np.isfinite(poses).all(axis=1), "is not finite", None)
        _refuse("edge", ~is_there, "leads to no pose", edges)
        _refuse("edge", edges[:, 0] == edges[:, 1], "joins a pose to itself", edges)
        _refuse("edge", ~is_finite, "is not finite", edges)
        what = "has an information that is not symmetric and positive definite"
        _refuse("edge", ~is_positive_definite(information), what, edges)
        for name, array in (
            ("poses", poses),
            ("edges", edges),
            ("motions", motions),
            ("information", information),
            ("is_closure", is_closure),
        ):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.poses)

    def with_poses(self, poses: F64) -> PoseGraph:
        """Return the same measurements around other poses, (N, 3)."""
        return dataclasses.replace(self, poses=poses)


def part_labels(edges: I64, count: int) -> tuple[int, I32]:
    """Return the number of connected parts of ``count`` poses, and the part of each, (count,)."""
    parts, labels = scipy.sparse.csgraph.connected_components(
        _adjacency(edges, count), directed=False
    )
    return int(parts), np.asarray(labels, np.int32)


def check_connected(edges: I64, count: int, where: str = "") -> None:
    """Raise ``GraphError`` if a graph of ``count`` poses is in several parts."""
    parts, _ = part_labels(edges, count)
    if parts > 1:
        message = f"{where}the graph is in {parts} parts that no edge joins"
        raise GraphError(f"{message}; optimise each part on its own")


def loop_closing(edges: I64, count: int) -> B8:
    """Return which edges, (M, 2) from and to, close a loop on top of odometry, (M,) bool.

    Edges between consecutive poses, in either direction, are odometry. Of the others, in order, one
    that joins two separate parts closes no loop.
    """
    is_closure = np.asarray(np.abs(edges[:, 1] - edges[:, 0]) != 1)
    is_closure[joining(edges, is_closure, count)] = False
    return is_closure


def joining(edges: I64, is_closure: B8, count: int) -> I64:
    """Return the indices, rising, of closures that each join two parts left apart so far."""
    parts, labels = part_labels(edges[~is_closure], count)
    between = labels[edges]
    candidates = np.flatnonzero(is_closure & (between[:, 0] != between[:, 1]))
    pairs = np.sort(between[candidates], axis=1).astype(np.int64)
    _, first = np.unique(pairs[:, 0] * parts + pairs[:, 1], return_index=True)
    # The minimum spanning tree, weighted by order.
    shape = (parts, parts)
    weights = scipy.sparse.coo_matrix(
        (first + 1.0, (pairs[first, 0], pairs[first, 1])), shape=shape
    )
    tree = scipy.sparse.csgraph.minimum_spanning_tree(weights)
    return np.asarray(np.sort(candidates[tree.data.astype(np.int64) - 1]), np.int64)


def chained_poses(graph: PoseGraph, root: int = 0) -> F64:
    """Return (N, 3) poses of a connected graph, chained from ``root`` along odometry first.

    Loops are not closed. It follows a breadth-first tree, one depth at a time.
    """
    count = len(graph)
    used = ~graph.is_closure
    used[joining(graph.edges, graph.is_closure, count)] = True
    ends = graph.edges[used]
    _, parents = scipy.sparse.csgraph.breadth_first_order(
        _adjacency(ends, count), root, directed=False
    )
    parents = np.asarray(parents, np.int64)
    # Of each pose the first edge to its parent, whichever way that points.
    forward = parents[ends[:, 1]] == ends[:, 0]
    backward = parents[ends[:, 0]] == ends[:, 1]
    motion = np.zeros((count, 3))
    for is_along, child, moves in (
        (backward, ends[:, 0], invert_poses(graph.motions[used])),
        (forward, ends[:, 1], graph.motions[used]),
    ):
        reverse = np.flatnonzero(is_along)[::-1]
        motion[child[reverse]] = moves[reverse]
    # Pointer doubling: after k rounds a pose is known in the frame of its 2^k-th ancestor.
    poses = motion
    poses[root] = graph.poses[root]
    above = parents.copy()
    above[root] = -1
    while (above >= 0).any():
        has = np.flatnonzero(above >= 0)
        poses[has] = compose_poses(poses[above[has]], poses[has])
        above[has] = above[above[has]]
    return poses


def _adjacency(edges: I64, count: int) -> scipy.sparse.coo_matrix:
    ones = np.ones(len(edges))
    return scipy.sparse.coo_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(count, count))


def _refuse(kind: str, is_bad: npt.ArrayLike, what: str, edges: I64 | None) -> None:
    """Raise an error that names the first bad pose or edge, and how many there are."""
    bad = np.flatnonzero(is_bad)
    if len(bad):
        ends = "" if edges is None else f" from {edges[bad[0], 0]} to {edges[bad[0], 1]}"
        raise GraphError(f"{kind} {bad[0]}{ends} {what}; {len(bad)} such {kind}s")


def is_positive_definite(matrices: F64) -> B8:
    """Tell which of (M, 3, 3) matrices are symmetric and positive definite, (M,)."""
    symmetric = (matrices == matrices.transpose(0, 2, 1)).all(axis=(1, 2))
    a, b, c = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 0, 2]
    d, e, f = matrices[:, 1, 1], matrices[:, 1, 2], matrices[:, 2, 2]
    # Cholesky by hand: each pivot of what is left must be above 0.
    with np.errstate(all="ignore"):
        second = d - b * b / a
        third = f - c * c / a - (e - b * c / a) ** 2 / second
        return np.asarray(symmetric & (a > 0.0) & (second > 0.0) & (third > 0.0))
