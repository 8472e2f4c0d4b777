"""The map that is drawn from all scans of a log at the fused path: the fused one, or beside it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.evidence.drawn_fusion import fuse_with_drawn
from slamfusion.evidence.drawn_map import DrawnScan
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.defaults import RUN_VOTE
from slamfusion.jobs.fuse_drive import DriveFusion
from slamfusion.jobs.fused_path import DrivePath, draw_like

DRAWN_MODE = "drawn"
NO_PATH = "fewer than two producers have a path, so there is no fused path to draw at"


@dataclass(frozen=True, eq=False)
class DrawnRun:
    """What came of drawing the map of a run.

    Attributes:
        fusion: the fusion, with the drawn map in place of the vote where that was asked for.
        beside: the drawn map that was asked for beside the fused one; None: it was not, or could
            not be drawn.
        why_voted: why the maps voted although the drawn map was asked for; None where they did not,
            or where nothing was asked for or fused.
    """

    fusion: DriveFusion
    beside: OccupancyGrid | None = None
    why_voted: str | None = None


def is_drawn(config: RunConfig) -> bool:
    """Whether a map is to be drawn from the scans: as the fused one, or beside it."""
    return config.run.draw or config.fusion.vote.mode == DRAWN_MODE


def voting_config(config: RunConfig) -> RunConfig:
    """Return the settings under which maps vote: of ``drawn`` those of the vote in its place."""
    if config.fusion.vote.mode != DRAWN_MODE:
        return config
    vote = replace(config.fusion.vote, mode=RUN_VOTE)
    return replace(config, fusion=replace(config.fusion, vote=vote))


def draw_run(
    scans: Callable[[], Sequence[DrawnScan]],
    path: DrivePath | None,
    fusion: DriveFusion,
    saved: Collection[str],
    config: RunConfig,
    device: ComputeDevice,
) -> DrawnRun:
    """Draw the map of a log at the fused path, as the fused map or beside it, as was asked for.

    Args:
        scans: returns those of the log; called where something is drawn.
        path: the fused path; None where there is none.
        fusion: of the maps, by vote.
        saved: names of inputs whose paths are not in the fused one: they vote beside what is drawn.
        config: ``fusion.vote.mode`` and ``run.draw`` say what is wanted.
        device: draws.
    """
    is_mode = config.fusion.vote.mode == DRAWN_MODE
    if fusion.result is None or not is_drawn(config):
        return DrawnRun(fusion)
    if path is None:
        return DrawnRun(fusion, why_voted=NO_PATH if is_mode else None)
    try:
        layer = draw_like(scans(), path.trajectory, device, fusion.result.fused)
        result = fusion.result
        if is_mode:
            result = fuse_with_drawn(result, layer, saved, config.fusion, device)
    except SlamFusionError as error:
        return DrawnRun(fusion, why_voted=str(error) if is_mode else None)
    return DrawnRun(replace(fusion, result=result), layer if config.run.draw else None)
