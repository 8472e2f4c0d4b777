"""Paths go back through the particles' parents, and tell how sure the filter is of them."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.geometry import F64, Pose2
from slamfusion.slam.gmapping.particles import LEAST_SIGMAS, ParticlePaths
from tests.support.examples import examples


@settings(max_examples=examples(50), deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 6), nodes=st.integers(1, 8))
def test_every_path_is_what_a_full_copy_at_each_resampling_would_hold(
    seed: int, count: int, nodes: int
):
    rng = np.random.default_rng(seed)
    paths = ParticlePaths(count)
    full: list[list[F64]] = [[] for _ in range(count)]
    stamp = 0.0
    for _ in range(nodes):
        parents = None if rng.random() < 0.5 else rng.integers(0, count, count)
        poses = rng.uniform(-1.0, 1.0, (count, 3))
        full = [list(full[parent]) for parent in (range(count) if parents is None else parents)]
        paths.add_node(poses, parents)
        motions = [Pose2(), *(Pose2(*rng.uniform(-0.1, 0.1, 3)) for _ in range(rng.integers(3)))]
        for moved in motions:
            paths.add_scan(stamp, moved)
            stamp += 0.1
            for index in range(count):
                pose = Pose2(*poses[index]).compose(moved)
                full[index].append(np.array([pose.x, pose.y, pose.yaw_rad]))
    for index in range(count):
        np.testing.assert_allclose(paths.path(index, "").poses, full[index], atol=1e-12)


def test_nodes_before_the_last_common_ancestor_take_one_pose_each():
    joined, apart = ParticlePaths(30), ParticlePaths(30)
    rng = np.random.default_rng(5)
    for number in range(100):
        poses = rng.uniform(-1.0, 1.0, (30, 3))
        joined.add_node(poses, np.full(30, number % 30))
        apart.add_node(poses, None)
    assert joined.memory_bytes < apart.memory_bytes / 20


def test_a_path_is_not_read_node_by_node():
    """After ten hours there are tens of thousands, and the ROS node reads its path every 2 s."""

    def events_of(nodes: int) -> list[str]:
        paths, events = ParticlePaths(2), list[str]()
        for number in range(nodes):
            paths.add_node(np.zeros((2, 3)), None)
            paths.add_scan(0.1 * number, Pose2())

        def note(*event: Any) -> Any:
            events.append(event[1])
            return note

        before = sys.gettrace()
        sys.settrace(note)
        try:
            paths.path(0, "")
        finally:
            sys.settrace(before)
        return events

    assert events_of(2000) == events_of(1000) != []


# -- entropy ---------------------------------------------------------------------------------------


def entropy_of(poses: F64) -> float:
    paths = ParticlePaths(len(poses))
    paths.add_node(poses, None)
    return paths.entropy()


def cloud(sigmas: tuple[float, float, float], centre: F64, count: int = 2000) -> F64:
    draws = np.random.default_rng(8).standard_normal((count, 3))
    return np.asarray(centre + draws * sigmas)


def test_entropy_is_that_of_a_gaussian():
    """0.5 ln((2 pi e)^3 det); the sample's covariance is known, so no tolerance for chance."""
    poses = cloud((0.3, 0.2, 0.1), np.zeros(3))
    covariance = np.cov(poses.T, bias=True) + np.diag(np.square(LEAST_SIGMAS))
    wanted = 0.5 * math.log((math.tau * math.e) ** 3 * np.linalg.det(covariance))
    assert entropy_of(poses) == pytest.approx(wanted, abs=1e-9)
