"""Poses as rows of arrays, (3,) x, y in metres and yaw in radians, and back."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2, wrap_angle

F64 = npt.NDArray[np.float64]


def pose_of(row: F64) -> Pose2:
    """Return the pose of a row; its yaw in [-pi, pi)."""
    x, y, yaw = (float(value) for value in row)
    return Pose2(x, y, wrap_angle(yaw))


def row_of(pose: Pose2) -> F64:
    """Return a pose as a row; its yaw as it is."""
    return np.array([pose.x, pose.y, pose.yaw_rad])


def wrapped_row_of(pose: Pose2) -> F64:
    """Return a pose as a row; its yaw in [-pi, pi)."""
    return np.array([pose.x, pose.y, wrap_angle(pose.yaw_rad)])
