"""Which walls two maps have in common, and whether these hold the motion between them.

Walls that run one way hold a motion across them and leave it free along them: each metre of such a
wall is evidence (``scores``), and all of them together say one thing. So the walls that meet are
counted by the direction in which they run; a motion is held by the metres of the direction in which
the fewest hold it.

Two straight walls that meet hold a motion in every direction and fit the corner of any other
building as well as their own: where nearly all common walls lie on two straight lines, three
numbers were fitted to three, and nothing is left that supports the answer.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from slamfusion.align.features import GridFeatures, spread_sample
from slamfusion.align.pair import Pair, invert, to_lattice
from slamfusion.compute.lattice import fixed_cells, fixed_poses

U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]
F64 = npt.NDArray[np.float64]

# Tolerances in metres, and the least they are in cells where cells are coarse.
NEAR_M, NEAR_CELLS_MIN = 0.15, 1.5
# How far along a wall it is looked at to tell its direction, metres, and the least in cells.
REACH_M, REACH_CELLS_MIN = 0.35, 3
# Walls around a point are a line where they spread across it by less than this share of what they
# spread along it (variances): two faces of a wall of 0.15 m do. Others hold both ways.
LINE_SPREAD = 0.25
# Points of each map that are looked at, and of those that meet a wall; each stands for its share.
HELD_POINTS, POINTS_MET = 4096, 512
# A line takes what lies within such a band, metres, and the least in cells: a wall with both faces.
BAND_M, BAND_CELLS_MIN = 0.3, 3.0
# Directions that are tried, degrees: all in coarse steps, fine ones around the best of them.
COARSE_DEG, FINE_DEG = np.arange(0.0, 180.0, 1.0), np.arange(-0.9, 0.91, 0.1)
# Points that are looked at, each stands for its share; fewer find the direction.
LINE_POINTS, COARSE_LINE_POINTS = 1024, 256
# Rounding, cells: a point that a band begins with lies on it.
NIL = 1e-6


def held_by(pair: Pair, motion: F64) -> float:
    """Return the metres of wall that hold a motion in the direction in which the fewest do.

    Args:
        pair: the two maps.
        motion: (3,) where the moving centre lands, cells, and yaw.
    """
    lattice = to_lattice(motion[None], pair.moving.centre)
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    forward = _normals_met(pair.moving, pair.reference, lattice)
    backward = _normals_met(pair.reference, pair.moving, invert(lattice))
    return held_m(0.5 * (turn @ forward @ turn.T + backward))


def _normals_met(own: GridFeatures, other: GridFeatures, lattice: F64) -> F64:
    """Return (2, 2) the normals of one map's walls that meet the other's, times metres of wall."""
    size = own.grid.grid.resolution
    walls = own.level(1).points
    points = spread_sample(walls, HELD_POINTS)
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


def common_middle(pair: Pair, motion: F64, sigma: float) -> F64:
    """Return (2,) the mean place of ``common_walls``; where the moving centre lands without any."""
    walls = common_walls(pair, motion, sigma)
    return walls.mean(axis=0) if len(walls) else motion[:2]


def common_walls(pair: Pair, motion: F64, sigma: float) -> F64:
    """Return (N, 2) moving walls that lie on walls of the reference, x and y in its cells."""
    points = pair.moving.level(1).points / 2.0 - np.array(pair.moving.centre)
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    x = cos * points[:, 0] - sin * points[:, 1] + motion[0]
    y = sin * points[:, 0] + cos * points[:, 1] + motion[1]
    height, width = pair.reference.shape
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = x[inside], y[inside]
    distance2 = pair.device.download(pair.reference.level(1).distance2)
    near = distance2[y.astype(np.int64), x.astype(np.int64)] <= sigma * sigma
    return np.column_stack((x[near], y[near]))


def beside_lines_m(pair: Pair, motion: F64) -> float:
    """Return the metres of common wall beside the two straight lines that take most of it.

    Args:
        pair: the two maps.
        motion: (3,) where the moving centre lands, cells, and yaw.
    """
    size = pair.resolution
    walls = common_walls(pair, motion, pair.widths[0])
    if not len(walls):
        return 0.0
    points = _sample(walls, LINE_POINTS)
    beside = beside_lines(points, max(BAND_M / size, BAND_CELLS_MIN))
    return size * len(walls) * beside / len(points)


def beside_lines(points: F64, band: float) -> int:
    """Return how many points, (N, 2), lie beside the two straight bands that take most of them.

    The direction of a band is that of a sample; of many long walls it may take the second longest.

    Args:
        points: x and y.
        band: width of one, in the unit of the points.
    """
    left = points
    for _ in range(2):
        if not len(left):
            break
        degrees, _ = _widest(_sample(left, COARSE_LINE_POINTS), COARSE_DEG, band)
        degrees, first = _widest(left, degrees + FINE_DEG, band)
        across = left @ _normal(degrees)
        left = left[(across < first - NIL) | (across > first + band + NIL)]
    return len(left)


def _sample(points: F64, most: int) -> F64:
    """Return at most so many of the points, evenly strided."""
    return points[:: -(-len(points) // most)]


def _widest(points: F64, degrees: F64, band: float) -> tuple[float, float]:
    """Return direction and beginning of the band that takes most points."""
    across = np.sort(_normal(degrees).T @ points.T, axis=1)
    taken = np.stack([np.searchsorted(row, row + band, side="right") for row in across])
    taken -= np.arange(len(points))
    best = np.unravel_index(taken.argmax(), taken.shape)
    return float(degrees[best[0]]), float(across[best])


def _normal(degrees: float | F64) -> F64:
    """Return the unit vector, or (2, K) of them, across lines that run at an angle."""
    return np.stack((np.cos(np.radians(degrees)), np.sin(np.radians(degrees))))
