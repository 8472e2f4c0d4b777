"""Statistics of the errors along a path, and of repetitions of an experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

# Bootstrap samples, samples in memory at once, and the seed.
DRAWS, DRAWS_AT_ONCE, SEED = 4000, 250, 0


@dataclass(frozen=True)
class ErrorStatistics:
    """Figures of absolute errors, in the unit of the key that holds them."""

    mean: float
    """Mean of the errors."""
    std: float
    """Their standard deviation (divided by N)."""
    rmse: float
    """Root of the mean square."""
    median: float
    """The middle one."""
    min: float
    """The smallest."""
    max: float
    """The largest."""

    @classmethod
    def of(cls, errors: npt.ArrayLike) -> ErrorStatistics:
        """Return the figures of at least one error; the sign of an error does not count."""
        values = np.abs(np.asarray(errors, dtype=np.float64))
        return cls(
            mean=float(values.mean()),
            std=float(values.std()),
            rmse=float(np.sqrt(np.mean(values**2))),
            median=float(np.median(values)),
            min=float(values.min()),
            max=float(values.max()),
        )


def mean_interval(errors: npt.ArrayLike) -> tuple[float, float]:
    """Return the 95 % interval of the mean error by the percentile bootstrap; reproducible.

    Errors are taken as independent, which those of one path are not quite.

    Args:
        errors: (N,) at least one; the sign does not count.

    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3.
    """
    values = np.abs(np.asarray(errors, dtype=np.float64))
    if len(values) == 1:  # SciPy refuses it
        return float(values[0]), float(values[0])
    drawn = scipy.stats.bootstrap(
        (values,),
        np.mean,
        n_resamples=DRAWS,
        batch=DRAWS_AT_ONCE,
        vectorized=True,
        method="percentile",
        random_state=np.random.default_rng(SEED),
    ).confidence_interval
    return float(drawn.low), float(drawn.high)


def correct_by_holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for the number of tests (family-wise error rate), in order.

    NaN (not tested) stays NaN.

    Source: Holm, A Simple Sequentially Rejective Multiple Test Procedure, Scand. J. Stat., 1979.
    """
    values = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    left = np.isfinite(values).sum() - np.arange(len(values))
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(left * values[order]))
    return [float(p_value) for p_value in corrected]
