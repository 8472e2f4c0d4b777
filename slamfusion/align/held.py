"""Do the walls that meet hold a motion in every direction?

Walls that run one way hold a motion across them and leave it free along them. The straight outer
wall of one building laid on that of another fits as well as a wall fits itself, and where it lies
along them only the ends of the two decide: each metre of such a wall is evidence (``pieces``), and
all of them together say one thing. So the walls that meet are counted by the direction in which
they run; a motion is held by the metres of the direction in which the fewest hold it.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.align.cancel import CancelToken
from slamfusion.align.features import GridFeatures, spread_sample
from slamfusion.align.measure import NEAR_CELLS_MIN, NEAR_M
from slamfusion.align.motions import invert, to_lattice
from slamfusion.compute.lattice import fixed_cells, fixed_poses

U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]
F64 = npt.NDArray[np.float64]

# How far along a wall it is looked at to tell its direction, metres, and the least in cells.
REACH_M, REACH_CELLS_MIN = 0.35, 3
# Walls around a point are a line where they spread across it by less than this share of what they
# spread along it (variances): two faces of a wall of 0.15 m do. Others hold both ways.
LINE_SPREAD = 0.25
# Points of each map that are looked at, and of those that meet a wall; each stands for its share.
POINTS, POINTS_MET = 4096, 512


def held_by(
    reference: GridFeatures, moving: GridFeatures, motion: F64, cancel: CancelToken | None = None
) -> float:
    """Return the metres of wall that hold a motion in the direction in which the fewest do.

    Args:
        reference, moving: the two grids.
        motion: (3,) where the moving centre lands, cells, and yaw.
        cancel: asked before each operation.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    lattice = to_lattice(motion[None], moving.centre)
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    forward = _met(moving, reference, lattice, cancel)
    backward = _met(reference, moving, invert(lattice), cancel)
    return held_m(0.5 * (turn @ forward @ turn.T + backward))


def _met(own: GridFeatures, other: GridFeatures, lattice: F64, cancel: CancelToken | None) -> F64:
    """Return (2, 2) the normals of one map's walls that meet the other's, times metres of wall."""
    size = own.grid.grid.resolution
    walls = own.level(1, cancel).points
    points = spread_sample(walls, POINTS)
    (pose,) = fixed_poses(lattice)
    rows, cols = fixed_cells(pose, points[:, 0].astype(np.int64), points[:, 1].astype(np.int64))
    reach = max(NEAR_M / size, NEAR_CELLS_MIN)
    around = walls_around(rows, cols, other.grid.solid, disc_around(reach))
    met = points[around.any(axis=1)]
    if not len(met):
        return np.zeros((2, 2))
    metres = size * len(walls) / len(points) * len(met)
    reach = max(REACH_M / size, REACH_CELLS_MIN)
    normals = wall_normals(spread_sample(met, POINTS_MET), own.grid.solid, reach)
    return np.asarray(metres * normals.mean(axis=0))


def wall_normals(points: I32, walls: U8, reach: float) -> F64:
    """Return in which directions walls hold a motion.

    Args:
        points: (N, 2) int32 lattice positions on walls, x and y in half cells.
        walls: (H, W) uint8, not 0 at a wall.
        reach: how far around a point walls are looked at, cells.

    Returns:
        (N, 2, 2) the product of a unit normal with itself at a point of a line; half the identity
        where the walls around a point run more than one way.
    """
    dx, dy = disc = disc_around(reach)
    weight = walls_around(points[:, 1] // 2, points[:, 0] // 2, walls, disc).astype(np.float64)
    moments = weight @ np.stack((np.ones(len(dx)), dx, dy, dx * dx, dx * dy, dy * dy), axis=1)
    count = np.maximum(moments[:, 0], 1.0)
    x, y, xx, xy, yy = (moments[:, k] / count for k in range(1, 6))
    xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
    apart = np.hypot(xx - yy, 2.0 * xy)
    along, across = (xx + yy + apart) / 2.0, (xx + yy - apart) / 2.0
    is_line = across < LINE_SPREAD * along
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    normal = np.stack((-np.sin(angle), np.cos(angle)), axis=1)
    tensor = normal[:, :, None] * normal[:, None, :]
    return np.where(is_line[:, None, None], tensor, 0.5 * np.eye(2))


def disc_around(reach: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return x and y (K,) of the cells within a distance of one, cells."""
    side = np.arange(-int(reach), int(reach) + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    is_near = x * x + y * y <= reach * reach
    return x[is_near], y[is_near]


def walls_around(
    rows: npt.NDArray[np.integer],
    cols: npt.NDArray[np.integer],
    walls: U8,
    disc: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]],
) -> npt.NDArray[np.bool_]:
    """Return (N, K) whether a wall stands in each cell around some cells; none does off the map."""
    height, width = walls.shape
    reach = int(disc[0].max())
    found = np.empty((len(rows), len(disc[0])), dtype=np.bool_)
    # Most see nothing beyond the edge, and one number is the place of each cell that they see.
    inner = (rows >= reach) & (rows < height - reach) & (cols >= reach) & (cols < width - reach)
    places = rows[inner].astype(np.int64) * width + cols[inner]
    found[inner] = walls.ravel().take(places[:, None] + (disc[1] * width + disc[0])) != 0
    outer = ~inner
    x, y = cols[outer, None] + disc[0], rows[outer, None] + disc[1]
    is_inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    on_map = walls[np.where(is_inside, y, 0), np.where(is_inside, x, 0)] != 0
    found[outer] = on_map & is_inside
    return found


def held_m(normals: F64) -> float:
    """Return the metres of wall that hold a motion in the direction in which the fewest do.

    Args:
        normals: (2, 2) sum of ``wall_normals`` times metres of wall.
    """
    return float(max(0.0, np.linalg.eigvalsh(normals)[0]))
