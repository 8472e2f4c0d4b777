"""Every whole-cell shift of one coarse grid over another, at every yaw: ranges, planes, scores.

The walls of each map on the evidence field of the other, both ways (see ``likelihood``). The
planes are padded, so that all shifts of a point lie side by side in memory.
"""

from __future__ import annotations

import functools
import math
from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import scipy

from slamfusion.align.features import GridFeatures, Level, spread_sample
from slamfusion.align.pair import Pair
from slamfusion.compute import ComputeDevice
from slamfusion.compute.arrays import DeviceArray
from slamfusion.compute.lattice import fixed_poses, grouped, shift_spans
from slamfusion.compute.layout import SHIFT_LANES
from slamfusion.geometry import F64

I32 = npt.NDArray[np.int32]
F32 = npt.NDArray[np.float32]
C64 = npt.NDArray[np.complex64]

# Sixteen values fit the packed adds of the correlate kernel.
COARSE_TOP = 15
# Width of a wall on coarse levels, cells.
COARSE_SIGMA = 0.75
# Walls of each map that judge a shift; of half as many and of nearly three times as many the
# right one ranks as high.
COARSE_POINTS = 384
# Cells that the walls at this percentile of their radii move from one yaw to the next.
YAW_STEP_CELLS = 1.3
RIM_PERCENTILE = 90.0
# Memory that yaws take that are scored at once: of more, each batch would be given new pages, which
# costs more than more launches do.
BATCH_BYTES = 1 << 23
# Cells on the longest side of the larger map of a pair, and on each side of its spectra, where a
# turned map must fit: beyond half of them shifts of little common ground are taken for others.
SPECTRUM_CELLS, SPECTRUM_SIZE = 64, 128
# The widest coarse cell, metres: a third of a narrow corridor with its two walls. Where a map has
# more of them than SPECTRUM_CELLS on a side its spectra are twice as large, or four or eight times.
CELL_MAX_M, GROWTH_MAX = 0.75, 8
# Steps of coarse levels grow by this factor, so that pairs of like sizes share them.
STEP_GROWTH = 1.25
SPECTRUM_TOP = 255
# Directions of walls, degrees; a wall has none beyond 180. Histogram of one degree.
DIRECTIONS = 180
# Cells on the longest side of the picture whose gradients are the directions, its blur, and the
# reach over which gradients of a wall are one direction, both cells.
DIRECTION_CELLS, DIRECTION_BLUR, DIRECTION_REACH = 768, 2.0, 3.0
SMOOTHING = np.array([1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0])
# Peaks of parallel walls: at least so far apart, so high, and not more.
PEAKS_APART, PEAK_SHARE, PEAKS_MAX = 12, 0.5, 3
# Turned maps are kept at multiples of this from their main direction, degrees, where a map has
# SPECTRUM_CELLS on a side; of more cells at finer ones, since the ends of a map move by as much.
YAW_STEP_DEG = 2.0
KEYS_PER_DEG = 4
# Spectra that are kept, bytes: all of a hundred maps of SPECTRUM_CELLS; of larger the last ones.
KEPT_BYTES = 2**28
# Shifts this near to the best one, coarse cells, are the same place.
SAME_PLACE_CELLS = 4


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
class ShiftScores:
    """The evidence for the best shift of each tile at each yaw.

    Attributes:
        step: fine cells per cell.
        yaws: (K,) yaw in rad.
        yaw_step: rad from one yaw to the next.
        evidence: (K, T) nats per cell of wall, summed over the sampled walls of both maps.
        rows, cols: (K, T) cell of the level where the moving centre lands.
        work: field values that were added.
    """

    step: int
    yaws: F64
    yaw_step: float
    evidence: F64
    rows: I32
    cols: I32
    work: float

    def motions(self, chosen: npt.NDArray[np.intp]) -> F64:
        """Return (P, 3) where the moving centre lands, fine cells, and yaw.

        Args:
            chosen: (P,) of the tiles of all yaws, counted along ``evidence``.
        """
        x, y = ((axis.ravel()[chosen] + 0.5) * self.step for axis in (self.cols, self.rows))
        return np.stack((x, y, self.yaws[chosen // self.evidence.shape[1]]), axis=1)


def shift_range(
    size: int, reach: int, start: float, window: SearchWindow, step: int
) -> tuple[int, int]:
    """Return the half-open range of cells where the moving centre may land along one axis.

    Wherever the circle around the moving walls overlaps the reference at all.
    """
    if window.shift_cells is not None:
        half = window.shift_cells / step
        return math.floor(start - half), math.floor(start + half) + 1
    return -reach, size + reach + 1


def shift_work(pair: Pair, step: int, window: SearchWindow) -> float:
    """Return how many field values ``score_shifts`` adds at most: it grows as ``step``^-3.

    Args:
        pair, step, window: as there.
    """
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


def score_shifts(pair: Pair, step: int, window: SearchWindow) -> ShiftScores:
    """Score every whole-cell shift at every yaw on one level of both grids.

    Args:
        pair: the two maps.
        step: of the level, fine cells per cell.
        window: where to search.
    """
    ref, mov = pair.reference.level(step), pair.moving.level(step)
    centre = np.array(pair.moving.centre) / step
    from_mov = spread_sample(mov.points, COARSE_POINTS)
    from_ref = spread_sample(ref.points, COARSE_POINTS)
    from_mov, from_ref = from_mov[grouped(from_mov)], from_ref[grouped(from_ref)]
    own = from_mov / 2.0 - centre
    radii = np.hypot(own[:, 0], own[:, 1])
    rim = max(1.0, float(np.percentile(radii, RIM_PERCENTILE)))
    yaws, yaw_step = _yaw_lattice(YAW_STEP_CELLS / rim, window)
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
    work = float(len(yaws) * surface.height * surface.lanes) * (len(from_mov) + len(from_ref))
    return ShiftScores(step, yaws, yaw_step, evidence, row + rows[0], col + cols[0], work)


def _yaw_lattice(step: float, window: SearchWindow) -> tuple[F64, float]:
    """Return evenly spaced yaws, the start's among them, and their distance.

    A full turn, or the window.
    """
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
        """Return in how many batches so many yaws are scored, for all to fit into memory."""
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
        """Return (K, 4) from and to which row and column ``backward``'s planes show the field."""
        height, width = self.mov.shape
        corners = np.array([(0, 0), (width, 0), (0, height), (width, height)])
        x, y = (corners - centre).T
        cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        sides = []
        for at in (sin * x + cos * y - dy, cos * x - sin * y - dx):
            sides += [np.floor(at.min(axis=1)) - 1, np.ceil(at.max(axis=1)) + 1]
        return np.stack(sides, axis=1).astype(np.int32)


def level_for(side: int, resolution: float) -> tuple[int, int]:
    """Return the fine cells per coarse cell for maps of this side, and by what spectra grow."""
    growth = 1
    while (step := _shared_step(side / (SPECTRUM_CELLS * growth))) * resolution > CELL_MAX_M:
        if growth == GROWTH_MAX:
            break
        growth *= 2
    return step, growth


def _shared_step(least: float) -> int:
    """Return a step of at least so many cells that others share."""
    power = math.ceil(math.log(max(1.0, least), STEP_GROWTH) - 1e-9)
    return math.ceil(STEP_GROWTH**power)


class KeptSpectra:
    """Spectra by any key; beyond so many bytes those that were not asked for longest go."""

    def __init__(self) -> None:
        self._spectra: OrderedDict[object, tuple[C64, C64]] = OrderedDict()
        self._bytes = 0

    def get(self, key: object) -> tuple[C64, C64] | None:
        """Return what is kept under a key."""
        found = self._spectra.get(key)
        if found is not None:
            self._spectra.move_to_end(key)
        return found

    def keep(self, key: object, spectra: tuple[C64, C64]) -> None:
        """Keep spectra under a key."""
        self._spectra[key] = spectra
        self._bytes += sum(item.nbytes for item in spectra)
        while self._bytes > KEPT_BYTES and len(self._spectra) > 1:
            _, oldest = self._spectra.popitem(last=False)
            self._bytes -= sum(item.nbytes for item in oldest)


class TurnedMap:
    """A map on coarse cells, and its spectra at the yaws that were asked for."""

    def __init__(
        self,
        features: GridFeatures,
        step: int,
        growth: int,
        directions: F64,
        device: ComputeDevice,
        kept: KeptSpectra,
    ) -> None:
        """Take evidence and walls of one level.

        Args:
            features: of the map.
            step: fine cells per coarse cell.
            growth: of the spectra's sides.
            directions: of its walls, see ``wall_directions``.
            device: computed the map.
            kept: spectra of all maps.
        """
        level = features.level(step)
        table = features.evidence_table(step, COARSE_SIGMA, SPECTRUM_TOP)
        field = device.download(features.field(step, table)).astype(np.float32)
        self._evidence: F32 = (field - np.float32(table.base)) * np.float32(table.unit)
        rows, cols = np.nonzero(device.download(level.wall))
        self._walls = np.column_stack((cols, rows)).astype(np.float64)
        self.directions = directions
        folded = self.directions[: DIRECTIONS // 2] + self.directions[DIRECTIONS // 2 :]
        # The direction of most walls, to which the grid is turned first, degrees.
        self.main_deg = int(folded.argmax())
        self.step = step
        # Of the level, and of the map, fine cells, x and y.
        self.middle: F64 = np.array(field.shape[::-1]) * step / 2.0
        self.centre: F64 = np.array(features.centre)
        self.size, self.yaw_step_deg = SPECTRUM_SIZE * growth, YAW_STEP_DEG / growth
        self._kept = kept

    def spectra(self, yaw_deg: float, scale: float = 1.0) -> tuple[C64, C64]:
        """Return the spectra of the evidence and of the walls, turned and scaled about the centre.

        Args:
            yaw_deg: by which the map is turned.
            scale: by which it is enlarged; a cell of wall then counts as much more.
        """
        half_turns, key = divmod(round(yaw_deg * KEYS_PER_DEG), 180 * KEYS_PER_DEG)
        found = self._kept.get((self, key, scale))
        if found is None:
            found = self._turned(key / KEYS_PER_DEG, scale)
            self._kept.keep((self, key, scale), found)
        if half_turns % 2 == 0:
            return found
        # Read from its end, a picture has the conjugate spectrum, shifted by one cell.
        turn = _half_turn(self.size)
        return np.conj(found[0]) * turn, np.conj(found[1]) * turn

    def _turned(self, yaw_deg: float, scale: float) -> tuple[C64, C64]:
        height, width = self._evidence.shape
        turn = scale * _rotation(math.radians(yaw_deg))
        centre = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
        shift = (self.size - 1) / 2.0 - turn @ centre
        sides = (self.size, self.size)
        evidence = cv2.warpAffine(self._evidence, np.column_stack((turn, shift)), sides)
        cols, rows = np.rint(self._walls @ turn.T + shift).astype(np.int64).T % self.size
        walls = np.zeros(sides, dtype=np.float32)
        np.add.at(walls, (rows, cols), np.float32(scale))
        spectra: C64 = scipy.fft.rfft2(np.stack((evidence, walls))).astype(np.complex64, copy=False)
        return spectra[0], spectra[1]


@functools.cache
def _half_turn(size: int) -> C64:
    """Return what the conjugate spectrum of a square picture is to be multiplied by."""
    phase = np.exp(2j * math.pi * np.arange(size) / size)
    return np.asarray(np.outer(phase, phase[: size // 2 + 1]), dtype=np.complex64)


def wall_directions(solid: npt.NDArray[np.uint8]) -> F64:
    """Return the histogram (180,) of directions across walls, mean 0 and length 1.

    Args:
        solid: (H, W) uint8, 1 at wall cells.
    """
    shrink = min(1.0, DIRECTION_CELLS / max(solid.shape))
    size = (max(1, round(solid.shape[1] * shrink)), max(1, round(solid.shape[0] * shrink)))
    # Shrunken in whole numbers: of a large map a picture of floats is much memory.
    small = cv2.resize(solid * np.uint8(255), size, interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(small.astype(np.float32), (0, 0), DIRECTION_BLUR)
    along_x = cv2.Scharr(picture, cv2.CV_32F, 1, 0)
    along_y = cv2.Scharr(picture, cv2.CV_32F, 0, 1)
    xx, yy, xy = (
        cv2.GaussianBlur(product, (0, 0), DIRECTION_REACH)
        for product in (along_x * along_x, along_y * along_y, along_x * along_y)
    )
    # The structure tensor's main axis, and how much longer it is than the other.
    weight = np.hypot(xx - yy, 2.0 * xy)
    strong = weight > 0.01 * weight.max()
    degrees = np.degrees(np.arctan2(2.0 * xy[strong], (xx - yy)[strong]) / 2.0) % DIRECTIONS
    # Shared by the two whole degrees beside it.
    below = np.floor(degrees)
    above = (degrees - below) * weight[strong]
    counts: F64 = np.zeros(DIRECTIONS)
    for more, part in enumerate((weight[strong] - above, above)):
        counts += np.bincount((below.astype(np.int64) + more) % DIRECTIONS, part, DIRECTIONS)
    reach = len(SMOOTHING) // 2
    wrapped = np.concatenate((counts[-reach:], counts, counts[:reach]))
    smooth = np.convolve(wrapped, SMOOTHING, "valid")
    smooth -= smooth.mean()
    length = float(np.linalg.norm(smooth))
    return np.asarray(smooth / length if length > 0.0 else smooth)


def parallel_yaws(reference: F64, moving: F64) -> list[float]:
    """Return the turns (degrees, 0 to 180) under which walls of two maps are parallel.

    Args:
        reference, moving: see ``wall_directions``.
    """
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


@dataclass(frozen=True, eq=False)
class ParallelShifts:
    """The evidence for every shift at each yaw at which walls are parallel.

    Attributes:
        yaws_deg: (K,) of the moving map, after the reference is turned by ``-main_deg``.
        main_deg: direction of most walls of the reference.
        scores: (K, S, S) nats a coarse cell; shifts run around, so the second half is negative.
    """

    yaws_deg: F64
    main_deg: float
    scores: F32

    def peak(self) -> tuple[float, tuple[int, int, int]]:
        """Return the most evidence, and where in ``scores`` it is."""
        best = int(self.scores.argmax())
        index, row, col = (int(value) for value in np.unravel_index(best, self.scores.shape))
        return float(self.scores[index, row, col]), (index, row, col)

    def forget(self, place: tuple[int, int, int]) -> None:
        """Take a peak and the shifts that are the same place out of ``scores``."""
        index, row, col = place
        size = self.scores.shape[1]
        around = np.arange(-SAME_PLACE_CELLS, SAME_PLACE_CELLS + 1)
        self.scores[index][np.ix_((row + around) % size, (col + around) % size)] = -np.inf

    def motions(self, reference: TurnedMap, moving: TurnedMap, most: int) -> F64:
        """Return the best motions (P, 3), ``most`` at each yaw: see ``pair``; takes them out.

        Args:
            reference, moving: that were compared.
            most: at each yaw.
        """
        size, found = self.scores.shape[1], []
        for index, yaw_deg in enumerate(self.yaws_deg):
            plane = self.scores[index]
            for _ in range(most):
                row, col = divmod(int(plane.argmax()), size)
                self.forget((index, row, col))
                shift = [(value + size // 2) % size - size // 2 for value in (col, row)]
                yaw = math.radians(yaw_deg + self.main_deg)
                place = reference.middle + reference.step * (
                    _rotation(math.radians(self.main_deg)) @ shift
                )
                place = place + _rotation(yaw) @ (moving.centre - moving.middle)
                found.append((*place, math.remainder(yaw, 2.0 * math.pi)))
        return np.array(found).reshape(-1, 3)


def _rotation(yaw: float) -> F64:
    """Return a rotation (2, 2) by radians."""
    return np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])


def parallel_shifts(reference: TurnedMap, moving: TurnedMap, scale: float = 1.0) -> ParallelShifts:
    """Score every shift of one map over another at the yaws at which their walls are parallel.

    Args:
        reference, moving: of one level.
        scale: by which the moving map is enlarged.
    """
    still, still_walls = reference.spectra(-reference.main_deg)
    yaws = []
    for yaw in parallel_yaws(reference.directions, moving.directions):
        # Turned to the main direction of either, a yaw is nearly a multiple of the step.
        step_deg = moving.yaw_step_deg
        beyond = (yaw - reference.main_deg + moving.main_deg) / step_deg
        turned = round(beyond) * step_deg - moving.main_deg
        yaws += [turned, turned + 180.0]
    sides = (reference.size, reference.size)
    scores: F32 = np.empty((len(yaws), *sides), dtype=np.float32)
    for plane, yaw in zip(scores, yaws, strict=True):
        evidence, walls = moving.spectra(yaw, scale)
        product = still * np.conj(walls)
        product += np.conj(evidence) * still_walls
        plane[:] = scipy.fft.irfft2(product, s=sides, overwrite_x=True)
    return ParallelShifts(np.array(yaws), reference.main_deg, scores)


def parallel_motions(pair: Pair, most: int) -> tuple[F64, int, float]:
    """Return the best motions at the yaws at which walls of two maps are parallel.

    Args:
        pair: the two maps.
        most: motions at each yaw.

    Returns:
        Motions (P, 3), see ``pair``; fine cells per cell of the level; yaw from one that is
        looked at to the next, rad.
    """
    size = pair.resolution
    level = level_for(pair.longest, size)
    kept = KeptSpectra()
    still, turned = (
        TurnedMap(item, *level, wall_directions(item.grid.solid), pair.device, kept)
        for item in pair
    )
    motions = parallel_shifts(still, turned).motions(still, turned, most)
    return motions, level[0], math.radians(still.yaw_step_deg)
