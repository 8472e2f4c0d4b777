"""Find the rigid motions under which the walls of two grids coincide, best first.

Two stages. The coarse stage scores every whole-cell shift at every yaw on shrunken grids: the
walls of each map on the other's wall likelihood less a penalty for walls in the other's free
space, both ways (of the scores tried on recorded pairs the one right most often). The fine stage
moves the best distinct peaks by robust Gauss-Newton steps on both distance fields, with ever
narrower scales, and ranks them by the same score on full-resolution cells.

What a motion is: see ``motions``.
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
from slamfusion.fusion.cancel import CancelToken, check_cancelled
from slamfusion.fusion.features import (
    COARSE_TABLE,
    FINE_TABLE,
    GridFeatures,
    Level,
    spread_sample,
)
from slamfusion.fusion.motions import distinct
from slamfusion.fusion.refine import rank, refine, settle

__all__ = [
    "CoarseSearch",
    "SearchWindow",
    "coarse_search",
    "coarse_step",
    "inside",
    "search",
    "shift_range",
]

F64 = npt.NDArray[np.float64]

TILE = 4
WALL_SHARE_MAX = 0.6
FINEST_FACTOR = 4
COARSE_POINTS = 2048
YAW_STEP_CELLS = 1.3
RIM_PERCENTILE = 90.0
SETTLED = 6
WINDOW_SLACK_CELLS = 2.0
WINDOW_SLACK_RAD = math.radians(1.0)


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


def coarse_step(
    reference: GridFeatures, moving: GridFeatures, cells: int, cancel: CancelToken | None = None
) -> int:
    """Return the fine cells per coarse cell that leave ``cells`` on the longest side.

    Finer where walls would fill more than 0.6 of the coarse cells, since a grid that is all wall
    tells nothing; but never more than four times finer, which would take too long.
    """
    longest = max(*reference.shape, *moving.shape)
    step = max(1, math.ceil(longest / cells))
    finest = max(1, math.ceil(longest / (FINEST_FACTOR * cells)))
    while step > finest and (
        max(grid.level(step, cancel).wall_share for grid in (reference, moving)) > WALL_SHARE_MAX
    ):
        step = max(finest, (2 * step) // 3)
    return step


def coarse_search(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> CoarseSearch:
    """Score all whole-cell shifts at all yaws on shrunken grids and return the best peaks."""
    step = coarse_step(reference, moving, config.coarse_cells, cancel)
    ref, mov = reference.level(step, cancel), moving.level(step, cancel)
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
    surface = _ShiftSurface(ref, mov, reference, moving, rows, cols, reach, cancel)
    forward = surface.forward(yaws, own, device)
    backward = surface.backward(yaws, from_ref // 2, centre, device)
    width = cols[1] - cols[0]
    check_cancelled(cancel)
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
        cancel: CancelToken | None,
    ) -> None:
        self.ref, self.mov, self.cancel = ref, mov, cancel
        self.field_ref = reference.field(ref.step, COARSE_TABLE, cancel)
        self.field_mov = moving.field(mov.step, COARSE_TABLE, cancel)
        self.rows, self.cols, self.reach = rows, cols, reach
        self.height = rows[1] - rows[0]
        self.width = cols[1] - cols[0]
        self.lanes = -(-self.width // SHIFT_LANES) * SHIFT_LANES

    def forward(self, yaws: F64, own: F64, device: ComputeDevice) -> DeviceArray[np.int32]:
        """Moving walls on the reference's field: scores (K, shifts)."""
        reach = self.reach
        plane_shape = (self.height + 2 * reach + 1, self.lanes + 2 * reach + 1)
        corner = (self.cols[0] - reach, self.rows[0] - reach, 0.0)
        check_cancelled(self.cancel)
        plane = device.warp(self.field_ref, fixed_poses(corner), plane_shape, COARSE_TABLE.base)
        cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        x = np.floor(cos * own[:, 0] - sin * own[:, 1] + 0.5).astype(np.int32)
        y = np.floor(sin * own[:, 0] + cos * own[:, 1] + 0.5).astype(np.int32)
        offsets = (y + reach) * plane_shape[1] + (x + reach)
        check_cancelled(self.cancel)
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
        check_cancelled(self.cancel)
        planes = device.warp(self.field_mov, fixed_poses(poses), plane_shape, COARSE_TABLE.base)
        offsets = (points[:, 1] * plane_shape[1] + points[:, 0]).astype(np.int32)[None, :]
        check_cancelled(self.cancel)
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


def search(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    device: ComputeDevice,
    cancel: CancelToken | None = None,
) -> tuple[CoarseSearch, F64, F64]:
    """Run both stages; return the coarse outcome, and motions (P, 3) and scores, best first.

    Args:
        reference, moving: the two grids.
        config: settings of the search.
        window: where to search.
        device: computes.
        cancel: asked before each operation.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    coarse = coarse_search(reference, moving, config, window, device, cancel)
    middle = max(1, round(coarse.step / 8))
    motions = refine(
        reference,
        moving,
        coarse.motions,
        middle,
        (16.0, 8.0, 4.0),
        device,
        points=384,
        cancel=cancel,
    )
    scores = rank(
        reference, moving, motions, middle, FINE_TABLE, device, points=1024, cancel=cancel
    )
    motions = distinct(motions[np.argsort(-scores, kind="stable")], 3.0 * middle, 0.02)[:SETTLED]
    motions = inside(window, settle(reference, moving, motions, device, cancel))
    if not len(motions):
        return coarse, motions, np.zeros(0)
    scores = rank(reference, moving, motions, 1, FINE_TABLE, device, cancel=cancel)
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
