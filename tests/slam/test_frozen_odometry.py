"""Odometry that stands still while the robot drives is named, and only that."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.slam.common.frozen_odometry import frozen_span
from slamfusion.trajectory import Trajectory

STAMPS_S = np.arange(40, dtype=np.float64)


def drive(stands: slice | None = None) -> Trajectory:
    """0.2 m a second along x; during ``stands`` the pose is repeated."""
    poses = np.zeros((40, 3))
    poses[:, 0] = 0.2 * STAMPS_S
    if stands is not None:
        poses[stands] = poses[stands.start]
    return Trajectory(STAMPS_S, poses, "drive")


@pytest.mark.parametrize(
    ("stands", "span"),
    [(None, None), (slice(0, 40), (0.0, 39.0)), (slice(10, 25), (10.0, 24.0)), (slice(4, 8), None)],
)
def test_it_is_found_where_the_path_goes_on(
    stands: slice | None, span: tuple[float, float] | None
) -> None:
    assert frozen_span(drive(stands), drive()) == span


def test_a_robot_that_stands_has_no_frozen_odometry() -> None:
    stands = slice(10, 25)
    assert frozen_span(drive(stands), drive(stands)) is None
