"""Fit two maps of one place as narrowly as cells allow, from several yaws.

The fits of a search are wide: maps that are bent, or draw walls of different thickness, meet
nowhere else. On a strip of common ground a wide fit settles some degrees off, where it begins, and
is pulled by walls that the other map does not have: of what the walls of two good maps could give
it may leave a fifth.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken
from slamfusion.align.features import GridFeatures
from slamfusion.align.motions import turned_about
from slamfusion.align.pieces import GOOD_DOUBT
from slamfusion.align.refine import are_as_thick, polish
from slamfusion.align.scale import common_middle, common_walls
from slamfusion.align.search import score_motions, wall_widths
from slamfusion.compute import ComputeDevice

F64 = npt.NDArray[np.float64]

# Turns from which a fit begins, the motion's own first; the width of a wall, cells, by which the
# best is chosen.
TURNS = np.radians([0.0, -0.6, 0.6, -1.2, 1.2])
THIN_CELLS = 1.0
# Steps by which a fit is sought among its neighbours, cells, and as many of each; turns move walls
# of the common ground as far as shifts, those of less ground as if it reached so far, cells.
STEPS, STEPS_MOST, REACH_CELLS_MIN = (0.5, 0.25, 0.125), 6, 8.0
# Walls there must give so many times as much as where the fit ended: between cells it knows more.
CLIMBED_GAIN = 1.1
NEIGHBOURS = np.array([(x, y, turn) for turn in (0, -1, 1) for y in (0, -1, 1) for x in (0, -1, 1)])
# A fit that turned so far, rad, may have farther to turn: so many times at most.
TURNED_RAD, ROUNDS = math.radians(0.1), 4


def narrow_fits(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> F64:
    """Return motions fitted narrowly, each on its own, by the evidence of thin walls.

    Args:
        reference, moving: the two grids.
        motions: (P, 3) where the moving centre lands, cells, and yaw: right to a few cells and
            degrees.
        device: computes.
        cancel: asked before each operation.

    Returns:
        (P, 3) the motions there.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    fitted = motions.copy()
    left = np.arange(len(fitted))
    sigma = wall_widths(reference)[0]
    for _ in range(ROUNDS):
        if not len(left):
            break
        begun = np.concatenate(
            [
                turned_about(motion, common_middle(reference, moving, motion, sigma, device), TURNS)
                for motion in fitted[left]
            ]
        )
        ends = polish(reference, moving, begun, device, cancel)
        values = _by_thin_walls(reference, moving, ends, device, cancel)
        best = values.reshape(-1, len(TURNS)).argmax(axis=1)
        ends = ends.reshape(-1, len(TURNS), 3)[np.arange(len(left)), best]
        turned = np.abs(np.angle(np.exp(1j * (ends[:, 2] - fitted[left, 2]))))
        fitted[left] = ends
        left = left[turned >= TURNED_RAD]
    return fitted


def climbed(
    reference: GridFeatures,
    moving: GridFeatures,
    motion: F64,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> F64:
    """Return a narrow fit, or what lies beside it where thin walls give a tenth more there.

    A fit of distances is pulled a little by what is no wall of both maps: on 5 to 15 m of common
    wall by a degree, now and then. Where one map's walls are thicker thin walls give most on one
    side of a room, and the fit stays.

    Args:
        reference, moving: the two grids.
        motion: (3,) see ``narrow_fits``.
        device: computes.
        cancel: asked before each operation.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    if not are_as_thick(reference, moving, cancel):
        return motion
    walls = common_walls(reference, moving, motion, wall_widths(reference)[0], device)
    if not len(walls):
        return motion
    middle, reach = walls.mean(axis=0), math.sqrt(float(walls.var(axis=0).sum()))
    turn = 1.0 / max(reach, REACH_CELLS_MIN)
    at = motion
    first = highest = float(_by_thin_walls(reference, moving, motion[None], device, cancel)[0])
    for step in STEPS:
        for _ in range(STEPS_MOST):
            near = turned_about(at, middle, step * turn * NEIGHBOURS[:, 2])
            near[:, :2] += step * NEIGHBOURS[:, :2]
            values = _by_thin_walls(reference, moving, near, device, cancel)
            best = int(values.argmax())
            if best == 0:
                break
            at, highest = near[best], float(values[best])
            middle = middle + step * NEIGHBOURS[best, :2]
    return at if highest > CLIMBED_GAIN * first else motion


def _by_thin_walls(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> F64:
    """Return the evidence (P,) of thin walls for motions."""
    return score_motions(
        reference, moving, motions, 1, device, sigma=THIN_CELLS, doubt=GOOD_DOUBT, cancel=cancel
    )
