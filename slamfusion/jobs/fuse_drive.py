"""The maps that several producers made of one drive become one, or the best founded one is named.

Shared by ``run_log`` and the experiments, which so measure what a user gets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError
from slamfusion.fusion.path_check import (
    LEAST_FUSED,
    PathGap,
    PathsApartError,
    best_founded,
    fuse_with_paths,
)
from slamfusion.fusion.records import Alignment, FusionResult
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.inputs import Progress
from slamfusion.trajectory import Trajectory

__all__ = ["DriveFusion", "fuse_drive"]


@dataclass(frozen=True, eq=False)
class DriveFusion:
    """What came of fusing the maps of one drive.

    Attributes:
        result: the fusion; None where nothing was fused.
        gaps: between the producers' paths in the fused frame.
        pairs: where nothing was fused, what was aligned.
        best_founded: where nothing was fused, the map to go on with: whose walls the others' fit
            best, or the only one; None where there is a fusion, or no map.
        failure: why nothing was fused; None where it was.
    """

    result: FusionResult | None = None
    gaps: tuple[PathGap, ...] = ()
    pairs: tuple[Alignment, ...] = ()
    best_founded: OccupancyGrid | None = None
    failure: AlignmentError | None = None


def fuse_drive(
    grids: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    config: RunConfig,
    device: ComputeDevice,
    *,
    shared_frame: bool,
    progress: Progress | None = None,
) -> DriveFusion:
    """Fuse the maps, and hold the producers' paths against each other in the fused frame.

    All producers begin in one frame, the odometry's. The search is full all the same: a lost
    producer must not be pulled into place. The common frame only decides between answers that fit
    equally well, in places that look alike under two turns. Saved maps may have any frame, so with
    them the settings decide.

    Args:
        grids: of distinct names.
        paths: those that were found with the producers' maps, by name.
        config: ``fusion``, and ``run.path_gap_m``.
        device: computes.
        shared_frame: all maps are of producers of this drive.
        progress: told the stage, and how much of it is done.

    Returns:
        The fusion; where there are too few maps, or too few fit, why there is none.
    """
    if len(grids) < LEAST_FUSED:
        count = len(grids) or "none"
        failure = AlignmentError(f"{count} of at least {LEAST_FUSED} maps that a vote needs")
        return DriveFusion(best_founded=grids[0] if grids else None, failure=failure)
    fusion = config.fusion
    if shared_frame:
        fusion = replace(fusion, align=replace(fusion.align, shared_frame=True))
    try:
        result, gaps = fuse_with_paths(
            grids, paths, fusion, config.run.path_gap_m, device, progress
        )
    except AlignmentError as error:
        return DriveFusion(
            gaps=error.gaps if isinstance(error, PathsApartError) else (),
            pairs=error.pairs,
            best_founded=best_founded(grids, error.pairs),
            failure=error,
        )
    return DriveFusion(result, gaps)
