"""The fused map of one drive: the maps of several producers, and how far their paths are apart.

Shared by ``run_log`` and the experiments, which so measure what a user gets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from slamfusion.align.records import Alignment, FusionResult
from slamfusion.align.starts import Starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.fusion.path_check import PathGap, PathsApartError, fallback_map, fuse_with_paths
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.inputs import Progress
from slamfusion.slam.registry import loop_closers
from slamfusion.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class DriveFusion:
    """The result of fusing the maps of one drive.

    Attributes:
        result: the fusion; None where nothing was fused.
        gaps: between the producers' paths in the fused frame.
        fallback: where nothing was fused, the map to go on with: whose walls the others' fit
            best, or the only one; None where there is a fusion, or no map.
        failure: why nothing was fused; None where it was.
    """

    result: FusionResult | None = None
    gaps: tuple[PathGap, ...] = ()
    pairs: tuple[Alignment, ...] = ()
    fallback: OccupancyGrid | None = None
    failure: AlignmentError | None = None


def fuse_drive(
    grids: Sequence[OccupancyGrid],
    paths: Mapping[str, Trajectory],
    config: RunConfig,
    device: ComputeDevice,
    *,
    shared_frame: bool,
    progress: Progress | None = None,
    starts: Starts | None = None,
) -> DriveFusion:
    """Fuse the maps of a drive, and compare the producers' paths in the fused frame.

    All producers begin in one frame, the odometry's. The search is full all the same: a lost
    producer must not be pulled into place. The common frame only decides between answers that fit
    equally well, in places that look alike under two turns. Saved maps may have any frame, so with
    them the settings decide.

    Returns:
        The fusion; where there are too few maps, or too few fit, why there is none.
    """
    if len(grids) < LEAST_FUSED:
        failure = AlignmentError(f"a vote needs at least {LEAST_FUSED} maps, found {len(grids)}")
        return DriveFusion(fallback=grids[0] if grids else None, failure=failure)
    fusion = config.fusion
    if shared_frame:
        fusion = replace(fusion, align=replace(fusion.align, shared_frame=True))
    limit_m = config.run.path_gap_m
    try:
        result, gaps = fuse_with_paths(grids, paths, fusion, limit_m, device, progress, starts)
    except AlignmentError as error:
        return DriveFusion(
            gaps=error.gaps if isinstance(error, PathsApartError) else (),
            pairs=error.pairs,
            fallback=fallback_map(grids, error.pairs, loop_closers(paths)),
            failure=error,
        )
    return DriveFusion(result, gaps)
