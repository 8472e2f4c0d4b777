"""Motions: of transforms and back, how far apart two are, and which of many are distinct."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.align.pair import Pair, both_ways, displacement, distinct
from slamfusion.compute import ComputeDevice
from slamfusion.geometry import Pose2, wrap_angle
from tests.fusion.drawings import features_of, random_grid, with_origin

# Farther than a rounding from any multiple of what the motions below are made of.
SHIFT, TURN = 1.1, 0.07


def greedy(motions: np.ndarray, most: int | None) -> list[list[float]]:
    """One after the other, best first: kept unless within both distances of one that was kept."""
    kept: list[np.ndarray] = []
    for motion in motions:
        near = [displacement(motion, other) for other in kept]
        if not any(shift < SHIFT and turn < TURN for shift, turn in near):
            kept.append(motion)
    return [motion.tolist() for motion in kept[:most]]


@given(
    steps=st.lists(
        st.tuples(st.integers(-5, 5), st.integers(-5, 5), st.integers(-8, 8), st.integers(-1, 1)),
        max_size=120,
    ),
    most=st.one_of(st.none(), st.integers(1, 6)),
)
def test_distinct_equals_the_greedy_definition(
    steps: list[tuple[int, int, int, int]], most: int | None
) -> None:
    motions = np.array(
        [(0.5 * x, 0.5 * y, 3.0 + 0.02 * yaw + 2 * math.pi * turns) for x, y, yaw, turns in steps]
    ).reshape(-1, 3)
    found = motions[distinct(motions, SHIFT, TURN, most)]
    assert found.shape[1:] == (3,)
    assert found.tolist() == greedy(motions, most)


def moved(way: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (2, N), each by its own motion: cos, sin, x, y."""
    (cos, sin, x, y), (px, py) = way, points
    return np.array((cos * px - sin * py + x, sin * px + cos * py + y))


def test_distinct_keeps_the_better_of_near_ones() -> None:
    motions = np.array([[0.0, 0, 0], [2.0, 0, 0.01], [2.0, 0, 0.5], [9.0, 0, 0], [9.5, 0, 0]])
    assert distinct(motions, 3.0, 0.1).tolist() == [0, 2, 3]
    assert distinct(motions, 3.0, 0.1, 2).tolist() == [0, 2]


def test_the_ways_land_the_centre_and_undo_each_other() -> None:
    motions = np.array([[3.0, -4.0, 1.2], [0.5, 8.0, -3.0]])
    centre = (10.0, 6.0)
    there, back = (np.array(way) for way in both_ways(motions, centre, np.array([1.0, 1.25])))
    landed = moved(there, np.array([centre, centre]).T)
    assert np.allclose(landed, motions[:, :2].T)
    assert np.allclose(moved(back, landed), np.array([centre, centre]).T)


def test_displacement_wraps_the_turn() -> None:
    a, b = np.array([0.0, 0.0, math.pi - 0.1]), np.array([3.0, 4.0, -math.pi + 0.1])
    assert displacement(a, b) == pytest.approx((5.0, 0.2))


@pytest.mark.parametrize("seed", range(8))
def test_a_transform_is_one_motion_and_the_motion_is_that_transform(
    device: ComputeDevice, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    transform, here, there = (
        Pose2(*rng.uniform(-50.0, 50.0, 2), rng.uniform(-math.pi, math.pi)) for _ in range(3)
    )
    ref = features_of(with_origin(random_grid(1), here), device)
    mov = features_of(with_origin(random_grid(2), there), device)
    motion = Pair(ref, mov).motion_of(transform)
    back = Pair(ref, mov).transform_of(motion)
    assert (back.x, back.y) == pytest.approx((transform.x, transform.y), abs=1e-8)
    assert abs(wrap_angle(back.yaw_rad - transform.yaw_rad)) < 1e-9
    # By definition: where the middle of the moving grid comes to lie on the reference's lattice.
    middle = mov.grid.grid.origin.transform(np.array(mov.centre) * 0.1)
    landed = ref.grid.grid.origin.inverse().transform(transform.transform(middle))
    assert motion[:2] == pytest.approx(np.array(landed) / 0.1, abs=1e-6)


def test_a_map_on_itself_is_its_own_middle_without_a_turn(device: ComputeDevice) -> None:
    grid = features_of(with_origin(random_grid(1), Pose2(3.0, -4.0, 0.7)), device)
    assert Pair(grid, grid).motion_of(Pose2()) == pytest.approx([*grid.centre, 0.0])
