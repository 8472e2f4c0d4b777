"""Distances from the walls of one map to those of another, and the shares that follow from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

# A wall exactly the tolerance away counts as found, whatever the last digits of the poses are.
_TOLERANCE_SLACK_M = 1e-6


@dataclass(frozen=True)
class WallDistance:
    """Distances from each wall cell of one map to the nearest wall cell of another, metres."""

    mean: float
    """Mean, metres."""
    p95: float
    """95th percentile, metres."""
    max: float
    """The largest, metres."""


def nearest_distances(
    walls: npt.NDArray[np.float64], others: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64] | None:
    """Return (N,) metres to the nearest of ``others``, inf where there is none; None without walls.

    Args:
        walls: (N, 2) points, metres.
        others: (M, 2) points, metres, same frame.
    """
    if walls.shape[0] == 0:
        return None
    if others.shape[0] == 0:
        return np.full(walls.shape[0], np.inf)
    distances, _ = scipy.spatial.KDTree(others).query(walls)
    return np.asarray(distances, dtype=np.float64)


def share_within(distances: npt.NDArray[np.float64] | None, tolerance_m: float) -> float | None:
    """Return the share of distances at most the tolerance, or None without walls."""
    if distances is None:
        return None
    return float(np.mean(distances <= tolerance_m + _TOLERANCE_SLACK_M))


def harmonic_mean(precision: float | None, recall: float | None) -> float | None:
    """Return F1, 0 when both are 0, None when one is undefined."""
    if precision is None or recall is None:
        return None
    total = precision + recall
    return 2.0 * precision * recall / total if total else 0.0


def distance_summary(distances: npt.NDArray[np.float64] | None) -> WallDistance | None:
    """Return mean, 95th percentile and maximum, or None when a side has no walls."""
    if distances is None or not np.isfinite(distances[0]):
        return None
    return WallDistance(
        float(distances.mean()), float(np.percentile(distances, 95)), float(distances.max())
    )
