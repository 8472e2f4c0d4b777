"""Align one grid to another: prepare, search, compare with alternative hypotheses, decide."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from threading import Lock

import numpy as np

from slamfusion.align.answer import conclude
from slamfusion.align.decide import DECISIONS, DecisionKind
from slamfusion.align.features import KEPT_CELLS, GridFeatures
from slamfusion.align.normalize import (
    check_ratio,
    check_resampling,
    common_resolution,
    normalize_grid,
)
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.refine import settle
from slamfusion.align.scores import cut_pieces
from slamfusion.align.search import (
    FINER_CHANCE_MAX,
    SearchResult,
    finer_step,
    ranked,
    search,
    search_window,
    window_around,
)
from slamfusion.align.starts import StartPose, pose_of
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig, FusionConfig, NormalizeConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid

# Half of an alignment is the host's, so a second thread keeps the device busy.
THREADS = 2
# Held while a map is made ready, so that threads do not make one twice.
MAKING = Lock()


def align_grids(
    reference: OccupancyGrid,
    moving: OccupancyGrid,
    config: FusionConfig,
    device: ComputeDevice,
    start: Pose2 | StartPose | None = None,
) -> Alignment:
    """Align one occupancy grid to another.

    Args:
        config: ``align.window_*`` limit the search around a ``start`` that has no tolerances.
        start: expected pose of the moving map frame in the reference's, metres; identity when
            None. With tolerances (``StartPose``) the search looks only within these.

    Raises:
        GridError: a grid has no known cells, or the two have odd resolutions.
        MemoryBudgetError: at their common resolution the grids would not fit into memory.
    """
    check_ratio(moving, reference.resolution)
    check_resampling([reference, moving], config.normalize, "aligning")
    resolution = common_resolution([reference, moving], config.normalize)
    features = []
    for grid in (reference, moving):
        # The last small ones are kept: one truth has many maps.
        make = _kept if _is_small(grid, resolution) else _kept.__wrapped__
        with MAKING:
            features.append(make(grid, resolution, config.normalize, device))
    return align_pair(Pair(*features), config.align, start)


def align_each(
    reference: OccupancyGrid,
    grids: Sequence[OccupancyGrid],
    config: FusionConfig,
    device: ComputeDevice,
) -> Iterator[Alignment]:
    """Align each grid to a reference, see ``align_grids``; yield the results in order.

    Two are aligned at once where all maps are small.
    """
    is_small = all(
        _is_small(one, common_resolution([reference, grid], config.normalize))
        for grid in grids
        for one in (reference, grid)
    )
    with ThreadPoolExecutor(THREADS if is_small else 1) as threads:
        yield from threads.map(lambda grid: align_grids(reference, grid, config, device), grids)


def _is_small(grid: OccupancyGrid, resolution: float) -> bool:
    return grid.cells.size * (grid.resolution / resolution) ** 2 <= KEPT_CELLS


# One reference, and a map of each thread of ``align_each``.
@lru_cache(maxsize=1 + THREADS)
def _kept(
    grid: OccupancyGrid, resolution: float, config: NormalizeConfig, device: ComputeDevice
) -> GridFeatures:
    return GridFeatures(normalize_grid(grid, resolution, config, device), device)


def align_pair(
    pair: Pair,
    config: AlignConfig,
    start: Pose2 | StartPose | None = None,
    pairs: int = 1,
    *,
    thorough: bool = True,
    image_after: Collection[DecisionKind] | None = None,
) -> Alignment:
    """Align two maps that are ready; see ``align_grids``.

    Args:
        pairs: pairs of maps in the job; with more pairs an answer needs more evidence.
        thorough: search a rejected pair again on a finer level.
        image_after: kinds of rejection after which the mirror image is searched too; None: all if
            the search is thorough, else none.
    """
    began = time.perf_counter()
    if (empty := _without_walls(pair)) is not None:
        return empty

    window = window_around(pair, config, start)
    near = f"within {start.reach} of the start" if isinstance(start, StartPose) else None
    if near is not None and window.shift_cells is not None:
        # Whether the two maps, boxes in their circles, can meet at all.
        (height, width), (x, y, _) = pair.reference.shape, window.start
        reach = window.shift_cells + math.hypot(*pair.moving.shape) / 2.0
        if not (-reach <= x <= width + reach and -reach <= y <= height + reach):
            return _rejected(pair, f"the maps do not meet {near}", began)

    found = search_window(pair, config, window)
    if not len(found.motions):
        return _rejected(
            pair, "no fit inside the window; widen it" if near is None else f"no fit {near}", began
        )
    expected = Pose2() if start is None and config.shared_frame else pose_of(start)
    if image_after is None:
        image_after = DECISIONS if thorough else ()

    # Compare the answer with its alternatives, and decide.
    is_finer, coarse = False, found.coarse
    if thorough and found.search == "full" and coarse is not None:
        finer = finer_step(pair, config.coarse_cells, coarse.step, window, FINER_CHANCE_MAX)
        is_finer = finer < coarse.step
    # If a finer level may still support the pair, the mirror image is searched there.
    is_cut = coarse is not None and coarse.is_cut
    found = replace(found, image_after=() if is_finer or is_cut else image_after)
    answer = conclude(pair, config, found, expected, pairs, began, near)
    is_good = answer.evidence is not None and answer.evidence.reading == "good"
    if (answer.accepted and is_good) or not is_finer:
        return answer

    # A pair that is rejected, or is read as bent or changed, is searched on a finer level too; what
    # was found stays a rival.
    coarse, more = search(pair, config, window, FINER_CHANCE_MAX)
    motions = ranked(pair, np.concatenate((more, found.motions)))
    found = replace(found, coarse=coarse, motions=motions, image_after=image_after)
    return conclude(pair, config, found, expected, pairs, began)


def track_pair(pair: Pair, start: Pose2, pairs: int = 1) -> Alignment:
    """Refine a known transform without a search, and decide as with a start there.

    Args:
        start: pose of the moving map frame in the reference's, within about half a metre and a few
            degrees.
    """
    began = time.perf_counter()
    if (empty := _without_walls(pair)) is not None:
        return empty

    def prepare() -> None:
        # The device makes the fields of the next fit and of the decision; the host cuts the walls.
        for grid in pair:
            grid.distances(1, solid=True, everywhere=False)
            grid.start_known(1)
        cut_pieces(pair, pair.widths[0])

    motion = settle(pair, pair.motion_of(start)[None], prepare)
    found = SearchResult(motion, None, "tracked")
    return conclude(pair, AlignConfig(), found, start, pairs, began)


def _without_walls(pair: Pair) -> Alignment | None:
    """Return the rejection of a pair of which a map has no walls; None for another pair."""
    for features in pair:
        if not len(features.wall_points):
            reason = f"{features.grid.name} has no occupied cell, so there is nothing to align"
            return _rejected(pair, reason, time.perf_counter())
    return None


def _rejected(pair: Pair, reason: str, began: float) -> Alignment:
    still, moved = (features.grid.name for features in pair)
    time_s = time.perf_counter() - began
    return Alignment(moving=moved, reference=still, reason=reason, time_s=time_s)
