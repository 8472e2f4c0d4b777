"""Rivals a step away from an answer: along a corridor, a row of desks, a single straight wall.

A search keeps peaks that lie apart; what slides along a wall is one long ridge and leaves no second
peak. So the shifts around an answer are looked at on their own, and the best of them are rivals.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken
from slamfusion.align.features import GridFeatures
from slamfusion.align.motions import distinct
from slamfusion.align.search import score_motions
from slamfusion.compute import ComputeDevice

F64 = npt.NDArray[np.float64]

# How far the farthest is, in distances of the nearest.
REACH = 2.5
# Wall points of each map that judge them, and how many are kept.
POINTS = 512
KEPT = 3


def slides(
    reference: GridFeatures,
    moving: GridFeatures,
    motion: F64,
    sigma: float,
    nearest: float,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> F64:
    """Return the best shifts of an answer, apart from it and from each other.

    Args:
        reference, moving: the two grids.
        motion: (3,) the answer: where the moving centre lands, cells, and yaw.
        sigma: width of a wall, cells; shifts are so far apart that no wall is missed.
        nearest: how far the nearest is, cells.
        device: computes.
        cancel: asked before each operation.

    Returns:
        (R, 3) motions, best first.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    farthest = REACH * nearest
    steps = np.arange(-np.floor(farthest / sigma), np.floor(farthest / sigma) + 1.0) * sigma
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    far = np.hypot(x, y)
    kept = (far > nearest) & (far <= farthest)
    motions = motion + np.stack((x[kept], y[kept], np.zeros(int(kept.sum()))), axis=1)
    scores = score_motions(
        reference, moving, motions, 1, device, sigma=sigma, points=POINTS, cancel=cancel
    )
    order = np.argsort(-scores, kind="stable")
    return distinct(motions[order], nearest, 1.0, KEPT)
