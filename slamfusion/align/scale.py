"""Do two maps have one scale? A resolution that is wrong shows as a scale that fits better.

The moving map is taken larger and smaller about the middle of the walls that meet, where an answer
is right whatever the scale, and each size is compared with the given one piece of wall by piece of
wall (``pieces``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken
from slamfusion.align.features import GridFeatures
from slamfusion.align.pieces import WallPieces, wall_pieces
from slamfusion.align.search import score_motions
from slamfusion.compute import ComputeDevice

F64 = npt.NDArray[np.float64]

# Scales that are tried, coarse and then around the best.
COARSE = np.linspace(-0.12, 0.12, 25)
FINE = np.linspace(-0.0075, 0.0075, 7)
# Shifts that go with them, in widths of a wall.
SHIFTS = np.array([(x, y, 0.0) for y in (-1.0, 0.0, 1.0) for x in (-1.0, 0.0, 1.0)])
# ... of an answer that is bent: a part of it fits, and is not the part about which the scale turns.
FAR_SHIFTS = np.array([(float(x), float(y), 0.0) for y in range(-4, 5) for x in range(-4, 5)])
POINTS = 1024
# So many pieces of wall must say that the other scale is better, as an answer needs.
BETTER_MIN = 6.0


@dataclass(frozen=True)
class ScaleFit:
    """The scale at which two maps fit best.

    Attributes:
        scale: size of the moving map's metre in the reference's; 1.0 unless another is better.
        share: evidence there as a share of what the common ground could give, by the narrow width.
    """

    scale: float
    share: float


def estimate_scale(
    reference: GridFeatures,
    moving: GridFeatures,
    motion: F64,
    widths: tuple[float, float],
    device: ComputeDevice,
    cancel: CancelToken | None = None,
    *,
    is_far: bool = False,
) -> ScaleFit:
    """Return the scale at which two maps fit best, and how well they do.

    Args:
        reference, moving: the two grids.
        motion: (3,) where the moving centre lands, cells, and yaw: right in the common ground.
        widths: of a wall in cells: the one by which the scale is looked for, and the narrow one.
        device: holds the fields.
        cancel: asked before each operation.
        is_far: look farther from the answer, as of one that leaves much unexplained.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    wide, narrow = widths
    shifts = FAR_SHIFTS if is_far else SHIFTS
    middle = common_middle(reference, moving, motion, wide, device)
    scale, at = 1.0, motion
    for offsets, sigma in ((COARSE, wide), (FINE, wide), (FINE, narrow)):
        scales = scale + offsets
        motions = np.concatenate(
            [_about(at, middle, s / scale) + shifts * (sigma, sigma, 1.0) for s in scales]
        )
        each = np.repeat(scales, len(shifts))
        found = score_motions(
            reference, moving, motions, 1, device,
            sigma=sigma, points=POINTS, scales=each, cancel=cancel,
        )  # fmt: skip
        best = int(np.argmax(found))
        scale, at = float(each[best]), motions[best]
    both = wall_pieces(
        reference, moving, np.stack((at, motion)), wide, device, cancel,
        scales=np.array([scale, 1.0]),
    )  # fmt: skip
    if not _is_better(both):
        scale, at = 1.0, motion
    fit = wall_pieces(reference, moving, at[None], narrow, device, cancel, scales=np.array([scale]))
    return ScaleFit(scale, float(fit.share()[0]))


def _is_better(both: WallPieces) -> bool:
    return both.better(0, 1) >= BETTER_MIN


def common_middle(
    reference: GridFeatures, moving: GridFeatures, motion: F64, sigma: float, device: ComputeDevice
) -> F64:
    """Return (2,) the mean place of ``common_walls``; where the moving centre lands without any."""
    walls = common_walls(reference, moving, motion, sigma, device)
    return walls.mean(axis=0) if len(walls) else motion[:2]


def common_walls(
    reference: GridFeatures, moving: GridFeatures, motion: F64, sigma: float, device: ComputeDevice
) -> F64:
    """Return (N, 2) moving walls that lie on walls of the reference, x and y in its cells."""
    points = moving.level(1).points / 2.0 - np.array(moving.centre)
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    x = cos * points[:, 0] - sin * points[:, 1] + motion[0]
    y = sin * points[:, 0] + cos * points[:, 1] + motion[1]
    height, width = reference.shape
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = x[inside], y[inside]
    distance2 = device.download(reference.level(1).distance2)
    near = distance2[y.astype(np.int64), x.astype(np.int64)] <= sigma * sigma
    return np.column_stack((x[near], y[near]))


def _about(motion: F64, middle: F64, scale: float) -> F64:
    """Return (1, 3) the motion whose moving map, larger by ``scale``, keeps ``middle`` in place."""
    moved = middle + scale * (motion[:2] - middle)
    return np.array([[moved[0], moved[1], motion[2]]])
