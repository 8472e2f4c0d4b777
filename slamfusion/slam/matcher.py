"""A bounded Monte-Carlo search for the pose under which a scan fits the map best.

The first look draws poses widely around each guess of where the robot went (what its odometry says;
that it goes on as it went) and scores them on wide basins; the best are refined by rounds of ever
narrower draws. All poses of a round are scored in one launch. The objective is the mean wall
value under the hits less a small loss for leaving the nearest guess.

Source: [H16] (Monte-Carlo matcher with a bounded number of tries).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from slamfusion.config import TinySlamConfig
from slamfusion.geometry import wrap_angles

__all__ = ["Guess", "Match", "Spread", "search_pose"]

F64 = npt.NDArray[np.float64]

# Draws narrow to this share of the spread after the first look, and again each round.
FIRST_NARROWING = 0.4
NARROWING = 0.5


class Score(Protocol):
    """How well poses fit."""

    def __call__(self, poses: F64, *, wide: bool) -> F64:
        """Return (N,) scores in 0..1 of poses (N, 3); wide: on the basins of the first look."""


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the first look.

    Attributes:
        xy_m: of x and of y.
        yaw_rad: of the heading.
    """

    xy_m: float
    yaw_rad: float

    def sigmas(self) -> F64:
        """Return (3,) x, y, yaw."""
        return np.array([self.xy_m, self.xy_m, self.yaw_rad])

    def wider(self, factor: float) -> Spread:
        """Return the spread times a factor."""
        return Spread(self.xy_m * factor, self.yaw_rad * factor)


@dataclass(frozen=True)
class Guess:
    """Where the robot may have gone.

    Attributes:
        pose: (3,) x, y in metres and yaw in radians, map frame.
        spread: how far to look around it.
        loss: what believing it costs, in units of the score.
    """

    pose: F64
    spread: Spread
    loss: float = 0.0


@dataclass(frozen=True)
class Match:
    """The best pose found.

    Attributes:
        pose: (3,) x, y in metres and yaw in radians, map frame.
        score: mean wall value under the hits there, 0 to 1.
        objective: the score less the loss for leaving the nearest guess.
        moved: how far the pose lies from the first guess, in spreads, along the worst axis.
    """

    pose: F64
    score: float
    objective: float
    moved: float


def search_pose(
    score: Score, guesses: Sequence[Guess], config: TinySlamConfig, rng: np.random.Generator
) -> Match:
    """Search around some guesses.

    Args:
        score: how well poses (N, 3) fit.
        guesses: at least one; the first look draws as many poses around each.
        config: numbers of draws and the weights of a guess.
        rng: where the draws come from.
    """
    centres = np.array([guess.pose for guess in guesses])
    sigmas = np.array([guess.spread.sigmas() for guess in guesses])
    losses = np.array([guess.loss for guess in guesses])
    weights = np.array([config.prior_weight_xy, config.prior_weight_xy, config.prior_weight_yaw])

    def loss(poses: F64) -> F64:
        away = (poses[:, None, :] - centres) / sigmas
        away[..., 2] = wrap_angles(poses[:, None, 2] - centres[:, 2]) / sigmas[:, 2]
        return np.asarray((away**2 @ weights + losses).min(axis=1))

    each = -(-config.first_poses // len(guesses))
    draws = rng.standard_normal((len(guesses), each, 3))
    draws[:, 0] = 0.0
    poses = (centres[:, None, :] + draws * sigmas[:, None, :]).reshape(-1, 3)
    order = np.argsort(loss(poses) - score(poses, wide=True), kind="stable")
    best = np.concatenate((poses[order[: config.best_poses]], centres))
    width = sigmas.max(axis=0) * FIRST_NARROWING
    objective = 0.0
    for _ in range(config.rounds):
        each = -(-config.poses // len(best))
        draws = rng.standard_normal((len(best), each, 3)) * width
        draws[:, 0] = 0.0
        poses = (best[:, None, :] + draws).reshape(-1, 3)
        values = score(poses, wide=False) - loss(poses)
        order = np.argsort(-values, kind="stable")
        best = poses[order[: max(1, len(best) // 2)]]
        objective = float(values[order[0]])
        width = width * NARROWING
    away = (best[0] - centres[0]) / sigmas[0]
    return Match(
        pose=best[0],
        score=objective + float(loss(best[:1])[0]),
        objective=objective,
        moved=float(np.abs(away).max()),
    )
