"""``PoseSampler``: the improved proposal of [G07] for all particles at once.

Every particle's drawn pose is moved to where the scan fits its own map, by hill climbing.
Likelihood times prior is sampled around there, and the pose is drawn from the Gaussian of these
samples; their sum is what the particle's weight is multiplied by.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.geometry import wrap_angles
from slamfusion.slam.common.matcher import pose_table
from slamfusion.slam.gmapping.particle_maps import ParticleMaps
from slamfusion.slam.gmapping.proposal import local_grid, propose

F64 = npt.NDArray[np.float64]

# Squared distance of a hit beside every wall, m^2: as 0.7 m away; one outlier decides little.
NO_HIT_M2 = 0.5
# Parts in which log-likelihoods count, to be whole numbers.
LOG_ONE = 1024
# Steps that hill climbing tries in all: a bound on its time; it ends far earlier.
MOST_TRIES = 40


@dataclass(frozen=True, eq=False)
class Sampled:
    """What became of N particles.

    Attributes:
        poses: (N, 3) drawn from each one's proposal, metres and radians.
        log_evidence: (N,) what their weights are multiplied by, logarithm.
        scores: (N,) sums of the hits' scores, each 0 to 1, where hill climbing ended.
        rejected: particles whose match was not believed.
    """

    poses: F64
    log_evidence: F64
    scores: F64
    rejected: int


class PoseSampler:
    """Samples the particles' poses."""

    def __init__(self, config: Any, device: ComputeDevice, maps: ParticleMaps) -> None:
        """Make the tables.

        Args:
            config: a ``GmappingConfig`` with nothing left open.
            device: where the maps live.
            maps: of the particles.
        """
        self._config = config
        self._device = device
        self._maps = maps
        self._likelihood_table = _likelihood_table(config)
        self._climb_sizes = _climb_sizes(config)
        self._samples = local_grid(
            config.llsamplerange, config.llsamplestep, config.lasamplerange, config.lasamplestep
        )

    def sample(
        self, points: F64, expected: F64, drawn: F64, sigmas: F64, rng: np.random.Generator
    ) -> Sampled:
        """Return the particles' poses and weights after a step.

        Args:
            points: (P, 2) hits, metres in the robot's frame.
            expected: (N, 3) where the motion model expects each particle.
            drawn: (N, 3) where it has drawn it.
            sigmas: (3,) its standard deviations.
            rng: where the poses are drawn from.
        """
        config, cell = self._config, self._config.delta
        hits = (points / cell).astype(np.float32)
        every = -(-len(points) // config.matcher.beams)
        # Match each particle on its own map.
        matched, score = self._hill_climb(hits[::every], expected, drawn, sigmas)
        scores = np.asarray(score * len(points))
        is_believed = scores > config.minimumScore
        centres = np.where(is_believed[:, None], matched, drawn)
        # Sample the likelihood around each match, times the motion model's prior.
        samples = centres[:, None, :] + self._samples
        looked_at = hits[:: max(every, config.lskip + 1)]
        log_likelihoods = self._log_likelihoods(looked_at, samples)
        away = (samples - expected[:, None, :]) / sigmas
        away[..., 2] = wrap_angles(samples[..., 2] - expected[:, None, 2]) / sigmas[2]
        log_priors = -0.5 * np.square(away).sum(axis=-1) - float(
            np.log(sigmas).sum() + 1.5 * math.log(math.tau)
        )
        # Draw from the Gaussian of the samples.
        steps = np.array([config.llsamplestep, config.llsamplestep, config.lasamplestep])
        proposal = propose(self._samples, log_likelihoods, log_priors, steps)
        noise = rng.standard_normal((len(drawn), 3))
        spread = np.linalg.cholesky(proposal.covariances)
        poses = centres + proposal.means + np.einsum("nij,nj->ni", spread, noise)
        poses = np.where(is_believed[:, None], poses, drawn)
        poses[:, 2] = wrap_angles(poses[:, 2])
        return Sampled(poses, proposal.log_evidence, scores, int((~is_believed).sum()))

    def _hill_climb(
        self, hits: npt.NDArray[np.float32], expected: F64, drawn: F64, sigmas: F64
    ) -> tuple[F64, F64]:
        """Return (N, 3) where hill climbing from the drawn poses ends, and (N,) mean scores.

        Args:
            hits: (K, 2) cells, in the robot's frame.
            expected: (N, 3), leaving it costs ``climb_loss``.
            drawn: (N, 3) the starts.
            sigmas: (3,) of the motion model.
        """
        config, cell, corner = self._config, self._config.delta, self._maps.corner
        looked_at = self._device.upload(hits)

        def rows(poses: F64) -> F64:
            """In cells of the window, headings near 0: float32 is to carry them."""
            yaw = wrap_angles(poses[..., 2] - expected[..., 2])
            return np.concatenate((poses[..., :2] / cell - corner, yaw[..., None]), axis=-1)

        turned = np.column_stack((np.cos(drawn[:, 2]), np.sin(drawn[:, 2])))
        losses = np.zeros((len(drawn), 7), dtype=np.float32)
        losses[:, :3] = rows(expected)
        losses[:, 3:6] = config.climb_loss * (np.array([cell, cell, 1.0]) / sigmas) ** 2
        found = self._device.climb_maps(
            self._maps.field,
            self._maps.tiles.page_tables,
            looked_at,
            losses,
            np.column_stack((rows(drawn), turned)).astype(np.float32),
            self._climb_sizes,
            tries=MOST_TRIES,
            scale=1.0 / (255.0 * looked_at.shape[0]),
        ).astype(np.float64)
        matched = np.column_stack(
            ((found[:, :2] + corner) * cell, wrap_angles(found[:, 2] + expected[:, 2]))
        )
        loss = (losses[:, 3:6] * (found[:, :3] - losses[:, :3]) ** 2).sum(axis=1)
        return matched, np.asarray(found[:, 5] + loss)

    def _log_likelihoods(self, hits: npt.NDArray[np.float32], samples: F64) -> F64:
        """Return (N, K) of hits (P, 2), in cells, at samples (N, K, 3) on the particles' maps."""
        maps = self._maps
        table = pose_table(samples, self._config.delta, maps.corner)
        looked_at = self._device.upload(hits)
        pages = maps.tiles.page_tables
        sums = self._device.score_maps(maps.field, pages, looked_at, table, self._likelihood_table)
        return np.asarray(sums / LOG_ONE)


def _likelihood_table(config: Any) -> npt.NDArray[np.int32]:
    """Return (256,) int32 log-likelihood, in 1/LOG_ONE, of a hit by the field under it."""
    field = np.arange(256) / 255.0
    squared_m2 = np.full(256, NO_HIT_M2)
    squared_m2[1:] = np.minimum(-config.sigma * np.log(field[1:]), NO_HIT_M2)
    return np.asarray(np.rint(-LOG_ONE * squared_m2 / config.lsigma).astype(np.int32))


def _climb_sizes(config: Any) -> npt.NDArray[np.float32]:
    """Return (S, 4) float32 steps of hill climbing, each half of the one before."""
    halves = 0.5 ** np.arange(config.iterations + 1)
    turns = config.astep * halves
    steps = (config.lstep / config.delta * halves, turns, np.cos(turns), np.sin(turns))
    return np.column_stack(steps).astype(np.float32)
