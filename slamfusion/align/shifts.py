"""Every whole-cell shift of one coarse grid over another, at every yaw: ranges, planes, scores.

The walls of each map are scored on the evidence field of the other, both ways (see ``likelihood``).
The planes are padded, so that all shifts of a point are contiguous in memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.align.features import DIRECTIONS, Level, spread_sample
from slamfusion.align.pair import Pair
from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.lattice import fixed_poses, grouped, shift_spans
from slamfusion.compute.layout import SHIFT_LANES
from slamfusion.geometry import F64

I32 = npt.NDArray[np.int32]

# Sixteen values fit the packed adds of the correlate kernel.
COARSE_TOP = 15
# Width of a wall on coarse levels, cells.
COARSE_SIGMA = 0.75
# Sampled wall points of each map for a shift.
COARSE_POINTS = 384
# Distance in cells that walls at this percentile of their radii move between two yaws.
YAW_STEP_CELLS = 1.3
RIM_PERCENTILE = 90.0
# Memory of yaws scored at once; larger batches need new pages, which cost more than launches.
BATCH_BYTES = 1 << 23
# Cells on the longest side of the larger map when only shifts at parallel walls are compared; if a
# cell would exceed this size in metres (a third of a narrow corridor), up to this factor more.
PARALLEL_CELLS, CELL_MAX_M, GROWTH_MAX = 64, 0.75, 8
# Sampled wall points of each map there.
PARALLEL_POINTS = 4096
# Steps of coarse levels grow by this factor, so that pairs of like sizes share them.
STEP_GROWTH = 1.25
# Peaks of parallel walls: least distance in degrees, least height, largest number.
PEAKS_APART, PEAK_SHARE, PEAKS_MAX = 12, 0.5, 3
# Shifts this near to the best one, coarse cells, are the same place.
SAME_PLACE_CELLS = 4


@dataclass(frozen=True)
class SearchWindow:
    """Where to search: motions within these distances of a start; None for everywhere.

    Attributes:
        start: (3,) x, y in cells, yaw in rad.
        shift_cells: largest distance of the centre from the start, None for any.
    """

    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift_cells: float | None = None
    yaw_rad: float = math.pi


@dataclass(frozen=True, eq=False)
class ShiftScores:
    """The evidence for the best shift of each tile at each yaw.

    Attributes:
        step: fine cells per cell.
        yaws: (K,) yaw in rad.
        yaw_step: rad from one yaw to the next.
        evidence: (K, T) nats per cell of wall, summed over the sampled walls of both maps.
        rows, cols: (K, T) cell of the level where the moving centre lands.
    """

    step: int
    yaws: F64
    yaw_step: float
    evidence: F64
    rows: I32
    cols: I32

    def best_two(self) -> tuple[float, float]:
        """Return the most evidence, and the most at another place or yaw."""
        index, tile = np.unravel_index(int(self.evidence.argmax()), self.evidence.shape)
        is_near = np.abs(self.rows[index] - self.rows[index, tile]) <= SAME_PLACE_CELLS
        is_near &= np.abs(self.cols[index] - self.cols[index, tile]) <= SAME_PLACE_CELLS
        rest = self.evidence.copy()
        rest[index, is_near] = -np.inf
        return float(self.evidence[index, tile]), float(rest.max())

    def motions(self, chosen: npt.NDArray[np.intp]) -> F64:
        """Return (P, 3) where the moving centre lands, fine cells, and yaw, of chosen tiles."""
        x, y = ((axis.ravel()[chosen] + 0.5) * self.step for axis in (self.cols, self.rows))
        return np.stack((x, y, self.yaws[chosen // self.evidence.shape[1]]), axis=1)


def shift_range(
    size: int, reach: int, start: float, window: SearchWindow, step: int
) -> tuple[int, int]:
    """Return the half-open range of cells along one axis where the moving walls may overlap."""
    if window.shift_cells is not None:
        half = window.shift_cells / step
        return math.floor(start - half), math.floor(start + half) + 1
    return -reach, size + reach + 1


def shift_work(pair: Pair, step: int, window: SearchWindow) -> float:
    """Return the most field values that ``score_shifts`` adds: it grows as ``step``^-3."""
    rim = math.hypot(*pair.moving.shape) / (2.0 * step)
    reach = math.ceil(rim) + 1
    sides = [
        np.diff(shift_range(math.ceil(size / step), reach, start / step, window, step)).item()
        for size, start in zip(
            pair.reference.shape, (window.start[1], window.start[0]), strict=True
        )
    ]
    yaws = len(_yaw_lattice(YAW_STEP_CELLS / max(1.0, rim), window)[0])
    return 2.0 * COARSE_POINTS * yaws * math.prod(sides)


def score_shifts(
    pair: Pair,
    step: int,
    window: SearchWindow,
    yaws: F64 | None = None,
    points: int = COARSE_POINTS,
) -> ShiftScores:
    """Score every whole-cell shift at every yaw on one level of both grids.

    Args:
        step: of the level, fine cells per cell.
        window: where to search.
        yaws: (K,) the only ones, rad; None: evenly spaced ones.
        points: walls of each map that judge a shift.
    """
    ref, mov = pair.reference.level(step), pair.moving.level(step)
    centre = np.array(pair.moving.centre) / step
    from_mov = spread_sample(mov.points, points)
    from_ref = spread_sample(ref.points, points)
    from_mov, from_ref = from_mov[grouped(from_mov)], from_ref[grouped(from_ref)]
    own = from_mov / 2.0 - centre
    radii = np.hypot(own[:, 0], own[:, 1])
    rim = max(1.0, float(np.percentile(radii, RIM_PERCENTILE)))
    even, yaw_step = _yaw_lattice(YAW_STEP_CELLS / rim, window)
    yaws = even if yaws is None else yaws
    reach = math.ceil(float(radii.max())) + 1
    rows = shift_range(ref.shape[0], reach, window.start[1] / step, window, step)
    cols = shift_range(ref.shape[1], reach, window.start[0] / step, window, step)
    surface = _ShiftSurface(ref, mov, rows, cols, reach)
    ours = pair.reference.evidence_table(step, COARSE_SIGMA, COARSE_TOP)
    theirs = pair.moving.evidence_table(step, COARSE_SIGMA, COARSE_TOP)
    on_ref, on_mov = pair.reference.field(step, ours), pair.moving.field(step, theirs)
    width = cols[1] - cols[0]
    peaks = []
    for some in np.array_split(yaws, surface.batches(len(yaws))):
        forward = surface.forward(on_ref, ours.base, some, own, pair.device)
        backward = surface.backward(on_mov, theirs.base, some, from_ref // 2, centre, pair.device)
        found = pair.device.tile_peaks(forward, backward, width)
        peaks.append([part.reshape(len(some), -1) for part in found])
    values, places = (np.concatenate(parts) for parts in zip(*peaks, strict=True))
    floor = len(from_mov) * ours.base + len(from_ref) * theirs.base
    row, col = np.divmod(places, width)
    evidence = np.asarray((values - floor) * ours.unit, dtype=np.float64)
    return ShiftScores(step, yaws, yaw_step, evidence, row + rows[0], col + cols[0])


def _yaw_lattice(step: float, window: SearchWindow) -> tuple[F64, float]:
    """Return evenly spaced yaws, with the start's, of a turn or the window, and their step."""
    if window.yaw_rad >= math.pi:
        count = max(4, math.ceil(2.0 * math.pi / step))
        own = 2.0 * math.pi / count
        return np.asarray(window.start[2] + np.arange(count) * own), own
    half = math.ceil(window.yaw_rad / step)
    if half == 0:
        return np.array([window.start[2]]), step
    own = window.yaw_rad / half
    return np.asarray(window.start[2] + np.arange(-half, half + 1) * own), own


class _ShiftSurface:
    """The padded planes and offsets that turn shifts into contiguous reads."""

    def __init__(
        self, ref: Level, mov: Level, rows: tuple[int, int], cols: tuple[int, int], reach: int
    ) -> None:
        self.ref, self.mov = ref, mov
        self.rows, self.cols, self.reach = rows, cols, reach
        self.height = rows[1] - rows[0]
        self.width = cols[1] - cols[0]
        self.lanes = -(-self.width // SHIFT_LANES) * SHIFT_LANES

    def batches(self, yaws: int) -> int:
        """Return the number of batches in which yaws fit into memory."""
        plane = (self.ref.shape[0] + self.height) * (self.ref.shape[1] + self.lanes)
        scores = 2 * np.dtype(np.int32).itemsize * self.height * self.lanes
        return min(yaws, -(-yaws * (plane + scores) // BATCH_BYTES))

    def forward(
        self, field: DeviceArray[np.uint8], base: int, yaws: F64, own: F64, device: ComputeDevice
    ) -> DeviceArray[np.int32]:
        """Moving walls on the reference's field: scores (K, shifts)."""
        reach = self.reach
        plane_shape = (self.height + 2 * reach + 1, self.lanes + 2 * reach + 1)
        corner = (self.cols[0] - reach, self.rows[0] - reach, 0.0)
        plane = device.warp(field, fixed_poses(corner), plane_shape, base)
        cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        x = np.floor(cos * own[:, 0] - sin * own[:, 1] + 0.5).astype(np.int32)
        y = np.floor(sin * own[:, 0] + cos * own[:, 1] + 0.5).astype(np.int32)
        y, x = y + reach, x + reach
        row, col = reach - self.rows[0], reach - self.cols[0]
        box = (row, row + self.ref.shape[0], col, col + self.ref.shape[1])
        spans = shift_spans(y, x, np.array([box]))
        offsets = y * plane_shape[1] + x
        return device.correlate(plane, offsets, (self.height, self.lanes), spans, base)

    def backward(
        self,
        field: DeviceArray[np.uint8],
        base: int,
        yaws: F64,
        points: I32,
        centre: F64,
        device: ComputeDevice,
    ) -> DeviceArray[np.int32]:
        """Reference walls on the moving field, turned; read with shifts running backwards."""
        plane_shape = (self.ref.shape[0] + self.height, self.ref.shape[1] + self.lanes)
        dx = 0.5 - self.cols[0] - self.width
        dy = 0.5 - self.rows[0] - self.height
        cos, sin = np.cos(yaws), np.sin(yaws)
        poses = np.stack(
            (cos * dx + sin * dy + centre[0], -sin * dx + cos * dy + centre[1], -yaws), axis=1
        )
        planes = device.warp(field, fixed_poses(poses), plane_shape, base)
        spans = shift_spans(
            points[None, :, 1], points[None, :, 0], self._boxes(yaws, centre, dx, dy)
        )
        offsets = (points[:, 1] * plane_shape[1] + points[:, 0]).astype(np.int32)[None, :]
        return device.correlate(planes, offsets, (self.height, self.lanes), spans, base)

    def _boxes(self, yaws: F64, centre: F64, dx: float, dy: float) -> npt.NDArray[np.int32]:
        """Return (K, 4) the rows and columns, from and to, of the field in the planes."""
        height, width = self.mov.shape
        corners = np.array([(0, 0), (width, 0), (0, height), (width, height)])
        x, y = (corners - centre).T
        cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        sides = []
        for at in (sin * x + cos * y - dy, cos * x - sin * y - dx):
            sides += [np.floor(at.min(axis=1)) - 1, np.ceil(at.max(axis=1)) + 1]
        return np.stack(sides, axis=1).astype(np.int32)


def parallel_shifts(pair: Pair) -> ShiftScores:
    """Score every shift of one map over another at the yaws at which their walls are parallel."""
    longest = pair.longest
    widest = max(CELL_MAX_M / pair.resolution, longest / (PARALLEL_CELLS * GROWTH_MAX))
    least = max(1.0, min(longest / PARALLEL_CELLS, widest))
    # One that other pairs share.
    power = math.ceil(math.log(least, STEP_GROWTH) - 1e-9)
    step = math.ceil(STEP_GROWTH**power)
    turns = np.radians(parallel_yaws(pair.reference.directions(), pair.moving.directions()))
    return score_shifts(
        pair, step, SearchWindow(), np.append(turns, turns + math.pi), PARALLEL_POINTS
    )


def parallel_yaws(reference: F64, moving: F64) -> list[float]:
    """Return the turns (degrees, 0 to 180) under which walls of two maps are parallel."""
    spectrum = np.fft.rfft(reference) * np.conj(np.fft.rfft(moving))
    whole = np.fft.irfft(spectrum, DIRECTIONS)
    fit = whole.copy()
    least = PEAK_SHARE * float(fit.max())
    yaws: list[float] = []
    around = np.arange(-PEAKS_APART, PEAKS_APART + 1)
    while len(yaws) < PEAKS_MAX and (not yaws or float(fit.max()) >= least):
        peak = int(fit.argmax())
        before, top, after = (float(whole[(peak + near) % DIRECTIONS]) for near in (-1, 0, 1))
        bend = 2.0 * top - before - after
        yaws.append(peak + ((after - before) / (2.0 * bend) if bend > 0.0 else 0.0))
        fit[(peak + around) % DIRECTIONS] = -np.inf
    return yaws
