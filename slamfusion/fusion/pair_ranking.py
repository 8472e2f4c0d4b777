"""Which pairs of many maps are worth an alignment, from what is computed once a map.

Walls of two maps of one place are parallel at few yaws: the peaks of the circular correlation of
their histograms of wall directions. At these yaws the evidence of walls (``wall_evidence``) of
every shift is one product of Fourier spectra, on cells of some half a metre. A pair is promising by
how much its best shift gives more than the best shift elsewhere. This ranks pairs and decides
nothing: what is promising is searched and judged in full.

Sources: Carpin, Fast and accurate map merging for multi-robot systems, Autonomous Robots 25 (2008),
yaws from the directions of walls.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import scipy.fft

from slamfusion.compute import ComputeDevice
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.shifts import COARSE_SIGMA

__all__ = ["RankedPair", "rank_pairs"]

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
C64 = npt.NDArray[np.complex64]

# Cells on the longest side of the larger map of a pair, and on each side of its spectra, where a
# turned map must fit: beyond half of them shifts of little common ground are taken for others.
CELLS, SIZE = 64, 128
# Steps of coarse levels grow by this factor, so that pairs of like sizes share them.
STEP_GROWTH = 1.25
FIELD_TOP = 255
# Directions of walls, degrees; a wall has none beyond 180. Histogram of one degree.
DIRECTIONS = 180
# Cells on the longest side of the picture whose gradients are the directions, and its blur.
DIRECTION_CELLS, DIRECTION_BLUR = 384, 1.2
SMOOTHING = np.array([1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0])
# Peaks of parallel walls: at least so far apart, so high, and not more.
PEAKS_APART, PEAK_SHARE, PEAKS_MAX = 12, 0.5, 3
# Turned maps are kept at multiples of this from their main direction, degrees.
YAW_STEP_DEG = 2
# Shifts this near to the best one, coarse cells, are the same place.
SAME_PLACE_CELLS = 4


@dataclass(frozen=True)
class RankedPair:
    """Two maps and how promising it is to align them.

    Attributes:
        a, b: indices of the maps, the lower one first.
        lead: evidence for the best place above that for the best one elsewhere, in square roots of
            the latter: so chance grows with the walls that two maps have, and large and small maps
            are compared.
        ratio: evidence for the best place over that for the best one elsewhere, at least 1.
    """

    a: int
    b: int
    lead: float
    ratio: float


def rank_pairs(maps: Sequence[GridFeatures], device: ComputeDevice) -> list[RankedPair]:
    """Return every pair of maps that have walls, the most promising first.

    Args:
        maps: at one resolution.
        device: computed the maps.
    """
    able = [index for index, item in enumerate(maps) if len(item.wall_points)]
    walls = {index: wall_directions(maps[index].grid.solid) for index in able}
    coarse: dict[tuple[int, int], _CoarseMap] = {}
    pairs = []
    for a, b in itertools.combinations(able, 2):
        step = _step(max(*maps[a].shape, *maps[b].shape))
        for index in (a, b):
            if (index, step) not in coarse:
                coarse[index, step] = _CoarseMap(maps[index], step, walls[index], device)
        pairs.append(_ranked(a, coarse[a, step], b, coarse[b, step]))
    return sorted(pairs, key=lambda pair: (-pair.lead, pair.a, pair.b))


def _step(side: int) -> int:
    """Return the fine cells per coarse cell for maps of this side."""
    power = math.ceil(math.log(max(1.0, side / CELLS), STEP_GROWTH) - 1e-9)
    return math.ceil(STEP_GROWTH**power)


class _CoarseMap:
    """A map on coarse cells, and its spectra at the yaws that were asked for."""

    def __init__(
        self, features: GridFeatures, step: int, directions: F64, device: ComputeDevice
    ) -> None:
        """Take evidence and walls of one level.

        Args:
            features: of the map.
            step: fine cells per coarse cell.
            directions: of its walls, see ``wall_directions``.
            device: computed the map.
        """
        level = features.level(step)
        table = features.evidence_table(step, COARSE_SIGMA, FIELD_TOP)
        field = device.download(features.field(step, table)).astype(np.float32)
        self._evidence: F32 = (field - np.float32(table.base)) * np.float32(table.unit)
        rows, cols = np.nonzero(device.download(level.wall))
        self._walls = np.column_stack((cols, rows)).astype(np.float64)
        self.directions = directions
        folded = self.directions[: DIRECTIONS // 2] + self.directions[DIRECTIONS // 2 :]
        # The direction of most walls, to which the grid is turned first, degrees.
        self.main_deg = int(folded.argmax())
        self._spectra: dict[int, tuple[C64, C64]] = {}

    def spectra(self, yaw_deg: int) -> tuple[C64, C64]:
        """Return the spectra of the evidence and of the walls, turned by a yaw about the centre."""
        key = yaw_deg % 360
        if key not in self._spectra:
            self._spectra[key] = self._turned(key)
        return self._spectra[key]

    def _turned(self, yaw_deg: int) -> tuple[C64, C64]:
        height, width = self._evidence.shape
        cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
        centre = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
        turn = np.array([[cos, -sin], [sin, cos]])
        shift = (SIZE - 1) / 2.0 - turn @ centre
        evidence = cv2.warpAffine(self._evidence, np.column_stack((turn, shift)), (SIZE, SIZE))
        cols, rows = np.rint(self._walls @ turn.T + shift).astype(np.int64).T % SIZE
        walls = np.zeros((SIZE, SIZE), dtype=np.float32)
        np.add.at(walls, (rows, cols), np.float32(1.0))
        spectra: C64 = scipy.fft.rfft2(np.stack((evidence, walls))).astype(np.complex64, copy=False)
        return spectra[0], spectra[1]


def wall_directions(solid: npt.NDArray[np.uint8]) -> F64:
    """Return the histogram (180,) of directions across walls, mean 0 and length 1.

    Args:
        solid: (H, W) uint8, 1 at wall cells.
    """
    shrink = min(1.0, DIRECTION_CELLS / max(solid.shape))
    size = (max(1, round(solid.shape[1] * shrink)), max(1, round(solid.shape[0] * shrink)))
    picture = cv2.resize(solid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(picture, (0, 0), DIRECTION_BLUR)
    along_x = cv2.Sobel(picture, cv2.CV_32F, 1, 0)
    along_y = cv2.Sobel(picture, cv2.CV_32F, 0, 1)
    weight = along_x * along_x + along_y * along_y
    strong = weight > 0.01 * weight.max()
    degrees = np.degrees(np.arctan2(along_y[strong], along_x[strong])) % DIRECTIONS
    counts = np.bincount(
        degrees.astype(np.int64) % DIRECTIONS, weights=weight[strong], minlength=DIRECTIONS
    )
    reach = len(SMOOTHING) // 2
    wrapped = np.concatenate((counts[-reach:], counts, counts[:reach]))
    smooth = np.convolve(wrapped, SMOOTHING, "valid")
    smooth -= smooth.mean()
    length = float(np.linalg.norm(smooth))
    return np.asarray(smooth / length if length > 0.0 else smooth)


def parallel_yaws(reference: F64, moving: F64) -> list[int]:
    """Return the turns (whole degrees, 0..179) under which walls of two maps are parallel.

    Args:
        reference, moving: see ``wall_directions``.
    """
    spectrum = np.fft.rfft(reference) * np.conj(np.fft.rfft(moving))
    fit = np.fft.irfft(spectrum, DIRECTIONS)
    least = PEAK_SHARE * float(fit.max())
    yaws: list[int] = []
    around = np.arange(-PEAKS_APART, PEAKS_APART + 1)
    while len(yaws) < PEAKS_MAX and (not yaws or float(fit.max()) >= least):
        yaws.append(int(fit.argmax()))
        fit[(yaws[-1] + around) % DIRECTIONS] = -np.inf
    return yaws


def _ranked(a: int, reference: _CoarseMap, b: int, moving: _CoarseMap) -> RankedPair:
    """Score every shift of one map over another at the yaws at which their walls are parallel."""
    still, still_walls = reference.spectra(-reference.main_deg)
    products = []
    for yaw in parallel_yaws(reference.directions, moving.directions):
        # Turned to the main direction of either, a yaw is nearly a multiple of the step.
        beyond = (yaw - reference.main_deg + moving.main_deg) / YAW_STEP_DEG
        turned = round(beyond) * YAW_STEP_DEG - moving.main_deg
        for half_turn in (0, 180):
            evidence, walls = moving.spectra(turned + half_turn)
            products.append(still * np.conj(walls) + np.conj(evidence) * still_walls)
    scores = scipy.fft.irfft2(np.stack(products), s=(SIZE, SIZE))
    best = int(scores.argmax())
    index, row, col = (int(value) for value in np.unravel_index(best, scores.shape))
    top = float(scores[index, row, col])
    around = np.arange(-SAME_PLACE_CELLS, SAME_PLACE_CELLS + 1)
    scores[index][np.ix_((row + around) % SIZE, (col + around) % SIZE)] = -np.inf
    second = max(float(scores.max()), 1.0)
    return RankedPair(a, b, (top - second) / math.sqrt(second), top / second)
