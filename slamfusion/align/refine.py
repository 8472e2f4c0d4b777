"""Move rigid motions to the nearest best fit of walls on walls, and rank them.

Robust Gauss-Newton steps on both distance fields, with ever narrower scales; the score is that of
the search, on full-resolution cells. What a motion is: see ``motions``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken, check_cancelled
from slamfusion.align.features import GridFeatures, spread_sample
from slamfusion.align.motions import both_ways, invert, to_lattice
from slamfusion.align.wall_evidence import ScoreTable
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.compute.search import FitSide

F64 = npt.NDArray[np.float64]

REFINE_POINTS = 768
FINE_POINTS = 1536
FINAL_POINTS = 4096
SPREAD_POINTS = 512
SCALE_SPREAD = 4.0
SETTLED_CELLS = 0.02
SURFACE_RADII = (1, 2, 3, 4)
# Robust scales of the last fit of two maps that show the same walls, cells.
POLISH_SCALES = (4.0, 2.0, 1.0)
# Where the six terms of a symmetric matrix of three rows stand, and its diagonal among the nine.
SYMMETRIC, DIAGONAL = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5]), slice(0, 9, 4)
# So many times as many wall cells to a cell of their surface, and the walls of a map are thicker.
THICKER = 1.15


def _device_poses(
    motions: F64, centre: tuple[float, float]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return (N, 4) float32 cos, sin, x, y from the moving lattice to the reference's, and back."""
    there, back = np.empty((2, len(motions), 4), dtype=np.float32)
    there.T[:], back.T[:] = both_ways(motions, centre)
    return there, back


def refine(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    step: int,
    scales: Sequence[float | F64],
    device: ComputeDevice,
    *,
    points: int = REFINE_POINTS,
    iterations: int = 4,
    solid: bool = False,
    everywhere: bool = False,
    cancel: CancelToken | None = None,
) -> F64:
    """Move motions to the nearest best fit of walls on walls.

    Args:
        reference, moving: the two grids.
        motions: (P, 3) where the moving centre lands, fine cells, and yaw.
        step: level to work on, fine cells a cell.
        scales: robust scale of each round, in cells of the level, wide to narrow; (P,) where each
            motion has its own.
        device: computes the normal equations.
        points: at most this many wall points of each grid.
        iterations: Gauss-Newton steps a scale; a pose that moves by less than 0.02 cells stops.
        solid: fit all wall cells, not only surfaces, at step 1.
        everywhere: also where a map knows nothing, as walls may lie that bent maps draw.
        cancel: asked before each operation.

    Returns:
        (P, 3) refined motions, the same form.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    ref, mov = reference.level(step, cancel), moving.level(step, cancel)
    if solid:
        ref, mov = reference.solid_level(cancel), moving.solid_level(cancel)
    from_mov = device.upload((spread_sample(mov.points, points) / 2.0).astype(np.float32))
    from_ref = device.upload((spread_sample(ref.points, points) / 2.0).astype(np.float32))
    on_ref, on_mov = (level.far_distance if everywhere else level.distance for level in (ref, mov))
    centre_mov = (moving.centre[0] / step, moving.centre[1] / step)
    pivot = (ref.shape[1] / 2.0, ref.shape[0] / 2.0)
    reach = math.hypot(*mov.shape) / 2.0
    local = motions / np.array([step, step, 1.0])
    for scale in scales:
        widths = np.broadcast_to(np.asarray(scale, dtype=np.float64), len(local))
        moves = np.arange(len(local))
        for _ in range(iterations):
            there, back = _device_poses(local[moves], centre_mov)
            check_cancelled(cancel)
            terms = device.refine_terms(
                FitSide(from_mov, there, on_ref),
                FitSide(from_ref, back, on_mov),
                scales=widths[moves].astype(np.float32),
                centre=pivot,
            )
            change = _solve(terms, widths[moves], reach)
            local[moves] = _apply(local[moves], change, pivot)
            moves = moves[(np.abs(change) * (1.0, 1.0, reach) >= SETTLED_CELLS).any(axis=1)]
            if not len(moves):
                break
    return np.asarray(local * np.array([step, step, 1.0]))


def _solve(terms: F64, scales: F64, reach: float) -> F64:
    """Return the damped Gauss-Newton step (P, 3) of each pose, no longer than its scale."""
    h = terms.take(SYMMETRIC, axis=1)
    h[:, DIAGONAL] += np.maximum(terms[:, 9:], 1.0) * (1e-3, 1e-3, 1e-3 * (reach * reach))
    step = -np.linalg.solve(h.reshape(-1, 3, 3), terms[:, 6:9, None])[:, :, 0]
    length = np.hypot(step[:, 0], step[:, 1]) / scales + np.abs(step[:, 2]) * reach / scales
    return np.asarray(step / np.maximum(1.0, length)[:, None])


def _apply(motions: F64, change: F64, pivot: tuple[float, float]) -> F64:
    """Apply small motions about the pivot after the motions (where the centre lands, yaw)."""
    cos, sin = np.cos(change[:, 2]), np.sin(change[:, 2])
    x, y = motions[:, 0] - pivot[0], motions[:, 1] - pivot[1]
    return np.stack(
        (
            cos * x - sin * y + pivot[0] + change[:, 0],
            sin * x + cos * y + pivot[1] + change[:, 1],
            motions[:, 2] + change[:, 2],
        ),
        axis=1,
    )


def settle(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> F64:
    """Finish motions that are right to a few cells, as finely as the walls of the two maps allow.

    Where one map's walls are thicker, their surfaces cannot meet: a fit narrower than the
    difference locks onto one side of a room, a wider one stays between both. So the last scale is
    four times the median distance of the surfaces that a wide fit leaves. And a surface says
    nothing of the wall's other side: the last fit takes all cells of the walls, under which a thin
    wall comes to lie in the middle of a thick one.
    """
    motions = refine(
        reference, moving, motions, 1, (12.0, 8.0), device, points=FINE_POINTS, cancel=cancel
    )
    spread = _surface_distance(reference, moving, motions, device, cancel)
    return refine(
        reference,
        moving,
        motions,
        1,
        (SCALE_SPREAD * spread,),
        device,
        points=FINE_POINTS,
        solid=True,
        cancel=cancel,
    )


def polish(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> F64:
    """Fit two maps that show the same walls as narrowly as cells allow, each motion on its own.

    Where little is in common a wide fit is pulled by walls that the other map does not have. Walls
    that are equally thick are fitted by their surfaces, others by all of their cells: see
    ``settle``.

    Args:
        reference, moving: the two grids.
        motions: (P, 3) right to a few cells.
        device: computes the normal equations.
        cancel: asked before each operation.

    Returns:
        (P, 3) the motions there.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    return refine(
        reference,
        moving,
        motions,
        1,
        POLISH_SCALES,
        device,
        points=FINAL_POINTS,
        solid=not are_as_thick(reference, moving, cancel),
        cancel=cancel,
    )


def are_as_thick(
    reference: GridFeatures, moving: GridFeatures, cancel: CancelToken | None = None
) -> bool:
    """Whether both maps draw walls about equally thick, so that their surfaces can meet.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    thick = [
        len(grid.wall_points) / max(1, len(grid.level(1, cancel).points))
        for grid in (reference, moving)
    ]
    return max(thick) <= THICKER * min(thick)


def _surface_distance(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> F64:
    """Return (P,) the median distance in cells, rounded up, of surfaces with one within 8 cells."""
    ref, mov = reference.level(1, cancel), moving.level(1, cancel)
    poses = to_lattice(motions, moving.centre)
    sides = ((mov.points, poses, ref), (ref.points, invert(poses), mov))
    near = np.zeros((len(SURFACE_RADII) + 1, len(motions)))
    for row, radius in enumerate((*SURFACE_RADII, 8)):
        for points, pose, level in sides:
            check_cancelled(cancel)
            counts = device.pose_counts(
                spread_sample(points, SPREAD_POINTS),
                fixed_poses(pose),
                level.free,
                level.distance2,
                level.free,
                base=0,
                near2=radius * radius,
                far2=0,
            )
            near[row] += counts[:, 1]
    reached = 2.0 * near[:-1] >= near[-1]
    reached[-1] = True
    return np.asarray(np.array(SURFACE_RADII, dtype=np.float64)[reached.argmax(axis=0)])


def rank(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    step: int,
    table: ScoreTable,
    device: ComputeDevice,
    *,
    points: int = FINAL_POINTS,
    cancel: CancelToken | None = None,
) -> F64:
    """Return the symmetric wall score (P,) of motions at a level; 1 for identical maps."""
    ref, mov = reference.level(step, cancel), moving.level(step, cancel)
    from_mov = spread_sample(mov.points, points)
    from_ref = spread_sample(ref.points, points)
    local = motions / np.array([step, step, 1.0])
    poses = to_lattice(local, (moving.centre[0] / step, moving.centre[1] / step))
    sides = (
        (from_mov, poses, reference, ref, len(mov.points)),
        (from_ref, invert(poses), moving, mov, len(ref.points)),
    )
    total = np.zeros(len(motions))
    weight = 0.0
    for sample, own, features, level, count in sides:
        field = features.field(level.step, table, cancel)
        check_cancelled(cancel)
        counts = device.pose_counts(
            sample,
            fixed_poses(own),
            field,
            level.distance2,
            level.free,
            base=table.base,
            near2=0,
            far2=0,
        )
        mean = (counts[:, 0] / len(sample) - table.base) / table.span
        total += mean * count
        weight += count
    return total / weight
