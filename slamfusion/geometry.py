"""Planar rigid motions: ``Pose2`` (SE(2)) and angle wrapping."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

# Below this spread places have no direction.
_NO_SPREAD_M = 1e-9
# A pose is fitted as two points this far before and behind it, metres, so that headings count even
# if a robot has hardly moved.
_LEVER_M = 3.0


B8: TypeAlias = npt.NDArray[np.bool_]
I8: TypeAlias = npt.NDArray[np.int8]
U8: TypeAlias = npt.NDArray[np.uint8]
U16: TypeAlias = npt.NDArray[np.uint16]
I32: TypeAlias = npt.NDArray[np.int32]
U32: TypeAlias = npt.NDArray[np.uint32]
I64: TypeAlias = npt.NDArray[np.int64]
F32: TypeAlias = npt.NDArray[np.float32]
F64: TypeAlias = npt.NDArray[np.float64]
# Kind of the elements of an array.
Scalar = TypeVar("Scalar", bound=np.generic)

# Angles from which on it pays to look first whether any is to be wrapped.
MANY_ANGLES = 512


def wrap_angle(angle_rad: float) -> float:
    """Wrap an angle to [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def wrap_angles(angles_rad: npt.ArrayLike) -> F64:
    """Wrap angles to [-pi, pi), any shape."""
    turned = np.asarray(np.asarray(angles_rad, np.float64) + math.pi)
    # Remainders of many angles take several times as long as finding that there is none to take.
    if turned.size < MANY_ANGLES or not (turned.min() >= 0.0 and turned.max() < math.tau):
        turned = turned % math.tau
    return np.asarray(turned - math.pi)


def compose_poses(a: npt.ArrayLike, b: npt.ArrayLike) -> F64:
    """Compose many poses at once, as ``Pose2.compose`` does one.

    Args:
        a: (..., 3) x, y, yaw; one length unit throughout, radians.
        b: (..., 3), or a shape that broadcasts against ``a``.

    Returns:
        (..., 3) float64; yaw in [-pi, pi).
    """
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    x, y = second[..., 0], second[..., 1]
    return np.stack(
        (
            first[..., 0] + cos * x - sin * y,
            first[..., 1] + sin * x + cos * y,
            wrap_angles(first[..., 2] + second[..., 2]),
        ),
        axis=-1,
    )


def invert_poses(poses: npt.ArrayLike) -> F64:
    """Invert many poses at once, as ``Pose2.inverse`` does one; (..., 3) to (..., 3) float64."""
    given = np.asarray(poses, np.float64)
    cos, sin = np.cos(given[..., 2]), np.sin(given[..., 2])
    x, y = given[..., 0], given[..., 1]
    return np.stack((-cos * x - sin * y, sin * x - cos * y, wrap_angles(-given[..., 2])), axis=-1)


def blend_poses(first: F64, second: F64, share: F64) -> F64:
    """Interpolate between poses (M, 3): straight, turning at constant rate the short way.

    Args:
        first, second: (M, 3) float64, x and y in metres, yaw in radians.
        share: (M,) float64, 0 is the first, 1 the second.
    """
    away = second - first
    away[:, 2] = wrap_angles(away[:, 2])
    return np.asarray(first + share[:, None] * away)


def interpolate_poses(times_s: F64, stamps_s: F64, poses: F64) -> F64:
    """Interpolate poses linearly at times; clamped to the ends.

    Args:
        stamps_s: (N,), increasing.
        poses: (N, 3) x, y, yaw at the stamps.

    Returns:
        (..., 3); the yaw is not wrapped.
    """
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    return np.stack([np.interp(times_s, stamps_s, column) for column in columns], axis=-1)


def moved_poses(motion: Pose2, poses: npt.ArrayLike) -> F64:
    """Transform poses (..., 3) by a motion; float64."""
    return compose_poses((motion.x, motion.y, motion.yaw_rad), poses)


def transform_points(poses: F64, points: F64, of: npt.NDArray[np.int64] | None = None) -> F64:
    """Map points by many poses at once, as ``Pose2.transform`` does by one.

    Args:
        poses: (N, 3) x, y, yaw; one length unit throughout, radians.
        points: (B, 2) x and y, same unit, each in the frame of a pose.
        of: (B,) index of the pose of each point; None: B is N, and each has a pose of its own.

    Returns:
        (B, 2) float64, in the frame that the poses are in.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    if of is not None:
        poses, cos, sin = poses[of], cos[of], sin[of]
    x, y = points[:, 0], points[:, 1]
    return np.stack((poses[:, 0] + cos * x - sin * y, poses[:, 1] + sin * x + cos * y), axis=1)


def corners(points: npt.NDArray[Scalar]) -> tuple[npt.NDArray[Scalar], npt.NDArray[Scalar]]:
    """Return the least and the greatest x and y, (2,) each, of points (N, 2 or more), N at least 1.

    NumPy reduces rows of two numbers ten times as slowly as columns of many.
    """
    columns = points[:, :2].T.copy()
    return columns.min(axis=1), columns.max(axis=1)


def travelled(places: F64) -> F64:
    """Return the length of a path up to each of its places (N, 2 or more), as (N,) float64."""
    steps = np.diff(places[:, :2], axis=0)
    return np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))


@dataclass(frozen=True)
class Pose2:
    """A pose in the plane, or the rigid motion that carries its frame there.

    ``pose_a_b`` is the pose of frame b in frame a; it maps points of b into a, and
    ``pose_a_b.compose(pose_b_c)`` is ``pose_a_c``.

    Attributes:
        x, y: metres (or any length unit, kept throughout).
        yaw_rad: counter-clockwise, radians; not wrapped.
    """

    x: float = 0.0
    y: float = 0.0
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.x) and math.isfinite(self.y) and math.isfinite(self.yaw_rad)):
            raise ValueError(f"pose ({self.x}, {self.y}, {self.yaw_rad}) must be finite")

    def compose(self, other: Pose2) -> Pose2:
        """Return the motion that applies ``other`` first and then this one."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Pose2(
            self.x + cos * other.x - sin * other.y,
            self.y + sin * other.x + cos * other.y,
            wrap_angle(self.yaw_rad + other.yaw_rad),
        )

    def inverse(self) -> Pose2:
        """Return the motion that undoes this one."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Pose2(
            -cos * self.x - sin * self.y, sin * self.x - cos * self.y, wrap_angle(-self.yaw_rad)
        )

    def transform(self, points: npt.ArrayLike) -> F64:
        """Map points (..., 2) of this frame into the parent frame, in the pose's unit."""
        xy = np.asarray(points, dtype=np.float64)
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        moved = np.empty((*xy.shape[:-1], 2))
        moved[..., 0] = self.x + cos * xy[..., 0] - sin * xy[..., 1]
        moved[..., 1] = self.y + sin * xy[..., 0] + cos * xy[..., 1]
        return moved

    def scaled(self, factor: float) -> Pose2:
        """Return the same motion with lengths in another unit (metres to cells: 1 / resolution)."""
        return Pose2(self.x * factor, self.y * factor, self.yaw_rad)


def with_levers(poses: F64) -> F64:
    """Return poses 3 m before and then behind each pose, so that place fits include headings.

    Args:
        poses: (N, 3) float64, x and y in metres, yaw in radians.

    Returns:
        (2 N, 3) float64, with the same headings.
    """
    ahead, behind = poses.copy(), poses.copy()
    lever_m = _LEVER_M * np.column_stack((np.cos(poses[:, 2]), np.sin(poses[:, 2])))
    ahead[:, :2] += lever_m
    behind[:, :2] -= lever_m
    return np.concatenate((ahead, behind))


def fit_motion(moving: F64, still: F64, weights: F64 | None = None) -> Pose2:
    """Return the rigid motion between paired poses: least squares of their places.

    Args:
        moving: (N, 3) float64, N at least 1; x and y in metres, yaw in radians.
        still: (N, 3) float64, where the same poses should be.
        weights: (N,) float64, at least 0 and not all 0; None: equal.

    Returns:
        The motion from the frame of ``moving`` to that of ``still``. If all places coincide, its
        turn is the mean difference of the headings.

    Source: Umeyama, PAMI 13(4), 1991, equations 40 to 42 with c = 1; in the plane R is one angle.
    """
    share = None if weights is None else weights / weights.sum()
    middle, goal = _mean(moving[:, :2], share), _mean(still[:, :2], share)
    a, b = moving[:, :2] - middle, still[:, :2] - goal
    dots, crosses = a * b, a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    if share is None:
        along, across, counted = float(dots.sum()), float(crosses.sum()), len(a)
    else:
        along, across, counted = float(share @ dots.sum(axis=1)), float(share @ crosses), 1
    if math.hypot(along, across) <= counted * _NO_SPREAD_M**2:
        turns = np.exp(1j * (still[:, 2] - moving[:, 2]))
        yaw_rad = float(np.angle(_mean(turns, share)))
    else:
        yaw_rad = math.atan2(across, along)
    x, y = goal - Pose2(0.0, 0.0, yaw_rad).transform(middle)
    return Pose2(float(x), float(y), yaw_rad)


def _mean(values: npt.NDArray[Any], share: F64 | None) -> npt.NDArray[Any]:
    """Return the mean along the first axis, weighted by shares that sum to 1 if given."""
    if share is None:
        return np.asarray(values.mean(axis=0))
    # The rounding of the product depends on the memory layout: always use one.
    return np.asarray(share @ np.ascontiguousarray(values))


def pose_of(row: F64) -> Pose2:
    """Return the pose of a row; its yaw in [-pi, pi)."""
    x, y, yaw = row.tolist()
    return Pose2(x, y, wrap_angle(yaw))


def row_of(pose: Pose2) -> F64:
    """Return a pose as a row; its yaw unchanged."""
    return np.array([pose.x, pose.y, pose.yaw_rad])


def wrapped_row_of(pose: Pose2) -> F64:
    """Return a pose as a row; its yaw in [-pi, pi)."""
    return np.array([pose.x, pose.y, wrap_angle(pose.yaw_rad)])


def quaternion_yaw_rad(x: float, y: float, z: float, w: float) -> float:
    """Return the direction of a quaternion's x axis in plan; any length, NaN for 0."""
    if x == y == z == w == 0.0:
        return math.nan
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
