"""Search the unknown scale of a map, such as a floor plan, then align as usual.

The plan is compared with the reference on coarse cells at each scale, at the yaws at which walls
are parallel (see ``shifts``). It is aligned at the best scales, and the decision counts every tried
scale as one more pair of the job.
"""

from __future__ import annotations

import math
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from slamfusion.align.align import align_pair
from slamfusion.align.decide import SCALE_MAX
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import check_resampling, normalize_grid
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.scores import walls_found
from slamfusion.align.shifts import parallel_shifts
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.errors import ConfigError, GridError, MemoryBudgetError
from slamfusion.geometry import F64
from slamfusion.grid import OccupancyGrid

# A scale is searched from half to twice the stated one.
FACTOR = 2.0
# Ratio of successive scales: the ends of a building of 40 m move by 0.3 m, less than a coarse cell.
SCALE_STEP = 1.03
# Cells for comparing scales, and for aligning at the best few, metres.
RANKED_CELL_M, TRIED_CELL_M = 0.2, 0.1
# The most tried scales, and the least evidence as a share of the best one's.
TRIED, TRIED_SHARE = 4, 0.5
# Wall points of each map in the search for the best scale.
POINTS = 4096
# The scales around that of an alignment among which the best is found; ``piece_sums`` allows no 2.
NEARBY = (1.0 / 1.5, 1.5)
# Rounds of alignment at a better scale, the change at which they end, and the last step as a share
# of the width of a wall.
ROUNDS, SETTLED_WITHIN, LAST_STEP = 4, 0.002, 1.0 / 16.0


def align_at_any_scale(
    reference: OccupancyGrid,
    moving: OccupancyGrid,
    config: FusionConfig,
    device: ComputeDevice,
    scales: tuple[float, float],
) -> tuple[float, Alignment]:
    """Align a map whose scale is not known.

    Args:
        scales: the least and the greatest factor on the resolution of ``moving``.

    Returns:
        By which the moving map's cells are larger than it says, and the alignment with such cells,
        which may be used only where it is accepted.

    Raises:
        ConfigError: the factors are not positive or not in order.
        GridError: a grid has no known or no occupied cells.
        MemoryBudgetError: at their common resolution the grids would not fit into memory.
    """
    began = time.perf_counter()
    lowest, highest = scales
    if not 0.0 < lowest <= highest < math.inf:
        message = f"scales from {lowest:g} to {highest:g}: give two positive factors, least first"
        raise ConfigError(message)
    search = _ScaleSearch(moving, scales, config, device)
    gains = search.gains(reference)
    scale, alignment = search.best(reference, gains)
    if not alignment.accepted:
        image = replace(reference, cells=np.ascontiguousarray(reference.cells[:, ::-1]))
        of_image = search.gains(image)
        if of_image.max() > gains.max():
            drawn_at, mirrored = search.best(image, of_image)
            if mirrored.accepted:
                reason = (
                    f"{moving.name} fits only as its mirror image (at {drawn_at:.3g} times its "
                    "scale): was it drawn or printed mirrored?"
                )
                alignment = replace(alignment, reason=reason, decision="mirrored")
    return scale, replace(alignment, time_s=time.perf_counter() - began)


def wrong_resolution(
    reference: OccupancyGrid, moving: OccupancyGrid, config: FusionConfig, device: ComputeDevice
) -> str | None:
    """Return the resolution a moving map should have if it fits only at another scale, in words.

    None if it does not fit at another scale either.
    """
    search = _ScaleSearch(moving, (1.0 / FACTOR, FACTOR), config, device)
    with suppress(GridError, MemoryBudgetError):
        scale, alignment = search.best(reference, search.gains(reference))
        if alignment.accepted and abs(scale - 1.0) >= SCALE_MAX:
            return (
                f"its resolution should be {moving.resolution * scale:.3g} m, "
                f"it says {moving.resolution:.3g} m (if that of {reference.name} is right)"
            )
    return None


def explained(
    alignment: Alignment,
    reference: OccupancyGrid,
    moving: OccupancyGrid,
    config: FusionConfig,
    device: ComputeDevice,
) -> Alignment:
    """Return an alignment, its reason the wrong resolution if that is why it was rejected."""
    if alignment.accepted or alignment.evidence is None or alignment.decision == "mirrored":
        return alignment
    words = wrong_resolution(reference, moving, config, device)
    return replace(alignment, reason=words, decision="other scale") if words else alignment


class _ScaleSearch:
    """A plan on coarse cells at all scales, to be compared with a map and with its image."""

    def __init__(
        self,
        plan: OccupancyGrid,
        scales: tuple[float, float],
        config: FusionConfig,
        device: ComputeDevice,
    ) -> None:
        self.plan, self.config, self.device = plan, config, device
        count = math.ceil(math.log(scales[1] / scales[0]) / math.log(SCALE_STEP)) + 1
        self.scales = np.geomspace(*scales, count)
        self._drawn: dict[float, GridFeatures] = {}

    def best(self, reference: OccupancyGrid, gains: F64) -> tuple[float, Alignment]:
        """Align at the scales with the highest gains, and settle the best on ``reference``."""
        cell = self.config.normalize.resolution or reference.resolution
        seen = self._ready(reference, max(cell, TRIED_CELL_M))
        tries = [self._aligned(seen, scale) for scale in self.scales[_peaks(gains)].tolist()]
        scale, best, pair = min(tries, key=lambda one: _standing(one[1]))
        seen, settled = self._ready(reference, cell), []
        for _ in range(ROUNDS):
            better = None if best.evidence is None else best.evidence.scale
            if better is None or better == 1.0:
                better = best_scale(pair, pair.motion_of(best.transform))
            better = np.clip(scale * better, *self.scales[[0, -1]]).item() / scale
            if abs(better - 1.0) < SETTLED_WITHIN and pair.reference is seen:
                break
            scale, best, pair = self._aligned(seen, scale * better)
            settled.append((scale, best))
        return min(settled, key=lambda one: _standing(one[1]))

    def gains(self, reference: OccupancyGrid) -> F64:
        """Return the most evidence of any place on the reference at each scale, nats and metres."""
        still, found = self._ready(reference, RANKED_CELL_M), []
        for scale in self.scales.tolist():
            if scale not in self._drawn:
                self._drawn[scale] = self._ready(scaled(self.plan, scale), RANKED_CELL_M)
            pair = Pair(still, self._drawn[scale])
            shifts = parallel_shifts(pair)
            found.append(shifts.best_two()[0] * shifts.step * RANKED_CELL_M)
        return np.array(found)

    def _aligned(self, reference: GridFeatures, scale: float) -> tuple[float, Alignment, Pair]:
        """Align the plan at a scale on the reference's cells."""
        plan = scaled(self.plan, scale)
        check_resampling([reference.grid.grid, plan], self.config.normalize, "aligning")
        pair = Pair(reference, self._ready(plan, reference.grid.grid.resolution))
        count = len(self.scales)
        alignment = align_pair(pair, self.config.align, None, count, thorough=False)
        return scale, alignment, pair

    def _ready(self, grid: OccupancyGrid, cell: float) -> GridFeatures:
        normalized = normalize_grid(grid, cell, self.config.normalize, self.device)
        features = GridFeatures(normalized, self.device)
        if not len(features.wall_points):
            raise GridError(f"{grid.name} has no occupied cell, so there is nothing to align")
        return features


def scaled(grid: OccupancyGrid, scale: float) -> OccupancyGrid:
    """Return a map with cells larger by a factor."""
    return replace(grid, resolution=grid.resolution * scale)


def _standing(alignment: Alignment) -> tuple[bool, float]:
    """Sort key: those accepted here or at a nearby scale first, then by expected wrong answers."""
    is_here = alignment.decision in {"accepted", "other scale"}
    evidence = alignment.evidence
    return not is_here, math.inf if evidence is None else evidence.expected_wrong


def _peaks(gains: F64) -> npt.NDArray[np.intp]:
    """Return the scales to try, best first: no neighbour within two steps is better."""
    padded = np.pad(gains, 2, constant_values=-np.inf)
    most = np.lib.stride_tricks.sliding_window_view(padded, 5).max(axis=1)
    peaks = np.flatnonzero((gains == most) & (gains >= TRIED_SHARE * gains.max()))
    return peaks[np.argsort(-gains[peaks], kind="stable")][:TRIED]


def best_scale(pair: Pair, motion: F64) -> float:
    """Return the scale of the best fit, found step by step from a motion (3,).

    Only the robot's walls decide: it sees outer walls from inside, and their outer sides would pull
    the plan's walls inwards.
    """
    sigma = pair.widths[0]
    reach = math.hypot(*pair.moving.shape) / 4.0
    around = np.stack(np.meshgrid(*[[0, -1, 1]] * 4, indexing="ij"), axis=-1).reshape(-1, 4)
    at, step = np.array([*motion, 1.0]), 1.0
    while step >= LAST_STEP:
        near = at + around * step * np.array([sigma, sigma, sigma / reach, sigma / reach])
        near[:, 3] = near[:, 3].clip(*NEARBY)
        scales = np.ascontiguousarray(near[:, 3])
        best = int(walls_found(pair, near[:, :3], sigma, scales, POINTS).argmax())
        at = near[best]
        if best == 0:
            step /= 2.0
    return float(at[3])
