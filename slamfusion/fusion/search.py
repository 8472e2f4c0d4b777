"""Find the rigid motions under which the walls of two grids coincide, best first.

Two stages. The coarse stage scores every whole-cell shift at every yaw on shrunken grids: the
walls of each map on the other's wall likelihood less a penalty for walls in the other's free
space, both ways (of the scores tried on recorded pairs the one right most often). The fine stage
moves the best distinct peaks by robust Gauss-Newton steps on both distance fields, with ever
narrower scales, and ranks them by the same score on full-resolution cells.

A motion here is in cells of the common lattice: (x, y, yaw) maps the moving grid's lattice into the
reference's, as x_ref = R(yaw) (x - centre of moving) + (x, y): (x, y) is where the centre lands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.lattice import fixed_poses
from slamfusion.compute.layout import SHIFT_LANES
from slamfusion.config import AlignConfig
from slamfusion.fusion.features import (
    COARSE_TABLE,
    FINE_TABLE,
    GridFeatures,
    Level,
    ScoreTable,
    spread_sample,
)

__all__ = [
    "CoarseSearch",
    "SearchWindow",
    "coarse_search",
    "coarse_step",
    "displacement",
    "distinct",
    "inside",
    "invert",
    "rank",
    "refine",
    "search",
    "settle",
    "shift_range",
    "to_lattice",
]

F64 = npt.NDArray[np.float64]

TILE = 4
WALL_SHARE_MAX = 0.6
FINEST_FACTOR = 4
COARSE_POINTS = 2048
YAW_STEP_CELLS = 1.3
RIM_PERCENTILE = 90.0
REFINE_POINTS = 768
FINE_POINTS = 1536
FINAL_POINTS = 4096
SPREAD_POINTS = 512
SCALE_SPREAD = 4.0
SETTLED = 6
WINDOW_SLACK_CELLS = 2.0
WINDOW_SLACK_RAD = math.radians(1.0)
SETTLED_CELLS = 0.02
SURFACE_RADII = (1, 2, 3, 4)


@dataclass(frozen=True)
class SearchWindow:
    """Where to search: motions within these distances of a start; None for everywhere.

    Attributes:
        start: (3,) x, y in cells, yaw in rad.
        shift_cells: largest distance of the centre from the start, None for any.
        yaw_rad: largest turn from the start.
    """

    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift_cells: float | None = None
    yaw_rad: float = math.pi


@dataclass(frozen=True, eq=False)
class CoarseSearch:
    """The outcome of the coarse stage.

    Attributes:
        step: fine cells per coarse cell.
        yaws: (K,) yaw in rad of each rotation tried.
        best: (K,) best score at each yaw, 1 for identical maps.
        motions: (P, 3) best distinct peaks in fine cells, best first.
        scores: (P,) their coarse scores.
    """

    step: int
    yaws: F64
    best: F64
    motions: F64
    scores: F64


def coarse_step(reference: GridFeatures, moving: GridFeatures, cells: int) -> int:
    """Return the fine cells per coarse cell that leave ``cells`` on the longest side.

    Finer where walls would fill more than 0.6 of the coarse cells, since a grid that is all wall
    tells nothing; but never more than four times finer, which would take too long.
    """
    longest = max(*reference.shape, *moving.shape)
    step = max(1, math.ceil(longest / cells))
    finest = max(1, math.ceil(longest / (FINEST_FACTOR * cells)))
    while step > finest and (
        max(reference.level(step).wall_share, moving.level(step).wall_share) > WALL_SHARE_MAX
    ):
        step = max(finest, (2 * step) // 3)
    return step


def coarse_search(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    device: ComputeDevice,
) -> CoarseSearch:
    """Score all whole-cell shifts at all yaws on shrunken grids and return the best peaks."""
    step = coarse_step(reference, moving, config.coarse_cells)
    ref, mov = reference.level(step), moving.level(step)
    centre = np.array(moving.centre) / step
    from_mov = spread_sample(mov.points, COARSE_POINTS)
    from_ref = spread_sample(ref.points, COARSE_POINTS)
    own = from_mov / 2.0 - centre
    radii = np.hypot(own[:, 0], own[:, 1])
    rim = max(1.0, float(np.percentile(radii, RIM_PERCENTILE)))
    yaws = _yaw_lattice(YAW_STEP_CELLS / rim, window)
    reach = math.ceil(float(radii.max())) + 1
    rows = shift_range(ref.shape[0], mov.shape, reach, window.start[1] / step, window, step)
    cols = shift_range(ref.shape[1], mov.shape, reach, window.start[0] / step, window, step)
    surface = _ShiftSurface(ref, mov, reference, moving, rows, cols, reach)
    forward = surface.forward(yaws, own, device)
    backward = surface.backward(yaws, from_ref // 2, centre, device)
    width = cols[1] - cols[0]
    values, places = device.tile_peaks(forward, backward, width, TILE)
    count = len(from_ref) + len(from_mov)
    scores = (values / count - COARSE_TABLE.base) / COARSE_TABLE.span
    motions, kept = _distinct_peaks(
        scores, places, yaws, rows[0], cols[0], width, config.candidates
    )
    motions[:, :2] *= step
    return CoarseSearch(step, yaws, scores.max(axis=(1, 2)), motions, kept)


def _yaw_lattice(step: float, window: SearchWindow) -> F64:
    """Return evenly spaced yaws, the start's among them: a full turn, or the window."""
    if window.yaw_rad >= math.pi:
        count = max(4, math.ceil(2.0 * math.pi / step))
        return np.asarray(window.start[2] + np.arange(count) * (2.0 * math.pi / count))
    half = math.ceil(window.yaw_rad / step)
    if half == 0:
        return np.array([window.start[2]])
    return np.asarray(window.start[2] + np.arange(-half, half + 1) * (window.yaw_rad / half))


def shift_range(
    size: int,
    moving_shape: tuple[int, int],
    reach: int,
    start: float,
    window: SearchWindow,
    step: int,
) -> tuple[int, int]:
    """Return the half-open range of cells where the moving centre may land along one axis.

    The circle around the moving walls must overlap the reference by half of the shorter side.
    """
    if window.shift_cells is not None:
        half = window.shift_cells / step
        return math.floor(start - half), math.floor(start + half) + 1
    overlap = min(size, *moving_shape) // 2
    return overlap - reach, size - overlap + reach + 1


class _ShiftSurface:
    """The padded planes and offsets that turn shifts into contiguous reads."""

    def __init__(
        self,
        ref: Level,
        mov: Level,
        reference: GridFeatures,
        moving: GridFeatures,
        rows: tuple[int, int],
        cols: tuple[int, int],
        reach: int,
    ) -> None:
        self.ref, self.mov = ref, mov
        self.field_ref = reference.field(ref.step, COARSE_TABLE)
        self.field_mov = moving.field(mov.step, COARSE_TABLE)
        self.rows, self.cols, self.reach = rows, cols, reach
        self.height = rows[1] - rows[0]
        self.width = cols[1] - cols[0]
        self.lanes = -(-self.width // SHIFT_LANES) * SHIFT_LANES

    def forward(self, yaws: F64, own: F64, device: ComputeDevice) -> DeviceArray[np.int32]:
        """Moving walls on the reference's field: scores (K, shifts)."""
        reach = self.reach
        plane_shape = (self.height + 2 * reach + 1, self.lanes + 2 * reach + 1)
        corner = (self.cols[0] - reach, self.rows[0] - reach, 0.0)
        plane = device.warp(self.field_ref, fixed_poses(corner), plane_shape, COARSE_TABLE.base)
        cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        x = np.floor(cos * own[:, 0] - sin * own[:, 1] + 0.5).astype(np.int32)
        y = np.floor(sin * own[:, 0] + cos * own[:, 1] + 0.5).astype(np.int32)
        offsets = (y + reach) * plane_shape[1] + (x + reach)
        return device.correlate(plane, offsets, (self.height, self.lanes))

    def backward(
        self, yaws: F64, points: npt.NDArray[np.int32], centre: F64, device: ComputeDevice
    ) -> DeviceArray[np.int32]:
        """Reference walls on the moving field, turned; read with shifts running backwards."""
        plane_shape = (self.ref.shape[0] + self.height, self.ref.shape[1] + self.lanes)
        dx = 0.5 - self.cols[0] - self.width
        dy = 0.5 - self.rows[0] - self.height
        cos, sin = np.cos(yaws), np.sin(yaws)
        poses = np.stack(
            (cos * dx + sin * dy + centre[0], -sin * dx + cos * dy + centre[1], -yaws), axis=1
        )
        planes = device.warp(self.field_mov, fixed_poses(poses), plane_shape, COARSE_TABLE.base)
        offsets = (points[:, 1] * plane_shape[1] + points[:, 0]).astype(np.int32)[None, :]
        return device.correlate(planes, offsets, (self.height, self.lanes))


def _distinct_peaks(
    scores: F64,
    places: npt.NDArray[np.int32],
    yaws: F64,
    row0: int,
    col0: int,
    width: int,
    most: int,
) -> tuple[F64, F64]:
    """Return the best peaks, each farther than a tile or two yaw steps from a better one."""
    flat = scores.ravel()
    first = np.argsort(-flat, kind="stable")[: 64 * most]
    k = first // (scores.shape[1] * scores.shape[2])
    row, col = np.divmod(places.ravel()[first], width)
    yaw_step = 2.0 * math.pi / max(len(yaws), 4) if len(yaws) > 1 else math.pi
    motions = np.stack((col + col0 + 0.5, row + row0 + 0.5, yaws[k]), axis=1).astype(np.float64)
    kept: list[int] = []
    for index, motion in enumerate(motions):
        near = motions[kept]
        if kept:
            shift = np.hypot(near[:, 0] - motion[0], near[:, 1] - motion[1])
            turn = np.abs(np.angle(np.exp(1j * (near[:, 2] - motion[2]))))
            if np.any((shift < TILE) & (turn < 2.5 * yaw_step)):
                continue
        kept.append(index)
        if len(kept) == most:
            break
    return motions[kept], flat[first[kept]]


def to_lattice(motions: F64, centre: tuple[float, float]) -> F64:
    """Return motions given by where the centre lands as (x, y, yaw) that map lattice origins."""
    cos, sin = np.cos(motions[:, 2]), np.sin(motions[:, 2])
    x = motions[:, 0] - cos * centre[0] + sin * centre[1]
    y = motions[:, 1] - sin * centre[0] - cos * centre[1]
    return np.stack((x, y, motions[:, 2]), axis=1)


def invert(motions: F64) -> F64:
    """Return the inverse of lattice motions (N, 3)."""
    cos, sin = np.cos(motions[:, 2]), np.sin(motions[:, 2])
    x = -cos * motions[:, 0] - sin * motions[:, 1]
    y = sin * motions[:, 0] - cos * motions[:, 1]
    return np.stack((x, y, -motions[:, 2]), axis=1)


def _device_poses(motions: F64) -> npt.NDArray[np.float32]:
    """Return (N, 4) float32 cos, sin, x, y."""
    return np.stack(
        (np.cos(motions[:, 2]), np.sin(motions[:, 2]), motions[:, 0], motions[:, 1]), axis=1
    ).astype(np.float32)


def refine(
    reference: GridFeatures,
    moving: GridFeatures,
    motions: F64,
    step: int,
    scales: tuple[float, ...],
    device: ComputeDevice,
    *,
    points: int = REFINE_POINTS,
    iterations: int = 4,
    solid: bool = False,
) -> F64:
    """Move motions to the nearest best fit of walls on walls.

    Args:
        reference, moving: the two grids.
        motions: (P, 3) where the moving centre lands, fine cells, and yaw.
        step: level to work on, fine cells a cell.
        scales: robust scale of each round, in cells of the level, wide to narrow.
        device: computes the normal equations.
        points: at most this many wall points of each grid.
        iterations: Gauss-Newton steps a scale; fewer once no pose moves by 0.02 cells.
        solid: fit all wall cells instead of surfaces; at step 1.
        solid: fit all wall cells, not only surfaces, at step 1.

    Returns:
        (P, 3) refined motions, the same form.
    """
    ref, mov = reference.level(step), moving.level(step)
    if solid:
        ref, mov = reference.solid_level, moving.solid_level
    from_mov = device.upload((spread_sample(mov.points, points) / 2.0).astype(np.float32))
    from_ref = device.upload((spread_sample(ref.points, points) / 2.0).astype(np.float32))
    centre_mov = (moving.centre[0] / step, moving.centre[1] / step)
    pivot = (ref.shape[1] / 2.0, ref.shape[0] / 2.0)
    reach = math.hypot(*mov.shape) / 2.0
    local = motions / np.array([step, step, 1.0])
    for scale in scales:
        for _ in range(iterations):
            poses = to_lattice(local, centre_mov)
            terms = device.refine_terms(
                from_mov,
                _device_poses(poses),
                ref.distance,
                scale=scale,
                centre=pivot,
                backward=False,
            ) + device.refine_terms(
                from_ref,
                _device_poses(invert(poses)),
                mov.distance,
                scale=scale,
                centre=pivot,
                backward=True,
            )
            change = _solve(terms, scale, reach)
            local = _apply(local, change, pivot)
            if np.all(np.abs(change) * (1.0, 1.0, reach) < SETTLED_CELLS):
                break
    return np.asarray(local * np.array([step, step, 1.0]))


def _solve(terms: F64, scale: float, reach: float) -> F64:
    """Return the damped Gauss-Newton step (P, 3) of each pose, no longer than the scale."""
    h = terms[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    ridge = np.array([1.0, 1.0, reach * reach]) * 1e-3
    weight = np.maximum(terms[:, 9], 1.0)[:, None]
    h = h + np.eye(3) * (ridge * weight)[:, None, :]
    step = -np.linalg.solve(h, terms[:, 6:9, None])[:, :, 0]
    length = np.hypot(step[:, 0], step[:, 1]) / scale + np.abs(step[:, 2]) * reach / scale
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
    reference: GridFeatures, moving: GridFeatures, motions: F64, device: ComputeDevice
) -> F64:
    """Finish motions that are right to a few cells, as finely as the walls of the two maps allow.

    Where one map's walls are thicker, their surfaces cannot meet: a fit narrower than the
    difference locks onto one side of a room, a wider one stays between both. So the last scale is
    four times the median distance of the surfaces that a wide fit leaves. And a surface says
    nothing of the wall's other side: the last fit takes all cells of the walls, under which a thin
    wall comes to lie in the middle of a thick one.
    """
    motions = refine(reference, moving, motions, 1, (12.0, 8.0), device, points=FINE_POINTS)
    spread = _surface_distance(reference, moving, motions, device)
    settled = np.empty_like(motions)
    for radius in np.unique(spread):
        mine = spread == radius
        last = SCALE_SPREAD * float(radius)
        settled[mine] = refine(
            reference,
            moving,
            motions[mine],
            1,
            (last,),
            device,
            points=FINE_POINTS,
            solid=True,
        )
    return settled


def _surface_distance(
    reference: GridFeatures, moving: GridFeatures, motions: F64, device: ComputeDevice
) -> F64:
    """Return (P,) the median distance in cells, rounded up, of surfaces with one within 8 cells."""
    ref, mov = reference.level(1), moving.level(1)
    poses = to_lattice(motions, moving.centre)
    sides = ((mov.points, poses, ref), (ref.points, invert(poses), mov))
    near = np.zeros((len(SURFACE_RADII) + 1, len(motions)))
    for row, radius in enumerate((*SURFACE_RADII, 8)):
        for points, pose, level in sides:
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
) -> F64:
    """Return the symmetric wall score (P,) of motions at a level; 1 for identical maps."""
    ref, mov = reference.level(step), moving.level(step)
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
        counts = device.pose_counts(
            sample,
            fixed_poses(own),
            features.field(level.step, table),
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


def displacement(a: F64, b: F64) -> tuple[float, float]:
    """Return how far two motions carry the moving centre apart (cells), and the turn (rad)."""
    turn = (a[2] - b[2] + math.pi) % (2.0 * math.pi) - math.pi
    return float(math.hypot(a[0] - b[0], a[1] - b[1])), abs(float(turn))


def search(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    device: ComputeDevice,
) -> tuple[CoarseSearch, F64, F64]:
    """Run both stages; return the coarse outcome, and motions (P, 3) and scores, best first."""
    coarse = coarse_search(reference, moving, config, window, device)
    middle = max(1, round(coarse.step / 8))
    motions = refine(
        reference, moving, coarse.motions, middle, (16.0, 8.0, 4.0), device, points=384
    )
    scores = rank(reference, moving, motions, middle, FINE_TABLE, device, points=1024)
    motions = distinct(motions[np.argsort(-scores, kind="stable")], 3.0 * middle, 0.02)[:SETTLED]
    motions = inside(window, settle(reference, moving, motions, device))
    if not len(motions):
        return coarse, motions, np.zeros(0)
    scores = rank(reference, moving, motions, 1, FINE_TABLE, device)
    order = np.argsort(-scores, kind="stable")
    return coarse, motions[order], scores[order]


def inside(window: SearchWindow, motions: F64) -> F64:
    """Return the motions that lie in the window; refinement may have carried some out of it."""
    start = np.array(window.start)
    turn = np.abs(np.angle(np.exp(1j * (motions[:, 2] - start[2]))))
    kept = turn <= window.yaw_rad + WINDOW_SLACK_RAD
    if window.shift_cells is not None:
        limit = window.shift_cells + WINDOW_SLACK_CELLS
        kept &= np.abs(motions[:, :2] - start[:2]).max(axis=1) <= limit
    return np.asarray(motions[kept])


def distinct(motions: F64, shift: float, turn: float) -> F64:
    """Return motions (best first) without those within ``shift`` cells and ``turn`` of a better."""
    kept: list[F64] = []
    for motion in motions:
        near = (displacement(motion, other) for other in kept)
        if not any(s < shift and t < turn for s, t in near):
            kept.append(motion)
    return np.array(kept)
