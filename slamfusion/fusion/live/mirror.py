"""Is one of two maps mirrored? A transposed map is a mirrored one that is turned.

A mirrored map of a room with many right angles fits the right one at half of its walls, which is
as much as the maps of two different SLAMs may have in common. What tells them apart is the mirror
image: it fits better than the map as it came. Of pairs whose walls meet that well the right ones
lose by 0.2 of the score and more when one is mirrored, but where the place itself is the same
mirrored (then both scores are equal), and the mirrored ones gain as much.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.fusion.align import align_features
from slamfusion.fusion.cancel import CancelToken
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.normalize import NormalizedGrid
from slamfusion.fusion.records import Alignment

__all__ = ["refuse_mirrored"]

# A score that no mirror image can clearly exceed needs no second search.
SURE_SCORE = 0.9
# By how much the mirror image must score better: twice what equal fits differ by.
GAIN_MIN = 0.05


def refuse_mirrored(
    pair: Alignment,
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> Alignment:
    """Return an alignment, refused with the reason where the maps fit better mirrored.

    Costs one more search without a window, where the pair was accepted with a score below 0.9.

    Args:
        pair: of the two grids.
        reference: held still.
        moving: the one that is mirrored.
        config: settings of the search; its window and start do not hold for a mirror image.
        device: computes.
        cancel: asked before each operation.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    if not pair.accepted or pair.score >= SURE_SCORE:
        return pair
    free = replace(
        config, prove=False, step=None, window_m=None, window_yaw_rad=math.pi, shared_frame=False
    )
    other = align_features(reference, _mirrored(moving, device), free, device, cancel=cancel)
    if other.score < pair.score + GAIN_MIN:
        return pair
    reason = (
        f"fits better mirrored: score {other.score:.2f}, as it is {pair.score:.2f}; one of the two "
        "maps is mirrored or transposed"
    )
    return replace(pair, accepted=False, reason=reason)


def _mirrored(features: GridFeatures, device: ComputeDevice) -> GridFeatures:
    """Return the mirror image of a grid, about its own x axis."""
    given = features.grid
    image = NormalizedGrid(
        replace(given.grid, cells=np.ascontiguousarray(given.grid.cells[::-1])),
        np.ascontiguousarray(given.cells[::-1]),
        np.ascontiguousarray(given.solid[::-1]),
    )
    return GridFeatures(image, device)
