"""Every whole-cell shift of one coarse grid over another, at every yaw: ranges, planes, scores.

The walls of each map are scored on the evidence field of the other, both ways (see ``likelihood``).
The planes are padded, so that all shifts of a point are contiguous in memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamfusion.align.features import DIRECTIONS, spread_sample
from slamfusion.align.pair import Pair
from slamfusion.compute.lattice import fixed_poses, from_the_end, grouped, shift_spans
from slamfusion.compute.layout import SHIFT_LANES
from slamfusion.compute.search import ShiftedSide
from slamfusion.geometry import F64, I32

# Sixteen values fit the packed adds of ``best_shifts``.
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
    from_mov, from_ref = from_mov[grouped(from_mov)], from_ref[grouped(from_ref)] // 2
    own = from_mov / 2.0 - centre
    radii = np.hypot(own[:, 0], own[:, 1])
    rim = max(1.0, float(np.percentile(radii, RIM_PERCENTILE)))
    even, yaw_step = _yaw_lattice(YAW_STEP_CELLS / rim, window)
    yaws = even if yaws is None else yaws
    reach = math.ceil(float(radii.max())) + 1
    rows = shift_range(ref.shape[0], reach, window.start[1] / step, window, step)
    cols = shift_range(ref.shape[1], reach, window.start[0] / step, window, step)
    height, width = rows[1] - rows[0], cols[1] - cols[0]
    lanes = -(-width // SHIFT_LANES) * SHIFT_LANES
    device = pair.device
    ours, on_ref = pair.reference.field(step, COARSE_SIGMA, COARSE_TOP, 0.0)
    theirs, on_mov = pair.moving.field(step, COARSE_SIGMA, COARSE_TOP, 0.0)
    # Moving walls on the reference's field.
    ahead_shape = (height + 2 * reach + 1, lanes + 2 * reach + 1)
    corner = fixed_poses((cols[0] - reach, rows[0] - reach, 0.0))
    on_ref = device.warp(on_ref, corner, ahead_shape, ours.base)
    low, left = reach - rows[0], reach - cols[0]
    whole = np.array([(low, low + ref.shape[0], left, left + ref.shape[1])])
    # Reference walls on the moving field, turned, and read from its end: all shifts run forwards.
    back_shape = (ref.shape[0] + height, ref.shape[1] + lanes)
    x0, y0 = 0.5 - cols[0] - width, 0.5 - rows[0] - height
    last_x, last_y = ref.shape[1] + width - 2, ref.shape[0] + height - 2
    corners = np.array([(x, y) for y in (0, mov.shape[0]) for x in (0, mov.shape[1])]) - centre
    back_x, back_y = (np.array(ref.shape[::-1]) - 1 - from_ref).astype(np.int32).T[:, None]
    back_offsets = back_y * back_shape[1] + back_x
    # Batches of yaws that fit into memory.
    peaks = []
    for some in np.array_split(
        yaws, min(len(yaws), -(-len(yaws) * math.prod(back_shape) // BATCH_BYTES))
    ):
        cos, sin = np.cos(some)[:, None], np.sin(some)[:, None]
        x = np.floor(cos * own[:, 0] - sin * own[:, 1] + 0.5).astype(np.int32) + reach
        y = np.floor(sin * own[:, 0] + cos * own[:, 1] + 0.5).astype(np.int32) + reach
        spans, offsets = shift_spans(y, x, whole), y * ahead_shape[1] + x
        ahead = ShiftedSide(on_ref, offsets, spans, ours.base)
        poses = np.column_stack(
            (cos * x0 + sin * y0 + centre[0], -sin * x0 + cos * y0 + centre[1], -some)
        )
        turned = from_the_end(fixed_poses(poses), (last_x, last_y))
        planes = device.warp(on_mov, turned, back_shape, theirs.base)
        # The rows and columns, from and to, of the field in the planes.
        sides = []
        for at in (
            last_y + y0 + 1 - sin * corners[:, 0] - cos * corners[:, 1],
            last_x + x0 + 1 - cos * corners[:, 0] + sin * corners[:, 1],
        ):
            sides += [np.floor(at.min(axis=1)) - 1, np.ceil(at.max(axis=1)) + 1]
        boxes = np.stack(sides, axis=1).astype(np.int32)
        spans = shift_spans(back_y, back_x, boxes)
        back = ShiftedSide(planes, back_offsets, spans, theirs.base)
        found = device.best_shifts(ahead, back, (height, width))
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
