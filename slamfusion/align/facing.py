"""From which side was a wall seen? From where free space lies.

A wall of one room laid on the back of another room's wall lies exactly there, and tells nothing: of
what the two maps show nothing is the same. Where maps share but a part, such places are the best
rivals of a right answer, and the best wrong ones. So each cell beside a wall is told where free
space lies from it, and a wall that comes to lie on one that was seen from another side is no
evidence (see ``pieces``). A wall with free space on both sides, as boards and pillars have, faces
nowhere, which is another thing than a wall that faces somewhere.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import FACES, FACES_NOWHERE, FACING_PARTS

# How far free space is looked for, metres. Deeper than the rim of free cells that drawn maps have
# behind their walls, and than what lies between both lines of a wall that was drawn twice; less
# than half of a door. It is looked for on squares of cells, of which that are this many.
REACH_M, REACH_SQUARES = 0.4, 4
# One half of the ground around a cell has at least so much more free space than the other, as a
# share of the half: a straight wall has all of it on one side. With less than ``EVEN`` it faces
# nowhere; what is between says nothing, as maps draw one wall by a cell thicker or thinner.
CLEARER, EVEN = 0.3, 0.15
# Known cells so near a wall, as a share of the reach, may face nowhere; farther ones say nothing
# then: walls of bent maps come to lie there.
NEAR = 0.5


def facings(
    cells: npt.NDArray[np.int8], distance2: npt.NDArray[np.uint16], resolution: float
) -> npt.NDArray[np.uint8]:
    """Return where free space lies from each cell beside a wall.

    Args:
        cells: (H, W) int8 in {-1, 0, 1}.
        distance2: (H, W) uint16, to the nearest wall, squared, cells.
        resolution: metres per cell.

    Returns:
        (H, W) uint8: ``FACES`` and the direction, 0 along +x, counter-clockwise, in parts of a
        whole turn, of which there are ``FACING_PARTS``; ``FACES_NOWHERE`` beside a wall where free
        space lies on several sides, or on none; 0 where nothing is said.
    """
    side = max(1, round(REACH_M / resolution / REACH_SQUARES))
    x, y = _clearer(_free_shares(cells, side))
    much, angle = (np.asarray(part, dtype=np.float32) for part in cv2.cartToPolar(x, y))
    faces = np.where(much >= CLEARER, facing_parts(angle) | np.uint8(FACES), np.uint8(0))
    faces[much < EVEN] = FACES_NOWHERE
    height, width = cells.shape
    out = cv2.resize(
        faces, None, fx=side, fy=side, interpolation=cv2.INTER_NEAREST
    )[:height, :width]  # fmt: skip
    # A whole number: against another kind all distances would be turned into that.
    near2 = int((NEAR * REACH_SQUARES * side) ** 2)
    says_nothing = (distance2 > near2) | (cells < 0)
    says_nothing &= out == FACES_NOWHERE
    return np.multiply(out, ~says_nothing, order="C")


def _free_shares(cells: npt.NDArray[np.int8], side: int) -> npt.NDArray[np.float32]:
    """Return (h, w) the share of free cells of each square, ``side`` cells wide."""
    height, width = cells.shape
    free = (cells == 0).view(np.uint8) * np.uint8(255)
    padded = cv2.copyMakeBorder(
        free, 0, -height % side, 0, -width % side, cv2.BORDER_CONSTANT, value=(0,)
    )
    size = padded.shape[1] // side, padded.shape[0] // side
    share = cv2.resize(padded, size, interpolation=cv2.INTER_AREA)
    return np.asarray(share * np.float32(1 / 255))


def _clearer(
    free: npt.NDArray[np.float32],
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return how much more free space lies to the right of squares than to the left, and above.

    As shares (h, w) of half of the ground around each; beyond the map's edge is nothing free.
    """
    half = REACH_SQUARES * (2 * REACH_SQUARES + 1)
    sign = np.repeat(np.array([-1, 0, 1], dtype=np.float32), [REACH_SQUARES, 1, REACH_SQUARES])
    one = np.ones_like(sign) / half
    x, y = (
        cv2.sepFilter2D(free, -1, across, along, borderType=cv2.BORDER_CONSTANT)
        for across, along in ((sign, one), (one, sign))
    )
    return np.asarray(x), np.asarray(y)


def facing_parts(angles: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Return angles, rad, from 0 on, in parts of a turn, of which there are ``FACING_PARTS``."""
    parts = angles * np.float32(FACING_PARTS / (2.0 * np.pi)) + np.float32(0.5)
    return parts.astype(np.uint8) & np.uint8(FACING_PARTS - 1)
