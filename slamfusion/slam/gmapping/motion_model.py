"""How a robot may have moved when its odometry says that it made a step: [G07], [B16] eq. 2."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.config import GmappingConfig
from slamfusion.geometry import Pose2, compose_poses, invert_poses

F64 = npt.NDArray[np.float64]

# Least standard deviations of x, y and yaw, metres and radians: a prior without width would decide
# everything.
LEAST_SIGMAS = (0.005, 0.005, 0.002)
# Distance, metres, below which a bicycle's steering cannot be told: it stands.
LEAST_DISTANCE_M = 1e-6
# Greatest steering angle, radians: at a right angle it could not drive.
MOST_STEERING_RAD = 1.4
# Turn, radians, below which an arc is straight: its radius would overflow.
LEAST_TURN_RAD = 1e-9


class MotionModel(Protocol):
    """Draws steps, and says how widely."""

    def draw(self, step: Pose2, count: int, rng: np.random.Generator) -> F64:
        """Return (count, 3) steps that the robot may have made; metres, radians, its own frame."""

    def sigmas(self, step: Pose2) -> F64:
        """Return (3,) standard deviations of x, y and yaw around the step."""


class DifferentialModel:
    """Errors grow with the distance and with the turn, alike in every direction."""

    def __init__(self, srr: float, srt: float, translation_per_turn: float, stt: float) -> None:
        """Take gmapping's ``srr``, ``srt``, ``str`` and ``stt``: error per metre and radian."""
        self._srr, self._srt, self._str, self._stt = srr, srt, translation_per_turn, stt

    def draw(self, step: Pose2, count: int, rng: np.random.Generator) -> F64:
        """See ``MotionModel.draw``."""
        errors = rng.standard_normal((count, 3)) * self._spread(step)
        return np.array([step.x, step.y, step.yaw_rad]) + errors

    def sigmas(self, step: Pose2) -> F64:
        """See ``MotionModel.sigmas``."""
        return np.maximum(self._spread(step), LEAST_SIGMAS)

    def _spread(self, step: Pose2) -> F64:
        distance, turn = math.hypot(step.x, step.y), abs(step.yaw_rad)
        across = self._srr * distance + self._str * turn
        return np.array([across, across, self._srt * distance + self._stt * turn])


class BicycleModel:
    """A steered front wheel: the robot goes along arcs, and its errors are those of an arc [B16].

    Speed and steering follow from the step: a distance s along the arc, and the steering angle
    atan(L * turn / s).
    """

    def __init__(self, srr: float, steering_sigma: float, wheel_base: float) -> None:
        """Take the error of the distance per metre, of the steering in radians, and L in metres."""
        self._srr, self._steering, self._base = srr, steering_sigma, wheel_base

    def draw(self, step: Pose2, count: int, rng: np.random.Generator) -> F64:
        """See ``MotionModel.draw``."""
        distance, steering = self._controls(step)
        errors = rng.standard_normal((count, 2))
        distances = distance + self._srr * abs(distance) * errors[:, 0]
        angles = np.clip(
            steering + self._steering * errors[:, 1], -MOST_STEERING_RAD, MOST_STEERING_RAD
        )
        meant = _arcs(np.array([distance]), np.array([distance * math.tan(steering) / self._base]))
        drawn = _arcs(distances, distances * np.tan(angles) / self._base)
        # The step may hold several arcs; what the errors change is put behind it.
        changed = compose_poses(invert_poses(meant), drawn)
        return np.asarray(compose_poses(np.array([[step.x, step.y, step.yaw_rad]]), changed))

    def sigmas(self, step: Pose2) -> F64:
        """See ``MotionModel.sigmas``."""
        distance, steering = self._controls(step)
        turn = abs(distance) * self._steering / (self._base * math.cos(steering) ** 2)
        along, across = self._srr * abs(distance), 0.5 * abs(distance) * turn
        return np.maximum(
            [math.hypot(along, across), math.hypot(along, across), turn], LEAST_SIGMAS
        )

    def _controls(self, step: Pose2) -> tuple[float, float]:
        """Return distance (m, negative backwards) and steering angle (rad) of a step."""
        chord = math.hypot(step.x, step.y)
        if chord < LEAST_DISTANCE_M:
            return 0.0, 0.0
        half = 0.5 * step.yaw_rad
        distance = chord * (half / math.sin(half) if abs(half) > LEAST_TURN_RAD else 1.0)
        forward = math.cos(half) * step.x + math.sin(half) * step.y
        distance = math.copysign(distance, forward)
        steering = math.atan(self._base * step.yaw_rad / distance)
        return distance, max(-MOST_STEERING_RAD, min(MOST_STEERING_RAD, steering))


def make_motion_model(config: GmappingConfig) -> MotionModel:
    """Return the model that a configuration with nothing left open asks for."""
    srr, srt, across, stt = (getattr(config, name) for name in ("srr", "srt", "str", "stt"))
    if config.motion_model == "bicycle":
        return BicycleModel(srr, config.steering_sigma, config.wheel_base)
    return DifferentialModel(srr, srt, across, stt)


def _arcs(distances: F64, turns: F64) -> F64:
    """Return (N, 3) steps along arcs of distances, metres, and turns, radians, (N,)."""
    safe = np.where(np.abs(turns) < LEAST_TURN_RAD, 1.0, turns)
    straight = np.abs(turns) < LEAST_TURN_RAD
    ahead = np.where(straight, 1.0, np.sin(turns) / safe)
    aside = np.where(straight, 0.0, (1.0 - np.cos(turns)) / safe)
    return np.column_stack((distances * ahead, distances * aside, turns))
