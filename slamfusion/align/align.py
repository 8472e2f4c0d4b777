"""Align one grid to another: search, measure, decide."""

from __future__ import annotations

import math
import time
from collections.abc import Collection
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from slamfusion.align.accept import DECISIONS, DecisionKind
from slamfusion.align.cancel import CancelToken
from slamfusion.align.features import GridFeatures
from slamfusion.align.fixed_step import fixed_step_search
from slamfusion.align.frames import motion_of
from slamfusion.align.judge import judge, prior_within, rejected_alignment
from slamfusion.align.normalize import check_resampling, common_resolution, normalize_grid
from slamfusion.align.records import Alignment
from slamfusion.align.refine import settle
from slamfusion.align.rivals import Found
from slamfusion.align.search import (
    FINER_CHANCE_MAX,
    finer_step,
    score_motions,
    search,
    wall_widths,
)
from slamfusion.align.shifts import SearchWindow
from slamfusion.align.start import StartPose, pose_of
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig, FusionConfig
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid

F64 = npt.NDArray[np.float64]


def align_grids(
    reference: OccupancyGrid,
    moving: OccupancyGrid,
    config: FusionConfig,
    device: ComputeDevice,
    start: Pose2 | StartPose | None = None,
) -> Alignment:
    """Align one occupancy grid to another.

    Args:
        reference: held still.
        moving: gets the transform.
        config: normalisation and search; ``config.align.window_*`` limit the search around a
            ``start`` that has no tolerances.
        device: computes.
        start: expected pose of the moving map frame in the reference's, metres; identity when
            None. With tolerances (``StartPose``) the search looks only within these.

    Returns:
        The alignment; also when it is rejected, with the reason.

    Raises:
        GridError: a grid has no known cells.
        MemoryBudgetError: at their common resolution the grids would not fit into memory.
    """
    check_resampling([reference, moving], config.normalize, "aligning")
    resolution = common_resolution([reference, moving], config.normalize)
    features = [
        GridFeatures(normalize_grid(grid, resolution, config.normalize, device), device)
        for grid in (reference, moving)
    ]
    return align_features(features[0], features[1], config.align, device, start)


def align_features(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    device: ComputeDevice,
    start: Pose2 | StartPose | None = None,
    cancel: CancelToken | None = None,
    pairs: int = 1,
    *,
    thorough: bool = True,
    image_after: Collection[DecisionKind] | None = None,
) -> Alignment:
    """Align two prepared grids; see ``align_grids``.

    Args:
        reference, moving, config, device, start: as there.
        cancel: asked before each operation.
        pairs: pairs of maps in the job: the more there are, the more an answer has to show.
        thorough: search a pair that is refused once more on a finer level.
        image_after: kinds of refusals after which the mirror image is searched too; None: all where
            the search is thorough, else none.

    Raises:
        CancelledSearchError: ``cancel`` says so; what was computed of the grids is kept.
    """
    began = time.perf_counter()
    for features in (reference, moving):
        if not len(features.wall_points):
            reason = f"{features.grid.name} has no occupied cell, so there is nothing to align"
            return rejected_alignment(reference, moving, reason, time.perf_counter() - began)
    given = start if isinstance(start, StartPose) else None
    window = _window(reference, moving, config, start)
    if given is not None and not _meets(reference, moving, window):
        reason = f"the maps do not meet within {given.reach} of the start"
        return rejected_alignment(reference, moving, reason, time.perf_counter() - began)
    if config.step is not None:
        motion = fixed_step_search(reference, moving, config.step, window, device, cancel)
        found = Found(motion[None], None, "fixed step")
    else:
        found = _searched(reference, moving, config, window, device, cancel)
    if not len(found.motions):
        reason = "no fit inside the window; widen it"
        if given is not None:
            reason = f"no fit within {given.reach} of the start"
        return rejected_alignment(reference, moving, reason, time.perf_counter() - began)
    if start is None and config.shared_frame:
        start = Pose2()
    expected = pose_of(start)
    if image_after is None:
        image_after = DECISIONS if thorough else ()
    has_finer = (
        thorough
        and found.search == "full"
        and _has_finer(reference, moving, config, window, found, cancel)
    )
    # Where a finer level may yet bear the pair out, the image waits for it; among walls everywhere
    # an image fits as anything does.
    is_cut = found.coarse is not None and found.coarse.is_cut
    found = replace(found, image_after=() if has_finer or is_cut else image_after)
    pair = judge(reference, moving, config, device, found, expected, pairs, began, cancel)
    if pair.accepted or not has_finer:
        return pair
    found = _searched_finer(reference, moving, config, window, device, found, cancel)
    found = replace(found, image_after=image_after)
    return judge(reference, moving, config, device, found, expected, pairs, began, cancel)


def _has_finer(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    found: Found,
    cancel: CancelToken | None,
) -> bool:
    """Whether walls filled the coarsest level, and there is a finer one to search."""
    if found.coarse is None:
        return False
    step, cells = found.coarse.step, config.coarse_cells
    return finer_step(reference, moving, cells, step, window, FINER_CHANCE_MAX, cancel) < step


def _searched_finer(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    device: ComputeDevice,
    found: Found,
    cancel: CancelToken | None,
) -> Found:
    """Search once more from a finer level on; what was found stays a rival."""
    coarse, more, _ = search(reference, moving, config, window, device, cancel, FINER_CHANCE_MAX)
    motions = np.concatenate((more, found.motions))
    sigma = wall_widths(reference)[0]
    values = score_motions(reference, moving, motions, 1, device, sigma=sigma, cancel=cancel)
    motions = motions[np.argsort(-values, kind="stable")]
    return replace(found, coarse=coarse, motions=motions)


def _searched(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    window: SearchWindow,
    device: ComputeDevice,
    cancel: CancelToken | None,
) -> Found:
    """Search; inside a window, with the rivals of everywhere."""
    coarse, motions, _ = search(reference, moving, config, window, device, cancel)
    if not len(motions):
        return Found(motions, coarse, "window")
    if window.shift_cells is None and window.yaw_rad >= math.pi:
        return Found(motions, coarse, "full")
    shift = float(max(*reference.shape, *moving.shape))
    if window.shift_cells is not None:
        shift = min(shift, window.shift_cells)
    prior = prior_within(reference, moving, shift, window.yaw_rad)
    # What stands out among few yaws and shifts stands out of nothing.
    _, others, _ = search(reference, moving, config, SearchWindow(), device, cancel)
    everything = np.concatenate((motions, others))
    return Found(everything, coarse, "window", prior, candidates=len(motions))


def track_features(
    reference: GridFeatures,
    moving: GridFeatures,
    device: ComputeDevice,
    start: Pose2,
    cancel: CancelToken | None = None,
) -> Alignment:
    """Refine a known transform without a search; the decision rests on the fit alone.

    Args:
        reference, moving: the grids.
        device: computes.
        start: pose of the moving map frame in the reference's, within about half a metre and a few
            degrees.
        cancel: asked before each operation.

    Raises:
        CancelledSearchError: ``cancel`` says so.
    """
    began = time.perf_counter()
    motion = settle(reference, moving, motion_of(reference, moving, start)[None], device, cancel)
    found = Found(motion, None, "tracked")
    return judge(reference, moving, AlignConfig(), device, found, start, 1, began, cancel)


def _window(
    reference: GridFeatures,
    moving: GridFeatures,
    config: AlignConfig,
    start: Pose2 | StartPose | None,
) -> SearchWindow:
    """Return the search window in lattice cells: a start's own tolerances, or the settings'."""
    metres, yaw_rad = config.window_m, config.window_yaw_rad
    if isinstance(start, StartPose):
        metres, yaw_rad = start.metres, min(start.radians, math.pi)
    motion = motion_of(reference, moving, pose_of(start) or Pose2())
    x, y, yaw = (float(value) for value in motion)
    shift = None if metres is None else metres / reference.grid.grid.resolution
    if shift is not None and shift >= max(abs(x), abs(y)) + 2 * sum(
        max(features.shape) for features in (reference, moving)
    ):
        shift = None  # the window holds every place where the two maps meet
    if start is None and yaw_rad >= math.pi:
        yaw = 0.0
    return SearchWindow((x, y, yaw), shift, yaw_rad)


def _meets(reference: GridFeatures, moving: GridFeatures, window: SearchWindow) -> bool:
    """Whether the two maps, boxes in their circles, can meet at all inside a window."""
    if window.shift_cells is None:
        return True
    height, width = reference.shape
    reach = window.shift_cells + math.hypot(*moving.shape) / 2.0
    x, y, _ = window.start
    return -reach <= x <= width + reach and -reach <= y <= height + reach
