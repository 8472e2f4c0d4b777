"""``Particles``: poses and weights of the filter, and how they are resampled."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from slamfusion.geometry import Pose2
from slamfusion.slam.common.mapper import Series
from slamfusion.slam.common.pose_rows import pose_of
from slamfusion.slam.gmapping.proposal import effective_particles

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


@dataclass(eq=False)
class Particles:
    """N particles; it is its own state.

    Attributes:
        poses: (N, 3) in the map frame, metres and radians.
        log_weights: (N,) since the last resampling.
        path_weights: (N,) logarithms too, of whole paths: never set back by resampling.
        best: index of the one whose path has the greatest weight.
        n_eff: times of the filter steps, seconds, and how many particles were effective there.
    """

    poses: F64
    log_weights: F64
    path_weights: F64
    best: int = 0
    n_eff: list[tuple[float, float]] = field(default_factory=list)

    @classmethod
    def of(cls, count: int) -> Particles:
        """Return equal ones at the origin."""
        return cls(np.zeros((count, 3)), np.zeros(count), np.zeros(count))

    def __len__(self) -> int:
        """N."""
        return len(self.poses)

    @property
    def best_pose(self) -> Pose2:
        """Pose of the best one in the map frame."""
        return pose_of(self.poses[self.best])

    def move(self, poses: F64, log_evidence: F64) -> None:
        """Give each particle a pose, (N, 3), and what its weight is multiplied by, (N,)."""
        self.poses = poses
        self.log_weights = self.log_weights + log_evidence
        self.path_weights = self.path_weights + log_evidence

    def weigh(self, stamp_s: float, gain: float) -> tuple[F64, float]:
        """Return (N,) normalised weights, and how many particles are effective.

        Args:
            stamp_s: time of the filter step, under which that is kept.
            gain: gmapping's ``ogain``.
        """
        shares = normalised_weights(self.log_weights, gain)
        n_eff = effective_particles(shares)
        self.n_eff.append((stamp_s, n_eff))
        return shares, n_eff

    def resample(self, parents: I64) -> None:
        """Let every particle become its parent, (N,); all are equally likely then."""
        self.poses = self.poses[parents]
        self.path_weights = self.path_weights[parents]
        self.log_weights = np.zeros(len(self))

    def choose_best(self) -> None:
        """Find the best one by the weights of now."""
        self.best = int(np.argmax(self.path_weights))

    def series(self, limit_share: float) -> tuple[Series, ...]:
        """Return how the effective number of particles went, with a limit, a share of all."""
        if not self.n_eff:
            return ()
        stamps_s, values = np.array(self.n_eff).T
        return (Series("effective particles", "", stamps_s, values, limit_share * len(self)),)


def better_half(log_weights: F64) -> I64:
    """Return (N,) parents: each of the better half of the particles, and each again."""
    better = np.argsort(-log_weights, kind="stable")[: -(-len(log_weights) // 2)]
    return np.resize(better, len(log_weights))


def normalised_weights(log_weights: F64, gain: float) -> F64:
    """Return weights that sum to 1, evened out by gmapping's ``ogain`` times the particles."""
    away = log_weights - log_weights.max()
    weights = np.exp(away / (gain * len(log_weights)))
    return np.asarray(weights / weights.sum())
