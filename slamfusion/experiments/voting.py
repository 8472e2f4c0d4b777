"""The maps of one drive, voted on in every way, and how far each map is from the truth."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import get_args

import numpy as np

from slamfusion.align.align import align_grids
from slamfusion.align.records import FusionResult
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig, RunConfig, VoteMode
from slamfusion.errors import GridError
from slamfusion.evaluation import MapError, compare_to_truth
from slamfusion.fusion.pipeline import vote_again
from slamfusion.geometry import wrap_angle
from slamfusion.grid import IDENTITY, UNKNOWN, OccupancyGrid
from slamfusion.jobs.partial import Layers, fuse_layers

# Every way to vote.
FUSIONS: tuple[VoteMode, ...] = get_args(VoteMode)
PLAIN: VoteMode = "majority"
# A map that is turned by more against the true one lies wrong where both head alike, radians.
MOST_TURN_RAD = 0.5 * math.pi


def vote_every_way(
    layers: Layers,
    config: RunConfig,
    device: ComputeDevice,
    notes: dict[str, str],
    *,
    shared_frame: bool = True,
) -> dict[str, OccupancyGrid | None]:
    """Return the fused map of every way to vote; all have the same voters, or the same one map.

    Args:
        layers: what takes part of the producers' maps.
        config: settings of the fusion.
        device: computes.
        notes: told, by method, what went wrong.
        shared_frame: all maps are of producers of this drive.

    Returns:
        By way to vote; None where there is no map at all.
    """
    if not layers.maps:
        notes[PLAIN] = "no map was made"
        return dict.fromkeys(FUSIONS)
    notes |= {f"{PLAIN}, {vote.name} in part": vote.sentence() for vote in layers.partial}
    plain = _vote_plainly(layers, config, device, notes, shared_frame=shared_frame)
    if isinstance(plain, OccupancyGrid):
        return dict.fromkeys(FUSIONS, plain)
    return {mode: vote_again(plain, _voting(config.fusion, mode), device).fused for mode in FUSIONS}


def _vote_plainly(
    layers: Layers,
    config: RunConfig,
    device: ComputeDevice,
    notes: dict[str, str],
    *,
    shared_frame: bool,
) -> FusionResult | OccupancyGrid:
    """Return the plain vote, or the map to go on with alone; ``notes`` say what went wrong."""
    first, *others = layers.grids
    if not others:
        notes[PLAIN] = f"{first.name} alone: it made the only map"
        return first
    config = replace(config, fusion=_voting(config.fusion, PLAIN))
    fusion = fuse_layers(layers, config, device, shared_frame=shared_frame)
    if fusion.result is None:
        best = fusion.fallback or first
        notes[PLAIN] = f"{best.name} alone: {fusion.failure}"
        return best
    for record in fusion.result.rejected:
        notes[f"{PLAIN} without {record.name}"] = record.reason
    return fusion.result


def _voting(config: FusionConfig, mode: VoteMode) -> FusionConfig:
    return replace(config, vote=replace(config.vote, mode=mode))


def against_truth(
    grid: OccupancyGrid | None,
    truth: OccupancyGrid,
    config: RunConfig,
    device: ComputeDevice,
    *,
    same_heading: bool = False,
) -> MapError:
    """Measure a map where it lies best on the truth: in the truth's frame, or aligned to it.

    Aligned is where its walls fit best, or next best.

    Args:
        grid: None is a map that knows nothing.
        truth: decides lattice and box.
        config: thresholds, search (never the fixed-step one) and tolerance.
        device: computes.
        same_heading: both frames head nearly alike, as those of a simulated drive and of its world
            do: an alignment that turns the map by more than a quarter is none. In a room that looks
            nearly the same turned round, a wrong one can have the smaller error.
    """
    nothing = np.full((1, 1), UNKNOWN, dtype=np.int8)
    known = grid or OccupancyGrid(nothing, truth.resolution, truth.origin, "nothing")
    transforms = [IDENTITY]
    align = replace(config.fusion.align, step=None)
    settings = replace(config.fusion, align=align)
    if grid is not None:
        with suppress(GridError):  # not one known cell: it lies as well anywhere
            found = align_grids(truth, grid, settings, device)
            transforms.append(found.transform)
            # Of a map in two pieces each lies somewhere, and their scores are as good as equal.
            if found.runner_up is not None:
                transforms.append(found.runner_up.transform)
    if same_heading:
        transforms = [item for item in transforms if abs(wrap_angle(item.yaw_rad)) <= MOST_TURN_RAD]
    errors = [
        compare_to_truth(
            known,
            truth,
            transform,
            normalize=config.fusion.normalize,
            tolerance_m=config.evaluate.tolerance_m,
        )
        for transform in transforms
    ]
    return min(errors, key=lambda item: item.error)
