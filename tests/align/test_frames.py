"""Transforms of map frames as motions of grids, and back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.align.pair import Pair
from slamfusion.compute import ComputeDevice
from slamfusion.geometry import Pose2, wrap_angle
from tests.fusion.drawings import features_of, random_grid, with_origin


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
