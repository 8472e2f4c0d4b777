"""Several producers on one drive: their maps, and the one that these become.

Shared by ``run_log`` and the experiments, which so measure what a user gets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from slamfusion.align.records import Alignment, FusionResult
from slamfusion.align.starts import Starts
from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError, SlamFusionError
from slamfusion.fusion.groups import LEAST_FUSED
from slamfusion.fusion.path_check import (
    PathGap,
    PathsApartError,
    Votes,
    fallback_map,
    fuse_with_paths,
)
from slamfusion.grid import OccupancyGrid
from slamfusion.io import LogScan
from slamfusion.jobs.inputs import Progress
from slamfusion.slam.common.runner import run_producer
from slamfusion.slam.registry import loop_closers, make_producer
from slamfusion.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class DriveMaps:
    """What producers made of a drive.

    Attributes:
        maps: by producer; None where it made none.
        paths: found with the maps, by producer.
        reasons: why a producer made no map, by producer.
    """

    maps: Mapping[str, OccupancyGrid | None]
    paths: Mapping[str, Trajectory]
    reasons: Mapping[str, str]

    @property
    def grids(self) -> list[OccupancyGrid]:
        """The maps that were made, in order."""
        return [grid for grid in self.maps.values() if grid is not None]


def produce_maps(
    scans: Mapping[str, Sequence[LogScan]],
    config: RunConfig,
    device: ComputeDevice,
    progress: Progress | None = None,
) -> DriveMaps:
    """Run producers on scans in memory, one after the other; one that fails is named.

    Args:
        scans: what each producer is fed, by its name in the registry.
        config: settings of the producers.
        device: computes.
        progress: told the producer, and the scans that it has been fed.
    """
    maps: dict[str, OccupancyGrid | None] = {}
    paths: dict[str, Trajectory] = {}
    reasons: dict[str, str] = {}
    for name, items in scans.items():

        def tell(done: int, name: str = name, total: int = len(items)) -> None:
            if progress is not None:
                progress(name, done, total)

        try:
            run = run_producer(make_producer(name, config, device), items, progress=tell)
        except SlamFusionError as error:
            maps[name], reasons[name] = None, str(error)
            continue
        maps[name], paths[name] = run.grid, run.trajectory
    return DriveMaps(maps, paths, reasons)


@dataclass(frozen=True, eq=False)
class DriveFusion:
    """What came of fusing the maps of one drive.

    Attributes:
        result: the fusion; None where nothing was fused.
        gaps: between the producers' paths in the fused frame.
        pairs: where nothing was fused, what was aligned.
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
    votes: Votes | None = None,
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
        starts: see ``fuse_grids``.
        votes: see ``fuse_with_paths``.

    Returns:
        The fusion; where there are too few maps, or too few fit, why there is none.
    """
    if len(grids) < LEAST_FUSED:
        count = len(grids) or "none"
        failure = AlignmentError(f"{count} of at least {LEAST_FUSED} maps that a vote needs")
        return DriveFusion(fallback=grids[0] if grids else None, failure=failure)
    fusion = config.fusion
    if shared_frame:
        fusion = replace(fusion, align=replace(fusion.align, shared_frame=True))
    try:
        result, gaps = fuse_with_paths(
            grids, paths, fusion, config.run.path_gap_m, device, progress, starts, votes
        )
    except AlignmentError as error:
        return DriveFusion(
            gaps=error.gaps if isinstance(error, PathsApartError) else (),
            pairs=error.pairs,
            fallback=fallback_map(grids, error.pairs, loop_closers(paths)),
            failure=error,
        )
    return DriveFusion(result, gaps)
