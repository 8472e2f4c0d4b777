"""The improved proposal of [G07]: a Gaussian from samples around the match, and its weight."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


class Proposal(NamedTuple):
    """Gaussians of N particles, and what each particle's weight is multiplied by.

    Attributes:
        means: (N, 3) x, y in metres and yaw in radians, relative to the centre of the samples.
        covariances: (N, 3, 3).
        log_evidence: (N,) logarithm of the integral of likelihood times prior over the samples.
    """

    means: F64
    covariances: F64
    log_evidence: F64


def local_grid(range_m: float, step_m: float, range_rad: float, step_rad: float) -> F64:
    """Return (K, 3) offsets of x, y and yaw around a pose, the pose itself among them."""
    along = _symmetric(range_m, step_m)
    around = _symmetric(range_rad, step_rad)
    grid = np.meshgrid(along, along, around, indexing="ij")
    return np.stack([axis.ravel() for axis in grid], axis=-1)


def propose(offsets: F64, log_likelihoods: F64, log_priors: F64, steps: F64) -> Proposal:
    """Fit a Gaussian to likelihood times prior on samples of the pose.

    Args:
        offsets: (K, 3) the samples, from the centre that each particle has of its own.
        log_likelihoods: (N, K) of the scan at each sample.
        log_priors: (N, K) log density of the motion model there.
        steps: (3,) distance between samples along x, y, yaw: the volume that each stands for.

    Returns:
        Means and covariances of the normalised product; the variance within a sample's own volume
        is part of it, so that a single sharp sample still has a width.
    """
    joint = log_likelihoods + log_priors
    top = joint.max(axis=1, keepdims=True)
    shares = np.exp(joint - top)
    total = shares.sum(axis=1, keepdims=True)
    log_evidence = (top + np.log(total))[:, 0] + float(np.log(steps).sum())
    shares /= total
    means = shares @ offsets
    away = offsets[None] - means[:, None]
    covariances = np.einsum("nk,nki,nkj->nij", shares, away, away)
    covariances += np.diag(steps**2 / 12.0)
    return Proposal(means, covariances, log_evidence)


def effective_particles(weights: F64) -> float:
    """Return N_eff of normalised weights, 1 to N."""
    return 1.0 / float(np.square(weights).sum())


def resample_systematic(weights: F64, start: float) -> npt.NDArray[np.int64]:
    """Return (N,) which particle each new one descends from; systematic resampling.

    Args:
        weights: (N,) normalised.
        start: uniform in [0, 1).
    """
    count = len(weights)
    places = (np.arange(count) + start) / count
    sums = np.cumsum(weights)
    # Rounding may leave the last place beyond the sum: it goes to the last one with any weight.
    last = np.searchsorted(sums, sums[-1])
    return np.asarray(np.minimum(np.searchsorted(sums, places, side="right"), last))


def _symmetric(reach: float, step: float) -> F64:
    """Return multiples of a step from -reach to reach."""
    most = int(reach / step + 1e-9)
    return np.asarray(step * np.arange(-most, most + 1, dtype=np.float64))
