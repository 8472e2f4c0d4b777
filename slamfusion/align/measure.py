"""Numbers of one motion of one grid on another: matched walls, walls in free space, [F16] error."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken, check_cancelled
from slamfusion.align.features import GridFeatures, spread_sample
from slamfusion.align.motions import invert, to_lattice
from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses

F64 = npt.NDArray[np.float64]

# Tolerances in metres, and the least they are in cells where cells are coarse.
NEAR_M, NEAR_CELLS_MIN = 0.15, 1.5
CLASH_M, CLASH_CELLS_MIN = 0.4, 3.0
FAR_CLASH_M, FAR_CLASH_CELLS_MIN = 1.0, 5.0
MEASURED_POINTS = 4096


def measure(
    reference: GridFeatures,
    moving: GridFeatures,
    motion: F64,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> dict[str, float]:
    """Return the numbers by which a motion is judged.

    ``wall_match`` is the smaller of the two shares of wall cells with a wall of the other map
    within 0.15 m, ``wall_clash`` the larger of the two shares in the other's free space more than
    1 m from any wall, ``wall_clash_near`` the same beyond 0.4 m; ``chance`` is the larger of the
    two shares of known cells within 0.15 m of a wall, what a random place would match.
    ``explained`` is the share of the map with fewer wall cells, and ``explained_by_chance`` what a
    random place on the known cells of the other map would match of it.
    """
    lattice = to_lattice(motion[None], moving.centre)
    ref, mov = reference.level(1, cancel), moving.level(1, cancel)
    size = reference.grid.grid.resolution
    near2 = int(max(NEAR_M / size, NEAR_CELLS_MIN) ** 2 + 1e-9)
    clashes2 = [
        int(max(metres / size, least) ** 2 + 1e-9)
        for metres, least in ((FAR_CLASH_M, FAR_CLASH_CELLS_MIN), (CLASH_M, CLASH_CELLS_MIN))
    ]
    match, known, chance = [], [], []
    clash: list[list[float]] = [[], []]
    for points, pose, features, level in (
        (moving.wall_points, lattice, reference, ref),
        (reference.wall_points, invert(lattice), moving, mov),
    ):
        sample = spread_sample(points, MEASURED_POINTS)
        for far2, shares in zip(clashes2, clash, strict=True):
            check_cancelled(cancel)
            counts = device.pose_counts(
                sample,
                fixed_poses(pose),
                features.known,
                level.distance2,
                level.free,
                base=0,
                near2=near2,
                far2=far2,
            )[0]
            shares.append(counts[2] / len(sample))
        match.append(counts[1] / len(sample))
        known.append(counts[0] / len(sample))
        check_cancelled(cancel)
        chance.append(features.near_wall_share(near2))
    smaller = 0 if len(moving.wall_points) <= len(reference.wall_points) else 1
    overlap, error = _overlap_and_error(reference, moving, lattice, device, cancel)
    return {
        "wall_match": float(min(match)),
        "wall_match_moving": float(match[0]),
        "wall_match_reference": float(match[1]),
        "wall_clash": float(max(clash[0])),
        "wall_clash_near": float(max(clash[1])),
        "wall_known": float(min(known)),
        "chance": float(max(chance)),
        "explained": float(match[smaller]),
        "explained_by_chance": float(chance[smaller]),
        "overlap": overlap,
        "error": error,
    }


def _overlap_and_error(
    reference: GridFeatures,
    moving: GridFeatures,
    lattice: F64,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> tuple[float, float]:
    """Return the share of known cells in common, and the [F16] error over the reference's box."""
    check_cancelled(cancel)
    warped = device.warp(moving.cells, fixed_poses(invert(lattice)), reference.shape, -1)
    check_cancelled(cancel)
    counts = device.confusion(reference.cells, warped)
    both = float(counts[1:, 1:].sum())
    smaller = max(1, min(reference.known_cells, moving.known_cells))
    squares = np.array([[0, 1, 4], [1, 0, 1], [4, 1, 0]])
    return min(1.0, both / smaller), math.sqrt(float((counts * squares).sum()))
