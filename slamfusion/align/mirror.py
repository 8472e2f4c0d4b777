"""Is one of two maps mirrored? A transposed map is a mirrored one that is turned.

A mirrored map of a place with many right angles fits the right one at a third of its walls, far
better than anything else does. What tells is the mirror image: it fits better still.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import NormalizedGrid
from slamfusion.align.pieces import wall_pieces
from slamfusion.align.search import search
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig

F64 = npt.NDArray[np.float64]

# An answer that is so much of what the common ground could give needs no look at a mirror image.
SURE_SHARE = 0.9


def mirror_gain(
    reference: GridFeatures,
    moving: GridFeatures,
    motion: F64,
    config: AlignConfig,
    sigma: float,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
    *,
    doubt: float = 0.0,
) -> float | None:
    """Return the evidence for the best fit of the moving map's image over that for a motion.

    Args:
        reference: held still.
        moving: the one that is mirrored.
        motion: (3,) of the map as it is: where its centre lands, cells, and yaw.
        config: settings of the search; everywhere, since no start holds for an image.
        sigma: width of a wall, cells.
        device: computes.
        cancel: asked before each operation.
        doubt: how much speaks against both what they leave unexplained, see ``WallPieces``.

    Returns:
        None where nothing speaks for the motion.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    pieces = wall_pieces(reference, moving, motion[None], sigma, device, cancel)
    own = float(replace(pieces, doubt=doubt).total[0])
    if own <= 0.0:
        return None
    image = mirror_image(moving, device)
    _, motions, _ = search(reference, image, config, SearchWindow(), device, cancel)
    if not len(motions):
        return 0.0
    pieces = wall_pieces(reference, image, motions, sigma, device, cancel)
    return max(0.0, float(replace(pieces, doubt=doubt).total.max())) / own


def mirror_image(features: GridFeatures, device: ComputeDevice) -> GridFeatures:
    """Return the mirror image of a grid, about its own x axis."""
    given = features.grid
    image = NormalizedGrid(
        replace(given.grid, cells=np.ascontiguousarray(given.grid.cells[::-1])),
        np.ascontiguousarray(given.cells[::-1]),
        np.ascontiguousarray(given.solid[::-1]),
    )
    return GridFeatures(image, device)
