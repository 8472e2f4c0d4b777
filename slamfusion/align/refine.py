"""Move rigid motions to the nearest best fit of walls on walls, and rank them.

Robust Gauss-Newton steps on both distance fields, with ever narrower scales; the score is that of
the search, on full-resolution cells. What a motion is: see ``pair``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from slamfusion.align.pair import Pair, both_ways, turned_about
from slamfusion.align.scores import GOOD_DOUBT, count_met, score_motions
from slamfusion.compute.search import FitSide
from slamfusion.geometry import F64

REFINE_POINTS = 768
FINE_POINTS = 1536
FINAL_POINTS = 4096
SPREAD_POINTS = 512
SCALE_SPREAD = 4.0
SURFACE_RADII = (1, 2, 3, 4)
# Robust scales of the last fit of two maps that show the same walls, cells.
POLISH_SCALES = (4.0, 2.0, 1.0)
# Ratio of wall cells per surface cell from which the walls of one map are thicker.
THICKER = 1.15
# Turns from which a fit starts, the motion's own first; the wall width in cells to choose the best.
TURNS = np.radians([0.0, -0.6, 0.6, -1.2, 1.2])
THIN_CELLS = 1.0
# Steps of the local search, cells, and their number; turns move walls of the common ground as far
# as shifts, with at least this radius, cells.
CLIMB_STEPS, CLIMBS_MOST, REACH_CELLS_MIN = (0.5, 0.25, 0.125), 6, 8.0
# Least gain in evidence over the fit: between cells the fit is more accurate.
CLIMBED_GAIN = 1.1
NEIGHBOURS = np.array([(x, y, turn) for turn in (0, -1, 1) for y in (0, -1, 1) for x in (0, -1, 1)])
# A fit that turned farther, rad, is repeated, at most this number of times.
TURNED_RAD, ROUNDS = math.radians(0.1), 4


def refine(
    pair: Pair,
    motions: F64,
    step: int,
    scales: Sequence[float | F64],
    *,
    points: int = REFINE_POINTS,
    iterations: int = 4,
    solid: bool = False,
    everywhere: bool = False,
    meanwhile: Callable[[], None] | None = None,
) -> F64:
    """Move motions to the nearest best fit of walls on walls.

    Args:
        motions: (P, 3) where the moving centre lands, fine cells, and yaw.
        step: level to work on, fine cells a cell.
        scales: robust scale of each round, in cells of the level, wide to narrow; (P,) where each
            motion has its own.
        iterations: Gauss-Newton steps a scale, fewer where a motion is settled.
        solid: fit all wall cells, not only surfaces, at step 1.
        everywhere: also in unknown cells, for bent maps.
        meanwhile: what the host does while the device fits.

    Returns:
        (P, 3) refined motions, the same form.
    """
    on_ref, on_mov = (grid.distances(step, solid=solid, everywhere=everywhere) for grid in pair)
    from_ref, from_mov = (grid.wall_places(step, points, solid=solid) for grid in pair)
    sides = FitSide(from_mov, on_ref), FitSide(from_ref, on_mov)
    centre_mov = (pair.moving.centre[0] / step, pair.moving.centre[1] / step)
    (height, width), mov_shape = (grid.level(step).shape for grid in pair)
    middle, reach = np.array((width, height)) / 2.0, math.hypot(*mov_shape) / 2.0
    local = motions / np.array([step, step, 1.0])
    there, _ = both_ways(local, centre_mov)
    fitted = pair.device.start_fit(
        *sides, np.stack(there), np.stack([np.broadcast_to(s, len(motions)) for s in scales]),
        iterations, (*middle, reach),
    )  # fmt: skip
    if meanwhile is not None:
        meanwhile()
    moved = fitted()
    cos, sin = np.cos(moved[:, 2]), np.sin(moved[:, 2])
    x, y = (local[:, :2] - middle).T
    local = np.column_stack((cos * x - sin * y, sin * x + cos * y, local[:, 2])) + moved
    local[:, :2] = (local[:, :2] + middle) * step
    return local


def settle(pair: Pair, motions: F64, meanwhile: Callable[[], None] | None = None) -> F64:
    """Finish motions that are right to a few cells, as finely as the walls of the two maps allow.

    If one map's walls are thicker, their surfaces cannot meet: a narrow fit locks onto one side of
    a room, a wider one stays between both. So the last scale is four times the median surface
    distance after a wide fit. The last fit uses all wall cells, so that a thin wall ends in the
    middle of a thick one. ``meanwhile`` is what the host does while the device makes the first fit.
    """
    motions = refine(pair, motions, 1, (12.0, 8.0), points=FINE_POINTS, meanwhile=meanwhile)
    # The median distance in cells, rounded up, of surfaces with one within 8 cells.
    counts = count_met(pair, motions, SPREAD_POINTS, [r * r for r in (*SURFACE_RADII, 8)])
    near = (counts[0] + counts[1])[:, 2 : 3 + len(SURFACE_RADII)].T
    reached = 2.0 * near[:-1] >= near[-1]
    reached[-1] = True
    spread = np.array(SURFACE_RADII, dtype=np.float64)[reached.argmax(axis=0)]
    return refine(pair, motions, 1, (SCALE_SPREAD * spread,), points=FINE_POINTS, solid=True)


def polish(pair: Pair, motions: F64) -> F64:
    """Fit motions (P, 3), right to a few cells, of two maps that show the same walls.

    With little common ground a wide fit is pulled by walls that the other map does not have.
    Equally thick walls are fitted by their surfaces, others by all of their cells: see ``settle``.
    """
    return refine(
        pair, motions, 1, POLISH_SCALES, points=FINAL_POINTS, solid=not are_as_thick(pair)
    )


def are_as_thick(pair: Pair) -> bool:
    """Whether both maps draw walls about equally thick, so that their surfaces can meet."""
    thick = [len(grid.wall_points) / max(1, len(grid.level(1).points)) for grid in pair]
    return max(thick) <= THICKER * min(thick)


def narrow_fits(pair: Pair, motions: F64) -> F64:
    """Return motions (P, 3), right to a few cells and degrees, each fitted by thin walls."""
    fitted = motions.copy()
    left = np.arange(len(fitted))
    sigma = pair.widths[0]
    for _ in range(ROUNDS):
        if not len(left):
            break
        turned = []
        for motion in fitted[left]:
            walls = common_walls(pair, motion, sigma)
            middle = walls.mean(axis=0) if len(walls) else motion[:2]
            turned.append(turned_about(motion, middle, TURNS))
        ends = polish(pair, np.concatenate(turned))
        values = _by_thin_walls(pair, ends)
        best = values.reshape(-1, len(TURNS)).argmax(axis=1)
        ends = ends.reshape(-1, len(TURNS), 3)[np.arange(len(left)), best]
        turns = np.abs(np.angle(np.exp(1j * (ends[:, 2] - fitted[left, 2]))))
        fitted[left] = ends
        left = left[turns >= TURNED_RAD]
    return fitted


def climbed(pair: Pair, motion: F64) -> F64:
    """Return a narrow fit (3,), or a neighbour with a tenth more evidence of thin walls.

    Walls that only one map has pull a fit of distances by up to a degree on 5 to 15 m of common
    wall. If one map's walls are thicker, the fit stays.
    """
    if not are_as_thick(pair):
        return motion
    walls = common_walls(pair, motion, pair.widths[0])
    if not len(walls):
        return motion
    middle, reach = walls.mean(axis=0), math.sqrt(float(walls.var(axis=0).sum()))
    turn = 1.0 / max(reach, REACH_CELLS_MIN)
    at = motion
    first = highest = float(_by_thin_walls(pair, motion[None])[0])
    for step in CLIMB_STEPS:
        for _ in range(CLIMBS_MOST):
            near = turned_about(at, middle, step * turn * NEIGHBOURS[:, 2])
            near[:, :2] += step * NEIGHBOURS[:, :2]
            values = _by_thin_walls(pair, near)
            best = int(values.argmax())
            if best == 0:
                break
            at, highest = near[best], float(values[best])
            middle = middle + step * NEIGHBOURS[best, :2]
    return at if highest > CLIMBED_GAIN * first else motion


def _by_thin_walls(pair: Pair, motions: F64) -> F64:
    """Return the evidence (P,) of thin walls for motions."""
    return score_motions(pair, motions, 1, sigma=THIN_CELLS, doubt=GOOD_DOUBT)


def common_walls(pair: Pair, motion: F64, sigma: float) -> F64:
    """Return (N, 2) moving walls that lie on walls of the reference, x and y in its cells."""
    points = pair.moving.level(1).points / 2.0 - np.array(pair.moving.centre)
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    x = cos * points[:, 0] - sin * points[:, 1] + motion[0]
    y = sin * points[:, 0] + cos * points[:, 1] + motion[1]
    height, width = pair.reference.shape
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = x[inside], y[inside]
    distance2 = pair.reference.level(1).host_distance2
    near = distance2[y.astype(np.int64), x.astype(np.int64)] <= sigma * sigma
    return np.column_stack((x[near], y[near]))
