"""Pose graphs to test with: drawn ones, false closures, and how far two solutions are apart."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import F64, compose_poses, invert_poses
from slamfusion.pose_graph.graph import PoseGraph, loop_closing
from slamfusion.pose_graph.least_squares import Measurements
from tests.support.datasets import DATASETS

POSE_GRAPHS = DATASETS / "pose-graphs"
ABSENT = f"the recorded pose graphs are not at {POSE_GRAPHS}; set SLAMFUSION_DATASETS"
INFORMATION = np.array([[100.0, 10.0, 2.0], [10.0, 60.0, -3.0], [2.0, -3.0, 400.0]])


def between(poses: F64, edges: npt.NDArray[np.int64]) -> F64:
    """Return the motions that edges would measure without any error."""
    return compose_poses(invert_poses(poses[edges[:, 0]]), poses[edges[:, 1]])


def drawn(poses: F64, edges: npt.NDArray[np.int64], noise: float = 0.0, seed: int = 0) -> PoseGraph:
    """Return a graph of true poses, measured with noise in the deviations of ``INFORMATION``.

    Args:
        poses: (N, 3), also the graph's.
        edges: (M, 2).
        noise: of a measurement, in its deviations.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    spread = np.linalg.cholesky(np.linalg.inv(INFORMATION))
    errors = noise * rng.normal(size=(len(edges), 3)) @ spread.T
    return PoseGraph(
        poses=poses,
        edges=edges,
        motions=compose_poses(between(poses, edges), errors),
        information=np.tile(INFORMATION, (len(edges), 1, 1)),
        is_closure=loop_closing(edges, len(poses)),
    )


def ring(count: int = 20, radius_m: float = 5.0) -> tuple[F64, npt.NDArray[np.int64]]:
    """Return poses around a circle and the edges along it, the last one closing it."""
    angle = 2.0 * math.pi * np.arange(count) / count
    poses = np.stack((radius_m * np.sin(angle), radius_m * (1.0 - np.cos(angle)), angle), axis=1)
    steps = np.stack((np.arange(count), (np.arange(count) + 1) % count), axis=1)
    return poses, steps


def laps(count: int = 40, rounds: int = 4, every: int = 4) -> tuple[F64, npt.NDArray[np.int64]]:
    """Return poses several times around a circle, each lap tied to the one before."""
    poses, _ = ring(count)
    poses = np.tile(poses, (rounds, 1)) + np.arange(rounds).repeat(count)[:, None] * [
        0.1,
        0.05,
        0.0,
    ]
    total = count * rounds
    steps = np.stack((np.arange(total - 1), np.arange(1, total)), axis=1)
    later = np.arange(count, total, every)
    ties = np.stack((later, later - count), axis=1)
    return poses, np.concatenate((steps, ties))


def with_false_closures(graph: PoseGraph, share: float, seed: int, kind: str) -> PoseGraph:
    """Add closures between random poses, as many as a share of the true ones.

    Args:
        graph: optimised; ``random`` draws places within its extent.
        share: of the closures.
        seed: of the draw.
        kind: ``shuffled`` takes motion and information of a true closure elsewhere; ``random``
            draws the motion and takes only the information.
    """
    rng = np.random.default_rng(seed)
    closures = np.flatnonzero(graph.is_closure)
    count = round(share * len(closures))
    ends = rng.integers(0, len(graph), (20 * count + 100, 2))
    ends = ends[np.abs(ends[:, 0] - ends[:, 1]) > 5][:count]
    source = rng.choice(closures, count)
    motions = graph.motions[source]
    if kind == "random":
        extent = np.append(np.ptp(graph.poses[:, :2], axis=0), 2.0 * math.pi)
        motions = rng.uniform(-0.5, 0.5, (count, 3)) * extent
    return replace(
        graph,
        edges=np.concatenate((graph.edges, ends)),
        motions=np.concatenate((graph.motions, motions)),
        information=np.concatenate((graph.information, graph.information[source])),
        is_closure=np.concatenate((graph.is_closure, np.ones(count, np.bool_))),
    )


def chi2_of(graph: PoseGraph, poses: F64 | None = None) -> F64:
    """Return each edge's squared error in its deviations, (M,), by default at the graph's poses."""
    measured = Measurements(graph.edges, graph.motions, graph.information)
    return measured.squared_errors(graph.poses if poses is None else poses)


def apart(one: F64, other: F64) -> float:
    """Return how far two solutions are apart, as a share of the extent of the first.

    The root mean square distance of the poses after the best rigid motion, over the diagonal of the
    first one's box.
    """
    first = one[:, :2] - one[:, :2].mean(axis=0)
    second = other[:, :2] - other[:, :2].mean(axis=0)
    a, b = first @ [1.0, 1.0j], second @ [1.0, 1.0j]
    turn = np.vdot(b, a)
    distance = np.abs(a - b * turn / max(abs(turn), 1e-300))
    return float(np.sqrt((distance**2).mean()) / np.hypot(*np.ptp(first, axis=0)))
